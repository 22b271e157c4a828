"""Masks for real footage: a block, placed once and refined over all frames, is projected into each.

LabelFusion (Marion et al., 2018) does the same with reconstructed and aligned meshes; a cuboid
needs neither.
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
    project_points,
    read_placing,
    trace_rays,
)
from perception.label.outline_match import LEAST_SIGMAS, OutlineMatch, match_outline
from perception.label.refinement import (
    POINTS_PER_MOUTH,
    prepare_view,
    refine_cuboid,
    refine_mouths,
    sample_block_outline,
    sample_mouth_outline,
    smooth_gray,
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
        reach_px: How far from the placed outline the picture's edges are looked for, and how far
            copies of the outline are shifted to judge its place.
        max_outline_px: Largest distance of the copy of the outline that fits the picture best; a
            frame with more is left out.
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

    def check(self) -> None:
        if self.max_outline_px >= self.reach_px / 2:
            raise ConfigError(
                f"max_outline_px: the outline is compared with copies up to reach_px="
                f"{self.reach_px:g} px away; expected less than half of that, got "
                f"{self.max_outline_px:g}"
            )

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
        cuboid = place_cuboid(placing, *clicked)
        corners_m, views = cuboid.world(np.array([cuboid.low_m, cuboid.high_m])), []
        if self.num_refined:
            names = sorted(footage.poses)
            count = min(self.num_refined, len(names))
            chosen = np.linspace(0, len(names) - 1, count).round().astype(int)
            for frame in self._read_frames({names[k] for k in chosen}):
                views.append(prepare_view(frame, footage.poses[frame.name].world_from_camera))
            cuboid = refine_cuboid(cuboid, views, self.noise_per_m, self.reach_px)
        refined_m = cuboid.world(np.array([cuboid.low_m, cuboid.high_m]))
        shift_m = float(np.linalg.norm(refined_m - corners_m, axis=1).max())
        cuboid = place_mouths(cuboid, placing, *clicked)
        if views:
            cuboid = refine_mouths(cuboid, views, self.noise_per_m, self.reach_px)
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
        return {
            "schema": 1,
            "block": block,
            "refined_by_m": shift_m,
            "num_labelled": num_labelled,
            "frames": entries,
        }

    def _read_frames(self, names: set[str] | None = None) -> Iterator[Frame]:
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

    def _locate_cameras(self, tracker: CameraTracker, clicked_in: str) -> _Footage:
        """Return the cameras of all frames, and the frame that was clicked in."""
        poses: dict[str, CameraPose] = {}
        entries: dict[str, dict[str, Any]] = {}
        clicked = None
        for frame in self._read_frames():
            stem = Path(frame.name).name
            entry: dict[str, Any] = dict.fromkeys(
                ("left_out", "board_px", "outline_px", "outline_sigmas", "depth_share")
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
        (folder / OVERLAYS).mkdir(parents=True, exist_ok=True)
        poses = footage.poses
        with ItemProgress("masks", len(poses)) as progress:
            for frame in self._read_frames(set(poses)):
                name, pose = Path(frame.name).name, poses[frame.name].world_from_camera
                label, share = self._build_label(cuboid, frame, pose)
                match = self._match_outline(cuboid, frame, pose)
                outline_px = None if match is None else match.offset_px
                reason = self._find_fault(match, share)
                footage.entries[name] |= {
                    "outline_px": outline_px,
                    "outline_sigmas": None if match is None else match.num_sigmas,
                    "depth_share": share,
                    "left_out": reason,
                }
                picture = _draw_overlay(cuboid, frame, pose, label, reason is None)
                dataset.write_picture(folder / OVERLAYS / f"{name}.png", picture[..., ::-1])
                if reason is None:
                    truth = _build_truth(cuboid, frame, pose, outline_px or 0.0, self.noise_per_m)
                    stem = folder / FRAMES / name
                    dataset.write_frame(stem, frame.color, None, label=label, truth=truth)
                progress.advance()

    def _find_fault(self, match: OutlineMatch | None, share: float | None) -> str | None:
        """Return why a frame is left out, `None` where it is not."""
        if match is None:
            return "too little of the block's outline is in view"
        if not match.is_significant:
            return (
                "it cannot be told where the outline lies: its best place stands out by "
                f"{match.num_sigmas:.1f} standard deviations, {LEAST_SIGMAS:g} are needed"
            )
        if match.offset_px > self.max_outline_px:
            return (
                f"the outline fits the picture best {match.offset_px:.1f} px off, "
                f"{self.max_outline_px:g} are allowed"
            )
        if share is not None and share < self.min_depth_share:
            return (
                f"{share:.0%} of the depth agrees with the block, {self.min_depth_share:.0%} are "
                "needed"
            )
        return None

    def _match_outline(self, cuboid: Cuboid, frame: Frame, pose: np.ndarray) -> OutlineMatch | None:
        """Return the place at which the block's outline fits best; `None` where too little is seen."""
        # Only what touches a label that may be kept counts as an occluder. Within all of `reach_px`
        # the block's own top, seen at a slant, would hide its rear edges.
        outline = sample_block_outline(cuboid, frame, pose, self.noise_per_m, self.max_outline_px)
        return match_outline(outline, smooth_gray(frame), self.reach_px)

    def _build_label(
        self, cuboid: Cuboid, frame: Frame, pose: np.ndarray
    ) -> tuple[FrameLabel, float | None]:
        """Return the masks, and which part of the known depth agrees with the block."""
        view = trace_rays(cuboid, compute_pixel_rays(frame), pose)
        block = view.face >= 0
        with np.errstate(invalid="ignore"):
            away = frame.depth_m - np.where(block, view.depth_m, np.nan)
            depth_m = np.where(block, view.depth_m, 0.0)
            step = np.maximum(self.num_sigma * self.noise_per_m * depth_m**2, LEAST_STEP_M)
            near, far = away < -step, (away > step) & ~view.mouth
        known = block & ~view.mouth & np.isfinite(frame.depth_m)
        share = float((known & ~near & ~far).sum() / known.sum()) if known.any() else None
        near, far = _remove_specks(near), _remove_specks(far)
        shown = block & ~near & ~far
        return FrameLabel(shown, shown & view.mouth, block & near), share


