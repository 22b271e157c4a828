"""Guesses which column of a table is its time, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from actuators.recordings.advice import advise
from actuators.recordings.clocks import (
    AlignedTime,
    Column,
    RowTime,
    TimeColumn,
    find_fault,
    is_later,
    unwrap,
)
from actuators.recordings.column_names import (
    COUNT_WORDS,
    TIME_UNITS,
    TIME_WORDS,
    split_unit,
    split_words,
)
from actuators.recordings.guess import Evidence, GivenColumns, Guess
from actuators.recordings.log_tables import Table

RATES_HZ = (0.1, 5000.0)
"""Slowest and fastest rate of a log of joints; a unit of time that gives another one is wrong."""
USUAL_RATES_HZ = (10.0, 1000.0)
EPOCH_S = (1e9, 4e9)
"""Seconds since 1970 from 2001 to 2096."""
TIME_MODULI = (2.0**16, 2.0**24, 2.0**32, 1e3, 1e4, 1e5, 1e6, 1e9, 3600.0, 86400.0)
"""Values at which counters of time begin again, in their own unit."""


@dataclass(frozen=True)
class TimeGuess:
    """The clock of a table.

    Attributes:
        time: Its column.
        guess: How sure it is.
        num_doubled: Rows whose stamp repeats that of the row before, with other values.
    """

    time: TimeColumn
    guess: Guess
    num_doubled: int = 0


def shift_clock(time: TimeColumn, offset_s: float) -> TimeColumn:
    """Return a clock that is later by a time."""
    if isinstance(time, Column):
        return replace(time, offset=time.offset + offset_s)
    if isinstance(time, AlignedTime):
        return replace(time, anchor=replace(time.anchor, offset=time.anchor.offset + offset_s))
    return time


def guess_time(name: str, table: Table, given: GivenColumns, skip: bool) -> TimeGuess | list[str]:
    """Return the clock of a table, or what is wrong with the columns that could be one."""
    subject = f"time of '{name}'" if name else "time"
    if given.rate_hz is not None:
        guess = Guess(
            subject,
            f"row / {given.rate_hz:g} Hz",
            (Evidence("as given by log.rate_hz", 5.0),),
            (),
            True,
        )
        return TimeGuess(RowTime(rate_hz=given.rate_hz), guess)
    if table.clock is not None and given.time is None:
        return _guess_own_clock(subject, table)
    candidates, faults = [], []
    for text, values in _list_clocks(table, given.time):
        judged = _judge_clock(subject, text, values, table, skip, given.time is not None)
        if isinstance(judged, TimeGuess):
            candidates.append(judged)
        elif judged:
            faults.append(judged)
    if not candidates:
        return faults
    best = max(candidates, key=lambda one: one.guess.probability)
    others = tuple(one.guess.value for one in candidates if one is not best)
    remedy = advise("time", columns=best.guess.value)
    return replace(best, guess=replace(best.guess, others=others).advise(remedy))


def _guess_own_clock(subject: str, table: Table) -> TimeGuess:
    """Return the clock that the reader of the log made, or that of the sensor tied to it."""
    clock, stamp = table.clock or "", "header.stamp"
    num_doubled = 0
    if stamp in table.columns:
        stamp_s, anchor_s = table.columns[stamp], table.columns[clock]
        num_doubled = int((np.diff(stamp_s) == 0).sum())
        if len(stamp_s) > 2 and (np.diff(stamp_s) > 0).all():
            late_s = anchor_s - stamp_s
            drift = float(np.polyfit(stamp_s - stamp_s[0], late_s, 1)[0])
            reason = (
                f"the sensor's own clock; behind the recorder's by {np.median(late_s):.4g} s, drift {1e6 * drift:.3g} ppm, "
                f"scatter of the transport {1000 * (np.quantile(late_s, 0.95) - late_s.min()):.3g} ms"
            )
            anchor = Column(column=clock, scale=1.0, offset=0.0)
            time = AlignedTime(column=stamp, scale=1.0, anchor=anchor)
            return TimeGuess(time, Guess(subject, stamp, (Evidence(reason, 5.0),), (clock,)))
    time = Column(column=clock, scale=1.0, offset=0.0)
    guess = Guess(subject, clock, (Evidence("the recorder's own clock, in s", 5.0),))
    return TimeGuess(time, guess, num_doubled)


def _list_clocks(table: Table, given: Sequence[str] | None) -> Iterable[tuple[str, np.ndarray]]:
    """Yield the columns that could be a time, and pairs of seconds and nanoseconds."""
    columns = table.columns
    if given is not None:
        if all(name in columns for name in given):
            text = given[0] if len(given) == 1 else f"{quote(given[0])} + 1e-9 * {quote(given[1])}"
            values = columns[given[0]] + (1e-9 * columns[given[1]] if len(given) > 1 else 0.0)
            yield text, values
        return
    for name, values in columns.items():
        words = split_words(name)
        if not any(word in ("sec", "secs", "seconds", "s") for word in words):
            continue
        for other, parts in columns.items():
            has_unit = any(
                word in ("nanosec", "nsec", "nsecs", "nanosecs", "ns", "nanoseconds", "nanos")
                for word in split_words(other)
            )
            if has_unit and other != name and np.nanmin(parts) >= 0 and np.nanmax(parts) < 1e9:
                yield f"{quote(name)} + 1e-9 * {quote(other)}", values + 1e-9 * parts
    yield from columns.items()


def quote(name: str) -> str:
    """Return a name as arithmetic over columns takes it."""
    return name if re.fullmatch(r"[A-Za-z_]\w*", name) else f"`{name}`"


def _judge_clock(
    subject: str, text: str, values: np.ndarray, table: Table, skip: bool, is_given: bool
) -> TimeGuess | str | None:
    """Return a clock made of a column, a sentence about one that is broken, or `None` for no clock."""
    if len(values) < 2 or not np.isfinite(values).any():
        return None
    is_pair = text not in table.columns
    plain, stated = split_unit(text)
    words = split_words(plain)
    is_named = (
        is_pair or is_given or any(word in TIME_WORDS or word in TIME_UNITS for word in words)
    )
    if not is_pair and not is_given and any(word in COUNT_WORDS for word in words):
        return None
    wraps = _find_time_wrap(values) if is_named else None
    values = unwrap(values, wraps)
    later = is_later(values)
    if is_named and is_later(-values).all():
        return f"'{text}' only decreases: the newest row comes first; sort the rows, oldest first"
    if not later.all():
        if later.mean() < (0.02 if is_named else 0.9) or not (skip or np.isfinite(values).all()):
            return None
        fault = find_fault(values, table, text)
        assert fault is not None
        if any(word in ("dt", "delta", "diff", "period") for word in words):
            rate_hz = 1.0 / max(float(np.mean(values)), 1e-9)
            return f"'{text}' holds the time since the row before; {advise('rate', rate_hz=float(f'{rate_hz:.3g}'))}"
        if not skip or fault.kind == "coarse":
            place = table.locate(int(fault.rows[0]))
            return f"'{text}': {fault.text}, first in {place}; {fault.advice}"
    steps = np.diff(values[later])
    period = float(np.median(steps)) if len(steps) else 0.0
    if period <= 0.0:
        return None
    evidence = [
        Evidence(
            "only increases"
            if later.all()
            else f"increases but for {int((~later).sum())} of {len(later)} rows",
            0.0,
        )
    ]
    unit = 1.0 if is_pair else TIME_UNITS.get(stated or "")
    if unit is None:
        unit = next((TIME_UNITS[word] for word in reversed(words) if word in TIME_UNITS), None)
    scales = [
        s for s in (1.0, 1e-3, 1e-6, 1e-9) if RATES_HZ[0] <= 1.0 / (period * s) <= RATES_HZ[1]
    ]
    epochs = [s for s in scales if EPOCH_S[0] <= abs(values[later][0]) * s <= EPOCH_S[1]]
    if unit is not None and is_named:
        scale = unit
        evidence.append(
            Evidence(f"1 = {scale:g} s (unit in its name)", 5.0 if unit in scales else -3.0)
        )
    elif not scales:
        return None
    elif epochs:
        scale = epochs[0]
        evidence.append(
            Evidence(f"1 = {scale:g} s (it counts from 1970)", 4.0 if is_named else 2.0)
        )
    else:
        usual = [s for s in scales if USUAL_RATES_HZ[0] <= 1.0 / (period * s) <= USUAL_RATES_HZ[1]]
        is_whole = bool((values[later] == np.round(values[later])).all())
        scale = (usual or scales)[0] if is_whole else scales[0]
        is_only = len(scales) == 1 or (not is_whole and len(usual) == 1 and usual[0] == scale)
        text_of_unit = (
            "the only unit that gives a usual rate"
            if is_only
            else "a unit 1000 times longer or shorter would do too"
        )
        evidence.append(Evidence(f"1 = {scale:g} s ({text_of_unit})", 1.0 if is_only else 0.0))
        if period == 1.0 and is_whole and not is_named:
            return None  # whole numbers that count rows are no clock
    is_regular = float(np.quantile(np.abs(steps / period - 1.0), 0.9)) < 0.2
    evidence.append(Evidence(f"{1.0 / (period * scale):.4g} Hz", 0.5 if is_regular else -0.5))
    evidence.append(
        Evidence("" if is_named else "its name does not say it", 1.5 if is_named else 0.0)
    )
    if wraps is not None:
        evidence.append(Evidence(f"it begins again at {wraps:g}", 0.0))
    if is_given:
        evidence.append(Evidence("as given by log.time", 2.0))
    guess = Guess(subject, text, tuple(evidence), (), is_given)
    return TimeGuess(Column(column=text, scale=scale, offset=0.0, wraps=wraps), guess)


def _find_time_wrap(values: np.ndarray) -> float | None:
    """Return the value at which a counter of time begins again, `None` for one that does not."""
    steps = np.diff(values[np.isfinite(values)])
    forward = steps[steps > 0]
    back = steps[steps < 0]
    if not len(back) or len(forward) < 10 or len(back) > 0.2 * len(steps):
        return None
    period = float(np.median(forward))
    for modulus in TIME_MODULI:
        # from the last value before the wrap to the first after it one period passes
        if (
            np.abs(back + modulus - period).max() <= max(1.5 * period, 0.001 * modulus)
            and np.nanmin(values) >= 0
        ):
            return modulus
    return None
