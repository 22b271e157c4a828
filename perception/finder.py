"""Staged finder: a frame becomes masks, ellipses and holes; every refusal keeps its reason."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np

from brokk_rl.contracts.vision import Ellipse, FrameDetections, HolePose, Masks, Rejection
from brokk_rl.signals import Frame
from brokk_rl.spec import NonNegative, Positive, spec
from perception import pair_check, search
from perception.camera import express_in_camera
from perception.contracts import SegmenterSpec
from perception.ellipse.detector import ContourArcs
from perception.pair_check import PairCheck, RimScale
from perception.pose import consistency
from perception.pose.appearance import IN_DUST
from perception.pose.plane_conic import PlaneConic, convert_to_gray
from perception.pose.rim import build_chart
from perception.stereo import PairDepth

SAME_ELLIPSE = 0.15
"""Distance and difference in size, as parts of an ellipse's size, below which two ellipses are the
same rim. Chosen by hand: a rim found in two resolutions differs by a few percent."""
STRONG_SCORE = 0.5
"""Part of the best score from which an ellipse counts as strong. Chosen by hand: among strong rims
inside each other the larger one wins, a weak larger one does not."""
SURE_SCORE = 0.5
"""Score of a hole from which no rim of another size is asked: by twice the baseline a dark patch
passed with 0.3, and the rims of 8 rendered holes have 0.7 or more."""
MOST_CANDIDATES = 16
"""Candidates that are judged, the best first: each takes about 10 ms."""

EXPLANATIONS = {
    **pair_check.EXPLANATIONS,
    **consistency.EXPLANATIONS,
    "part of the picture that is block": "too little is block. Is the block in sight?",
    "ellipses of a possible size on the block": "nothing on it looks like a rim of the right size.",
    "pixels of the face with depth": "its face has hardly any depth: dark, near, or no texture?",
    "depth noise on the face, 1/m": "its face is no plane. The block's edge, or noisy depth?",
    "tilt of the face, rad": "the face is seen at too flat an angle. Move the camera.",
    "axis ratio on the face": "on the face it is no circle. A shadow, a stain, or an edge.",
    "part of a circle on the face with a rim": "too little is seen of it. Move the camera.",
    "radius, m": "on the face it does not have the size of a hole. Check perception.pose.radius_m.",
    "brightness inside over outside": "it is not dark inside: a ring, a filled hole, or a lamp.",
    "contrast to the grain of the face": "it is hardly darker than grain. A stain or a shadow.",
    IN_DUST: "in this dust a hole looks like a flat disc. Wait, or look from farther aside.",
    "mouth probability inside": "the network takes it for no mouth. A flat dark disc?",
    "evidence of depth inside": "it is evenly dark, and as deep as the face. A flat dark disc?",
    "major semi-axis where it lies, px": "no hole looks so large or so small there (radius_m).",
    "candidates of a frame before it": "too many are better. Grain or clutter that looks like rims.",
    "distance to a larger rim, m": "it lies within a larger rim. The far rim or the floor.",
}
"""Explanation and remedy for each `Rejection.reason`."""


@spec
class StagedPerception:
    """Find boreholes in stages: segmenter, ellipse detector, pose estimator; each an option.

    Attributes:
        segmenter: Marks the block.
        ellipse: Finds ellipses on it.
        pose: Turns ellipses into holes.
        radius_m: Radius of the holes; limits the size of the ellipses.
        size_slack: Allowed relative error of that size.
        comfortable_px: Smallest semi-axis for which the picture is searched in a coarser
            resolution.
        smallest_block: Smallest part of the picture that must be block.
        block_probability: Probability from which a pixel counts as block.
        apart: Holes nearer to each other than this many radii are one; the outer rim wins.
        depth: Matches pairs of frames that come without depth, and holes again where depth is coarse;
            `null` for never.
        rims: Says whether rims of another size than that of the holes show a wrong scale of depth
            where no hole is found; `null` for never.
        pair: Check of the camera pair before anything else; `null` for none.
    """

    segmenter: SegmenterSpec
    ellipse: ContourArcs
    pose: PlaneConic
    radius_m: Positive
    size_slack: NonNegative
    comfortable_px: float
    smallest_block: float
    block_probability: float
    apart: float
    depth: PairDepth | None
    rims: RimScale | None
    pair: PairCheck | None

    def build(self) -> StagedFinder:
        """Return a finder."""
        return StagedFinder(self)


Found = list[tuple[Ellipse, HolePose]]
"""Holes, with the candidates they come from."""


class StagedFinder:
    """Finder that runs the stages of `StagedPerception`; see `BoreholeFinder`."""

    def __init__(self, settings: StagedPerception) -> None:
        self.settings = settings
        self._segmenter = settings.segmenter.build()
        self._pose = settings.pose.build()
        self._pair = settings.pair.build() if settings.pair else None

    def find(self, frame: Frame) -> FrameDetections:
        """Return all detections of one frame, in the base frame where the camera's pose is known.

        Raises:
            FrameError: the segmenter cannot use the frame.
        """
        s = self.settings
        ms: dict[str, float] = {}
        with _time_stage(ms, "frame"):
            frame = rectify(frame)
        if self._pair is not None:
            with _time_stage(ms, "pair"):
                fault = self._pair.find_fault(frame)
            if fault is not None:
                return FrameDetections([], [fault], [], None, ms)
        if s.depth is not None:
            with _time_stage(ms, "stereo"):
                frame = s.depth.stereo.match_frame(frame)
        with _time_stage(ms, "segment"):
            masks = self._segmenter.segment(frame)
        # The share decides before the dear search begins.
        on_block = masks.block > s.block_probability
        share = cv2.countNonZero(on_block.view(np.uint8)) / on_block.size
        if share < s.smallest_block:
            reason = "part of the picture that is block"
            rejected = [Rejection("segment", reason, share, s.smallest_block)]
            rejected += self._doubt_scale(frame, [], ms)
            return FrameDetections([], rejected, [], masks, ms)
        with _time_stage(ms, "ellipse"):
            candidates, rejected = self._detect_ellipses(frame, on_block)
        with _time_stage(ms, "pose"):
            found = self._judge(frame, masks, candidates, rejected)
        if frame.depth_shrink > 1:
            found = self._look_again(frame, found, rejected, ms)
        if all(pose.score < SURE_SCORE for _, pose in found):
            doubts = self._doubt_scale(frame, found, ms)
            rejected += doubts
            found = [] if doubts else found
        found, doubles = self._remove_inner_rims(found)
        if not found and not rejected:
            rejected = [Rejection("ellipse", "ellipses of a possible size on the block", 0.0, 1.0)]
        # Doubles are holes too; they are told apart from rejected candidates only by their
        # reason.
        rejected += doubles
        shown = [ellipse for ellipse, _ in found]
        shown += [one.ellipse for one in rejected if one.ellipse is not None]
        # The stages so far; what follows is negligible.
        ms["total"] = sum(ms.values())
        detections = FrameDetections([pose for _, pose in found], rejected, shown, masks, ms)
        return detections.in_base_frame(frame)

    def find_ellipses(self, frame: Frame) -> tuple[FrameDetections, tuple[()]]:
        """Return the ellipses of the whole picture, of any size, without depth; no hole is tracked."""
        ms: dict[str, float] = {}
        with _time_stage(ms, "ellipse"):
            ellipses = self.settings.ellipse.detect(convert_to_gray(frame), None, None)
        return FrameDetections([], [], ellipses, None, ms), ()

    def _doubt_scale(self, frame: Frame, found: Found, ms: dict[str, float]) -> list[Rejection]:
        """Return that a rim of another size is surer than all holes; nothing where none is."""
        s = self.settings
        if s.rims is None:
            return []
        with _time_stage(ms, "scale"):
            scale = s.rims.measure_scale(frame, s.ellipse, s.radius_m)
        if scale is None or any(pose.score > scale[1] for _, pose in found):
            return []
        reason = pair_check.OF_DEPTH if frame.right is None else pair_check.OF_PAIR
        return [Rejection("ellipse", reason, scale[0], 1.0)]

    def _look_again(
        self, frame: Frame, found: Found, rejected: list[Rejection], ms: dict[str, float]
    ) -> Found:
        """Return holes as they look where they are expected: coarse depth errs, and tells discs less."""
        if self.settings.depth is None or frame.right is None or frame.baseline_m is None:
            return found
        again = []
        for ellipse, pose in found:
            place = expect_rim(pose, frame)
            if place is None:
                again.append((ellipse, pose))
                continue
            with _time_stage(ms, "stereo"):
                closer, face = self.settings.depth.match_near(frame, *place)
            # The expected rim is the candidate: it is known better than a detector would find it.
            # None of its edges has been seen yet, so that most of the circle must be.
            with _time_stage(ms, "pose"):
                near = self._judge(closer, Masks(face, None), [place[0]], rejected)
            # The score is that of the detected ellipse.
            again += [(ellipse, replace(one, score=pose.score)) for _, one in near]
        return again

    def explain(self, rejection: Rejection) -> str:
        """Return a sentence: the refused candidate, the value and its limit, and a remedy."""
        place = rejection.ellipse
        subject = "the frame"
        if place is not None:
            subject = (
                f"the ellipse at ({place.x:.0f}, {place.y:.0f}), {place.a:.0f} x {place.b:.0f} px"
            )
        value = "unknown" if math.isnan(rejection.value) else f"{rejection.value:.4g}"
        figures = f"{rejection.reason}: {value}, limit {rejection.limit:.4g}"
        return f"{subject}: {EXPLANATIONS.get(rejection.reason, 'it was refused.')} ({figures})"

    def _judge(
        self, frame: Frame, masks: Masks, candidates: Sequence[Ellipse], rejected: list[Rejection]
    ) -> Found:
        """Return the holes among some candidates, and add to `rejected` why the others are none."""
        found, reason = [], "candidates of a frame before it"
        # Every candidate is judged alone: holes do not compete until all are known.
        for number, candidate in enumerate(candidates):
            pose = Rejection("ellipse", reason, float(number), MOST_CANDIDATES, candidate)
            if number < MOST_CANDIDATES:
                pose = self._pose.estimate(frame, masks, candidate)
            if isinstance(pose, Rejection):
                rejected.append(pose)
            else:
                found.append((candidate, pose))
        return found

    def _detect_ellipses(
        self, frame: Frame, on_block: np.ndarray
    ) -> tuple[list[Ellipse], list[Rejection]]:
        """Return the ellipses of a possible size on the block, each rim once, and the others."""
        s = self.settings
        gray = convert_to_gray(frame)
        levels = search.plan_search_levels(
            frame, on_block, s.radius_m, s.size_slack, s.comfortable_px
        )
        ellipses, wrong_size = [], []
        for level in levels:
            for ellipse in level.detect(self.settings.ellipse, gray):
                limit_px = level.find_missed_limit(ellipse)
                if limit_px is None:
                    ellipses.append(ellipse)
                else:
                    reason = "major semi-axis where it lies, px"
                    wrong_size.append(Rejection("ellipse", reason, ellipse.a, limit_px, ellipse))
        return _remove_duplicates(ellipses), wrong_size

    def _remove_inner_rims(self, found: Found) -> tuple[Found, list[Rejection]]:
        """Return each hole once, the surest first, and the refused rims.

        Of rims within each other the outer one is kept: it is the near end of the hole.
        """
        kept: Found = []
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


def expect_rim(hole: HolePose, frame: Frame) -> tuple[Ellipse, np.ndarray] | None:
    """Return the ellipse of a known hole's rim in a frame, and its face, the plane `m · P = 1`.

    Returns:
        `None` where its centre is not in the picture.
    """
    place = express_in_camera(hole, frame)
    if place is None:
        return None
    center_m, axis, _ = place
    height, width = frame.color.shape[:2]
    if center_m[2] <= 0 or float(axis @ center_m) >= 0:
        return None
    m = axis / float(axis @ center_m)
    row = build_chart(center_m, m, frame.camera_matrix).seen(np.array([0.0, 0.0, hole.radius_m]))
    if not np.isfinite(row).all() or not (0 <= row[0] < width and 0 <= row[1] < height):
        return None
    return Ellipse(*map(float, row), rms_px=0.0, coverage=0.0, score=hole.score), m


def rectify(frame: Frame) -> Frame:
    """Return the frame without lens distortion; depth is moved, never interpolated."""
    # Most cameras deliver rectified pictures: nothing is copied then.
    if frame.distortion is None or not np.any(frame.distortion):
        return frame
    matrix, size = frame.camera_matrix, frame.depth_m.shape[::-1]
    maps = cv2.initUndistortRectifyMap(
        matrix, frame.distortion, np.eye(3), matrix, size, cv2.CV_32FC1
    )
    # Cubic for colour: edges keep their place to a fraction of a pixel.
    color = cv2.remap(frame.color, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    # Nearest for depth: a mean of two surfaces is a place where nothing is.
    depth = cv2.remap(frame.depth_m, *maps, cv2.INTER_NEAREST, borderValue=float("nan"))
    # The right picture is not rectified with the left one, so it no longer belongs to it.
    pictures = {"color": np.asarray(color, np.uint8), "depth_m": np.asarray(depth, np.float32)}
    return replace(frame, **pictures, distortion=None, right=None)


def _remove_duplicates(ellipses: Sequence[Ellipse]) -> list[Ellipse]:
    """Return the ellipses, the best first, without near copies of a better one."""
    kept: list[Ellipse] = []
    for one in sorted(ellipses, key=lambda one: -one.score):
        # The geometric mean semi-axis, as everywhere for the size.
        size = (one.a * one.b) ** 0.5
        for other in kept:
            away = np.hypot(one.x - other.x, one.y - other.y) / size
            if max(away, abs((other.a * other.b) ** 0.5 / size - 1)) < SAME_ELLIPSE:
                break
        else:
            kept.append(one)
    return kept


@contextmanager
def _time_stage(ms: dict[str, float], stage: str) -> Iterator[None]:
    """Add the duration of a stage, ms."""
    start = time.perf_counter()
    yield
    ms[stage] = ms.get(stage, 0.0) + 1000.0 * (time.perf_counter() - start)
