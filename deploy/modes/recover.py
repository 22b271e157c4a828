"""`brokk mode=recover`: makes whole captures of those that a crash or a power failure cut off."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from brokk_rl.session import Session
from brokk_rl.spec import spec


class RecoverySpec(Protocol):
    """What knows the files of a capture."""

    def run(self, folder: Path) -> None:
        """Writes the recovered files into `folder`."""
        ...


@spec
class RecoverMode:
    """Recovers captures that a crash or a power failure cut off."""

    session: Session
    recover: RecoverySpec

    def run(self) -> None:
        """Writes the recovered files into the run folder; the originals stay as they are.

        Raises:
            RecordingError: nothing matches, or nothing can be read.
        """
        self.recover.run(self.session.folder)