def _remove_specks(mask: np.ndarray) -> np.ndarray:
    """Return a mask without single wrong matches and the rim of smeared depth along edges."""
    side = max(3, 2 * round(mask.shape[1] / PIXELS_PER_SPECK) + 1)
    opened = cv2.morphologyEx(
        mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)
    )
    return opened > 0


def _build_truth(
    cuboid: Cuboid, frame: Frame, pose: np.ndarray, outline_px: float, noise_per_m: float
) -> SceneTruth:
    """Return the block and its holes as a truth file has them.

    Without a known base the world's frame stands in for it.
    """
    camera_from_world = np.linalg.inv(pose)
    base = pose if frame.base_from_camera is None else frame.base_from_camera
    rotation = camera_from_world[:3, :3] @ cuboid.rotation
    middle = cuboid.world((cuboid.low_m + cuboid.high_m) / 2.0)
    circles = []
    for number, mouth in enumerate(cuboid.mouths):
        center_in_world = cuboid.world(np.array([mouth.x_m, mouth.y_m, 0.0]))
        center = camera_from_world[:3, :3] @ center_in_world + camera_from_world[:3, 3]
        seen = len(sample_mouth_outline(cuboid, number, frame, pose, noise_per_m, 0.0).points_m)
        axis = rotation[:, 2]
        circle = TrueCircle(
            center_m=tuple(center.tolist()),
            axis=tuple(axis.tolist()),
            center_in_base_m=tuple((base[:3, :3] @ center + base[:3, 3]).tolist()),
            axis_in_base=tuple((base[:3, :3] @ axis).tolist()),
            radius_m=mouth.radius_m,
            depth_m=0.0,
            hidden=1.0 - seen / POINTS_PER_MOUTH,
            in_view=seen > 0,
        )
        circles.append(circle)
    place = {
        "center_m": (camera_from_world[:3, :3] @ middle + camera_from_world[:3, 3]).tolist(),
        "rotation": rotation.tolist(),
        "half_m": (cuboid.size_m / 2.0).tolist(),
    }
    return SceneTruth("real", {"outline_px": outline_px}, tuple(circles), (), place)


def _draw_overlay(
    cuboid: Cuboid, frame: Frame, pose: np.ndarray, found: FrameLabel, good: bool
) -> np.ndarray:
    """Return the frame with block, mouths and their occluders in colour, and the block's edges."""
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
