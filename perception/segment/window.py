"""Windows: parts of a picture, brought to the network's size and back at a fixed aspect ratio."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class Window:
    """A rectangle of a picture, px; it may reach beyond the picture, where all is black.

    Attributes:
        left: First column.
        top: First row.
        width: Columns.
        height: Rows.
    """

    left: int
    top: int
    width: int
    height: int

    def crop_matrix(self, camera_matrix: np.ndarray) -> np.ndarray:
        """Return the camera matrix of the picture in the window, from that of the whole, `(3, 3)`."""
        corner = np.array([[0.0, 0.0, self.left], [0.0, 0.0, self.top], [0.0, 0.0, 0.0]])
        return camera_matrix - corner

    def take(self, picture: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """Return the picture in the window, `(h, w)` or `(h, w, c)` of the picture's type.

        Args:
            picture: `(H, W)` or `(H, W, c)`.
            size_px: Width and height of the result, of the window's aspect ratio.
        """
        source, target = self._shared(picture.shape, size_px)
        out = np.zeros((size_px[1], size_px[0], *picture.shape[2:]), picture.dtype)
        if target is not None:
            piece, place = picture[source], out[target]
            how = cv2.INTER_AREA if piece.shape[1] >= place.shape[1] else cv2.INTER_LINEAR
            out[target] = cv2.resize(
                piece, (place.shape[1], place.shape[0]), interpolation=how
            ).reshape(place.shape)
        return out

    def put(self, values: np.ndarray, into: np.ndarray) -> None:
        """Write values of the window, `(h, w)`, to their place in `into`, `(H, W)` float32."""
        source, target = self._shared(into.shape, (values.shape[1], values.shape[0]))
        if target is not None:
            place = into[source]
            into[source] = cv2.resize(
                values[target], (place.shape[1], place.shape[0]), interpolation=cv2.INTER_LINEAR
            )

    def _shared(
        self, shape: tuple[int, ...], size_px: tuple[int, int]
    ) -> tuple[tuple[slice, slice], tuple[slice, slice] | None]:
        """Return the part of the picture in the window, and its place in `size_px`; `None` for nowhere."""
        source, target = [], []
        for begin, length, limit, size in (
            (self.top, self.height, shape[0], size_px[1]),
            (self.left, self.width, shape[1], size_px[0]),
        ):
            first, last = max(begin, 0), min(begin + length, limit)
            scale = size / length
            low, high = round((first - begin) * scale), round((last - begin) * scale)
            if last <= first or high <= low:
                return (slice(0), slice(0)), None
            source.append(slice(first, last))
            target.append(slice(low, high))
        return (source[0], source[1]), (target[0], target[1])


def cover_picture(shape: tuple[int, ...], size_px: tuple[int, int]) -> Window:
    """Return the smallest window of the aspect ratio of `size_px` around a whole picture `(H, W)`."""
    return center_window((0, 0, shape[1], shape[0]), size_px, 0.0)


def tile_halves(shape: tuple[int, ...], size_px: tuple[int, int]) -> list[Window]:
    """Return six overlapping windows of half the size of a picture `(H, W)` that cover most of it."""
    height, width = shape[:2]
    corners = []
    for down in (0.05, 0.45):
        for across in (0.0, 0.25, 0.5):
            corners.append((across * width, down * height))
    return [center_window((*corner, 0.5 * width, 0.5 * height), size_px, 0.0) for corner in corners]


def center_window(
    box: tuple[float, float, float, float], size_px: tuple[int, int], margin: float
) -> Window:
    """Return the window of the aspect ratio of `size_px` around the middle of a box.

    Args:
        box: Left, top, width and height, px.
        size_px: Width and height of the network's picture.
        margin: Room on each side, as a part of the box.
    """
    left, top, width, height = box
    scale = (1.0 + 2.0 * margin) * max(width / size_px[0], height / size_px[1])
    across, down = max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale))
    first, highest = left + width / 2.0 - across / 2.0, top + height / 2.0 - down / 2.0
    return Window(round(first), round(highest), across, down)


def bound_block(
    block: np.ndarray, threshold: float, smallest: float
) -> tuple[int, int, int, int] | None:
    """Return the box (left, top, width, height) around the block, px; `None` where there is none.

    Args:
        block: Probability of the block, `(h, w)`.
        threshold: Probability from which a pixel is block.
        smallest: Least size of a piece, as a part of the largest one.
    """
    count, _, stats, _ = cv2.connectedComponentsWithStats((block > threshold).astype(np.uint8))
    if count < 2:
        return None
    kept = stats[1:][stats[1:, cv2.CC_STAT_AREA] >= smallest * stats[1:, cv2.CC_STAT_AREA].max()]
    left, top = kept[:, cv2.CC_STAT_LEFT].min(), kept[:, cv2.CC_STAT_TOP].min()
    right = (kept[:, cv2.CC_STAT_LEFT] + kept[:, cv2.CC_STAT_WIDTH]).max()
    bottom = (kept[:, cv2.CC_STAT_TOP] + kept[:, cv2.CC_STAT_HEIGHT]).max()
    return int(left), int(top), int(right - left), int(bottom - top)
