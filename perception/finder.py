"""Staged finder: a frame becomes masks, ellipses and holes; every refusal keeps its reason."""

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
    HoleProposerSpec,
    Masks,
    PoseEstimatorSpec,
    Rejection,
    SegmenterSpec,
)
from brokk_rl.errors import ConfigError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception import rectification, search
from perception.pose.plane_conic import convert_to_gray
from perception.rectification import RectificationCheck

SAME_ELLIPSE = 0.15
"""Distance and difference in size, as parts of an ellipse's size, below which two ellipses are the
same rim. Chosen by hand: a rim found in two resolutions differs by a few percent."""
STRONG_SCORE = 0.5
"""Part of the best score from which an ellipse counts as strong. Chosen by hand: among strong rims
inside each other the larger one wins, a weak larger one does not."""

SAME_REGION = 0.6
"""Distance, as a part of the smaller major semi-axis, below which a proposal shows the region of an
ellipse. Chosen by hand: the middle of a region with a broken rim is off by up to 0.35."""
SHAPE_REASONS = ("part of a circle on the face with a rim", "radius, m", "axis ratio on the face")
"""Reasons that refuse an ellipse and not its region: it may have followed the wrong edges."""

EXPLANATIONS = {
    rectification.REASON: (
        "the rows of left and right picture do not correspond, so its depth is wrong",
        "Calibrate the camera pair.",
    ),
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
        "Try another place for the camera.",
    ),
    "axis ratio on the face": ("on the face it is no circle", "A shadow, a stain, or an edge."),
    "part of a circle on the face with a rim": (
        "too little of a rim is seen",
        "Something hides it: try another place for the camera.",
    ),
    "radius, m": (
        "on the face it does not have the size of a hole",
        "Check perception.pose.radius_m if the holes have another size.",
    ),
    "brightness inside over outside": (
        "it is not dark inside",
        "A ring, a filled hole, or a lamp in it.",
    ),
    "contrast to the grain of the face": (
        "it is hardly darker than the grain of the face",
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
        "Depth is missing inside most holes; perception=plane_conic needs none there.",
    ),
    "local normals around the rim": ("there is too little depth around it for normals", ""),
    "angle between local normals, rad": ("the normals around it do not agree", ""),
    "known pose of the camera": ("the pose of the camera is unknown", "Run mode=calibrate."),
    "angle to the expected normal, rad": (
        "as a circle it would lie on a face of another direction than expected",
        "",
    ),
}
"""Explanation and remedy for each `Rejection.reason`."""


@spec
class StagedPerception:
    """Find boreholes in stages: segmenter, ellipse detector, pose estimator; each an option.

    Attributes:
        segmenter: Marks the block.
        ellipse: Finds ellipses on it.
        proposer: Proposes further places, by other signs than edges; `null` for none.
        pose: Turns ellipses into holes.
        radius_m: Radius of the holes; limits the size of the ellipses.
        size_slack: Allowed relative error of that size.
        comfortable_px: Smallest semi-axis for which the picture is searched in a coarser
            resolution.
        smallest_block: Smallest part of the picture that must be block.
        block_probability: Probability from which a pixel counts as block.
        roi: Search region: the `mask` of the block, or its bounding `box`.
        apart: Holes nearer to each other than this many radii are one; the outer rim wins.
        rectification: Check of the pair before anything else; `null` for none.
    """

    segmenter: SegmenterSpec
    ellipse: EllipseDetectorSpec
    proposer: HoleProposerSpec | None
    pose: PoseEstimatorSpec
    radius_m: float
    size_slack: float
    comfortable_px: float
    smallest_block: float
    block_probability: float
    roi: str
    apart: float
    rectification: RectificationCheck | None

    def check(self) -> None:
        if self.roi not in ("mask", "box"):
            raise ConfigError(f"perception.roi: expected mask or box, got '{self.roi}'")
        if self.radius_m <= 0 or self.size_slack < 0:
            raise ConfigError(
                "perception: expected radius_m > 0 and size_slack >= 0, got "
                f"{self.radius_m} and {self.size_slack}"
            )

    def build(self) -> StagedFinder:
        """Return a finder."""
        return StagedFinder(self)


