"""Signals of a log on their own clocks."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from actuators.recordings import clocks
from actuators.recordings.clocks import TimeColumn, unwrap
from actuators.recordings.guess import advise
from actuators.recordings.log_tables import LogRun, Table, parse_expression, warn_once
from brokk_rl.errors import ConfigError, RecordingError, list_choices

log = logging.getLogger(__name__)

TICK_TOLERANCE = 1e-3
"""Part of a period by which a sample may lie after its tick and still count for it. Seconds since
1970 are rounded to 0.2 µs, and no logger is as punctual as this."""
SPARSE_SHARE = 0.2
"""Share of empty cells from which a column of a table counts as one that comes less often than the rows."""


@dataclass(frozen=True)
class Signal:
    """A signal on the clock of one table.

    Attributes:
        table: Name of the table whose rows it has.
        t_s: Times, `(T,)`.
        values: `(T,)`.
        rows: Rows of the table that they come from, `(T,)`.
        text: Column or arithmetic that it comes from.
    """

    table: str
    t_s: np.ndarray
    values: np.ndarray
    rows: np.ndarray
    text: str

    def hold(self, ticks_s: np.ndarray, period_s: float) -> np.ndarray:
        """Return the value in force at each tick: that of the newest sample."""
        newest = np.searchsorted(self.t_s, ticks_s + TICK_TOLERANCE * period_s, "right") - 1
        return self.values[newest.clip(0)]

    def average(self, ticks_s: np.ndarray, period_s: float) -> np.ndarray:
        """Return the mean over the period that begins at each tick, of values held between samples.

        A force acts by its mean over a period; samples between two ticks would else be lost.
        """
        held_s = np.diff(self.t_s, append=self.t_s[-1] + period_s)
        impulse = np.concatenate([[0.0], np.cumsum(self.values * held_s)])
        edges_s = np.append(self.t_s, self.t_s[-1] + period_s)
        begin, end = (np.interp(ticks_s + later_s, edges_s, impulse) for later_s in (0.0, period_s))
        return (end - begin) / period_s

    def interpolate(self, ticks_s: np.ndarray) -> np.ndarray:
        """Return the value at each tick, linear between samples."""
        return np.interp(ticks_s, self.t_s, self.values)


@dataclass
class RunSignals:
    """The signals of a run, each on the clock of its table.

    Attributes:
        run: The run.
        times: Clocks of its tables.
        skip: Leave rows out that lack a number or whose time does not increase.
        gap_s: Time at which a log is split; parts between which a clock was set back lie further apart.
        quiet: Leave out without a warning.
    """

    run: LogRun
    times: Mapping[str, TimeColumn]
    skip: bool
    gap_s: float
    quiet: bool = False

    def _read_times(self, name: str, table: Table) -> np.ndarray:
        """Return the times of a table, `(T,)` s; NaN for rows that are left out."""
        if name not in self.times:
            choices = list_choices(name, self.times)
            self.run.refuse(f"the map has no time for table '{name}'; {choices}")
        time = self.times[name]
        num_rows = len(next(iter(table.columns.values())))
        if num_rows < 2:
            self.run.refuse(f"table '{name}' has {num_rows} rows; a log has at least 2")
        if isinstance(time, clocks.RowTime):
            return np.arange(num_rows) / time.rate_hz
        t_s = time.compute(table.columns)
        known = np.isfinite(t_s)
        if not known.all() and not self.skip:
            self._refuse_cell(table, known, time.column, time.column)
        fault = clocks.find_fault(t_s, table, time.column)
        if fault is not None:
            row = int(fault.rows[0])
            place = f"{table.locate(row)}, column '{time.column}'"
            if not (self.skip and fault.is_damage):
                times = f"{t_s[max(row - 1, 0)]:g} s, then {t_s[row]:g} s"
                text = f"{place}: time does not increase ({times}): {fault.text}; {fault.advice}"
                self.run.refuse(text)
            for at in fault.rows if fault.is_set_back else ():
                t_s[at:] += t_s[at - 1] - t_s[at] + 2.0 * self.gap_s
            later = clocks.is_later(t_s)
            if not self.quiet:
                count = f"{np.sum(~later)} of {num_rows} rows left out"
                warn_once(f"{self.run.where}: {place}: {fault.text}; {count}")
            t_s = np.where(later, t_s, np.nan)
        if isinstance(time, clocks.AlignedTime):
            kept = np.isfinite(t_s)
            anchor_s = time.anchor.compute(table.columns)
            t_s[kept] = time.align(t_s[kept], anchor_s[kept])
        return t_s

    def read(self, text: str, empty: bool = False, wraps: float | None = None) -> Signal:
        """Return a column or arithmetic over columns.

        Rows of a sparse table that lack the column are none of it, and of its clock. Elsewhere an empty cell is damage, which
        is refused unless `empty` or the request to skip allows it.

        Raises:
            RecordingError: It holds what is no number; names row and column.
        """
        names = self._list_names(text)
        parts = {name: self._read_column(name, empty) for name in names}
        first = parts[names[0]]
        if names == (text,):
            return replace(first, values=unwrap(first.values, wraps))
        columns = {}
        for name, part in parts.items():
            is_same = part.table == first.table and np.array_equal(part.rows, first.rows)
            columns[name] = part.values if is_same else part.interpolate(first.t_s)
        values = parse_expression(text).evaluate(columns)
        bad = ~np.isfinite(values)
        if bad.any() and not empty:
            row = int(np.argmax(bad))
            raise RecordingError(
                f"{locate(self.run, first, row, text)}: the value is {values[row]}, no number"
            )
        return Signal(first.table, first.t_s, unwrap(values, wraps), first.rows, text)

    def _read_column(self, name: str, empty: bool) -> Signal:
        table, column = self.run.places[name]
        content = self.run.tables[table]
        if content.is_sparse:
            content = content.select(np.isfinite(content.columns[column]))
        t_s = self._read_times(table, content)
        values = np.asarray(content.columns[column], dtype=float)
        lacking = ~np.isfinite(values)
        is_sparse = lacking.mean() >= SPARSE_SHARE
        if lacking.any() and not (empty or self.skip or is_sparse):
            self._refuse_cell(content, ~lacking, column, name)
        is_left_out = lacking & np.isfinite(t_s)
        if is_left_out.any() and not (self.quiet or empty or is_sparse):
            first = content.locate(int(np.argmax(is_left_out)))
            count = f"{is_left_out.sum()} of {len(values)} rows"
            text = "%s: column '%s': %s lack a number and are left out; the first is %s"
            log.warning(text, self.run.where, name, count, first)
        rows = np.flatnonzero(np.isfinite(t_s) if empty else np.isfinite(t_s) & ~lacking)
        if len(rows) < 2:
            count = f"{len(rows)} values with a time"
            self.run.refuse(f"column '{name}' has {count}; a log has at least 2")
        return Signal(table, t_s[rows], values[rows], rows, name)

    def _list_names(self, text: str) -> tuple[str, ...]:
        """Return the columns that a text names: itself, or those of its arithmetic."""
        if text in self.run.places:
            return (text,)
        try:
            names = parse_expression(text).names
        except ConfigError:
            self._refuse_missing(text)
            raise
        for name in names:
            self._refuse_missing(name)
        return names

    def _refuse_missing(self, name: str) -> None:
        """Refuse a column that is missing."""
        if f"{name}#1" in self.run.places:
            self.run.refuse(
                f"several columns are named '{name}'; rename them, or name one: {name}#1, {name}#2"
            )
        if name not in self.run.places:
            choices = list_choices(name, self.run.places)
            self.run.refuse(f"column '{name}' is missing or holds no numbers; {choices}")

    def _refuse_cell(self, table: Table, known: np.ndarray, column: str, name: str) -> NoReturn:
        """Refuse the first row of a column that is not `known`, `(T,)`; `name`: its full name."""
        row = int(np.argmin(known))
        cell = table.show_cell(row, column) if column in table.columns else "the value"
        place = f"{table.locate(row)}, column '{name}'"
        self.run.refuse(f"{place}: {cell} is not a number; {advise('damaged')}")


def locate(run: LogRun, signal: Signal, row: int, column: str) -> str:
    """Return file, row and column of a sample for a message."""
    table = signal.table
    inside = f"table '{table}', " if table and not column.startswith(f"{table}:") else ""
    place = run.tables[table].locate(int(signal.rows[row]))
    return f"{run.where}: {place}, {inside}column '{column}'"
