"""Contracts of the parts of the shipped finder: segmenters, ellipse detectors.

A segmenter is an option of `conf/perception/segmenter`. Pictures and
camera coordinates are those of `brokk_rl.contracts.vision`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from brokk_rl.contracts.vision import Masks
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
