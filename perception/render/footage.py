"""Footage: one block beside a board, and a camera that is carried around both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl.errors import ConfigError
from brokk_rl.session import Session, write_text
from brokk_rl.spec import NonNegative, Range, spec
from perception.label.camera_pose import Charuco
from perception.render.drilled_block import DrilledBlock
from perception.render.printed_board import PrintedPlate, build_plate
from perception.render.scene_ranges import SceneRanges, draw_uniform, view_from
from perception.render.scene_sampler import compose_scene, compute_hidden_share
from perception.render.scene_sequence import StagedScene, build_pose
from perception.render.stereo_camera import StereoRig

CAMERAS, PLACING, MEASURED = "cameras.yaml", "placing.yaml", "measured.yaml"
TRIES = 2000
"""Camera places that are drawn until one shows block and board."""
BORDER_PX = 8
"""Corners of block and board stay as far from the picture's border."""
LOWEST_M = 0.3
"""The camera stays as far above the ground; chosen by hand."""


@spec
class Footage:
    """A block and a board that stand still, seen from many places.

    Attributes:
        name: In truth files and tables.
        kind: Ranges that block, surroundings and light are drawn from, once.
        board: The board; it stands beside the drilled face and faces as that does.
        margin_m: White margin around its print.
        gap_m: Between the face's edge and the plate.
        distance_m: From the camera to the middle between face and board.
        obliquity_rad: Between the face's normal and the line of sight.
        roll_rad: Largest turn about the line of sight.
        click_px: How far the clicks of `placing.yaml` are from the corners.
    """

    name: str
    kind: SceneRanges
    board: Charuco
    margin_m: NonNegative
    gap_m: NonNegative
    distance_m: Range
    obliquity_rad: Range
    roll_rad: NonNegative
    click_px: NonNegative

    def check(self) -> None:
        if self.kind.block.present < 1.0 or self.kind.block.holes[0] < 1:
            raise ConfigError(
                "kind: expected a block with a hole (kind.block.present=1, holes of 1 or "
                f"more), got {self.kind.block.present} and {self.kind.block.holes}"
            )

    def open(self, rig: StereoRig, session: Session) -> FootageScenes:
        """Return the scenes.

        Raises:
            ConfigError: the board cannot be drawn.
        """
        return FootageScenes(self, rig, session)


