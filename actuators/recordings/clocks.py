"""Clocks of the tables of a log: columns of times, and what is done where they do not increase.

A clock that wraps, is set back, repeats rows or is coarser than the rows is named by its kind, with the
key that reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import theilslopes

from actuators.recordings.advice import advise
from actuators.recordings.expression import parse_expression
from actuators.recordings.log_tables import LogRun, Table, warn_once
from brokk_rl.errors import RecordingError
from brokk_rl.spec import Positive, spec

CLOCK_POINTS = 200
"""Points of the line that ties one clock to another; its cost grows with their square, and 200
points of the fastest messages fix a drift of 1 ppm within minutes."""
COARSE_SHARE = 0.1
"""Share of rows at the time of the row before from which a clock is coarse; lost rows repeat less often."""
MOST_UNORDERED = 0.1
"""Share of rows out of their order from which a clock is broken: its other times may be wrong too."""
SETBACK_PERIODS = 10
"""A longer step back is a clock that was set; shorter ones are rows out of their order."""


@spec
class Column:
    """A column of numbers: `scale * value + offset`.

    Attributes:
        column: Its name in the log, or arithmetic over columns.
        scale: Unit of the recording for one of the log.
        offset: Added after scaling, in the unit of the recording.
        wraps: Value of the log at which a counter or an angle begins again; negative for a sign bit
            of that value; `null` for none.
    """

    column: str
    scale: float
    offset: float
    wraps: float | None = None  # maps from before this field have none


@spec
class AlignedTime:
    """A clock that is tied to another one of the same table by a straight line.

    Samples carry the time of the sensor's own clock, whose zero and drift are unknown, and that of
    the recorder, which is late by the varying time of the transport. The line goes through the
    samples that were fastest.

    Attributes:
        column: Time of the sensor's clock.
        scale: Seconds for one of it.
        anchor: Time of the recorder's clock, to s.
    """

    column: str
    scale: float
    anchor: Column

    def align(self, stamp_s: np.ndarray, anchor_s: np.ndarray) -> np.ndarray:
        """Return times of the recorder's clock without the scatter of the transport, `(T,)` s."""
        late_s = anchor_s - stamp_s
        blocks = np.array_split(np.arange(len(late_s)), min(CLOCK_POINTS, len(late_s)))
        fastest = [int(rows[np.argmin(late_s[rows])]) for rows in blocks]
        x, y = stamp_s[fastest] - stamp_s[0], late_s[fastest]
        line: Any = theilslopes(y, x) if len(fastest) > 2 and np.ptp(x) > 0 else (0.0,)
        slope = float(line[0])
        return stamp_s + float(np.median(y - slope * x)) + slope * (stamp_s - stamp_s[0])


@spec
class RowTime:
    """A clock of rows that are equally spaced in time.

    Attributes:
        rate_hz: Their rate.
    """

    rate_hz: Positive


TimeColumn = Column | AlignedTime | RowTime
"""Clock of a table."""


@dataclass(frozen=True)
class ClockFault:
    """Rows of a clock that do not come later than all before.

    Attributes:
        kind: A `coarse` or a `broken` clock, one that was set `back`, or rows that repeat or are out of `order`.
        rows: Rows concerned.
        text: Description.
        advice: How the log is read all the same.
    """

    kind: str
    rows: np.ndarray
    text: str
    advice: str

    @property
    def is_damage(self) -> bool:
        """True where the other rows can be used."""
        return self.kind not in ("coarse", "broken")


def unwrap(values: np.ndarray, modulus: float | None) -> np.ndarray:
    """Return a counter or an angle without its wraps, `(T,)`; a negative modulus is a sign bit."""
    if not modulus:
        return values
    if modulus < 0:
        return np.where(values >= -modulus, -modulus - values, values)
    found, known = values.copy(), np.isfinite(values)
    found[known] = np.unwrap(values[known], period=modulus)
    return found


def put_near(values: np.ndarray, near: float, modulus: float) -> np.ndarray:
    """Return unwrapped values moved by whole turns until their median lies next to `near`; same shape."""
    if modulus <= 0.0:  # a sign bit, or none
        return values
    return values + modulus * round((near - float(np.median(values))) / modulus)


def is_later(times: np.ndarray) -> np.ndarray:
    """Return where a time is a number and later than all before it, `(T,)`."""
    known = np.where(np.isfinite(times), times, -np.inf)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(known)[:-1]])
    return known > before


def list_time_columns(time: TimeColumn) -> list[str]:
    """Return the columns, or the arithmetic, that a clock needs."""
    if isinstance(time, RowTime):
        return []
    return [time.column, time.anchor.column] if isinstance(time, AlignedTime) else [time.column]