class StagedFinder:
    """See `StagedPerception` and `brokk_rl.contracts.vision.BoreholeFinder`."""

    def __init__(self, settings: StagedPerception) -> None:
        self.settings = settings
        self._segmenter, self._detector = settings.segmenter.build(), settings.ellipse.build()
        self._proposer = settings.proposer.build() if settings.proposer else None
        self._pose = settings.pose.build()

    def find(self, frame: Frame) -> FrameDetections:
        """Return all detections of one frame, in the base frame where the camera's pose is known.

        Raises:
            FrameError: the segmenter cannot use the frame.
        """
        s = self.settings
        ms: dict[str, float] = {}
        with _time_stage(ms, "frame"):
            frame = rectify(frame)
        if s.rectification is not None:
            with _time_stage(ms, "pair"):
                fault = s.rectification.find_fault(frame)
            if fault is not None:
                return FrameDetections([], [fault], [], None, ms)
        with _time_stage(ms, "segment"):
            masks = self._segmenter.segment(frame)
        # The share decides before the dear search begins.
        on_block = masks.block > s.block_probability
        share = cv2.countNonZero(on_block.view(np.uint8)) / on_block.size
        if share < s.smallest_block:
            reason = "part of the picture that is block"
            rejection = Rejection("segment", reason, share, s.smallest_block)
            return FrameDetections([], [rejection], [], masks, ms)
        with _time_stage(ms, "ellipse"):
            ellipses = self._detect_ellipses(frame, on_block)
        proposals: list[Ellipse] = []
        if self._proposer is not None:
            with _time_stage(ms, "regions"):
                proposals = self._proposer.propose(frame, masks)
        with _time_stage(ms, "pose"):
            found, rejected = self._judge(frame, masks, ellipses, proposals)
            found, doubles = self._remove_inner_rims(found)
        if not ellipses and not proposals:
            rejected = [Rejection("ellipse", "ellipses of a possible size on the block", 0.0, 1.0)]
        # Doubles are holes too; they are told apart from rejected candidates only by their
        # reason.
        rejected += doubles
        judged = [ellipse for ellipse, _ in found]
        judged += [one.ellipse for one in rejected if one.ellipse is not None]
        # The stages so far; what follows is negligible.
        ms["total"] = sum(ms.values())
        detections = FrameDetections([pose for _, pose in found], rejected, judged, masks, ms)
        return detections.in_base_frame(frame)

    def find_ellipses(self, frame: Frame) -> list[Ellipse]:
        """Return the ellipses of the whole picture, of any size, the best first; needs no depth."""
        return self._detector.detect(convert_to_gray(rectify(frame)), None, None)

    def explain(self, rejection: Rejection) -> str:
        """Return a sentence: the refused candidate, the reason, and a remedy."""
        return explain_rejection(rejection)

    def _judge(
        self, frame: Frame, masks: Masks, ellipses: Sequence[Ellipse], proposals: Sequence[Ellipse]
    ) -> tuple[list[tuple[Ellipse, HolePose]], list[Rejection]]:
        """Return the holes among ellipses and proposals, and why the others are none."""
        found: list[tuple[Ellipse, HolePose]] = []
        rejected: list[Rejection] = []
        decided: list[Ellipse] = []
        # Every candidate is judged alone: holes do not compete until all are known.
        for candidate in (*ellipses, *proposals):
            # A proposal is of use only where no ellipse was judged by its appearance.
            if candidate in proposals and _is_near_any(candidate, decided):
                continue
            pose = self._pose.estimate(frame, masks, candidate)
            if isinstance(pose, Rejection):
                rejected.append(pose)
            else:
                found.append((candidate, pose))
            if not isinstance(pose, Rejection) or pose.reason not in SHAPE_REASONS:
                decided.append(candidate)
        return found, rejected

    def _detect_ellipses(self, frame: Frame, on_block: np.ndarray) -> list[Ellipse]:
        """Return the ellipses of a possible size on the block, each rim once."""
        s = self.settings
        gray = convert_to_gray(frame)
        levels = search.plan_search_levels(
            frame, on_block, s.radius_m, s.size_slack, s.comfortable_px
        )
        if s.roi == "box":
            levels = search.merge_levels_to_box(on_block, levels)
        ellipses = []
        for level in levels:
            ellipses += level.detect(self._detector, gray)
        return _remove_duplicates(ellipses)

    def _remove_inner_rims(
        self, found: Sequence[tuple[Ellipse, HolePose]]
    ) -> tuple[list[tuple[Ellipse, HolePose]], list[Rejection]]:
        """Return each hole once, the surest first, and the refused rims.

        Of rims within each other the outer one is kept: it is the near end of the hole.
        """
        kept: list[tuple[Ellipse, HolePose]] = []
        doubles = []
        limit_m = self.settings.apart * self.settings.radius_m
        best = max((ellipse.score for ellipse, _ in found), default=0.0)

        def rank(one: tuple[Ellipse, HolePose]) -> tuple[bool, float]:
            return one[0].score >= STRONG_SCORE * best, one[1].radius_m

        for ellipse, pose in sorted(found, key=rank, reverse=True):
            distances_m = []
            for _, other in kept:
                distances_m.append(float(np.linalg.norm(pose.center_m - other.center_m)))
            nearest_m = min(distances_m, default=np.inf)
            if nearest_m < limit_m:
                reason = "distance to a larger rim, m"
                doubles.append(Rejection("pose", reason, nearest_m, limit_m, ellipse))
            else:
                kept.append((ellipse, pose))
        return sorted(kept, key=lambda one: -one[1].score), doubles


