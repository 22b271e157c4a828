"""Contracts of the parts of the shipped finder: segmenters, ellipse detectors, pose estimators.

Each is an option of `conf/perception/<part>`: a spec whose `build()` returns the part. Pictures and
camera coordinates are those of `brokk_rl.contracts.vision`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from brokk_rl.contracts.vision import Ellipse, FrameDetections, HolePose, Masks, Rejection
from brokk_rl.signals import Frame


@dataclass(frozen=True)
class SizePrior:
    """Range of the major semi-axis of the ellipses to look for, px."""

    lowest_px: float
    highest_px: float


class Segmenter(Protocol):
    """Marks the pixels of the block and of its holes."""

    def segment(self, frame: Frame) -> Masks:
        """Return masks of the size of the frame."""
        ...


class SegmenterSpec(Protocol):
    """A spec in `conf/perception/segmenter`."""

    def build(self) -> Segmenter:
        """Return a segmenter."""
        ...


class PoseEstimator(Protocol):
    """Turns an ellipse of a picture into a hole in space."""

    def estimate(self, frame: Frame, masks: Masks, ellipse: Ellipse) -> HolePose | Rejection:
        """Return the hole in camera coordinates, or why it is refused; `frame` has no distortion."""
        ...


class PoseEstimatorSpec(Protocol):
    """A spec in `conf/perception/pose`."""

    def build(self) -> PoseEstimator:
        """Return an estimator."""
        ...


@runtime_checkable
class RejectionExplainer(Protocol):
    """Optional ability of a finder, for `explain.txt` of `mode=perceive`."""

    def explain(self, rejection: Rejection) -> str:
        """Return a sentence: the refused candidate, the reason, and a remedy."""
        ...


@runtime_checkable
class HoleFollower(Protocol):
    """Optional ability of a finder: to look at known holes alone, in a fraction of the time."""

    @property
    def search_every(self) -> int:
        """Frames of which one is to be searched as a whole."""
        ...

    def follow(self, frame: Frame, holes: Sequence[HolePose]) -> FrameDetections:
        """Return those of some holes, seen before, that are still where they were."""
        ...
