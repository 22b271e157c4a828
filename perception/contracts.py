"""Contracts of the parts of the shipped finder: segmenters, ellipse detectors.

A segmenter is an option of `conf/perception/segmenter`. Pictures and
camera coordinates are those of `brokk_rl.contracts.vision`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from brokk_rl.contracts.vision import FrameDetections, HolePose, Masks, Rejection
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


@runtime_checkable
class SteeredFinder(Protocol):
    """Optional abilities of a finder: words for `explain.txt`, and to look at known holes alone."""

    def explain(self, rejection: Rejection) -> str:
        """Return a sentence: the refused candidate, the reason, and a remedy."""
        ...

    @property
    def search_every(self) -> int:
        """Frames of which one is to be searched as a whole."""
        ...

    def follow(self, frame: Frame, holes: Sequence[HolePose]) -> FrameDetections:
        """Return those of some holes, seen before, that are still where they were."""
        ...