def find_fault(t_s: np.ndarray, table: Table, clock: str) -> ClockFault | None:
    """Return what is wrong with a clock, `None` for one that only increases.

    Args:
        t_s: Its times, `(T,)` s.
        table: The table with the columns that are needed.
        clock: Column of the clock, which the others are held against.
    """
    later = is_later(t_s)
    if later.all():
        return None
    bad = np.flatnonzero(~later)
    steps = np.diff(t_s, prepend=-np.inf)
    is_equal = steps[bad] == 0
    others = [values for name, values in table.columns.items() if name != clock]
    same = np.ones(len(bad), dtype=bool)
    for values in others:
        now, before = values[bad], values[bad - 1]
        same &= (now == before) | (np.isnan(now) & np.isnan(before))
    count = f"{len(bad)} of {len(t_s)} rows"
    if (is_equal & ~same).sum() > COARSE_SHARE * len(t_s):
        text = f"the clock is coarser than the rows: {count} repeat the time of the row before, with other values"
        return ClockFault("coarse", bad, text, _advise_rate(t_s))
    period_s = float(np.median(steps[later][1:])) if later.sum() > 1 else 0.0
    back = np.flatnonzero(steps < -SETBACK_PERIODS * period_s)
    if 0 < len(back) <= max(3, 0.01 * len(t_s)):
        text = f"the clock is set back {len(back)} times, by {-steps[back[0]]:.4g} s at first; what follows is a piece of its own"
        return ClockFault("back", back, text, advise("damaged"))
    text = f"the time does not increase in {count}"
    if (is_equal & same).sum() > 0.5 * len(bad):
        return ClockFault("order", bad, f"{text}, which repeat the row before", advise("damaged"))
    if len(bad) > MOST_UNORDERED * len(t_s):
        rate = _advise_rate(np.floor(t_s))
        return ClockFault("broken", bad, f"{text}: its digits may be wrong", rate)
    return ClockFault("order", bad, text, advise("damaged"))


def _advise_rate(t_s: np.ndarray) -> str:
    """Return the advice to take rows as equally spaced, at their mean rate."""
    stamps_s, counts = np.unique(t_s[np.isfinite(t_s)], return_counts=True)
    # the first and the last stamp may have only a part of their rows
    span_s = stamps_s[-1] - stamps_s[1] if len(stamps_s) > 2 else 1.0
    rate_hz = float(counts[1:-1].sum() / span_s) or len(t_s)
    return advise("rate", rate_hz=float(f"{rate_hz:.3g}"))


def read_clock(
    run: LogRun, name: str, time: TimeColumn, skip: bool, gap_s: float, quiet: bool = False
) -> np.ndarray:
    """Return the times of a table, `(T,)` s; NaN for rows that are left out.

    Args:
        run: The run.
        name: The table.
        time: Its clock.
        skip: Leave rows out whose time does not increase, instead of refusing the log.
        gap_s: Time at which a log is split; parts between which the clock was set back lie further apart.
        quiet: Leave out without a warning.

    Raises:
        RecordingError: The times cannot be used.
    """
    table = run.tables[name]
    num_rows = len(next(iter(table.columns.values())))
    if num_rows < 2:
        raise RecordingError(
            f"{run.where}: table '{name}' has {num_rows} rows; a log has at least 2"
        )
    if isinstance(time, RowTime):
        return np.arange(num_rows) / time.rate_hz
    wraps, offset_s = (time.wraps, time.offset) if isinstance(time, Column) else (None, 0.0)
    t_s = time.scale * unwrap(_read_column(table.columns, time.column), wraps) + offset_s
    known = np.isfinite(t_s)
    if not known.all() and not skip:
        row = int(np.argmin(known))
        cell = table.show_cell(row, time.column) if time.column in table.columns else "the value"
        raise RecordingError(
            f"{run.where}: {table.locate(row)}, column '{time.column}': {cell} is not a number; {advise('damaged')}"
        )
    fault = find_fault(t_s, table, time.column)
    if fault is not None:
        row = int(fault.rows[0])
        place = f"{run.where}: {table.locate(row)}, column '{time.column}'"
        if not (skip and fault.is_damage):
            before_s = t_s[max(row - 1, 0)]
            raise RecordingError(
                f"{place}: time does not increase ({before_s:g} s, then {t_s[row]:g} s): {fault.text}; {fault.advice}"
            )
        for at in fault.rows if fault.kind == "back" else ():
            t_s[at:] += t_s[at - 1] - t_s[at] + 2.0 * gap_s
        later = is_later(t_s)
        if not quiet:
            warn_once(f"{place}: {fault.text}; {np.sum(~later)} of {num_rows} rows left out")
        t_s = np.where(later, t_s, np.nan)
    if isinstance(time, AlignedTime):
        kept = np.isfinite(t_s)
        anchor = _read_column(table.columns, time.anchor.column)
        anchor_s = time.anchor.scale * anchor + time.anchor.offset
        t_s[kept] = time.align(t_s[kept], anchor_s[kept])
    return t_s


def _read_column(columns: Mapping[str, np.ndarray], text: str) -> np.ndarray:
    if text in columns:
        return np.asarray(columns[text], dtype=float)
    return parse_expression(text).evaluate(columns)
