"""`brokk mode=convert`: makes recordings of the logs of other machines and programs."""

from actuators.recordings import conversion
from actuators.recordings.conversion import LogReader
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec


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
        """Write `recordings/<log>_<piece>.parquet`; nothing if any log cannot be used.

        Raises:
            RecordingError: no log matches, one of them cannot be used, two have the same name, or,
                at the end, something of one is lost.
            StorageError: a file could not be written.
        """
        pieces = conversion.read_logs(self.convert.input, self.reader, self.machine)
        conversion.write_recordings(pieces, self.session.folder / conversion.FOLDER)
        conversion.check_damage(pieces)
