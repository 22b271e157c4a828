"""`brokk mode=label`: makes masks for real footage of a block, to train the segmenter on."""

from __future__ import annotations

import logging
from typing import Any

from brokk_rl.console_table import print_table
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from perception.label.labeller import BlockLabelling

log = logging.getLogger(__name__)


@spec
class Label:
    """Label frames of a block that does not move.

    Attributes:
        session: Folder to write into.
        label: Frames, board, measured block and holes, and settings.
    """

    session: Session
    label: BlockLabelling

    def run(self) -> None:
        """Write `frames` for `mode=train_perception`, `overlays` to look at, and `labels.json`.

        Raises:
            FrameError: no frame can be labelled.
        """
        result = self.label.label(self.session.folder)
        write_json(self.session.folder / "labels.json", result)
        _show(result)
        log.info("training.frames=%s", self.session.folder / "frames")


def _show(result: dict[str, Any]) -> None:
    rows = []
    for name, entry in result["frames"].items():
        board = None if entry["board_px"] is None else f"{entry['board_px']:.2f}"
        share = None if entry["depth_share"] is None else f"{entry['depth_share']:.0%}"
        rows.append((name, board, share, entry["left_out"] or ""))
    print_table(
        ("frame", "board [px]", "depth agrees", "left out because"),
        rows,
        f"{result['num_labelled']} of {len(result['frames'])} frames labelled",
    )
