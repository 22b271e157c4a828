"""Guesses which column of a table is its time, in which unit, and says how sure it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from actuators.recordings.column_names import TIME_UNITS, TIME_WORDS, split_words
from actuators.recordings.log_tables import LogRun, Table
from actuators.recordings.whole_rows import is_later
from brokk_rl.errors import RecordingError, list_choices

Sureness = Literal["sure", "likely", "unsure"]
RATES_HZ = (1.0, 5000.0)
"""Slowest and fastest rate of a log of joints; a unit of time that gives another one is wrong."""
LATER_SHARE = 0.9
"""Share of the rows in which a clock must increase; a coarser one repeats its values for another reason."""


@dataclass(frozen=True)
class Guess:
    """One guess.

    Attributes:
        subject: What is guessed, `boom: command`.
        value: The chosen value as text.
        sureness: How sure it is.
        reason: Evidence for it.
        others: Other candidates.
    """

    subject: str
    value: str
    sureness: Sureness
    reason: str
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class TimeGuess:
    """The clock of a table.

    Attributes:
        column: Its column.
        scale: Seconds for one of it.
        anchor: Column of the recorder's clock, to s; `None` without one.
        guess: How sure it is.
        offset_s: Seconds added to it, as given.
    """

    column: str
    scale: float
    anchor: str | None
    guess: Guess
    offset_s: float = 0.0


def guess_times(
    run: LogRun, skip: bool = False, offsets_s: Mapping[str, float] | None = None
) -> dict[str, TimeGuess]:
    """Return the clock of each table that has one.

    Args:
        run: Beginning of a log, with all columns.
        skip: Accept a clock that repeats or lacks some times; these rows will be left out.
        offsets_s: Seconds added to the clocks of tables.
    """
    found = {}
    for name, table in run.tables.items():
        time = _guess_time(name, table, skip)
        if time is not None:
            found[name] = time
    for name, offset_s in (offsets_s or {}).items():
        if name not in found:
            raise RecordingError(
                f"{run.where}: log.clock_offset_s: table '{name}' is missing or has no clock; {list_choices(name, found)}"
            )
        found[name] = replace(found[name], offset_s=float(offset_s))
    return found


def describe_broken_clocks(run: LogRun) -> list[str]:
    """Return a sentence for each column that could be a time if it increased in all rows."""
    found = []
    for table in run.tables.values():
        for column, values in table.columns.items():
            later = is_later(values)
            if later.all() or not (_is_named_time(column) or later.mean() >= LATER_SHARE):
                continue
            row = int(np.argmin(later))
            found.append(
                f"'{column}' does not increase in {int((~later).sum())} of {len(later)} rows, first in {table.locate(row)}"
            )
    return found


def _is_named_time(column: str) -> bool:
    return any(word in TIME_WORDS or word in TIME_UNITS for word in split_words(column))


def _guess_time(name: str, table: Table, skip: bool) -> TimeGuess | None:
    candidates = []
    for column in table.columns:
        words, is_named = split_words(column), _is_named_time(column)
        values = table.columns[column]
        if len(values) < 2:
            continue
        later = is_later(values)
        if not later.all() and not (skip and is_named and later.mean() >= LATER_SHARE):
            continue
        values = values[later]
        unit = next((TIME_UNITS[word] for word in reversed(words) if word in TIME_UNITS), None)
        period = float(np.median(np.diff(values)))
        scales = [s for s in (1.0, 1e-3, 1e-6, 1e-9) if RATES_HZ[0] <= 1.0 / (period * s) <= RATES_HZ[1]]  # fmt: skip
        if unit is not None and is_named:
            candidates.append((2 if unit in scales else 0, column, unit, "unit in its name"))
        elif scales:
            # Integers that count rows are no clock.
            is_count = period == 1.0 and not is_named
            candidates.append((0 if is_count else int(is_named), column, scales[0], ""))
    if "log_time" in table.columns and "header.stamp" in table.columns:
        stamp = table.columns["header.stamp"]
        if np.all(np.diff(stamp) > 0):
            return _guess_stamped(name, table)
    named = sorted((c for c in candidates if c[0] > 0), key=lambda c: -c[0])
    best = named[0] if named else (candidates[0] if len(candidates) == 1 else None)
    if best is None:
        return None
    _, column, scale, source = best
    later = is_later(table.columns[column])
    rate_hz = 1.0 / (float(np.median(np.diff(table.columns[column][later]))) * scale)
    sure: Sureness = "sure" if named and source else ("likely" if named else "unsure")
    reason = f"only increases; 1 = {scale:g} s ({source or 'the only unit that gives a rate of 1 to 5000 Hz'}): {rate_hz:.4g} Hz"
    if not source and named and RATES_HZ[0] <= rate_hz / 1000 * 1.0:
        reason += "; a unit 1000 times longer would do too"
    if not later.all():
        reason = reason.replace(
            "only increases", f"increases but for {int((~later).sum())} of {len(later)} rows"
        )
    others = tuple(c[1] for c in candidates if c[1] != column)
    subject = f"time of '{name}'" if name else "time"
    return TimeGuess(column, scale, None, Guess(subject, column, sure, reason, others))


def _guess_stamped(name: str, table: Table) -> TimeGuess:
    """Return the sensor's clock, tied to that of the recorder."""
    stamp_s, anchor_s = table.columns["header.stamp"], table.columns["log_time"]
    late_s = anchor_s - stamp_s
    drift = float(np.polyfit(stamp_s - stamp_s[0], late_s, 1)[0]) if len(stamp_s) > 2 else 0.0
    reason = (
        f"the sensor's own clock; behind the recorder's by {np.median(late_s):.4g} s, drift {1e6 * drift:.3g} ppm, "
        f"scatter of the transport {1000 * (np.quantile(late_s, 0.95) - late_s.min()):.3g} ms"
    )
    guess = Guess(f"time of '{name}'", "header.stamp", "sure", reason, ("log_time",))
    return TimeGuess("header.stamp", 1.0, "log_time", guess)


def read_times(table: Table, time: TimeGuess) -> np.ndarray:
    """Return the times of a table, `(T,)` s, by the recorder's clock where it has one."""
    scale = 1.0 if time.anchor else time.scale
    return np.asarray(table.columns[time.anchor or time.column]) * scale + time.offset_s
