"""Segmenter that reads the masks beside a rendered or labelled frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from brokk_rl.contracts.vision import Masks
from brokk_rl.errors import FrameError
from brokk_rl.signals import Frame
from brokk_rl.spec import spec
from perception import dataset


@spec
class TruthMasks:
    """Read the true masks beside a rendered or labelled frame; a perfect segmenter."""

    def build(self) -> TruthSegmenter:
        """Return the segmenter."""
        return TruthSegmenter()


class TruthSegmenter:
    """A segmenter that has the answer."""

    def segment(self, frame: Frame) -> Masks:
        """Return the masks beside the frame.

        Raises:
            FrameError: there are none, or they are of another size.
        """
        if not frame.name:
            raise FrameError(
                "segmenter=truth reads the mask beside a frame on disk; this frame comes from a live "
                "source"
            )
        label = dataset.read_label(Path(frame.name))
        if label.block.shape != frame.color.shape[:2]:
            raise FrameError(
                f"{frame.name}{dataset.MASK}: {label.block.shape[::-1]} px, the frame has "
                f"{frame.color.shape[1::-1]}"
            )
        return Masks(label.block.astype(np.float32), label.hole_mask.astype(np.float32))
