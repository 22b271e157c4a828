"""Rows of a log that can be used: their time increases, and their cells are numbers."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from actuators.recordings.log_tables import LogRun, Table

log = logging.getLogger(__name__)

HOW_TO_SKIP = "log.damaged=skip, or damaged: skip in the column map, leaves such rows out"
"""End of a message that refuses a row."""


def is_later(times: np.ndarray) -> np.ndarray:
    """Return where a time is a number and later than all before it, `(T,)`."""
    known = np.where(np.isfinite(times), times, -np.inf)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(known)[:-1]])
    return known > before


class _ChosenColumns(Mapping[str, np.ndarray]):
    """Columns of some rows of a table, each read when it is asked for."""

    def __init__(self, columns: Mapping[str, np.ndarray], rows: np.ndarray) -> None:
        self._columns, self._rows = columns, rows

    def __getitem__(self, name: str) -> np.ndarray:
        return self._columns[name][self._rows]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)


@dataclass(frozen=True)
class _ChosenRows(Table):
    """Some rows of a table; messages name them as the whole table does."""

    whole: Table
    rows: np.ndarray

    def locate(self, row: int) -> str:
        """Return the place of a row in its file, for a message."""
        return self.whole.locate(int(self.rows[row]))

    def show_cell(self, row: int, column: str) -> str:
        """Return the value of a cell as its file has it, for a message."""
        return self.whole.show_cell(int(self.rows[row]), column)


def leave_broken_rows_out(
    run: LogRun, clocks: Mapping[str, str], needed: Mapping[str, Collection[str]], warn: bool = True
) -> LogRun:
    """Return a run without rows whose time does not increase or that lack a number.

    Args:
        run: The run.
        clocks: Column of the time of each table.
        needed: Columns of each table that must hold numbers.
        warn: Say what is left out.
    """
    tables = {}
    for name, table in run.tables.items():
        tables[name] = table
        if name not in clocks:
            continue
        later = is_later(np.asarray(table.columns[clocks[name]], dtype=float))
        is_whole = later.copy()
        for column in needed.get(name, ()):
            is_whole &= np.isfinite(np.asarray(table.columns[column], dtype=float))
        if is_whole.all():
            continue
        rows = np.flatnonzero(is_whole)
        if warn:
            log.warning(
                "%s: %s%d of %d rows left out: in %d the time does not increase, %d lack a number; the first is %s",
                run.where,
                f"table '{name}': " if name else "",
                len(is_whole) - len(rows),
                len(is_whole),
                int((~later).sum()),
                int((later & ~is_whole).sum()),
                table.locate(int(np.argmin(is_whole))),
            )
        tables[name] = _ChosenRows(_ChosenColumns(table.columns, rows), table, rows)
    return LogRun(run.name, run.where, tables)
