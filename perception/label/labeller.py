"""Masks for real footage: a block measured in the frame of a board is projected into each frame.

LabelFusion (Marion et al., 2018) does the same with reconstructed and aligned meshes; a box beside a
board needs neither. Depth cuts away what stands before the block.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import yaml
from annotated_types import Interval

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from perception import dataset
from perception.dataset import FrameLabel, SceneTruth, TrueCircle
from perception.label.camera_pose import Charuco
from perception.sources.look import look_at_frames
from perception.stereo import Stereo

EXAMPLE = """lengths are in m, not in mm; expected YAML such as
  std_m: 0.0005   # of the measured centres
  holes:          # in the board's frame: from its corner, x along the top, y down, z into the face
    - {name: A, center_m: [1.120, 0.310, 0.004], axis: [0, 0, -1], radius_m: 0.05}
  block: {corner_m: [-0.20, -0.15, 0.004], size_m: [1.6, 0.9, 0.6]}   # for mode=label: least x, y, z"""
USUAL = {"axis": (0.0, 0.0, -1.0), "radius_m": 0.05}
"""Axis and radius of a hole whose file gives none."""
# Larger numbers are mm. Chosen by hand: no block is longer, and no hole wider.
Coordinate = Annotated[float, Interval(ge=-20, le=20)]
Side = Annotated[float, Interval(gt=0, le=20)]
Radius = Annotated[float, Interval(gt=0, le=1)]


@spec
class MeasuredHole:
    """A hole in the board's frame: centre, axis out of the hole, radius."""

    name: str
    center_m: tuple[Coordinate, Coordinate, Coordinate]
    axis: tuple[float, float, float]
    radius_m: Radius

    def check(self) -> None:
        if not any(self.axis):
            raise ConfigError(f"hole {self.name}: axis: expected a direction, got 0")

    @property
    def outward(self) -> np.ndarray:
        """Unit vector along the axis, `(3,)`."""
        return np.array(self.axis) / np.linalg.norm(self.axis)


@spec
class MeasuredBlock:
    """Corner of a block with the least x, y and z in the board's frame, and its sides along them."""

    corner_m: tuple[Coordinate, Coordinate, Coordinate]
    size_m: tuple[Side, Side, Side]


@spec
class MeasuredScene:
    """Holes and block in the board's frame, whose z axis goes into the drilled face.

    Attributes:
        holes: At least one.
        std_m: Standard deviation of their centres.
        block: The block; `None` where it was not measured.
    """

    holes: tuple[MeasuredHole, ...]
    std_m: Radius
    block: MeasuredBlock | None

    def check(self) -> None:
        if not self.holes:
            raise ConfigError("holes: expected one or more, got none")


def read_measured(path: Path, where: str) -> MeasuredScene:
    """Read what was measured.

    Raises:
        ConfigError: the file cannot be read; the message shows the expected form.
    """
    try:
        told = {"block": None} | yaml.safe_load(path.read_text())
        holes = []
        for number, one in enumerate(told["holes"], 1):
            holes.append(USUAL | one | {"name": str(one.get("name", number))})
        return MeasuredScene(**told | {"holes": holes})
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError, ConfigError) as error:
        raise ConfigError(f"{where}={path}: {type(error).__name__} {error}; {EXAMPLE}") from error


