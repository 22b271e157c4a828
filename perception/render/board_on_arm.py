"""A printed board on the last link, as the camera sees it, and the recording of the joints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from brokk_rl import record
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import Session, write_text
from brokk_rl.spec import Positive, spec
from perception.calibrate.arm import compute_link_poses
from perception.calibrate.transforms import make_transform
from perception.label.camera_pose import Charuco
from perception.render.scene_ranges import Scene, SceneRanges
from perception.render.scene_sampler import SceneSampler
from perception.render.solids import (
    Box,
    Hits,
    Material,
    SolidPose,
    Surface,
    build_frame,
    build_rods,
)
from perception.render.stereo_camera import StereoRig, measure_disparity_error

SQUARE_PX = range(100, 1001)
"""Sides of a square from which the one is taken that puts the edges of its markers on pixels."""
LARGEST_PX = 5e-3
"""Such an edge may lie this far from a pixel's, as a part of the square: 0.5 mm of 100 mm."""
PRINTED, INK = 4, 6
"""Parts of a plate: the side that is printed (-z), and the ink on it."""
PLATE_M = 0.01
"""Thickness of the plate; chosen by hand."""
PAPER = Material((0.8, 0.8, 0.8), 0.01, 0.001)
BLACK = Material((0.03, 0.03, 0.03), 0.05, 0.001)


def draw_board_picture(board: Charuco) -> np.ndarray:
    """Return the board in pixels, `(h, w)` uint8, with the edges of its markers on theirs.

    Raises:
        ConfigError: the dictionary has too few markers, or the markers' edges fit no pixels.
    """
    drawn = board.describe()
    markers = drawn.getDictionary()
    needed, there = board.columns * board.rows // 2, len(markers.bytesList)
    if needed > there:
        raise ConfigError(
            f"board.dictionary={board.dictionary}: it has {there} markers, {board.columns} x "
            f"{board.rows} squares need {needed}"
        )
    # A marker has a black border of one module on each side.
    modules, ratio = markers.markerSize + 2, board.marker_m / board.square_m
    misses = {}
    for side in SQUARE_PX:
        marker = modules * max(round(side * ratio / modules), 1)
        is_even = (side - marker) % 2 == 0
        misses[side] = abs(marker / side - ratio) if is_even else np.inf
    side = min(misses, key=misses.__getitem__)
    if misses[side] > LARGEST_PX:
        raise ConfigError(
            f"board.marker_m={board.marker_m:g}: its modules fit no pixels; expected three "
            f"quarters of square_m, {0.75 * board.square_m:g}"
        )
    return drawn.generateImage((board.columns * side, board.rows * side), marginSize=0)


MATERIALS = (*(PAPER,) * INK, BLACK)


@dataclass(frozen=True)
class PrintedPlate(Box):
    """A plate with a printed side; edges of the print are exact, as they are parts of the solid.

    x and y of its pose are as on the print, z is away from who looks at it. Parts: the six faces of
    a box, and the ink.

    Attributes:
        is_ink: The print, `(h, w)` bool, in the middle of the plate.
        pixel_m: Side of one of its pixels.
    """

    is_ink: np.ndarray
    pixel_m: float

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Return where rays meet the plate, on ink or beside it."""
        hits = super().hit(origin, direction)
        rows = np.flatnonzero(np.isfinite(hits.t) & (hits.part == PRINTED))
        start, along = self.pose.local(
            origin if origin.ndim == 1 else origin[rows], direction[rows]
        )
        place = (start + hits.t[rows, None] * along)[:, :2] / np.float32(self.pixel_m)
        size = np.array(self.is_ink.shape[::-1])
        column, row = np.floor(place + size / 2).astype(int).T
        inside = (column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])
        hits.part[rows[inside][self.is_ink[row[inside], column[inside]]]] = INK
        return hits

    def surface(self, point: np.ndarray, part: np.ndarray, to_sun: np.ndarray) -> Surface:
        """Describe faces; ink lies on the printed one."""
        return super().surface(point, np.where(part == INK, PRINTED, part), to_sun)


def build_plate(board: Charuco, from_board: np.ndarray, margin_m: float) -> PrintedPlate:
    """Return a plate with a board on it.

    Args:
        board: The print.
        from_board: Pose of the board's own frame, `(4, 4)`: origin at its corner, x and y along its
            sides, z away from who looks at it.
        margin_m: White margin around the print.
    """
    size_m = np.array([board.columns, board.rows]) * board.square_m
    picture = draw_board_picture(board)
    middle = np.array([*size_m / 2, PLATE_M / 2])
    return PrintedPlate(
        "board",
        SolidPose(from_board[:3, :3], from_board[:3, :3] @ middle + from_board[:3, 3]),
        np.array([*(size_m / 2 + margin_m), PLATE_M / 2]),
        MATERIALS,
        picture < 128,
        float(size_m[0] / picture.shape[1]),
    )


JOINTS, TRUTH = "joints.parquet", "truth.yaml"
TRIES = 2000
"""Poses that are drawn until one shows the board."""
BORDER_PX = 8
"""Corners of the board stay as far from the picture's border."""
FACING = 0.5
"""Least cosine between the board's normal and the line of sight: 60 degrees."""
GROUND_M = 0.0
"""Height of the ground in the base frame."""
BOOM_M, CHISEL_M = 0.09, 0.04
"""Radii of the drawn links and of the tool; chosen by hand."""


