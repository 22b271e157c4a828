"""Stages of an identification: its fits, each stored when done, so that a run can resume.

With one split there is one stage; with cross-validation one for each fold, and a last one that fits
the model that is kept.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path

import numpy as np
import torch

from actuators import open_loop
from actuators.contracts import ActuatorFit, FitTask
from brokk_rl.errors import StorageError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_bytes

log = logging.getLogger(__name__)

FREE_RUNS = "free_runs"
"""Folder of what a stage's models predicted."""


@dataclass
class FitStage:
    """Recordings by run for one fit, the folder of its results, and what came of it.

    Attributes:
        name: Name in the log.
        folder: Where the fitted model goes; rivals have folders of their own within it.
        seed: Of the fit.
        train: To fit to.
        validation: To stop the fit by.
        test: To judge by; none where a model is only made to be kept.
        cut: Windows of `test`; `None` where it judges nothing.
        fitted: Results of its fits, by model.
    """

    name: str
    folder: Path
    seed: int
    train: Mapping[str, Sequence[Recording]]
    validation: Mapping[str, Sequence[Recording]]
    test: Mapping[str, Sequence[Recording]]
    cut: open_loop.FreeRunWindows | None = None
    fitted: dict[str, FittedModel] = field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """Hash of all that is in the recordings, by part."""
        state = hashlib.sha256(str(self.seed).encode())
        for part in (self.train, self.validation, self.test):
            state.update(b"part")
            for recording in list_recordings(part):
                state.update(recording.u.tobytes() + recording.q.tobytes())
        return state.hexdigest()


@dataclass(frozen=True)
class FittedModel:
    """Result of a fit.

    Attributes:
        predicted: Positions in free runs through the stage's windows, `(W, K, J)`.
        seconds: Time the fit took in the process that finished it.
        use: Override that makes other modes use the model; empty where its fit left no option.
    """

    predicted: np.ndarray
    seconds: float
    use: str


def list_recordings(part: Mapping[str, Sequence[Recording]]) -> list[Recording]:
    """Return the recordings of all runs."""
    found = []
    for recordings in part.values():
        found.extend(recordings)
    return found


def fit_or_restore(
    stage: FitStage,
    name: str,
    fit: ActuatorFit,
    folder: Path,
    machine: Machine,
    device: torch.device,
) -> FittedModel:
    """Fit a model and roll it out through windows, or restore an earlier result.

    Raises:
        StorageError: another fit, or one to other recordings, has been done in this folder.
        RecordingError: too little data to fit to.
    """
    path = folder / FREE_RUNS / f"{name}.npz"
    shape = () if stage.cut is None else stage.cut.q.shape
    stamp = repr((fit, machine.fingerprint(), stage.digest, shape))
    key = hashlib.sha256(stamp.encode()).hexdigest()
    if path.exists():
        return _restore(path, key)
    where = f"{stage.name}: " if stage.name else ""
    log.info("%sfitting %s to %d runs", where, name, len(stage.train))
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    train, validation = list_recordings(stage.train), list_recordings(stage.validation)
    actuator = fit.fit(FitTask(machine, train, validation, folder, stage.seed, device))
    seconds = time.monotonic() - began
    predicted = np.zeros((0, 0, machine.num_joints))
    if stage.cut is not None:
        predicted = open_loop.roll_out(actuator, machine, stage.cut, device)
    option = folder / f"{name}.yaml"
    found = FittedModel(predicted, seconds, f"actuator=@{option}" if option.exists() else "")
    content = BytesIO()
    predicted = predicted.astype(np.float32)
    np.savez_compressed(content, predicted=predicted, seconds=seconds, use=found.use, key=key)
    write_bytes(path, content.getvalue())
    return found


def _restore(path: Path, key: str) -> FittedModel:
    try:
        with np.load(path) as stored:
            values = {name: stored[name] for name in stored.files}
        if str(values["key"]) != key:
            raise StorageError(
                f"{path} is of another fit, or of other recordings or windows. To go on, give the settings of the interrupted run; "
                "for others choose another session.out"
            )
        return FittedModel(values["predicted"], float(values["seconds"]), str(values["use"]))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise StorageError(
            f"{path} cannot be read ({error}); delete it, and this fit is done again"
        ) from error