FRAMES, OVERLAYS = "frames", "overlays"
LEAST_STEP_M = 0.02
"""Something nearer than the block by less than this is part of it; chosen by hand."""
PIXELS_PER_SPECK = 400
"""A speck is up to one pixel wide, both ways, per so many pixels of width; chosen by hand."""
GREEN, ORANGE, RED = (0, 158, 115), (230, 159, 0), (213, 94, 0)
"""Of the colour-blind-safe palette (Okabe and Ito)."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _LabelledView:
    """Masks of a frame, and what they rest on.

    Attributes:
        label: The masks.
        depth_share: Part of the block's known depth that agrees with it; `None` for no depth.
        hidden: Part of each mouth that is not seen.
    """

    label: FrameLabel
    depth_share: float | None
    hidden: tuple[float, ...]


@spec
class BlockLabelling:
    """Label a folder of frames of one block that does not move, with a board in view.

    Attributes:
        source: The frames.
        board: The board, in whose frame block and holes were measured.
        measured: YAML file of the measured block and holes; see `perception.label.labeller`.
        noise_per_m: Standard deviation of inverse depth, 1/m.
        stereo: Gives the depth of a pair.
        num_sigma: Depth this many standard deviations off says that something else is there.
        min_depth_share: Least part of the block's known depth that must agree with it.
    """

    source: FrameSourceSpec
    board: Charuco
    measured: str
    noise_per_m: Positive
    stereo: Stereo
    num_sigma: Positive
    min_depth_share: float

    def label(self, folder: Path) -> dict[str, Any]:
        """Write frames with masks, and overlays, into `folder`.

        Returns:
            The content of `labels.json`: figures of each frame, and why frames were left out.

        Raises:
            ConfigError: what was measured cannot be read, or has no block.
            FrameError: no frame can be labelled.
        """
        scene = read_measured(Path(self.measured), "label.measured")
        if scene.block is None:
            raise ConfigError(f"label.measured={self.measured}: expected a block; add `block`")
        corner_m, entries = np.array(scene.block.corner_m), {}
        block_m = np.stack([corner_m, corner_m + scene.block.size_m])

        def label(frame: Frame) -> dict[str, Any]:
            """Write what a frame gives, and return its figures."""
            pose, name = self.board.locate(frame), Path(frame.name).name
            world_from_camera = np.linalg.inv(pose.camera_from_board[0])
            frame = self.stereo.match_frame(frame)
            view = self._build_view(scene, block_m, frame, world_from_camera)
            reason = self._find_fault(view, frame.right is not None)
            picture = _draw_overlay(frame, view.label, reason is None)
            dataset.write_picture(folder / OVERLAYS / f"{name}.png", picture[..., ::-1])
            if reason is None:
                truth = _build_truth(scene, frame, pose.camera_from_board[0], view.hidden)
                stem = folder / FRAMES / name
                dataset.write_frame(stem, frame.color, None, label=view.label, truth=truth)
            return _describe_entry(reason, pose.error_px, view.depth_share)

        for name, entry, reason in look_at_frames(self.source, "masks", label):
            entries[name] = entry or _describe_entry(reason)
        num_labelled = sum(entry["left_out"] is None for entry in entries.values())
        if not num_labelled:
            reasons = sorted({str(entry["left_out"]) for entry in entries.values()})
            raise FrameError(f"no frame could be labelled: {'; '.join(reasons[:3])}")
        return {"schema": 3, "num_labelled": num_labelled, "frames": entries}

    def _find_fault(self, view: _LabelledView, is_pair: bool) -> str | None:
        """Return why a frame is left out, `None` where it is not."""
        if not view.label.block.any():
            return "the block is not in view"
        share = view.depth_share
        if share is None and is_pair:
            return "left and right picture give no depth of the block; are they rectified?"
        if share is not None and share < self.min_depth_share:
            return (
                f"{share:.0%} of the depth agrees with the block, {self.min_depth_share:.0%} are "
                "needed"
            )
        return None

    def _build_view(
        self, scene: MeasuredScene, block_m: np.ndarray, frame: Frame, pose: np.ndarray
    ) -> _LabelledView:
        rays = _compute_pixel_rays(frame) @ pose[:3, :3].T
        block_depth_m = _trace_box(block_m - pose[:3, 3], rays)
        block = np.isfinite(block_depth_m)
        mouths = [block & _trace_mouth(hole, pose[:3, 3], rays) for hole in scene.holes]
        mouth = np.any(mouths, axis=0)
        with np.errstate(invalid="ignore"):
            away = frame.depth_m - np.where(block, block_depth_m, np.nan)
            depth_m = np.where(block, block_depth_m, 0.0)
            step = np.maximum(self.num_sigma * self.noise_per_m * depth_m**2, LEAST_STEP_M)
            near, far = away < -step, (away > step) & ~mouth
        known = block & ~mouth & np.isfinite(frame.depth_m)
        share = float((known & ~near & ~far).sum() / known.sum()) if known.any() else None
        near, far = _remove_specks(near), _remove_specks(far)
        shown = block & ~near & ~far
        hidden = []
        for there in mouths:
            hidden.append(1.0 - float(shown[there].mean()) if there.any() else 1.0)
        return _LabelledView(FrameLabel(shown, shown & mouth, block & near), share, tuple(hidden))


def _describe_entry(
    left_out: str | None, board_px: float | None = None, depth_share: float | None = None
) -> dict[str, Any]:
    return {"left_out": left_out, "board_px": board_px, "depth_share": depth_share}


def _compute_pixel_rays(frame: Frame) -> np.ndarray:
    """Return the undistorted rays of all pixels at depth 1, `(h, w, 3)`."""
    height, width = frame.color.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    flat = np.asarray(cv2.undistortPoints(pixels, frame.camera_matrix, frame.distortion))
    return np.concatenate([flat.reshape(height, width, 2), np.ones((height, width, 1))], axis=-1)


def _trace_box(bounds_m: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the depth at which rays `(h, w, 3)` enter a box, `(2, 3)` from the eye; infinite beside."""
    along = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    low, high = bounds_m[0] / along, bounds_m[1] / along
    enters, leaves = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
    return np.where((enters > 0) & (enters < leaves), enters, np.inf)


