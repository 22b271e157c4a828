"""`brokk mode=train_perception`: fits the segmenter to frames with masks, and says how good it is on frames it has not seen."""

from __future__ import annotations

import logging
from typing import Any, Protocol

from rich.console import Console
from rich.table import Table

from brokk_rl.errors import ConfigError
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec

log = logging.getLogger(__name__)


class SegmenterFit(Protocol):
    """Trains a segmenter."""

    def fit(self, session: Session, resume: bool) -> dict[str, Any]:
        """Trains into the session's folder, going on where it was stopped if `resume`; returns what `training.json` says."""
        ...


@spec
class TrainPerception:
    """Trains a segmenter; leaves it as ONNX and safetensors, with its learning curve and samples.

    Attributes:
        session: Folder, seed, device.
        training: What is trained, and how.
        resume: Run folder of an interrupted training to go on with; the same as `session.out`.
    """

    session: Session
    training: SegmenterFit
    resume: str | None

    def run(self) -> float | None:
        """Trains, writes `training.json`, shows its figures.

        Returns:
            The overlap (intersection over union) of mouths on unseen frames.

        Raises:
            FrameError: frames or masks cannot be used.
            CheckpointError: an interrupted training cannot go on.
        """
        if self.resume is not None and self.resume != self.session.out:
            raise ConfigError(
                f"resume={self.resume}: a training goes on in its own folder; add session.out={self.resume}"
            )
        result = self.training.fit(self.session, self.resume is not None)
        write_json(self.session.folder / "training.json", result)
        _show(result)
        log.info(
            "perception/segmenter=onnx perception.segmenter.weights=%s",
            self.session.folder / "segmenter.onnx",
        )
        return result["conditions"]["all"]["mouth"]


def _show(result: dict[str, Any]) -> None:
    table = Table(title="on unseen frames", box=None)
    for name in (
        "condition",
        "frames",
        "overlap of blocks",
        "overlap of mouths",
        "mouths found",
        "false mouths a frame",
    ):
        table.add_column(name, justify="left" if name == "condition" else "right")
    for name, row in result["conditions"].items():
        shares = (
            "–" if row[key] is None else f"{row[key]:.3f}"
            for key in ("block", "mouth", "found", "false")
        )
        table.add_row(name, str(row["frames"]), *shares)
    Console().print(table)
