"""From a frame to holes: segmenter, ellipses, poses, filter, with every refusal and the time of every stage."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np

from brokk_rl.contracts.vision import (
    Ellipse,
    EllipseDetectorSpec,
    FrameDetections,
    HolePose,
    PoseEstimatorSpec,
    Rejection,
    SegmenterSpec,
    Target,
    TrackerSpec,
)
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Borehole, Frame
from brokk_rl.spec import spec
from perception import search
from perception.pose.plane_conic import convert_to_gray

ALIKE = 0.15
"""Part of its size by which an ellipse differs from another that is the same rim."""


@spec
class StagedPerception:
    """Looks for boreholes in frames: a segmenter, an ellipse detector, a pose estimator and a filter, each to be swapped.

    Attributes:
        segmenter: Says where the block is.
        ellipse: Finds ellipses on it.
        pose: Makes holes of them.
        filter: Makes one target of many frames.
        radius_m: Radius of the holes, for the size that their ellipses may have.
        size_slack: By how much that size may be off, as a part of it.
        comfortable_px: Least semi-axis for which an ellipse is looked for in a coarser resolution.
        smallest_block: Least part of the picture that must be block.
        block_probability: From which a pixel is block.
        roi: Where ellipses are looked for: on the `mask` of the block, or in its bounding `box`.
        apart: Holes nearer to each other than so many radii are one; the outer rim is taken.
    """

    segmenter: SegmenterSpec
    ellipse: EllipseDetectorSpec
    pose: PoseEstimatorSpec
    filter: TrackerSpec
    radius_m: float
    size_slack: float
    comfortable_px: float
    smallest_block: float
    block_probability: float
    roi: str
    apart: float

    def check(self) -> None:
        if self.roi not in ("mask", "box"):
            raise ConfigError(f"perception.roi: expected mask or box, got '{self.roi}'")
        if self.radius_m <= 0 or self.size_slack < 0:
            raise ConfigError(
                f"perception: expected radius_m > 0 and size_slack >= 0, got {self.radius_m} and {self.size_slack}"
            )

    def build(self) -> StagedFinder:
        """Returns a finder."""
        return StagedFinder(self)


class StagedFinder:
    """See `Perception`. `find` and `look` answer for one frame; `follow` remembers."""

    def __init__(self, settings: StagedPerception) -> None:
        self.settings = settings
        self._segmenter, self._detector = settings.segmenter.build(), settings.ellipse.build()
        self._pose = settings.pose.build()
        self._filter = settings.filter.build()

    def find(self, frame: Frame) -> Borehole | None:
        """Returns the borehole in the base frame, or `None` when there is none to be sure of in this frame."""
        if frame.base_from_camera is None:
            raise FrameError(
                f"{frame.name or 'frame'}: nobody knows where the camera is (T_base_cam); run mode=calibrate first"
            )
        try:
            sighting = self.look(frame)
        except FrameError:
            return None
        return sighting.holes[0].borehole() if sighting.holes else None

    def follow(self, sighting: FrameDetections, t_s: float) -> Target | None:
        """Returns what the filter holds to be true after this sighting as well."""
        return self._filter.update(sighting.holes, t_s)

    def look(self, frame: Frame) -> FrameDetections:
        """Returns everything that one frame says; in the base frame where the camera's pose is known, else in the camera's.

        Raises:
            FrameError: the segmenter cannot use the frame.
        """
        s = self.settings
        ms: dict[str, float] = {}
        with _time_stage(ms, "frame"):
            frame = rectify(frame)
        with _time_stage(ms, "segment"):
            masks = self._segmenter.segment(frame)
        roi = masks.block > s.block_probability
        share = cv2.countNonZero(roi.view(np.uint8)) / roi.size
        if share < s.smallest_block:
            return FrameDetections(
                [],
                [
                    Rejection(
                        "segment", "part of the picture that is block", share, s.smallest_block
                    )
                ],
                [],
                masks,
                ms,
            )
        with _time_stage(ms, "ellipse"):
            gray = convert_to_gray(frame)
            levels = search.plan_search_levels(
                frame, roi, s.radius_m, s.size_slack, s.comfortable_px
            )
            levels = search.merge_levels_to_box(roi, levels) if s.roi == "box" else levels
            ellipses = _remove_duplicates(
                [one for level in levels for one in level.detect(self._detector, gray)]
            )
        with _time_stage(ms, "pose"):
            judged = [(ellipse, self._pose.estimate(frame, masks, ellipse)) for ellipse in ellipses]
            found = [(e, pose) for e, pose in judged if isinstance(pose, HolePose)]
            refused = [pose for _, pose in judged if isinstance(pose, Rejection)]
            holes, doubles = self._single(found)
        if not ellipses:
            refused = [Rejection("ellipse", "ellipses of a possible size on the block", 0.0, 1.0)]
        if frame.base_from_camera is not None:
            holes = [
                (ellipse, pose.moved(frame.base_from_camera, frame.camera_cov))
                for ellipse, pose in holes
            ]
        rejected = [*refused, *doubles]
        shown = [e for e, _ in holes] + [r.ellipse for r in rejected if r.ellipse is not None]
        ms["total"] = sum(ms.values())
        return FrameDetections([pose for _, pose in holes], rejected, shown, masks, ms)

    def ellipses(self, frame: Frame) -> list[Ellipse]:
        """Returns the ellipses of the whole picture, the best first, of any size; needs no depth."""
        return self._detector.detect(convert_to_gray(rectify(frame)), None, None)

    def explain(self, rejection: Rejection) -> str:
        """Returns in words what was refused, why, and what could be done."""
        return explain_rejection(rejection)

    def _single(
        self, found: Sequence[tuple[Ellipse, HolePose]]
    ) -> tuple[list[tuple[Ellipse, HolePose]], list[Rejection]]:
        """Returns each hole once, the best first: of rims within each other the outer one, which is the near one."""
        kept: list[tuple[Ellipse, HolePose]] = []
        doubles = []
        limit = self.settings.apart * self.settings.radius_m
        best = max((e.score for e, _ in found), default=0.0)
        strong = [(e.score >= 0.5 * best, pose.radius_m) for e, pose in found]
        for k in sorted(range(len(found)), key=lambda k: strong[k], reverse=True):
            ellipse, pose = found[k]
            distance = min(
                (float(np.linalg.norm(pose.center_m - other.center_m)) for _, other in kept),
                default=np.inf,
            )
            if distance < limit:
                doubles.append(
                    Rejection("pose", "distance to a larger rim, m", distance, limit, ellipse)
                )
            else:
                kept.append((ellipse, pose))
        return sorted(kept, key=lambda one: -one[1].score), doubles


def rectify(frame: Frame) -> Frame:
    """Returns the frame without lens distortion; depth is moved, never mixed between pixels."""
    if frame.distortion is None or not np.any(frame.distortion):
        return frame
    height, width = frame.depth_m.shape
    maps = cv2.initUndistortRectifyMap(
        frame.camera_matrix,
        frame.distortion,
        np.eye(3),
        frame.camera_matrix,
        (width, height),
        cv2.CV_32FC1,
    )
    color = cv2.remap(frame.color, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    depth = cv2.remap(
        frame.depth_m,
        *maps,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
    return replace(
        frame,
        color=np.asarray(color, np.uint8),
        depth_m=np.asarray(depth, np.float32),
        distortion=None,
        right=None,
    )


def _remove_duplicates(ellipses: Sequence[Ellipse]) -> list[Ellipse]:
    """Returns the ellipses, the best first, without those that are nearly the same as a better one."""
    kept: list[Ellipse] = []
    for one in sorted(ellipses, key=lambda one: -one.score):
        size = (one.a * one.b) ** 0.5
        if not any(
            np.hypot(one.x - other.x, one.y - other.y) < ALIKE * size
            and abs((other.a * other.b) ** 0.5 / size - 1) < ALIKE
            for other in kept
        ):
            kept.append(one)
    return kept


@contextmanager
def _time_stage(ms: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    ms[stage] = 1000.0 * (time.perf_counter() - start)


WORDS = {
    "part of the picture that is block": (
        "too little of the picture is block",
        "Is the block in sight, the segmenter the right one?",
    ),
    "ellipses of a possible size on the block": (
        "nothing on the block looks like a rim of the right size",
        "",
    ),
    "pixels of the face with depth": (
        "the face around it has hardly any depth",
        "Too dark, too near, or no texture to match.",
    ),
    "depth noise on the face, 1/m": (
        "the face around it is no plane",
        "Is it on the block's edge, or is the depth that noisy?",
    ),
    "tilt of the face, rad": (
        "the camera sees the face at too flat an angle",
        "Another place for the camera would see it better.",
    ),
    "axis ratio on the face": ("on the face it is no circle", "A shadow, a stain, or an edge."),
    "part of a circle on the face with a rim": (
        "too little of a rim is seen",
        "What hides it? Another place would see it better.",
    ),
    "radius, m": (
        "on the face it does not have the size of a hole",
        "Look at perception.pose.radius_m if the holes are of another size.",
    ),
    "brightness inside over outside": (
        "it is not dark inside",
        "A ring, a filled hole, or a lamp in it.",
    ),
    "contrast to the grain of the face": (
        "it is hardly darker than the spots of the face",
        "A stain or a shadow.",
    ),
    "mouth probability inside": (
        "the network does not take it for the mouth of a hole",
        "A flat dark disc looks like this.",
    ),
    "evidence of depth inside": (
        "it is evenly dark, and as deep as the face",
        "A flat dark disc looks like this.",
    ),
    "distance to a larger rim, m": (
        "it lies within a larger rim",
        "The far rim or the floor of a hole.",
    ),
    "known depth at the centre": (
        "the depth at its centre is unknown",
        "The interior of a hole is; perception=plane_conic needs none.",
    ),
    "local normals around the rim": ("there is too little depth around it for normals", ""),
    "angle between local normals, rad": ("the normals around it do not agree", ""),
    "known pose of the camera": ("nobody knows where the camera is", "Run mode=calibrate."),
    "angle to the expected normal, rad": (
        "seen as a circle, its face looks elsewhere than expected",
        "",
    ),
}


def explain_rejection(rejection: Rejection) -> str:
    """Returns a sentence with what was refused, the figure and its limit, and what could be done."""
    place = rejection.ellipse
    where = (
        "the frame"
        if place is None
        else f"the ellipse at ({place.x:.0f}, {place.y:.0f}), {place.a:.0f} x {place.b:.0f} px"
    )
    reason, advice = WORDS.get(rejection.reason, ("it was refused", ""))
    figure = "unknown" if math.isnan(rejection.value) else f"{rejection.value:.4g}"
    return f"{where}: {reason} ({rejection.reason}: {figure}, limit {rejection.limit:.4g}). {advice}".rstrip()
