"""Logs of a CAN bus (BLF or ASC), decoded by a DBC file.

Each message of the DBC is a table with its signals and `time`, the time of the frame in s.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np

from actuators.recordings.log_tables import BLOCK_ROWS, LogFile, LogRun, StoredColumns, Table
from brokk_rl import registry
from brokk_rl.errors import ConfigError, RecordingError

TIME = "time"
HEAD_FRAMES = 20000
"""Frames from the beginning in which messages are looked for: slow ones come once a second."""


class CanLog(LogFile):
    """A log of a CAN bus."""

    def __init__(self, path: Path, dbc: str) -> None:
        super().__init__(path)
        self._messages = {message.frame_id: message for message in load_dbc(dbc)}

    def list_tables(self) -> dict[str, list[str]]:
        """Return the signals of the messages of the DBC that the beginning of the log has."""
        seen = set()
        for number, frame in enumerate(self._iterate()):
            seen.add(frame.arbitration_id)
            if number >= HEAD_FRAMES:
                break
        tables = {}
        for frame_id, message in self._messages.items():
            if frame_id in seen:
                tables[message.name] = [TIME, *(signal.name for signal in message.signals)]
        return tables

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the log as one run."""
        chosen = {i: m for i, m in self._messages.items() if m.name in wanted}
        names = {i: [s.name for s in m.signals if s.name in wanted[m.name]] for i, m in chosen.items()}  # fmt: skip
        stores = {i: StoredColumns([TIME, *several]) for i, several in names.items()}
        rows: dict[int, list[list[float]]] = {i: [] for i in chosen}
        counts = dict.fromkeys(chosen, 0)
        for number, frame in enumerate(self._iterate()):
            at = frame.arbitration_id
            if at not in chosen or (max_rows is not None and counts[at] >= max_rows):
                if max_rows is not None and all(count >= max_rows for count in counts.values()):
                    break
                continue
            try:
                values: Any = chosen[at].decode(frame.data, decode_choices=False)
            except Exception as error:  # cantools and bitstruct raise what they stumble over
                raise RecordingError(
                    f"{self.path}: frame {number} at {frame.timestamp:.6f} s: is no message '{chosen[at].name}' of the DBC "
                    f"({error})"
                ) from error
            rows[at].append([frame.timestamp, *(values.get(name, np.nan) for name in names[at])])
            counts[at] += 1
            if len(rows[at]) >= BLOCK_ROWS:
                _store(stores[at], rows[at], names[at])
        for at in chosen:
            _store(stores[at], rows[at], names[at])
        tables = {chosen[at].name: Table(store) for at, store in stores.items()}
        yield LogRun(self.path.stem, str(self.path), tables)

    def _check_size(self, reader: Any) -> None:
        """Refuse a BLF file that is shorter than its header says; python-can reads it without a word."""
        stated, there = getattr(reader, "file_size", 0), self.path.stat().st_size
        if there < stated:
            raise RecordingError(f"{self.path}: cut off at byte {there} of {stated}")

    def _iterate(self) -> Iterator[can.Message]:
        """Yield the frames that carry data."""
        count, last_s = 0, 0.0
        try:
            with can.LogReader(self.path) as reader:
                self._check_size(reader)
                for frame in reader:
                    count, last_s = count + 1, frame.timestamp
                    if not (frame.is_error_frame or frame.is_remote_frame):
                        yield frame
        except Exception as error:  # python-can raises what its parsers stumble over
            if isinstance(error, RecordingError):
                raise
            raise RecordingError(
                f"{self.path}: damaged after frame {count} at {last_s:.6f} s ({type(error).__name__}: {error})"
            ) from error


def load_dbc(dbc: str) -> list[Any]:
    """Return the messages of a DBC file.

    Raises:
        ConfigError: It cannot be read.
    """
    path = registry.resolve_package_path(dbc)
    try:
        database: Any = cantools.database.load_file(str(path), strict=False)
    except Exception as error:  # cantools raises what its parser stumbles over
        raise ConfigError(f"dbc={dbc}: cannot be read ({error})") from error
    return list(database.messages)


def _store(columns: StoredColumns, rows: list[list[float]], names: list[str]) -> None:
    if rows:
        block = np.array(rows, dtype=float)
        for at, name in enumerate([TIME, *names]):
            columns.add(name, block[:, at])
        rows.clear()
