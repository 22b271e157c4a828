"""From a frame to holes: segmenter, ellipses, poses, filter, with every refusal and the time of every stage."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np

from brokk_rl.contracts.vision import (  # fmt: skip
    Ellipse,
    EllipseSpec,
    FilterSpec,
    HolePose,
    PoseSpec,
    Rejection,
    SegmenterSpec,
    Sighting,
    Target,
)
from brokk_rl.errors import ConfigError, FrameError
from brokk_rl.signals import Borehole, Frame
from brokk_rl.spec import spec
from perception import explain, search
from perception.pose.estimator import gray_of

ALIKE = 0.15
"""Part of its size by which an ellipse differs from another that is the same rim."""


@spec
class Perception:
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
    ellipse: EllipseSpec
    pose: PoseSpec
    filter: FilterSpec
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

    def build(self) -> Finder:
        """Returns a finder."""
        return Finder(self)


class Finder:
    """See `Perception`. `find` and `look` answer for one frame; `follow` remembers."""

    def __init__(self, settings: Perception) -> None:
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

    def follow(self, sighting: Sighting, t_s: float) -> Target | None:
        """Returns what the filter holds to be true after this sighting as well."""
        return self._filter.update(sighting.holes, t_s)

    def look(self, frame: Frame) -> Sighting:
        """Returns everything that one frame says; in the base frame where the camera's pose is known, else in the camera's.

        Raises:
            FrameError: the segmenter cannot use the frame.
        """
        s = self.settings
        ms: dict[str, float] = {}
        with _timed(ms, "frame"):
            frame = rectified(frame)
        with _timed(ms, "segment"):
            masks = self._segmenter.segment(frame)
        roi = masks.block > s.block_probability
        share = cv2.countNonZero(roi.view(np.uint8)) / roi.size
        if share < s.smallest_block:
            return Sighting(
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
        with _timed(ms, "ellipse"):
            gray = gray_of(frame)
            levels = search.levels(frame, roi, s.radius_m, s.size_slack, s.comfortable_px)
            levels = search.box(roi, levels) if s.roi == "box" else levels
            ellipses = _distinct(
                [one for level in levels for one in level.detect(self._detector, gray)]
            )
        with _timed(ms, "pose"):
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
        return Sighting([pose for _, pose in holes], rejected, shown, masks, ms)

    def ellipses(self, frame: Frame) -> list[Ellipse]:
        """Returns the ellipses of the whole picture, the best first, of any size; needs no depth."""
        return self._detector.detect(gray_of(rectified(frame)), None, None)

    def explain(self, rejection: Rejection) -> str:
        """Returns in words what was refused, why, and what could be done."""
        return explain.words(rejection)

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


def rectified(frame: Frame) -> Frame:
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


def _distinct(ellipses: Sequence[Ellipse]) -> list[Ellipse]:
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
def _timed(ms: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    ms[stage] = 1000.0 * (time.perf_counter() - start)
