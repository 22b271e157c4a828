"""`brokk mode=convert`: makes recordings of the logs of other machines and programs."""

import logging
from pathlib import Path

from actuators.recordings.log_reader import LogReader
from brokk_rl import record
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

FOLDER = "recordings"


@spec
class Conversion:
    """Logs to convert.

    Attributes:
        input: Glob, or list of globs, of logs.
    """

    input: str | tuple[str, ...]


@spec
class Convert:
    """Makes recordings of logs, one for each piece of a log that has no gap."""

    session: Session
    machine: Machine
    reader: LogReader
    convert: Conversion

    def run(self) -> None:
        """Write `recordings/<log>_<piece>.parquet`; nothing if any log cannot be used.

        Raises:
            RecordingError: no log matches, one of them cannot be used, or two have the same name.
            StorageError: a file could not be written.
        """
        logs = record.find_files(self.convert.input, "log")
        by_name: dict[str, Path] = {}
        for path in logs:
            if (other := by_name.setdefault(path.stem, path)) is not path:
                raise RecordingError(
                    f"convert.input: {other} and {path} would become the same recording; rename one"
                )
        pieces = {path: self.reader.read(path, self.machine) for path in logs}
        folder = self.session.folder / FOLDER
        for path, recordings in pieces.items():
            for number, recording in enumerate(recordings):
                record.write_recording(recording, folder / f"{path.stem}_{number:02d}.parquet")
            minutes = sum(recording.duration_s for recording in recordings) / 60.0
            log.info("%s: %d recordings, %.1f minutes", path, len(recordings), minutes)
        count = sum(map(len, pieces.values()))
        log.info("%d recordings of %d logs in %s", count, len(logs), folder)