@spec
class BoardOnArm:
    """A board on the last link while the arm moves from pose to pose.

    Attributes:
        name: In truth files and tables.
        kind: Ranges of surroundings and light; its block is left out.
        machine: The arm.
        board: The board, before the tool's tip in the middle pose, where it faces the camera.
        margin_m: White margin around its print.
        ahead_m: How far the board is nearer to the camera than the tip.
        middle: Joint positions of the middle pose, rad or m.
        spread: Largest departure of each joint from it.
        move_s: Duration of a move.
        rest_s: Rest between two moves.
        rate_hz: Frame rate.
        clock_s: Time to add to that of a frame to have the recording's.
        zero_std_rad: Standard deviation of the zeros of the joints between the first and the last;
            no camera can tell those two.
        sensor_std_rad: Standard deviation of the measured joint positions.
    """

    name: str
    kind: SceneRanges
    machine: Machine
    board: Charuco
    margin_m: float
    ahead_m: float
    middle: tuple[float, ...]
    spread: tuple[float, ...]
    move_s: Positive
    rest_s: Positive
    rate_hz: Positive
    clock_s: float
    zero_std_rad: float
    sensor_std_rad: float

    def check(self) -> None:
        if not len(self.middle) == len(self.spread) == self.machine.num_joints:
            raise ConfigError(
                f"middle: expected it and spread of {self.machine.num_joints} joints, got "
                f"{len(self.middle)} and {len(self.spread)}"
            )


