"""Contents of a log: tables of columns, each table on a clock of its own.

A table is what shares a clock: a CSV file, a topic, a message of the bus. The full name of a column
is `<table>:<column>`; a log with one table leaves the first part out.
"""

from __future__ import annotations

import functools
import logging
import weakref
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import SpooledTemporaryFile

import numpy as np

from brokk_rl.errors import RecordingError

log = logging.getLogger(__name__)

SPOOLED_BYTES = 4 << 20
"""Bytes of a column that stay in memory; the rest of a long log waits in a temporary file."""
BLOCK_ROWS = 65536
"""Rows that a reader gathers before it stores them: some megabytes for a hundred columns."""


@dataclass(frozen=True)
class Table:
    """Columns of a log that share a clock.

    Attributes:
        columns: Numbers by column, each `(T,)`.
    """

    columns: Mapping[str, np.ndarray]

    def locate(self, row: int) -> str:
        """Return the place of a row in its file, for a message."""
        return f"row {row}"

    def show_cell(self, row: int, column: str) -> str:
        """Return the value of a cell as its file has it, for a message."""
        return f"{self.columns[column][row]:g}"


@dataclass(frozen=True)
class LogRun:
    """One run of a machine as a log has it.

    Attributes:
        name: Name of the run: recordings of a run are never split into fit and test.
        where: File or folder, for messages.
        tables: Tables by name; the only table of a log has the empty name.
    """

    name: str
    where: str
    tables: Mapping[str, Table]


@functools.cache
def _warn_once(text: str) -> None:
    """Warn of a damage; a log is read several times, and each time it is met again."""
    log.warning("%s", text)


class LogFile(ABC):
    """A log of which only the needed columns are read."""

    keep_whole = False
    """True leaves damaged parts out with a warning; False refuses a log with damage."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def report_damage(self, text: str, error: Exception | None) -> None:
        """Raise a `RecordingError` for a damaged part, or warn that it is left out.

        Args:
            text: Place and kind of the damage.
            error: What a library raised.
        """
        if not self.keep_whole:
            raise RecordingError(
                f"{self.path}: {text}; log.damaged=skip, or damaged: skip in the column map, reads what is whole"
            ) from error
        _warn_once(f"{self.path}: {text}: left out")

    @abstractmethod
    def list_tables(self) -> dict[str, list[str]]:
        """Return the columns of numbers of each table, from the beginning of the log.

        Raises:
            RecordingError: The log cannot be read.
        """

    @abstractmethod
    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield each run with the wanted columns.

        Args:
            wanted: Columns to read by table; other tables are left out.
            max_rows: Rows of each table after which reading may stop; `None` for all.

        Raises:
            RecordingError: The log is damaged; names the place.
        """


class StoredColumns(Mapping[str, np.ndarray]):
    """Columns that grow by blocks and are loaded one at a time.

    Long ones wait in temporary files, so that a log may be larger than the memory.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._files = {name: SpooledTemporaryFile(SPOOLED_BYTES) for name in names}  # noqa: SIM115
        weakref.finalize(self, _close_files, list(self._files.values()))
        self._num_rows: int | None = None
        self._order: np.ndarray | None = None

    def add(self, name: str, values: np.ndarray) -> None:
        """Append a block of numbers, `(T,)`, to a column."""
        self._files[name].write(np.ascontiguousarray(values, dtype=np.float64).tobytes())

    def sort(self, name: str) -> None:
        """Bring the rows into the order of a column."""
        values = self[name]
        if (np.diff(values) < 0).any():
            self._order = np.argsort(values, kind="stable")

    def cut(self, num_rows: int) -> None:
        """Leave out the rows after the first `num_rows`."""
        self._num_rows = num_rows

    def __getitem__(self, name: str) -> np.ndarray:
        file = self._files[name]
        file.seek(0)
        values = np.frombuffer(file.read(), np.float64)[: self._num_rows]
        return values if self._order is None else values[self._order]

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def _close_files(files: Iterable[SpooledTemporaryFile[bytes]]) -> None:
    for file in files:
        file.close()


def join_names(table: str, column: str) -> str:
    """Return the full name of a column."""
    return f"{table}:{column}" if table else column
