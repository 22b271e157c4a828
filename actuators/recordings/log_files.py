"""Logs by their kind: a file by its ending, a folder by what lies in it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from actuators.recordings.array_log import LeRobotLog, MatlabLog, NumpyLog, ParquetLog
from actuators.recordings.log_tables import LogFile, LogRun
from actuators.recordings.message_log import BagLog, McapLog
from actuators.recordings.text_log import CsvLayout, CsvLog
from brokk_rl.errors import ConfigError, RecordingError

TEXT_ENDINGS = (".csv", ".tsv", ".txt")
CAN_ENDINGS = (".blf", ".asc")
BAG_ENDINGS = (".db3", ".bag")
ENDINGS = (*TEXT_ENDINGS, *CAN_ENDINGS, *BAG_ENDINGS, ".mcap", ".parquet", ".npz", ".mat")
"""Endings of the files that are logs."""
SAGE_FILES = ("control.csv", "state_motor.csv")
"""Files of a motion in a folder of SAGE: targets, and what the motors answered."""
JOINT_LIST = "joint_list.txt"
"""File in which SAGE names the joints, one a line."""


class SageLog(LogFile):
    """A folder of SAGE: `control.csv` and `state_motor.csv` of one motion, each on its clock."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        labels = []
        if (path / JOINT_LIST).is_file():
            labels = (path / JOINT_LIST).read_text(errors="replace").split()
        self._logs = {Path(name).stem: CsvLog(path / name, None, labels) for name in SAGE_FILES}

    def list_tables(self) -> dict[str, list[str]]:
        """Return the columns of both files, items of lists by the joints where they are listed."""
        return {table: log.list_tables()[""] for table, log in self._logs.items()}

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the motion as one run."""
        tables = {}
        for table, log in self._logs.items():
            if names := wanted.get(table):
                (run,) = log.read_runs({"": names}, max_rows)
                tables[table] = run.tables[""]
        yield LogRun(self.path.resolve().name, str(self.path), tables)


def open_log(path: Path, layout: CsvLayout | None = None, dbc: str | None = None) -> LogFile:
    """Open a log.

    Args:
        path: File or folder.
        layout: Signs of a CSV file; `None` to tell them from its beginning.
        dbc: DBC file of a log of a CAN bus.

    Raises:
        ConfigError: A log of a CAN bus without a DBC file.
        RecordingError: It is no log of a known kind, or its beginning cannot be read.
    """
    if path.is_dir():
        kind = tell_folder(path)
        if kind is None:
            raise RecordingError(
                f"{path}: expected a folder of SAGE ({', '.join(SAGE_FILES)}), a LeRobotDataset (meta/info.json) or a bag "
                "of ROS 2 (metadata.yaml)"
            )
        return kind(path)
    if not path.exists():
        raise RecordingError(f"{path}: no such log")
    ending = path.suffix.lower()
    if ending == ".parquet":
        return ParquetLog(path)
    if ending == ".npz":
        return NumpyLog(path)
    if ending == ".mat":
        return MatlabLog(path)
    if ending == ".mcap":
        return McapLog(path)
    if ending in BAG_ENDINGS:
        return BagLog(path)
    if ending in CAN_ENDINGS:
        return _open_can_log(path, dbc)
    return CsvLog(path, layout)


def _open_can_log(path: Path, dbc: str | None) -> LogFile:
    from actuators.recordings.can_log import CanLog  # here: a desk without CAN has no python-can

    if dbc is None:
        raise ConfigError(
            f"{path}: frames of a CAN bus mean nothing without their DBC file: log.dbc=<file>, or a column map that names it"
        )
    return CanLog(path, dbc)


def tell_folder(path: Path) -> type[LogFile] | None:
    """Return the kind of log that a folder is, `None` for a folder of something else."""
    if all((path / name).is_file() for name in SAGE_FILES):
        return SageLog
    if (path / "meta" / "info.json").is_file():
        return LeRobotLog
    if (path / "metadata.yaml").is_file():
        return BagLog
    return None


def expand_logs(paths: list[Path]) -> list[Path]:
    """Return the logs among files and folders; a folder that is no log gives the logs below it.

    Raises:
        RecordingError: A folder holds none.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir() or tell_folder(path) is not None:
            found.append(path)
            continue
        inside = []
        for entry in sorted(path.iterdir()):
            if entry.is_dir() and not entry.name.startswith("."):
                inside += _find_below(entry)
            elif entry.suffix.lower() in ENDINGS:
                inside.append(entry)
        if not inside:
            raise RecordingError(
                f"{path}: no log in this folder; logs end in {', '.join(ENDINGS)} or are folders of their own"
            )
        found += inside
    return found


def _find_below(folder: Path) -> list[Path]:
    try:
        return expand_logs([folder])
    except RecordingError:
        return []
