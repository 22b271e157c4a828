"""`brokk mode=train_perception`: trains the segmenter and evaluates it on unseen frames."""

from __future__ import annotations

import logging

from brokk_rl.console_table import print_table
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from perception.train.trainer import SegmenterTraining

log = logging.getLogger(__name__)


@spec
class TrainPerception:
    """Train a segmenter; leave it as ONNX and safetensors, with its learning curve.

    Attributes:
        session: Folder, seed, device.
        training: Frames, network and optimiser.
    """

    session: Session
    training: SegmenterTraining

    def run(self) -> float | None:
        """Train, write `training.json`, show its figures.

        Returns:
            The overlap (intersection over union) of mouths on unseen frames.

        Raises:
            FrameError: frames or masks cannot be used.
            CheckpointError: the network to start with cannot be used.
        """
        result = self.training.fit(self.session)
        write_json(self.session.folder / "training.json", result)
        rows = []
        for name, figures in result["conditions"].items():
            overlaps = []
            for part in ("block", "mouth"):
                overlaps.append(None if figures[part] is None else f"{figures[part]:.3f}")
            rows.append((name, figures["frames"], *overlaps))
        head = ("condition", "frames", "overlap of blocks", "overlap of mouths")
        print_table(head, rows, "on unseen frames")
        log.info(
            "perception/segmenter=onnx perception.segmenter.weights=%s",
            self.session.folder / "segmenter.onnx",
        )
        return result["conditions"]["all"]["mouth"]
