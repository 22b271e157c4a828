"""`brokk mode=convert`: makes recordings of the logs of other machines and programs."""

from __future__ import annotations

from itertools import chain

from actuators.recordings import conversion
from actuators.recordings.conversion import LogReader
from actuators.recordings.inspection import InspectionThresholds
from actuators.recordings.recording_checks import examine_recordings, tabulate_remarks
from brokk_rl.console_table import print_table, print_text
from brokk_rl.machine import Machine
from brokk_rl.session import Session, read_record
from brokk_rl.spec import spec

SIMULATORS = {
    "position": "actuator=servo",
    "torque": "actuator=force actuator.mass_kg=<of your simulator>",
    "speed": "actuator=ideal",
}
"""Ideal simulator of each command interface, by which recordings are diagnosed first."""


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
    thresholds: InspectionThresholds
    convert: Conversion

    def run(self) -> None:
        """Write `recordings/<log>_<piece>.parquet`, nothing if any log cannot be used, and print what is odd.

        Raises:
            RecordingError: no log matches, one of them cannot be used, two have the same name, or,
                at the end, something of one is lost.
            StorageError: a file could not be written.
        """
        pieces = conversion.read_logs(self.convert.input, self.reader, self.machine)
        folder = self.session.folder / conversion.FOLDER
        conversion.write_recordings(pieces, folder)
        recordings = list(chain.from_iterable(pieces.values()))
        remarks = examine_recordings(recordings, self.machine, self.thresholds)
        head, rows = tabulate_remarks(remarks)
        if rows:
            print_table(head, rows, "look at these first")
        choices = (read_record(self.session.folder) or {}).get("choices", {})
        print_text("then:")
        print_text(
            f"brokk mode=diagnose machine={choices.get('machine', '…')} 'diagnosis.field={folder}/*' "
            f"{SIMULATORS[self.machine.interface]}"
        )
        conversion.check_damage(pieces)