class FootageScenes:
    """The frames of one footage; see `perception.render.scene_sequence.SceneSequence`."""

    base_from_camera = None

    def __init__(self, settings: Footage, rig: StereoRig, session: Session) -> None:
        self._settings, self._rig, self._session = settings, rig, session
        # Everything is drawn once, in the coordinates of a camera on the machine.
        self._scene = compose_scene(settings.kind, rig, session.generator("scene/block"))
        block = self._scene.block
        assert block is not None  # checked
        self._block = block
        self._plate = _place_board(settings, block, rig.down_in_camera)
        face = block.pose.point(np.array([0.0, 0.0, block.half_m[2]]))
        self._aim = (face + self._plate.pose.center_m) / 2
        self._ground_m = float((block.corners_m @ rig.down_in_camera).max())

    def view(self, number: int) -> StagedScene:
        """Return the scene in the camera coordinates of frame `number`.

        Raises:
            ConfigError: no place of the camera shows block and board.
        """
        generator = self._session.generator(f"scene/{number}")
        first_from_camera = self._draw_place(generator)
        motion = np.linalg.inv(first_from_camera)
        staged = replace(self._scene, solids=(*self._scene.solids, self._plate))
        scene = view_from(staged, motion)
        block = scene.block
        assert block is not None
        to_face = block.pose.center_m - motion[:3, 3]
        conditions = scene.conditions | {
            "distance_m": float(np.linalg.norm(motion[:3, :3] @ self._aim + motion[:3, 3])),
            "obliquity_rad": float(
                np.arccos(np.clip(-block.pose.rotation[:, 2] @ _normalize(to_face), -1, 1))
            ),
            "arm": 0.0,
        }
        moved = replace(
            scene,
            hidden=tuple(compute_hidden_share(scene.solids, block, hole) for hole in block.holes),
            hidden_discs=tuple(
                compute_hidden_share(scene.solids, block, disc) for disc in block.discs
            ),
            conditions=conditions,
        )
        return StagedScene(moved, self._rig.base_from_camera @ first_from_camera, generator)

    def write_records(self, folder: Path, count: int) -> None:
        """Write true camera poses, clicks for `mode=label`, and holes on the board for `mode=score_camera`."""
        poses = {}
        for number in range(count):
            poses[f"{number:05d}"] = self.view(number).base_from_camera.tolist()
        write_text(folder / CAMERAS, yaml.safe_dump(poses, default_flow_style=None, width=132))
        block = self.view(0).scene.block
        assert block is not None
        half = block.half_m
        signs = np.array([[-1, -1, 1], [1, -1, 1], [-1, 1, 1]])
        generator = self._session.generator("scene/clicks")
        mouths = []
        for hole in block.holes:
            center_px = self._click(block.pose.point(hole.center_m)[None], generator)[0]
            mouths.append({"center_px": center_px, "radius_m": float(hole.radius_m)})
        placing = {
            "frame": f"{0:05d}",
            "corners_px": self._click(block.pose.point(signs * half), generator),
            "thickness_m": float(2 * half[2]),
            "mouths": mouths,
        }
        write_text(folder / PLACING, yaml.safe_dump(placing, sort_keys=False))
        write_text(folder / MEASURED, yaml.safe_dump(self._measure_holes(), sort_keys=False))

    def _measure_holes(self) -> dict[str, Any]:
        """Return the holes in the board's frame, as a caliper would measure them."""
        board, plate = self._settings.board, self._plate
        size_m = np.array([board.columns, board.rows]) * board.square_m
        corner = plate.pose.point(np.array([*(-size_m / 2), -plate.half_m[2]]))
        holes = []
        for number, hole in enumerate(self._block.holes, 1):
            center = self._block.pose.point(hole.center_m)
            local = (center - corner) @ plate.pose.rotation
            axis = self._block.pose.rotation @ hole.outward @ plate.pose.rotation
            holes.append(
                {
                    "name": f"hole {number}",
                    "center_m": local.round(6).tolist(),
                    "axis": axis.round(6).tolist(),
                    "radius_m": float(hole.radius_m),
                }
            )
        return {"std_m": 0.0, "holes": holes}

    def _click(self, points_m: np.ndarray, generator: np.random.Generator) -> list[list[float]]:
        """Return where a person clicks who misses points of the first frame by `click_px`."""
        angle = generator.uniform(-np.pi, np.pi, len(points_m))
        miss = self._settings.click_px * np.stack([np.cos(angle), np.sin(angle)], 1)
        return np.round(self._rig.left.project(points_m) + miss, 1).tolist()

    def _draw_place(self, generator: np.random.Generator) -> np.ndarray:
        """Return a camera that shows block and board, `(4, 4)`, in the first coordinates."""
        settings, down = self._settings, self._rig.down_in_camera
        normal = self._block.pose.rotation[:, 2]
        half = self._block.half_m
        signs = np.array([[-1, -1, 1], [1, -1, 1], [-1, 1, 1], [1, 1, 1]])
        points_m = np.concatenate([self._block.pose.point(signs * half), self._plate.corners_m])
        across = _normalize(np.cross(normal, down))
        for _ in range(TRIES):
            lean, azimuth = draw_uniform(settings.obliquity_rad, generator), generator.uniform(0, 7)
            side = np.cos(azimuth) * across + np.sin(azimuth) * np.cross(normal, across)
            toward = np.cos(lean) * normal + np.sin(lean) * side
            place = self._aim + draw_uniform(settings.distance_m, generator) * toward
            pose = _look_at(
                place, self._aim, down, draw_uniform((-1, 1), generator) * settings.roll_rad
            )
            if place @ down > self._ground_m - LOWEST_M:
                continue
            if self._rig.left.is_inside((points_m - place) @ pose[:3, :3], BORDER_PX):
                return pose
        raise ConfigError(
            f"scene={settings.name}: no place of the camera from {settings.distance_m} m shows "
            "block and board; choose larger scene.distance_m or a smaller block"
        )


def _place_board(settings: Footage, block: DrilledBlock, down: np.ndarray) -> PrintedPlate:
    """Return the board beside a block's drilled face."""
    board, half = settings.board, block.half_m
    rotation = block.pose.rotation
    # Beside the face, on that of its sides which points most to the right of who looks at it.
    right = np.cross(-rotation[:, 2], -down)
    sides = [(axis, sign) for axis in (0, 1) for sign in (1.0, -1.0)]
    axis, sign = max(sides, key=lambda one: one[1] * float(rotation[:, one[0]] @ right))
    x = sign * rotation[:, axis]
    z = -rotation[:, 2]
    turn = np.stack([x, np.cross(z, x), z], 1)
    size_m = np.array([board.columns, board.rows]) * board.square_m
    away = half[axis] + settings.gap_m + settings.margin_m
    face = block.pose.point(np.array([0.0, 0.0, half[2]]))
    corner = face + away * x - size_m[1] / 2 * turn[:, 1]
    return build_plate(board, build_pose(turn, corner), settings.margin_m)


def _look_at(place: np.ndarray, aim: np.ndarray, down: np.ndarray, roll_rad: float) -> np.ndarray:
    """Return a camera at `place` that looks at `aim`, `(4, 4)`."""
    z = _normalize(aim - place)
    y = _normalize(down - z * (z @ down))
    x = np.cross(y, z)
    cos, sin = np.cos(roll_rad), np.sin(roll_rad)
    return build_pose(np.stack([cos * x + sin * y, cos * y - sin * x, z], 1), place)


def _normalize(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