def rectify(frame: Frame) -> Frame:
    """Return the frame without lens distortion; depth is moved, never interpolated."""
    # Most cameras deliver rectified pictures: nothing is copied then.
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
    # Cubic for colour: edges keep their place to a fraction of a pixel.
    color = cv2.remap(frame.color, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    # Nearest for depth: a mean of two surfaces is a place where nothing is.
    depth = cv2.remap(
        frame.depth_m,
        *maps,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
    # The right picture is not rectified with the left one, so it no longer belongs to it.
    return replace(
        frame,
        color=np.asarray(color, np.uint8),
        depth_m=np.asarray(depth, np.float32),
        distortion=None,
        right=None,
    )


def explain_rejection(rejection: Rejection) -> str:
    """Return a sentence: the refused candidate, the value and its limit, and a remedy."""
    place = rejection.ellipse
    subject = "the frame"
    if place is not None:
        subject = f"the ellipse at ({place.x:.0f}, {place.y:.0f}), {place.a:.0f} x {place.b:.0f} px"
    explanation, remedy = EXPLANATIONS.get(rejection.reason, ("it was refused", ""))
    value = "unknown" if math.isnan(rejection.value) else f"{rejection.value:.4g}"
    figures = f"{rejection.reason}: {value}, limit {rejection.limit:.4g}"
    return f"{subject}: {explanation} ({figures}). {remedy}".rstrip()


def _remove_duplicates(ellipses: Sequence[Ellipse]) -> list[Ellipse]:
    """Return the ellipses, the best first, without near copies of a better one."""
    kept: list[Ellipse] = []
    for one in sorted(ellipses, key=lambda one: -one.score):
        # The geometric mean semi-axis, as everywhere for the size.
        size = (one.a * one.b) ** 0.5
        if not any(_is_same_ellipse(one, other, size) for other in kept):
            kept.append(one)
    return kept


def _is_near_any(one: Ellipse, others: Sequence[Ellipse]) -> bool:
    """Return whether an ellipse lies on one of the others."""
    return any(
        float(np.hypot(one.x - other.x, one.y - other.y)) < SAME_REGION * min(one.a, other.a)
        for other in others
    )


def _is_same_ellipse(one: Ellipse, other: Ellipse, size: float) -> bool:
    is_near = np.hypot(one.x - other.x, one.y - other.y) < SAME_ELLIPSE * size
    return bool(is_near and abs((other.a * other.b) ** 0.5 / size - 1) < SAME_ELLIPSE)


@contextmanager
def _time_stage(ms: dict[str, float], stage: str) -> Iterator[None]:
    """Measure the duration of a stage, ms."""
    start = time.perf_counter()
    yield
    ms[stage] = 1000.0 * (time.perf_counter() - start)
