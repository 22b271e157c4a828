"""The contract of whatever reads logs of other machines and programs."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from brokk_rl.machine import Machine
from brokk_rl.record import Recording


class LogReader(Protocol):
    """A spec in `conf/import`: reads one kind of log."""

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the gapless pieces of the log at `path`, in order; they share metadata `run`.

        Raises:
            RecordingError: the log cannot be used; names file, row and column.
        """
        ...
