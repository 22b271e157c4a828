"""Recordings of logs: all of them, or none where one cannot be used."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from actuators.recordings.log_files import expand_logs
from brokk_rl import record
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import DAMAGE, Recording

log = logging.getLogger(__name__)

FOLDER = "recordings"
"""Folder of the recordings in a run folder."""


class LogReader(Protocol):
    """A spec in `conf/import`: reads one kind of log of another machine or program."""

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the gapless pieces of the log at `path`, in order; they share metadata `run`.

        Raises:
            RecordingError: the log cannot be used; names file, row and column.
        """
        ...


def find_logs(patterns: str | Sequence[str]) -> list[Path]:
    """Return the logs that match one or several globs.

    Raises:
        RecordingError: None matches, or two would become the same recording.
    """
    logs = expand_logs(record.find_files(patterns, "log"))
    by_name: dict[str, Path] = {}
    for path in logs:
        if (other := by_name.setdefault(name_log(path), path)) is not path:
            raise RecordingError(f"{other} and {path} would become the same recording; rename one")
    return logs


def name_log(path: Path) -> str:
    """Return the first part of the names of a log's recordings."""
    return path.resolve().name if path.is_dir() else path.stem


def read_logs(
    patterns: str | Sequence[str], reader: LogReader, machine: Machine
) -> dict[Path, list[Recording]]:
    """Return the pieces of each log.

    Raises:
        RecordingError: No log matches, one of them cannot be used, or two have the same name.
    """
    return {path: reader.read(path, machine) for path in find_logs(patterns)}


def write_recordings(pieces: Mapping[Path, Sequence[Recording]], folder: Path) -> None:
    """Write `<log>_<piece>.parquet` into a folder for each piece of each log.

    Raises:
        StorageError: A file could not be written.
    """
    for path, recordings in pieces.items():
        for number, recording in enumerate(recordings):
            record.write_recording(recording, folder / f"{name_log(path)}_{number:02d}.parquet")
        minutes = sum(recording.duration_s for recording in recordings) / 60.0
        log.info("%s: %d recordings, %.1f minutes", path, len(recordings), minutes)
    count = sum(map(len, pieces.values()))
    log.info("%d recordings of %d logs in %s", count, len(pieces), folder)


def check_damage(pieces: Mapping[Path, Sequence[Recording]]) -> None:
    """Refuse to end well where a log was damaged; its recordings hold the rest.

    Raises:
        RecordingError: Something of a log is lost.
    """
    found = []
    for path, recordings in pieces.items():
        if recordings and DAMAGE in recordings[0].metadata:
            found.append(f"{path}: {recordings[0].metadata[DAMAGE]}")
    if found:
        raise RecordingError(
            f"the recordings hold the rest, but something is lost of {'; '.join(found)}"
        )
