"""A coarse grid of pixels with their lines of sight, and sums over many of them by rows and columns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

ONE, X, Y, XX, XY, YY = (0, 0), (0, 1), (1, 0), (0, 2), (1, 1), (2, 0)
"""Powers of y and x, in which sums over pixels are kept."""


@dataclass(frozen=True)
class Grid:
    """The pixels that a coarse picture keeps: the line of sight `(x, y, 1)` at depth 1 of each, by column and by row.

    Attributes:
        x: `(w,)`.
        y: `(h,)`.
    """

    x: np.ndarray
    y: np.ndarray

    @staticmethod
    def of(camera_matrix: np.ndarray, shape: tuple[int, ...], step: int) -> Grid:
        """Returns that of the middles of cells of `step` x `step` px."""
        y, x = (
            (
                (np.arange(count) * step + step // 2 - camera_matrix[k, 2]) / camera_matrix[k, k]
            ).astype(np.float32)
            for count, k in zip(shape, (1, 0), strict=True)
        )
        return Grid(x, y)

    def sight(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Returns the lines of sight of some of them, `(…, 3)`."""
        return np.stack([self.x[columns], self.y[rows], np.ones(rows.shape, np.float32)], -1)

    @cached_property
    def half(self) -> Grid:
        """Returns every second of them, in double precision."""
        return Grid(self.x[::2].astype(float), self.y[::2].astype(float))

    @cached_property
    def powers(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns 1, x and x², `(3, w)`, and 1, y and y², `(3, h)`: what sums over pixels are made of, by rows and columns."""
        across, down = (
            np.stack([np.ones_like(some), some, some * some]) for some in (self.x, self.y)
        )
        return across, down

    def inverse(self, plane: np.ndarray) -> np.ndarray:
        """Returns inverse depth on a plane, `(h, w)`."""
        plane = plane.astype(self.x.dtype)
        return plane[0] * self.x + (plane[1] * self.y + plane[2])[:, None]


def squares(sums: np.ndarray) -> np.ndarray:
    """Returns the sums of the products of x, y and 1 with each other, `(3, 3)`, among those of `x^i y^j`, `[j, i]`."""
    return np.array(
        [[sums[j, i] for j, i in row] for row in ((XX, XY, X), (XY, YY, Y), (X, Y, ONE))]
    )
