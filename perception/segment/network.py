"""Segmentation by a network in onnxruntime.

The network runs on the whole picture for the block, then on the block alone, where a hole has
several times the pixels. It runs once more where the block has grown, and on parts of the picture
where the first run found no block.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from brokk_rl.contracts.vision import Masks
from brokk_rl.errors import CheckpointError
from brokk_rl.signals import Frame
from brokk_rl.spec import Count, NonNegative, spec
from perception.segment.window import Window, bound_block, center_window, cover_picture, tile_halves

SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the networks that come with the package."""
SCHEMA = 1
PREFIX = "brokk."
"""Prefix of our entries in the metadata of an ONNX file; each is JSON."""
THRESHOLD = 0.5
"""Probability from which a pixel belongs to a mask."""
SMALLEST_PIECE = 0.2
"""Least piece of a partly hidden block, as a part of the largest one, that the second run must
show. Chosen by hand."""
LEAST_BLOCK = 0.003
"""Least piece of a block, as a part of the picture; that of `depth_plane`, where it is `min_area`."""
MAX_CLOSE_RUNS, STABLE = 2, 0.1
"""Largest number of runs on the block alone; change of its box, as a part of its size, below which
no other one follows. Chosen by hand."""

Infer = Callable[[np.ndarray], np.ndarray]
"""From a picture `(3, h, w)` float32 in [0, 1] to the probabilities of block and hole, `(2, h,
w)`."""


@spec
class Onnx:
    """Run an exported network in onnxruntime; needs no torch.

    Attributes:
        weights: An ONNX file of `mode=train_perception`: a path, or the name of one that ships with
            the package.
        margin: Room around the block in the second run, as a part of its box; `null`: one run.
        gate: Another such file, which learned from many pictures without a block: a piece of block
            that it does not see is dropped; `null` for none.
        threads: CPU threads.
    """

    weights: str
    margin: NonNegative | None
    gate: str | None
    threads: Count

    def build(self) -> NetworkSegmenter:
        """Return the segmenter.

        Raises:
            CheckpointError: there is no such network, or it is none of ours.
        """
        import onnxruntime

        path = find_weights(self.weights)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self.threads
        try:
            session = onnxruntime.InferenceSession(
                path.read_bytes(), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # the library's errors have no common base
            raise CheckpointError(
                f"{path}: corrupt or no ONNX file ({error}); copy it again or train a new one"
            ) from error
        meta = session.get_modelmeta().custom_metadata_map
        header = {}
        for key, value in meta.items():
            if key.startswith(PREFIX):
                header[key.removeprefix(PREFIX)] = json.loads(value)
        size_px = check_size(path, header)

        def infer(picture: np.ndarray) -> np.ndarray:
            return session.run(None, {"picture": picture[None]})[0][0]  # type: ignore[index]

        gate = None
        if self.gate is not None:
            gate = replace(self, weights=self.gate, gate=None).build()
        return NetworkSegmenter(infer, size_px, self.margin, gate)


@dataclass(frozen=True)
class NetworkSegmenter:
    """Apply a network to frames of any size.

    Attributes:
        infer: The network.
        size_px: Width and height of its input.
        margin: Room around the block in the second run; `None` for one run.
        gate: Drops pieces of block that it does not see; `None` for none.
    """

    infer: Infer
    size_px: tuple[int, int]
    margin: float | None
    gate: NetworkSegmenter | None = None

    def segment(self, frame: Frame) -> Masks:
        """Return both masks."""
        masks = self._segment_alone(frame)
        if self.gate is None or not (masks.block > THRESHOLD).any():
            return masks
        return _drop_pieces(masks, self.gate.segment(frame).block > THRESHOLD)

    def _segment_alone(self, frame: Frame) -> Masks:
        """Return both masks, without the gate."""
        window = cover_picture(frame.color.shape, self.size_px)
        block, holes = (np.zeros(frame.color.shape[:2], np.float32) for _ in range(2))
        self._write_masks(frame, window, block, holes)
        if self.margin is None:
            return _drop_pieces(Masks(block, holes), None)
        box = bound_block(block, THRESHOLD, SMALLEST_PIECE)
        if box is None:
            part = np.zeros_like(block)
            for half in tile_halves(block.shape, self.size_px):
                self._write_masks(frame, half, part, np.zeros_like(part))
                np.maximum(block, part, out=block)
            box = bound_block(block, THRESHOLD, SMALLEST_PIECE)
        for _ in range(MAX_CLOSE_RUNS):
            closer = window if box is None else center_window(box, self.size_px, self.margin)
            if box is None or closer.width >= window.width:
                break
            holes[:] = 0.0
            self._write_masks(frame, closer, block, holes)
            before, box = box, bound_block(block, THRESHOLD, SMALLEST_PIECE)
            if box is not None and np.abs(np.subtract(box, before)).max() < STABLE * max(
                before[2:]
            ):
                break
        return _drop_pieces(Masks(block, holes), None)

    def _write_masks(
        self, frame: Frame, window: Window, block: np.ndarray, holes: np.ndarray
    ) -> None:
        """Write the network's answer for a window into both masks."""
        seen = self.infer(as_input(window.take(frame.color, self.size_px)))
        window.put(seen[0], block)
        window.put(seen[1], holes)


def _drop_pieces(masks: Masks, seen: np.ndarray | None) -> Masks:
    """Return masks without small pieces of block, and without those that touch nothing of `seen`.

    Where none is left there are no holes.
    """
    block = (masks.block > THRESHOLD).astype(np.uint8)
    count, numbers, stats, _ = cv2.connectedComponentsWithStats(block)
    pieces = np.asarray(numbers, int)
    kept = stats[:, cv2.CC_STAT_AREA] >= LEAST_BLOCK * block.size
    if seen is not None:
        kept &= np.isin(range(count), pieces[seen])
    kept[0] = True
    left = np.where(kept[pieces], masks.block, np.float32(0.0))
    if masks.hole_mask is None or kept[1:].any():
        return Masks(left, masks.hole_mask)
    return Masks(left, np.zeros_like(masks.hole_mask))


def as_input(picture: np.ndarray) -> np.ndarray:
    """Return the input of a network, `(3, h, w)` float32 in [0, 1], from `(h, w, 3)` uint8."""
    return np.ascontiguousarray(picture.transpose(2, 0, 1)).astype(np.float32) / np.float32(255.0)


def find_weights(weights: str) -> Path:
    """Return the path of a network: the given file, or a shipped one of that name.

    Raises:
        CheckpointError: there is neither.
    """
    for path in (Path(weights), SHIPPED / weights):
        if path.is_file():
            return path
    shipped = ", ".join(sorted(path.name for path in SHIPPED.glob("*.*"))) or "none"
    raise CheckpointError(
        f"segmenter.weights: there is no file '{weights}' (seen from {Path.cwd()}), nor one of that "
        f"name in the package ({shipped}). `brokk mode=train_perception` makes one; "
        "perception/segmenter=depth_plane needs none."
    )


def check_size(path: Path, header: dict) -> tuple[int, int]:
    """Return width and height of a network's picture from the header of its file.

    Raises:
        CheckpointError: the header is not that of a segmenter that we can run.
    """
    if (
        header.get("schema") != SCHEMA
        or header.get("channels") != ["block", "mouth"]
        or len(header.get("size_px", ())) != 2
    ):
        raise CheckpointError(
            f"{path}: no segmenter of ours: expected schema {SCHEMA} and channels block, mouth, got "
            f"schema {header.get('schema')} and {header.get('channels')}; train one with "
            "`brokk mode=train_perception`"
        )
    width, height = header["size_px"]
    return int(width), int(height)
