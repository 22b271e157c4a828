"""A finished diagnosis: the answer, and the free runs that a report draws, so that it can be made again without computing.

Two files: `diagnosis.json` (the answer) and `diagnosis.npz` (recordings and free runs). Axes: `W`
windows, `K` steps, `J` joints.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import answer
from diagnosis.answer import Answer
from diagnosis.free_runs import WindowedRuns

ARRAYS = "diagnosis.npz"


@dataclass(frozen=True)
class Outcome:
    """A finished diagnosis.

    Attributes:
        answer: What it says.
        before: Free runs of the simulator as it was through field recordings that no effect was
            fitted to.
        after: The same with the selected effects; `None` where none was selected.
        floor: The simulator's through reference recordings that it was not fitted to; `None`
            without any.
    """

    answer: Answer
    before: WindowedRuns
    after: WindowedRuns | None
    floor: WindowedRuns | None

    def save(self, folder: Path) -> None:
        """Writes `diagnosis.json` and `diagnosis.npz`, each in one step.

        Raises:
            StorageError: something could not be written.
        """
        arrays: dict[str, Any] = {}
        for name in ("before", "after", "floor"):
            runs = getattr(self, name)
            if runs is not None:
                arrays |= _packed(name, runs)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        temporary = folder / f".{ARRAYS}.{os.getpid()}.part"
        try:
            temporary.write_bytes(buffer.getvalue())
            os.replace(temporary, folder / ARRAYS)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise StorageError(
                f"cannot write {folder / ARRAYS}: {error.strerror or error}; nothing was left behind"
            ) from error
        self.answer.write(folder / answer.FILE)


def load(folder: Path, machine: Machine) -> Outcome:
    """Reads what `Outcome.save` wrote.

    Raises:
        RecordingError: a file is missing or damaged.
    """
    try:
        with np.load(folder / ARRAYS, allow_pickle=False) as arrays:
            found = {
                name: _unpacked(name, arrays, machine) for name in ("before", "after", "floor")
            }
    except (OSError, ValueError, KeyError) as error:
        raise RecordingError(
            f"{folder / ARRAYS}: cannot be read as the arrays of a diagnosis ({error})"
        ) from error
    if found["before"] is None:
        raise RecordingError(f"{folder / ARRAYS}: holds no free runs; run mode=diagnose again")
    return Outcome(
        answer.read(folder / answer.FILE), found["before"], found["after"], found["floor"]
    )


def _packed(name: str, runs: WindowedRuns) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        f"{name}.source": runs.source, f"{name}.row": runs.row, f"{name}.simulated": runs.simulated.astype(np.float32),
        f"{name}.titles": np.array([r.path.stem if r.path else r.run for r in runs.recordings]),
        f"{name}.created": np.array([r.metadata.get("created", "") for r in runs.recordings]),
        f"{name}.rate_hz": np.array([r.rate_hz for r in runs.recordings]),
    }  # fmt: skip
    for number, recording in enumerate(runs.recordings):
        arrays |= {f"{name}.{number}.{key}": getattr(recording, key) for key in ("t_s", "u", "q")}
    return arrays


def _unpacked(name: str, arrays: Any, machine: Machine) -> WindowedRuns | None:
    if f"{name}.row" not in arrays:
        return None
    empty = Recording(
        machine=machine.name, joints=machine.joint_names, units=tuple(joint.unit for joint in machine.joints),
        rate_hz=1.0 / machine.period_s, t_s=np.zeros(0), u=np.zeros(0), q=np.zeros(0),
    )  # fmt: skip
    titles, created, rates = (
        arrays[f"{name}.{key}"].tolist() for key in ("titles", "created", "rate_hz")
    )
    recordings = [
        replace(
            empty, rate_hz=rate_hz, metadata={"run": title} | ({"created": begun} if begun else {}),
            **{key: arrays[f"{name}.{number}.{key}"] for key in ("t_s", "u", "q")},
        )
        for number, (title, begun, rate_hz) in enumerate(zip(titles, created, rates, strict=True))
    ]  # fmt: skip
    return WindowedRuns(
        recordings,
        arrays[f"{name}.source"],
        arrays[f"{name}.row"],
        arrays[f"{name}.simulated"].astype(float),
    )
