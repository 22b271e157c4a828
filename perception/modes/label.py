"""`brokk mode=label`: makes masks for real footage of a block, to train the segmenter on."""

from __future__ import annotations

import logging

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
        frames = result["frames"]
        rows = []
        for name, entry in frames.items():
            board = entry["board_px"] and f"{entry['board_px']:.2f}"
            share = entry["depth_share"] and f"{entry['depth_share']:.0%}"
            rows.append((name, board, share, entry["left_out"] or ""))
        head = ("frame", "board [px]", "depth agrees", "left out because")
        print_table(head, rows, f"{result['num_labelled']} of {len(frames)} frames labelled")
        log.info("training.frames=%s", self.session.folder / "frames")
