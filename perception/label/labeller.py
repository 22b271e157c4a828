"""Masks for real footage: a block, placed once by clicks, is projected into each frame.

LabelFusion (Marion et al., 2018) does the same with reconstructed and aligned meshes; a cuboid
needs neither. Depth cuts away what stands before the block, and what lies behind it where the
clicks were a few pixels off.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from brokk_rl.contracts.vision import FrameSourceSpec
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.progress import ItemProgress
from brokk_rl.signals import Frame
from brokk_rl.spec import Index, Positive, spec
from perception import dataset
from perception.dataset import FrameLabel, SceneTruth, TrueCircle
from perception.label.camera_pose import CameraPose, CameraTracker, CameraTrackerSpec
from perception.label.cuboid import (
    Cuboid,
    compute_pixel_rays,
    place_cuboid,
    place_mouths,
    read_placing,
    trace_rays,
)
from perception.label.refinement import (
    RefinementView,
    measure_misfit_px,
    prepare_view,
    refine_cuboid,
)

FRAMES, OVERLAYS = "frames", "overlays"
LEAST_STEP_M = 0.02
"""Something nearer than the block by less than this is part of it; chosen by hand."""
PIXELS_PER_SPECK = 400
"""A speck is up to one pixel wide, both ways, per so many pixels of width; chosen by hand."""
GREEN, ORANGE, RED = (0, 158, 115), (230, 159, 0), (213, 94, 0)
"""Of the colour-blind-safe palette (Okabe and Ito)."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Footage:
    """Cameras of all frames.

    Attributes:
        poses: Camera of each frame that can be used, by the frame's name.
        entries: Entry of `labels.json` for each frame, by its stem.
        clicked: The frame that was clicked in.
        clicked_pose: Its camera in the world, `(4, 4)`.
    """

    poses: dict[str, CameraPose]
    entries: dict[str, dict[str, Any]]
    clicked: Frame
    clicked_pose: np.ndarray


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
    """Label a folder of frames of one block that does not move.

    Attributes:
        source: The frames.
        camera: Source of the camera's poses.
        placing: YAML file: corners of the drilled face, thickness, mouths; see
            `perception.label.cuboid`.
        noise_per_m: Standard deviation of inverse depth, 1/m.
        num_sigma: Depth this many standard deviations off says that something else is there.
        num_refined: Frames, evenly spread, by which the block is refined; 0 takes it as placed.
        reach_px: How far from the placed outline the picture's edges are looked for.
        max_outline_px: Largest distance of three quarters of the outline from edges of the picture;
            a frame with more is left out.
        min_depth_share: Least part of the block's known depth that must agree with it.
    """

    source: FrameSourceSpec
    camera: CameraTrackerSpec
    placing: str
    noise_per_m: Positive
    num_sigma: Positive
    num_refined: Index
    reach_px: Positive
    max_outline_px: Positive
    min_depth_share: float

    def label(self, folder: Path) -> dict[str, Any]:
        """Write frames with masks, and overlays, into `folder`.

        Returns:
            The content of `labels.json`: the block, figures of each frame, and why frames were left
                out.

        Raises:
            ConfigError: the placing cannot be read, or names a frame that is not there.
            FrameError: no frame can be labelled.
        """
        placing = read_placing(Path(self.placing))
        footage = self._locate_cameras(self.camera.build(), placing.frame)
        clicked = footage.clicked, footage.clicked_pose
        cuboid = place_mouths(place_cuboid(placing, *clicked), placing, *clicked)
        if self.num_refined:
            names = sorted(footage.poses)
            chosen = np.linspace(0, len(names) - 1, min(self.num_refined, len(names)))
            wanted = {names[number] for number in chosen.round().astype(int)}
            views = []
            for frame in self._read_frames():
                if frame.name in wanted:
                    views.append(self._prepare(frame, footage.poses[frame.name]))
            cuboid = refine_cuboid(cuboid, views, self.reach_px)
        self._write(cuboid, footage, folder)
        entries = footage.entries
        num_labelled = sum(entry["left_out"] is None for entry in entries.values())
        if not num_labelled:
            reasons = sorted({str(entry["left_out"]) for entry in entries.values()})
            raise FrameError(f"no frame could be labelled: {'; '.join(reasons[:3])}")
        block = {
            "rotation": cuboid.rotation.tolist(),
            "origin_m": cuboid.origin_m.tolist(),
            "size_m": cuboid.size_m.tolist(),
        }
        return {"schema": 2, "block": block, "num_labelled": num_labelled, "frames": entries}

    def _prepare(self, frame: Frame, pose: CameraPose) -> RefinementView:
        return prepare_view(frame, pose.world_from_camera, self.noise_per_m)

    def _read_frames(self) -> Iterator[Frame]:
        with self.source.build() as source:
            while True:
                try:
                    frame = source.read_latest()
                except FrameError as error:
                    log.warning("%s", error)
                    continue
                if frame is None:
                    return
                yield frame

    def _locate_cameras(self, tracker: CameraTracker, clicked_in: str) -> _Footage:
        """Return the cameras of all frames, and the frame that was clicked in."""
        poses: dict[str, CameraPose] = {}
        entries: dict[str, dict[str, Any]] = {}
        clicked = None
        for frame in self._read_frames():
            stem = Path(frame.name).name
            entry: dict[str, Any] = dict.fromkeys(
                ("left_out", "board_px", "outline_px", "depth_share")
            )
            entries[stem] = entry
            try:
                pose = tracker.locate(frame)
            except FrameError as error:
                entry["left_out"] = str(error)
                continue
            poses[frame.name], entry["board_px"] = pose, pose.error_px
            if stem == clicked_in:
                clicked = frame, pose.world_from_camera
        if clicked is None:
            why = entries.get(clicked_in, {}).get("left_out")
            if not why:
                why = f"there is none; frames: {', '.join(list(entries)[:5]) or 'none'}, …"
            raise ConfigError(f"label.placing: frame '{clicked_in}' cannot be used: {why}")
        return _Footage(poses, entries, *clicked)

    def _write(self, cuboid: Cuboid, footage: _Footage, folder: Path) -> None:
        with ItemProgress("masks", len(footage.poses)) as progress:
            for frame in self._read_frames():
                if frame.name not in footage.poses:
                    continue
                name, pose = Path(frame.name).name, footage.poses[frame.name].world_from_camera
                view = self._build_view(cuboid, frame, pose)
                prepared = self._prepare(frame, footage.poses[frame.name])
                outline_px = measure_misfit_px(cuboid, prepared, self.reach_px)
                reason = self._find_fault(view, outline_px)
                footage.entries[name] |= {
                    "outline_px": outline_px,
                    "depth_share": view.depth_share,
                    "left_out": reason,
                }
                picture = _draw_overlay(frame, view.label, reason is None)
                dataset.write_picture(folder / OVERLAYS / f"{name}.png", picture[..., ::-1])
                if reason is None:
                    truth = _build_truth(cuboid, frame, pose, view.hidden)
                    stem = folder / FRAMES / name
                    dataset.write_frame(stem, frame.color, None, label=view.label, truth=truth)
                progress.advance()

    def _find_fault(self, view: _LabelledView, outline_px: float | None) -> str | None:
        """Return why a frame is left out, `None` where it is not."""
        if outline_px is None:
            return "too little of the block's outline is in view"
        if outline_px > self.max_outline_px:
            return (
                f"edges of the picture lie {outline_px:.1f} px beside the outline, "
                f"{self.max_outline_px:g} are allowed"
            )
        share = view.depth_share
        if share is not None and share < self.min_depth_share:
            return (
                f"{share:.0%} of the depth agrees with the block, {self.min_depth_share:.0%} are "
                "needed"
            )
        return None

    def _build_view(self, cuboid: Cuboid, frame: Frame, pose: np.ndarray) -> _LabelledView:
        view = trace_rays(cuboid, compute_pixel_rays(frame), pose)
        block, mouth = np.isfinite(view.depth_m), view.mouth >= 0
        with np.errstate(invalid="ignore"):
            away = frame.depth_m - np.where(block, view.depth_m, np.nan)
            depth_m = np.where(block, view.depth_m, 0.0)
            step = np.maximum(self.num_sigma * self.noise_per_m * depth_m**2, LEAST_STEP_M)
            near, far = away < -step, (away > step) & ~mouth
        known = block & ~mouth & np.isfinite(frame.depth_m)
        share = float((known & ~near & ~far).sum() / known.sum()) if known.any() else None
        near, far = _remove_specks(near), _remove_specks(far)
        shown = block & ~near & ~far
        hidden = []
        for number in range(len(cuboid.mouths)):
            there = view.mouth == number
            hidden.append(1.0 - float(shown[there].mean()) if there.any() else 1.0)
        return _LabelledView(FrameLabel(shown, shown & mouth, block & near), share, tuple(hidden))