def _trace_mouth(hole: MeasuredHole, eye_m: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Find rays `(h, w, 3)` that enter a hole through its rim."""
    toward = rays @ hole.outward
    facing = toward < 0
    depth_m = (hole.center_m - eye_m) @ hole.outward / np.where(facing, toward, -1.0)
    away_m = eye_m + rays * depth_m[..., None] - hole.center_m
    return facing & (depth_m > 0) & (np.linalg.norm(away_m, axis=-1) < hole.radius_m)


def _remove_specks(mask: np.ndarray) -> np.ndarray:
    """Return a mask without single wrong matches and the rim of smeared depth along edges."""
    side = max(3, 2 * round(mask.shape[1] / PIXELS_PER_SPECK) + 1)
    opened = cv2.morphologyEx(
        mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)
    )
    return opened > 0


def _build_truth(
    scene: MeasuredScene, frame: Frame, camera_from_board: np.ndarray, hidden: tuple[float, ...]
) -> SceneTruth:
    """Return the holes as a truth file has them; without a known base the board stands in for it."""
    base = frame.base_from_camera
    if base is None:
        base = np.linalg.inv(camera_from_board)
    circles = []
    for hole, part in zip(scene.holes, hidden, strict=True):
        center = camera_from_board[:3, :3] @ hole.center_m + camera_from_board[:3, 3]
        axis = camera_from_board[:3, :3] @ hole.outward
        place = (center, axis, base, hole.radius_m)
        circles.append(TrueCircle.place(*place, depth_m=0.0, hidden=part, in_view=part < 1.0))
    return SceneTruth("real", {}, tuple(circles), (), {})


def _draw_overlay(frame: Frame, found: FrameLabel, good: bool) -> np.ndarray:
    """Return the frame with block, mouths and their occluders in colour, and the mask's outline."""
    picture = frame.color.astype(np.float32)
    for mask, colour in ((found.block, GREEN), (found.arm, ORANGE), (found.hole_mask, RED)):
        picture[mask] = 0.6 * picture[mask] + 0.4 * np.array(colour, np.float32)
    picture = picture.astype(np.uint8)
    outlines, _ = cv2.findContours(
        found.block.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(picture, outlines, -1, (255, 255, 255) if good else RED, 1)
    return picture
