"""`brokk mode=board`: the ChArUco board for calibration and labels, to scale, as a PDF."""

from __future__ import annotations

import logging
from typing import Annotated

import numpy as np
from annotated_types import Ge
from matplotlib.figure import Figure

from brokk_rl.errors import ConfigError, StorageError
from brokk_rl.session import Session
from brokk_rl.spec import spec
from perception.label.camera_pose import Charuco
from perception.render.board_on_arm import draw_board_picture

log = logging.getLogger(__name__)

FILE = "board.pdf"
METRES_PER_INCH = 0.0254
RULER_M = 0.1
"""Length of the printed ruler, by which the scale of a print is checked."""


@spec
class PrintBoard:
    """Write the board to scale; the same options as `mode=calibrate` and `mode=label` take.

    Attributes:
        session: Folder to write into.
        board: The board.
        margin_m: White margin around it; markers need one, and printers leave a border.
    """

    session: Session
    board: Charuco
    margin_m: Annotated[float, Ge(0.02)]

    def check(self) -> None:
        if self.board.columns * self.board.square_m < RULER_M:
            raise ConfigError(
                f"board: expected {RULER_M} m across or more, for the ruler; got "
                f"{self.board.columns} squares of {self.board.square_m} m"
            )

    def run(self) -> None:
        """Write `board.pdf`.

        Raises:
            ConfigError: the dictionary has too few markers, or the markers' edges fit no pixels.
            StorageError: the file cannot be written.
        """
        path = self.session.folder / FILE
        figure = draw_board(self.board, self.margin_m)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # No date: the same options make the same file.
            figure.savefig(path, metadata={"CreationDate": None})
        except OSError as error:
            raise StorageError(f"{path} could not be written: {error.strerror or error}") from error
        size_mm = (1000 * METRES_PER_INCH * figure.get_size_inches()).tolist()
        text = "%s: %.0f x %.0f mm; print it at 100 %% and measure the ruler of 100 mm"
        log.info(text, path, *size_mm)


def draw_board(board: Charuco, margin_m: float) -> Figure:
    """Return a page of the size of the board and its margins, with a ruler.

    Raises:
        ConfigError: see `PrintBoard.run`.
    """
    picture = draw_board_picture(board)
    width_m, height_m = board.columns * board.square_m, board.rows * board.square_m
    page = np.array([width_m + 2 * margin_m, height_m + 2 * margin_m])
    figure = Figure(figsize=tuple((page / METRES_PER_INCH).tolist()))
    across, down = margin_m / page
    axis = figure.add_axes((across, down, width_m / page[0], height_m / page[1]))
    # `none` writes the pixels as they are: a PDF viewer does not blur their edges.
    axis.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto")
    axis.set_axis_off()
    sheet = figure.add_axes((0, 0, 1, 1), xlim=(0, page[0]), ylim=(0, page[1]), zorder=-1)
    sheet.set_axis_off()
    ruler = margin_m + np.array([0.0, RULER_M])
    sheet.plot(ruler, [0.6 * margin_m] * 2, color="black", linewidth=1, marker="|", markersize=8)
    text = (
        f"100 mm. board.dictionary={board.dictionary} board.columns={board.columns} "
        f"board.rows={board.rows} board.square_m={board.square_m:g} board.marker_m={board.marker_m:g}"
    )
    # A letter is about 0.6 of its size wide; 72 points are an inch.
    font_points = min(10.0, 72.0 * width_m / METRES_PER_INCH / (0.6 * len(text)))
    sheet.text(ruler[0], 0.2 * margin_m, text, fontsize=font_points)
    return figure
