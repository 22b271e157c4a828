"""Masks for real footage: the block is placed once, refined over all frames, and projected into each of them.

What LabelFusion (Marion et al., 2018) does by reconstruction and alignment of meshes; a cuboid
needs neither.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from rich.progress import Progress

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception import dataset
from perception.dataset import FrameLabel, SceneTruth, TrueCircle
from perception.label import cuboid as label_placing
from perception.label import refinement
from perception.label.camera_pose import CameraPose, CameraTracker
from perception.label.cuboid import Cuboid, compute_pixel_rays, project_points, trace_rays
from perception.label.refinement import (
    measure_edge_offsets,
    sample_block_outline,
    sample_mouth_outline,
    smooth_gray,
)

FRAMES, OVERLAYS = "frames", "overlays"
MIN_POINTS = 20
"""Points of the outline that must be seen to judge a frame by."""
LEAST_STEP_M = 0.02
"""A thing that stands this little before the block, or less, is part of it."""
GREEN, ORANGE, RED = (0, 158, 115), (230, 159, 0), (213, 94, 0)

log = logging.getLogger(__name__)


class CameraSpec(Protocol):
    """A spec in `conf/perception/camera_pose`."""

    def build(self) -> CameraTracker:
        """Returns a tracker."""
        ...


@spec
class BlockLabelling:
    """Labels a folder of frames of one block that does not move.

    Attributes:
        source: The frames.
        camera: How to know where the camera was.
        placing: YAML file: corners of the drilled face, thickness, mouths; see
            `perception.label.cuboid`.
        noise_per_m: Standard deviation of inverse depth, 1/m.
        num_sigma: Depth this many standard deviations off says that something else is there.
        num_refined: Frames, evenly spread, by which the block is refined; 0 takes it as placed.
        reach_px: How far from the placed outline the picture's edges are looked for.
        max_outline_px: Largest mean distance between the projected outline and the picture's edges;
            a frame with more is left out.
        min_depth_share: Least part of the block's known depth that must agree with it.
    """

    source: FrameSourceSpec
    camera: CameraSpec
    placing: str
    noise_per_m: float
    num_sigma: float
    num_refined: int
    reach_px: float
    max_outline_px: float
    min_depth_share: float

    def check(self) -> None:
        if (
            min(self.noise_per_m, self.num_sigma, self.reach_px, self.max_outline_px) <= 0
            or self.num_refined < 0
        ):
            raise ConfigError(
                "label: expected noise_per_m, num_sigma, reach_px and max_outline_px above 0, num_refined of 0 or more"
            )
        if self.max_outline_px >= self.reach_px / 2:
            raise ConfigError(
                f"label.max_outline_px: edges that are nowhere near lie {self.reach_px / 2:g} px off on average, half of reach_px; "
                f"expected less than that, got {self.max_outline_px:g}"
            )

    def label(self, folder: Path) -> dict[str, Any]:
        """Labels; writes frames with masks, and overlays, into `folder`.

        Returns:
            What `labels.json` says: the block, figures of each frame, and which were left out and
                why.

        Raises:
            ConfigError: the placing cannot be read, or names a frame that is not there.
            FrameError: no frame can be labelled.
        """
        placing, tracker = label_placing.read_placing(Path(self.placing)), self.camera.build()
        poses, told, clicked = self._poses(tracker, placing.frame)
        cuboid = label_placing.place_cuboid(placing, *clicked)
        before, views = cuboid.world(np.array([cuboid.low_m, cuboid.high_m])), []
        if self.num_refined:
            names = sorted(poses)
            chosen = {
                names[k]
                for k in np.linspace(0, len(names) - 1, min(self.num_refined, len(names)))
                .round()
                .astype(int)
            }
            views = [
                refinement.prepare_view(frame, poses[frame.name].world_from_camera)
                for frame in self._frames(chosen)
            ]
            cuboid = refinement.refine_cuboid(cuboid, views, self.noise_per_m, self.reach_px)
        shift_m = float(
            np.linalg.norm(
                cuboid.world(np.array([cuboid.low_m, cuboid.high_m])) - before, axis=1
            ).max()
        )
        cuboid = label_placing.place_mouths(cuboid, placing, *clicked)
        cuboid = (
            refinement.refine_mouths(cuboid, views, self.noise_per_m, self.reach_px)
            if views
            else cuboid
        )
        self._write(cuboid, poses, told, folder)
        good = [entry for entry in told.values() if entry["left_out"] is None]
        if not good:
            reasons = sorted({str(entry["left_out"]) for entry in told.values()})
            raise FrameError(f"no frame could be labelled: {'; '.join(reasons[:3])}")
        block = {
            "rotation": cuboid.rotation.tolist(),
            "origin_m": cuboid.origin_m.tolist(),
            "size_m": cuboid.size_m.tolist(),
        }
        return {
            "schema": 1,
            "block": block,
            "refined_by_m": shift_m,
            "num_labelled": len(good),
            "frames": told,
        }

    def _frames(self, names: set[str] | None = None) -> Any:
        with self.source.build() as source:
            while True:
                try:
                    frame = source.read_latest()
                except FrameError as error:
                    log.warning("%s", error)
                    continue
                if frame is None:
                    return
                if names is None or frame.name in names:
                    yield frame

    def _poses(
        self, tracker: CameraTracker, clicked_in: str | None
    ) -> tuple[dict[str, CameraPose], dict[str, dict[str, Any]], tuple[Frame, np.ndarray]]:
        """Returns the camera of each frame, an entry of `labels.json` for each, and the frame that was clicked in."""
        poses: dict[str, CameraPose] = {}
        told: dict[str, dict[str, Any]] = {}
        clicked = None
        for frame in self._frames():
            entry: dict[str, Any] = {
                "left_out": None,
                "board_px": None,
                "outline_px": None,
                "depth_share": None,
            }
            told[Path(frame.name).name] = entry
            try:
                pose = tracker.locate(frame)
            except FrameError as error:
                entry["left_out"] = str(error)
                continue
            poses[frame.name], entry["board_px"] = pose, pose.error_px
            if clicked is None and clicked_in in (None, Path(frame.name).name):
                clicked = frame, pose.world_from_camera
        if clicked is None:
            why = told.get(str(clicked_in), {}).get("left_out")
            known = ", ".join(list(told)[:5]) or "none"
            raise ConfigError(
                f"label.placing: frame '{clicked_in}' cannot be used: {why or f'there is none; frames: {known}, …'}"
            )
        return poses, told, clicked

    def _write(
        self,
        cuboid: Cuboid,
        poses: dict[str, CameraPose],
        told: dict[str, dict[str, Any]],
        folder: Path,
    ) -> None:
        (folder / OVERLAYS).mkdir(parents=True, exist_ok=True)
        with Progress(transient=True) as progress:
            task = progress.add_task("masks", total=len(poses))
            for frame in self._frames(set(poses)):
                name, pose = Path(frame.name).name, poses[frame.name].world_from_camera
                found, share = self._masks(cuboid, frame, pose)
                outline_px = self._outline_px(cuboid, frame, pose)
                entry = told[name]
                entry |= {
                    "outline_px": outline_px,
                    "depth_share": share,
                    "left_out": self._left_out(outline_px, share),
                }
                picture = _overlay(cuboid, frame, pose, found, entry["left_out"] is None)
                dataset.write_picture(folder / OVERLAYS / f"{name}.png", picture[..., ::-1])
                if entry["left_out"] is None:
                    truth = _truth(cuboid, frame, pose, outline_px or 0.0, self.noise_per_m)
                    dataset.write_frame(
                        folder / FRAMES / name, frame.color, None, label=found, truth=truth
                    )
                progress.advance(task)

    def _left_out(self, outline_px: float | None, share: float | None) -> str | None:
        if outline_px is None:
            return f"fewer than {MIN_POINTS} points of the block's outline are in view"
        if outline_px > self.max_outline_px:
            return f"the outline is {outline_px:.1f} px off the picture's edges, {self.max_outline_px:g} are allowed"
        if share is not None and share < self.min_depth_share:
            return f"{share:.0%} of the depth agrees with the block, {self.min_depth_share:.0%} are needed"
        return None

    def _outline_px(self, cuboid: Cuboid, frame: Frame, pose: np.ndarray) -> float | None:
        """Returns the mean distance between outline and edges, each point by its steepest edge within reach."""
        outline = sample_block_outline(cuboid, frame, pose, self.noise_per_m, self.reach_px)
        if len(outline.points_m) < MIN_POINTS:
            return None
        away = np.abs(measure_edge_offsets(outline, smooth_gray(frame), self.reach_px, np.inf))
        return float(np.nan_to_num(away, nan=self.reach_px).mean())

    def _masks(
        self, cuboid: Cuboid, frame: Frame, pose: np.ndarray
    ) -> tuple[FrameLabel, float | None]:
        """Returns the masks, and which part of the known depth agrees with the block."""
        there = trace_rays(cuboid, compute_pixel_rays(frame), pose)
        block = there.face >= 0
        with np.errstate(invalid="ignore"):
            away = frame.depth_m - np.where(block, there.depth_m, np.nan)
            step = np.maximum(
                self.num_sigma * self.noise_per_m * np.where(block, there.depth_m, 0.0) ** 2,
                LEAST_STEP_M,
            )
            near, far = away < -step, (away > step) & ~there.mouth
        known = block & ~there.mouth & np.isfinite(frame.depth_m)
        share = float((known & ~near & ~far).sum() / known.sum()) if known.any() else None
        # single wild matches, and the rim where a matcher smears depth across an edge, are no
        # things
        size = max(3, 2 * round(frame.color.shape[1] / 400) + 1)
        near, far = (
            cv2.morphologyEx(one.astype(np.uint8), cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
            > 0
            for one in (near, far)
        )
        shown = block & ~near & ~far
        return FrameLabel(shown, shown & there.mouth, block & near), share


def _truth(
    cuboid: Cuboid, frame: Frame, pose: np.ndarray, outline_px: float, noise_per_m: float
) -> SceneTruth:
    """Returns the block and its holes as a truth file has them; without a known base the world stands in for it."""
    camera_from_world = np.linalg.inv(pose)
    base = pose if frame.base_from_camera is None else frame.base_from_camera
    rotation = camera_from_world[:3, :3] @ cuboid.rotation
    middle = cuboid.world((cuboid.low_m + cuboid.high_m) / 2.0)
    circles = []
    for number, mouth in enumerate(cuboid.mouths):
        center = (
            camera_from_world[:3, :3] @ cuboid.world(np.array([mouth.x_m, mouth.y_m, 0.0]))
            + camera_from_world[:3, 3]
        )
        seen = len(sample_mouth_outline(cuboid, number, frame, pose, noise_per_m, 0.0).points_m)
        circles.append(
            TrueCircle(
                tuple(center.tolist()), tuple(rotation[:, 2].tolist()), tuple((base[:3, :3] @ center + base[:3, 3]).tolist()),
                tuple((base[:3, :3] @ rotation[:, 2]).tolist()), mouth.radius_m, 0.0, 1.0 - seen / 72, seen > 0,
            )
        )  # fmt: skip
    place = {
        "center_m": (camera_from_world[:3, :3] @ middle + camera_from_world[:3, 3]).tolist(),
        "rotation": rotation.tolist(),
        "half_m": (cuboid.size_m / 2.0).tolist(),
    }
    return SceneTruth("real", {"outline_px": outline_px}, tuple(circles), (), place)


def _overlay(
    cuboid: Cuboid, frame: Frame, pose: np.ndarray, found: FrameLabel, good: bool
) -> np.ndarray:
    """Returns the frame with block, mouths and what hides them in colour, and the block's edges."""
    picture = frame.color.astype(np.float32)
    for mask, colour in ((found.block, GREEN), (found.arm, ORANGE), (found.hole_mask, RED)):
        picture[mask] = 0.6 * picture[mask] + 0.4 * np.array(colour, np.float32)
    picture = picture.astype(np.uint8)
    for begin, end in cuboid.edges(pose[:3, 3]):
        ends = project_points(cuboid.world(np.stack([begin, end])), frame, pose)
        if np.isfinite(ends).all() and np.abs(ends).max() < 1e5:
            one, other = (tuple(int(value) for value in np.rint(point)) for point in ends)
            cv2.line(picture, one, other, (255, 255, 255) if good else RED, 1, cv2.LINE_AA)
    return picture
