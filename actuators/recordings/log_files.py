"""Logs by their kind: a file by its ending, a folder by what lies in it."""

from __future__ import annotations

import importlib
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from actuators.recordings.array_log import FORMATS
from actuators.recordings.guess import FOREIGN, Damaged, advise
from actuators.recordings.log_tables import LogFile, name_log
from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError

TEXT_ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".log", ".lvm")
READERS: dict[str, str] = {
    **dict.fromkeys(TEXT_ENDINGS, "text_log.TextLog"),
    **dict.fromkeys((".blf", ".asc", ".trc"), "can_log.CanLog"),
    **dict.fromkeys(FORMATS, "array_log.TableLog"),
    **dict.fromkeys((".npz", ".mat"), "array_log.ArrayLog"),
    **dict.fromkeys((".db3", ".bag"), "message_log.BagLog"),
    ".mcap": "message_log.McapLog",
}
"""Readers of files by their ending."""
SIGNATURES = {
    b"\x89MCAP0\r\n": (".mcap", "an MCAP file"),
    b"LOGG": (".blf", "a BLF file"),
    b"SQLite format 3\0": (".db3", "a bag of ROS 2"),
    b"#ROSBAG V": (".bag", "a bag of ROS 1"),
    b"PAR1": (".parquet", "a Parquet file"),
    b"PK\x03\x04": (".npz", "a NumPy archive"),
    b"MATLAB 5.0": (".mat", "a MATLAB file"),
}
"""First bytes of files, with the ending and the name of their kind."""
CANDUMP_LINE = re.compile(rb"^\s*\([-\d:. ]+\)\s+\S+\s+[0-9A-Fa-f]+(#|\s+\[\d+\])", re.MULTILINE)
"""A line of candump, as a file (`candump -l`) or as printed on a terminal (`candump -t a`)."""


def open_log(
    path: Path,
    signs: tuple[str, str] | None = None,
    dbc: str | None = None,
    damaged: Damaged = "refuse",
    channel: int | str | None = None,
) -> LogFile:
    """Open a log.

    Args:
        path: File or folder.
        signs: Delimiter and decimal sign of a text file; `None` to tell them.
        dbc: DBC file of a log of a CAN bus.
        damaged: What to do about damaged parts: `refuse` the log, or `skip` them with a warning.
        channel: Channel of the recorder of a CAN bus; `None` for all.

    Raises:
        ConfigError: A log of a CAN bus without a DBC file, or a library is not installed.
        RecordingError: It is no log of a known kind, or its beginning cannot be read.
    """
    name = _find_reader(path)
    more: dict[str, tuple[Any, ...]] = {"TextLog": (signs,), "CanLog": (dbc, channel)}
    if name == "can_log.CanLog" and dbc is None:
        raise ConfigError(
            f"{path}: frames of a CAN bus mean nothing without their DBC file: {advise('dbc')}"
        )
    module, _, reader = name.partition(".")
    try:  # a desk without such logs lacks what their module imports
        imported = importlib.import_module(f"actuators.recordings.{module}")
        opened = getattr(imported, reader)(path, *more.get(reader, ()))
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{path}: this kind of log needs {error.name}: pip install 'brokk-rl[logs]'"
        ) from error
    opened.keep_whole = damaged == "skip"
    return opened


def _find_reader(path: Path) -> str:
    """Return the reader of a log; refuse an empty file, and one whose first bytes are those of another kind."""
    if path.is_dir():
        reader = tell_folder(path)
        if reader is None and len([*path.glob("*.csv")]) < 2:
            raise RecordingError(
                f"{path}: expected a folder with the CSV files of one run, a LeRobotDataset (meta/info.json) or a bag of "
                "ROS 2 (metadata.yaml)"
            )
        return reader or "text_log.CsvFolderLog"
    if not path.exists():
        raise RecordingError(f"{path}: no such log")
    ending = path.suffix.lower()
    if ending in FOREIGN:
        raise RecordingError(f"{path}: {FOREIGN[ending]}")
    with path.open("rb") as file:
        head = file.read(4096)
    if not head:
        raise RecordingError(f"{path}: the file is empty")
    for signature, (expected, name) in SIGNATURES.items():
        if head.startswith(signature) and ending != expected:
            raise RecordingError(
                f"{path}: ends in '{ending}', its first bytes are those of {name}; rename it to end in '{expected}'"
            )
    if ending in (".log", ".txt") and CANDUMP_LINE.search(head):
        return "can_log.CanLog"
    return READERS.get(ending, "text_log.TextLog")


def tell_folder(path: Path) -> str | None:
    """Return the reader of a folder that is one log, `None` for a folder of something else."""
    if (path / "meta" / "info.json").is_file():
        return "array_log.LeRobotLog"
    return "message_log.BagLog" if (path / "metadata.yaml").is_file() else None


def find_logs(patterns: str | Sequence[str]) -> list[Path]:
    """Return the logs that match one or several globs; a folder that is no log gives the logs below it.

    Raises:
        RecordingError: None matches, a folder holds none, or two would become the same recording.
    """
    found: list[Path] = []
    for path in record.find_files(patterns, "log"):
        inside = _expand_log(path)
        if not inside:
            there = sorted({entry.suffix for entry in path.iterdir()} - {""})
            if len(there) == 1 and there[0].lower() in FOREIGN:
                raise RecordingError(f"{path}: each file {FOREIGN[there[0].lower()]}")
            ends = f" (its files end in {', '.join(there)})" if there else ""
            raise RecordingError(
                f"{path}: no log in this folder{ends}; logs end in {', '.join(READERS)} or are folders of their own"
            )
        found += inside
    by_name: dict[str, Path] = {}
    for path in found:
        if (other := by_name.setdefault(name_log(path), path)) is not path:
            raise RecordingError(f"{other} and {path} would become the same recording; rename one")
    return found


def _expand_log(path: Path) -> list[Path]:
    """Return a log, or those in a folder that is none and in the folders below it."""
    if not path.is_dir() or tell_folder(path) is not None:
        return [path]
    runs, found = _list_csv_runs(path), []
    for entry in sorted(path.iterdir()):
        if entry in runs or (entry.is_file() and entry.suffix.lower() in READERS):
            found.append(entry)
        elif entry.is_dir() and not entry.name.startswith("."):
            found += _expand_log(entry)
    return found


def _list_csv_runs(folder: Path) -> list[Path]:
    """Return the folders below that hold several CSV files by the same names: each is a run."""
    files = {}
    for entry in folder.iterdir():
        if entry.is_dir() and not entry.name.startswith(".") and tell_folder(entry) is None:
            files[entry] = tuple(sorted(path.name for path in entry.glob("*.csv")))
    counts = Counter(files.values())
    return [entry for entry, names in files.items() if len(names) > 1 and counts[names] > 1]
