"""The printed board: its picture, and a plate that carries it in rendered scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from brokk_rl.errors import ConfigError
from perception.label.camera_pose import Charuco
from perception.render.materials import Material
from perception.render.solids import Box, Hits, SolidPose, Surface

SQUARE_PX = range(100, 1001)
"""Sides of a square from which the one is taken that puts the edges of its markers on pixels."""
LARGEST_PX = 5e-3
"""Such an edge may lie this far from a pixel's, as a part of the square: 0.5 mm of 100 mm."""
PRINTED, INK = 4, 6
"""Parts of a plate: the side that is printed (-z), and the ink on it."""
PLATE_M = 0.01
"""Thickness of the plate; chosen by hand."""
PAPER = Material((0.8, 0.8, 0.8), 0.01, 0.001)
BLACK = Material((0.03, 0.03, 0.03), 0.05, 0.001)


def draw_board_picture(board: Charuco) -> np.ndarray:
    """Return the board in pixels, `(h, w)` uint8, with the edges of its markers on theirs.

    Raises:
        ConfigError: the dictionary has too few markers, or the markers' edges fit no pixels.
    """
    drawn = board.describe()
    markers = drawn.getDictionary()
    needed, there = board.columns * board.rows // 2, len(markers.bytesList)
    if needed > there:
        raise ConfigError(
            f"board.dictionary={board.dictionary}: it has {there} markers, {board.columns} x "
            f"{board.rows} squares need {needed}"
        )
    # A marker has a black border of one module on each side.
    modules, ratio = markers.markerSize + 2, board.marker_m / board.square_m
    misses = {}
    for side in SQUARE_PX:
        marker = modules * max(round(side * ratio / modules), 1)
        is_even = (side - marker) % 2 == 0
        misses[side] = abs(marker / side - ratio) if is_even else np.inf
    side = min(misses, key=misses.__getitem__)
    if misses[side] > LARGEST_PX:
        raise ConfigError(
            f"board.marker_m={board.marker_m:g}: its modules fit no pixels; expected three "
            f"quarters of square_m, {0.75 * board.square_m:g}"
        )
    return drawn.generateImage((board.columns * side, board.rows * side), marginSize=0)


MATERIALS = (*(PAPER,) * INK, BLACK)


@dataclass(frozen=True)
class PrintedPlate(Box):
    """A plate with a printed side; edges of the print are exact, as they are parts of the solid.

    x and y of its pose are as on the print, z is away from who looks at it. Parts: the six faces of
    a box, and the ink.

    Attributes:
        is_ink: The print, `(h, w)` bool, in the middle of the plate.
        pixel_m: Side of one of its pixels.
    """

    is_ink: np.ndarray
    pixel_m: float

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Return where rays meet the plate, on ink or beside it."""
        hits = super().hit(origin, direction)
        rows = np.flatnonzero(np.isfinite(hits.t) & (hits.part == PRINTED))
        start, along = self.pose.local(
            origin if origin.ndim == 1 else origin[rows], direction[rows]
        )
        place = (start + hits.t[rows, None] * along)[:, :2] / np.float32(self.pixel_m)
        size = np.array(self.is_ink.shape[::-1])
        column, row = np.floor(place + size / 2).astype(int).T
        inside = (column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])
        hits.part[rows[inside][self.is_ink[row[inside], column[inside]]]] = INK
        return hits

    def surface(self, point: np.ndarray, part: np.ndarray, to_sun: np.ndarray) -> Surface:
        """Describe faces; ink lies on the printed one."""
        return super().surface(point, np.where(part == INK, PRINTED, part), to_sun)


def build_plate(board: Charuco, from_board: np.ndarray, margin_m: float) -> PrintedPlate:
    """Return a plate with a board on it.

    Args:
        board: The print.
        from_board: Pose of the board's own frame, `(4, 4)`: origin at its corner, x and y along its
            sides, z away from who looks at it.
        margin_m: White margin around the print.
    """
    size_m = np.array([board.columns, board.rows]) * board.square_m
    picture = draw_board_picture(board)
    middle = np.array([*size_m / 2, PLATE_M / 2])
    return PrintedPlate(
        "board",
        SolidPose(from_board[:3, :3], from_board[:3, :3] @ middle + from_board[:3, 3]),
        np.array([*(size_m / 2 + margin_m), PLATE_M / 2]),
        MATERIALS,
        picture < 128,
        float(size_m[0] / picture.shape[1]),
    )
