"""`brokk mode=train_perception`: trains the segmenter and evaluates it on unseen frames."""

from __future__ import annotations

import logging
from typing import Any

from brokk_rl.console_table import print_table
from brokk_rl.errors import ConfigError
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from perception.train.trainer import SegmenterTraining

log = logging.getLogger(__name__)


@spec
class TrainPerception:
    """Train a segmenter; leave it as ONNX and safetensors, with its learning curve and samples.

    Attributes:
        session: Folder, seed, device.
        training: Frames, network and optimiser.
        resume: Run folder of an interrupted training to go on with; the same as `session.out`.
    """

    session: Session
    training: SegmenterTraining
    resume: str | None

    def run(self) -> float | None:
        """Train, write `training.json`, show its figures.

        Returns:
            The overlap (intersection over union) of mouths on unseen frames.

        Raises:
            FrameError: frames or masks cannot be used.
            CheckpointError: an interrupted training cannot go on.
        """
        if self.resume is not None and self.resume != self.session.out:
            raise ConfigError(
                f"resume={self.resume}: a training goes on in its own folder; add "
                f"session.out={self.resume}"
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
    rows = []
    for name, row in result["conditions"].items():
        shares = []
        for key in ("block", "mouth", "found", "false"):
            shares.append(None if row[key] is None else f"{row[key]:.3f}")
        rows.append([name, str(row["frames"]), *shares])
    overlaps = ("overlap of blocks", "overlap of mouths")
    head = ("condition", "frames", *overlaps, "mouths found", "false mouths a frame")
    print_table(head, rows, "on unseen frames")