def _remove_specks(mask: np.ndarray) -> np.ndarray:
    """Return a mask without single wrong matches and the rim of smeared depth along edges."""
    side = max(3, 2 * round(mask.shape[1] / PIXELS_PER_SPECK) + 1)
    opened = cv2.morphologyEx(
        mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)
    )
    return opened > 0


def _build_truth(
    cuboid: Cuboid, frame: Frame, pose: np.ndarray, hidden: tuple[float, ...]
) -> SceneTruth:
    """Return the block and its holes as a truth file has them.

    Without a known base the world's frame stands in for it.
    """
    camera_from_world = np.linalg.inv(pose)
    base = pose if frame.base_from_camera is None else frame.base_from_camera
    rotation = camera_from_world[:3, :3] @ cuboid.rotation
    middle = cuboid.world((cuboid.low_m + cuboid.high_m) / 2.0)
    axis = rotation[:, 2]
    circles = []
    for mouth, part in zip(cuboid.mouths, hidden, strict=True):
        center_in_world = cuboid.world(np.array([mouth.x_m, mouth.y_m, 0.0]))
        center = camera_from_world[:3, :3] @ center_in_world + camera_from_world[:3, 3]
        circle = TrueCircle(
            center_m=tuple(center.tolist()),
            axis=tuple(axis.tolist()),
            center_in_base_m=tuple((base[:3, :3] @ center + base[:3, 3]).tolist()),
            axis_in_base=tuple((base[:3, :3] @ axis).tolist()),
            radius_m=mouth.radius_m,
            depth_m=0.0,
            hidden=part,
            in_view=part < 1.0,
        )
        circles.append(circle)
    place = {
        "center_m": (camera_from_world[:3, :3] @ middle + camera_from_world[:3, 3]).tolist(),
        "rotation": rotation.tolist(),
        "half_m": (cuboid.size_m / 2.0).tolist(),
    }
    return SceneTruth("real", {}, tuple(circles), (), place)


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
