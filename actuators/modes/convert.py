"""`brokk mode=convert`: makes recordings of the logs of other machines and programs."""

from __future__ import annotations

import logging
from itertools import chain
from pathlib import Path
from typing import Protocol

from actuators.recordings.log_files import find_logs
from actuators.recordings.log_tables import name_log
from actuators.recordings.recording_checks import examine_recordings, tabulate_remarks
from brokk_rl import record
from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import DAMAGE, Recording
from brokk_rl.session import Session, read_record
from brokk_rl.spec import spec

log = logging.getLogger(__name__)

FOLDER = "recordings"
"""Folder of the recordings in a run folder."""
SIMULATORS = {
    "position": "actuator=servo",
    "torque": "actuator=force actuator.mass_kg=<of your simulator>",
    "speed": "actuator=ideal",
}
"""Ideal simulator of each command interface, by which recordings are diagnosed first."""


class LogReader(Protocol):
    """A spec in `conf/import`: reads one kind of log of another machine or program."""

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the gapless pieces of the log at `path`, in order; they share metadata `run`.

        Raises:
            RecordingError: the log cannot be used; names file, row and column.
        """
        ...


@spec
class Conversion:
    """Logs to convert.

    Attributes:
        input: Glob, or list of globs, of logs; a folder stands for the logs in it.
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
        """Write `recordings/<log>_<piece>.parquet`, nothing if any log cannot be used, and print what is odd.

        Raises:
            RecordingError: no log matches, one of them cannot be used, two have the same name, or,
                at the end, something of one is lost.
            StorageError: a file could not be written.
        """
        pieces, damages = {}, []
        for path in find_logs(self.convert.input):
            pieces[path] = self.reader.read(path, self.machine)
        folder = self.session.folder / FOLDER
        for path, several in pieces.items():
            for number, one in enumerate(several):
                record.write_recording(one, folder / f"{name_log(path)}_{number:02d}.parquet")
            minutes = sum(one.duration_s for one in several) / 60.0
            log.info("%s: %d recordings, %.1f minutes", path, len(several), minutes)
            if several and DAMAGE in several[0].metadata:
                damages.append(f"{path}: {several[0].metadata[DAMAGE]}")
        recordings = list(chain.from_iterable(pieces.values()))
        log.info("%d recordings of %d logs in %s", len(recordings), len(pieces), folder)
        head, rows = tabulate_remarks(examine_recordings(recordings, self.machine))
        if rows:
            print_table(head, rows, "look at these first")
        choices = (read_record(self.session.folder) or {}).get("choices", {})
        print_text("then:")
        print_text(
            f"brokk mode=diagnose machine={choices.get('machine', '…')} 'diagnosis.field={folder}/*' "
            f"{SIMULATORS[self.machine.interface]}"
        )
        if damages:
            raise RecordingError(
                f"the recordings hold the rest, but something is lost of {'; '.join(damages)}"
            )
