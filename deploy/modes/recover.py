"""`brokk mode=recover`: makes whole captures of those that a crash or a power failure cut off."""

from __future__ import annotations

from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.recorder.capture_reader import CaptureRecovery


@spec
class RecoverMode:
    """Recover captures that a crash or a power failure cut off."""

    session: Session
    recover: CaptureRecovery

    def run(self) -> None:
        """Write the recovered files into the run folder; the originals stay as they are.

        Raises:
            RecordingError: nothing matches, or nothing can be read.
        """
        self.recover.run(self.session.folder)