class BoardScenes:
    """The frames of one recording.

    Raises:
        ConfigError: the board cannot be drawn, or is not seen.
    """

    def __init__(self, settings: BoardOnArm, rig: StereoRig, session: Session) -> None:
        self._settings, self._rig, self._session = settings, rig, session
        self._camera_from_base = np.linalg.inv(rig.base_from_camera)
        self._poses: dict[int, np.ndarray] = {}
        self._link_from_board = self._attach_board()
        inner = np.zeros(settings.machine.num_joints)
        inner[1:-1] = settings.zero_std_rad
        self._zeros = inner * session.generator("scene/zeros").standard_normal(len(inner))

    def compose(self, number: int) -> tuple[Scene, np.random.Generator]:
        """Return the scene at the time of frame `number`, and the source of its noise.

        Raises:
            ConfigError: no pose shows the board.
        """
        settings, generator = self._settings, self._session.generator(f"scene/{number}")
        q = self._read_joints(number / settings.rate_hz + settings.clock_s)
        plate = build_plate(settings.board, self._compute_board(q), settings.margin_m)
        tool = compute_tool_kinematics(settings.machine, q[None])
        in_base_m = np.stack([*tool.joints_in_base_m[0], tool.tip_in_base_m[0]])
        points_m = in_base_m @ self._camera_from_base[:3, :3].T + self._camera_from_base[:3, 3]
        solids = (*build_rods(points_m, BOOM_M, CHISEL_M), plate)
        # The surroundings are drawn by the same numbers for each frame.
        scenery = self._session.generator("scene/surroundings")
        target = self._compute_board(np.array(settings.middle))[:3, 3]
        normal = -target / np.linalg.norm(target)
        ground_m = float(self._rig.base_from_camera[2, 3]) - GROUND_M
        sampler = SceneSampler(settings.kind, self._rig, scenery)
        return sampler.surround(None, solids, target, normal, ground_m), generator

    def write_records(self, folder: Path, count: int) -> None:
        """Write the recording of the joints, and the numbers that a calibration should find."""
        settings, machine = self._settings, self._settings.machine
        last_s = (count - 1) / settings.rate_hz + abs(settings.clock_s) + 1.0
        t_s = np.arange(0.0, last_s, machine.period_s)
        true = np.stack([self._read_joints(one) for one in t_s])
        noise = self._session.generator("scene/sensors").standard_normal(true.shape)
        speed = np.gradient(true, t_s, axis=0)
        recording = Recording(
            machine=machine.name,
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=t_s,
            u=np.clip(speed / machine.max_speed, -1.0, 1.0),
            q=true - self._zeros + settings.sensor_std_rad * noise,
            metadata={"source": "rendered"},
        )
        record.write_recording(recording, folder / JOINTS)
        zeros = dict(zip(machine.joint_names, self._zeros.round(6).tolist(), strict=True))
        truth = {
            "T_base_cam": self._rig.base_from_camera.round(9).tolist(),
            "clock_s": settings.clock_s,
            "joint_zeros": zeros,
            "disparity_error_px": [round(one, 4) for one in measure_disparity_error(self._rig)],
        }
        write_text(folder / TRUTH, yaml.safe_dump(truth, sort_keys=False, default_flow_style=None))

    def _attach_board(self) -> np.ndarray:
        """Return the board on the link, `(4, 4)`: it faces the camera in the middle pose."""
        settings = self._settings
        link = compute_link_poses(settings.machine, np.array([settings.middle])).base_from_link[0]
        tip = self._camera_from_base[:3, :3] @ link[:3, 3] + self._camera_from_base[:3, 3]
        middle = tip * (1.0 - settings.ahead_m / np.linalg.norm(tip))
        size_m = np.array([settings.board.columns, settings.board.rows]) * settings.board.square_m
        turn = build_frame(middle, 0.0)
        corner = middle - turn[:, :2] @ (size_m / 2)
        return np.linalg.inv(link) @ self._rig.base_from_camera @ make_transform(turn, corner)

    def _compute_board(self, q: np.ndarray) -> np.ndarray:
        """Return the board in the camera at true joint positions, `(4, 4)`."""
        link = compute_link_poses(self._settings.machine, q[None]).base_from_link[0]
        return self._camera_from_base @ link @ self._link_from_board

    def _read_joints(self, t_s: float) -> np.ndarray:
        """Return the true joint positions: rests, and moves that start and stop smoothly."""
        settings = self._settings
        number, into_s = divmod(max(t_s, 0.0), settings.move_s + settings.rest_s)
        share = min(max(into_s - settings.rest_s, 0.0) / settings.move_s, 1.0)
        begin, end = self._draw_pose(int(number)), self._draw_pose(int(number) + 1)
        return begin + (0.5 - 0.5 * math.cos(math.pi * share)) * (end - begin)

    def _draw_pose(self, number: int) -> np.ndarray:
        """Return joint positions at which the camera sees the whole board."""
        if number in self._poses:
            return self._poses[number]
        settings, machine = self._settings, self._settings.machine
        generator = self._session.generator(f"scene/pose/{number}")
        width = settings.board.columns * settings.board.square_m
        height = settings.board.rows * settings.board.square_m
        corners = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]])
        for _ in range(TRIES):
            chance = generator.uniform(-1, 1, machine.num_joints)
            q = np.clip(settings.middle + chance * settings.spread, machine.lower, machine.upper)
            board = self._compute_board(q)
            points_m = corners @ board[:3, :3].T + board[:3, 3]
            sight = points_m.mean(0) / np.linalg.norm(points_m.mean(0))
            faces = board[:3, 2] @ sight > FACING
            if faces and self._rig.left.is_inside(points_m, BORDER_PX):
                self._poses[number] = q
                return q
        raise ConfigError(
            f"scene={settings.name}: no pose about scene.middle={list(settings.middle)} shows the "
            "board to the camera; choose another pose or rig"
        )
