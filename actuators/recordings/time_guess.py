"""Guesses which column of a table is its time, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
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
SECOND_WORDS = {"sec", "secs", "seconds", "s"}
NANO_WORDS = {"nanosec", "nsec", "nsecs", "nanosecs", "ns", "nanoseconds", "nanos"}
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


def guess_time(name: str, table: Table, given: GivenColumns) -> TimeGuess | list[str]:
    """Return the clock of a table, or what is wrong with the columns that could be one."""
    subject = f"time of '{name}'" if name else "time"
    if given.rate_hz is not None:
        guess = Guess(
            subject, f"row / {given.rate_hz:g} Hz", (("as given by log.rate_hz", 5.0),), (), True
        )
        return TimeGuess(RowTime(rate_hz=given.rate_hz), guess)
    if table.clock is not None and given.time is None:
        return _guess_own_clock(subject, table)
    candidates, faults = [], []
    for text, values in _list_clocks(table, given.time):
        judged = _judge_clock(subject, text, values, table, given)
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
    if stamp in table.columns and np.ptp(table.columns[stamp]) > 0:  # a driver may leave it at 0
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
            return TimeGuess(time, Guess(subject, stamp, ((reason, 5.0),), (clock,)))
    time = Column(column=clock, scale=1.0, offset=0.0)
    guess = Guess(subject, clock, (("the recorder's own clock, in s", 5.0),))
    return TimeGuess(time, guess, num_doubled)


def _list_clocks(table: Table, given: Sequence[str] | None) -> Iterable[tuple[str, np.ndarray]]:
    """Yield the columns that could be a time, and pairs of seconds and nanoseconds."""
    columns = table.columns
    if given is not None:
        if all(name in columns for name in given):
            is_pair = len(given) > 1
            yield _pair_columns(columns, *given[:2]) if is_pair else (given[0], columns[given[0]])
        return
    for name in columns:
        for other, parts in columns.items():
            is_pair = SECOND_WORDS & {*split_words(name)} and NANO_WORDS & {*split_words(other)}
            if is_pair and other != name and np.nanmin(parts) >= 0 and np.nanmax(parts) < 1e9:
                yield _pair_columns(columns, name, other)
    yield from columns.items()


def _pair_columns(
    columns: Mapping[str, np.ndarray], second: str, nano: str
) -> tuple[str, np.ndarray]:
    """Return the time of a column of seconds and one of nanoseconds, as arithmetic and as numbers."""
    text = f"{quote(second)} + 1e-9 * {quote(nano)}"
    return text, columns[second] + 1e-9 * columns[nano]


def quote(name: str) -> str:
    """Return a name as arithmetic over columns takes it."""
    return name if re.fullmatch(r"[A-Za-z_]\w*", name) else f"`{name}`"


def _judge_clock(
    subject: str, text: str, values: np.ndarray, table: Table, given: GivenColumns
) -> TimeGuess | str | None:
    """Return a clock made of a column, a sentence about one that is broken, or `None` for no clock."""
    skip = given.is_skipping
    is_given = given.time is not None
    plain, stated = split_unit(text)
    words = {*split_words(plain)}
    is_chosen = is_given or text not in table.columns  # a pair is chosen by its two units
    is_named = is_chosen or not words.isdisjoint(TIME_WORDS | {*TIME_UNITS})
    is_count = not is_chosen and not words.isdisjoint(COUNT_WORDS)
    if is_count or len(values) < 2 or not np.isfinite(values).any():
        return None
    wraps = _find_time_wrap(values) if is_named else None
    values = unwrap(values, wraps)
    unit = 1.0 if text not in table.columns else TIME_UNITS.get(stated or "")
    if unit is None:
        named = [TIME_UNITS[word] for word in split_words(plain) if word in TIME_UNITS]
        unit = named[-1] if named else None
    later, fault = is_later(values), find_fault((unit or 1.0) * values, table, text)
    if is_named and is_later(-values).all():
        return f"'{text}' only decreases: the newest row comes first; sort the rows, oldest first"
    if not later.all():
        if later.mean() < (0.02 if is_named else 0.9) or not (skip or np.isfinite(values).all()):
            return None
        assert fault is not None
        if not words.isdisjoint(("dt", "delta", "diff", "period")):
            rate_hz = 1.0 / max(float(np.mean(values)), 1e-9)
            return f"'{text}' holds the time since the row before; {advise('rate', rate_hz=float(f'{rate_hz:.3g}'))}"
        if not (skip and fault.is_damage):
            place = table.locate(int(fault.rows[0]))
            return f"'{text}': {fault.text}, first in {place}; {fault.advice}"
    judged = _judge_unit(values[later], unit if is_named else None, is_named)
    if judged is None:
        return None
    scale, reason = judged
    steps = np.diff(values[later])
    period = float(np.median(steps))
    is_regular = float(np.quantile(np.abs(steps / period - 1.0), 0.9)) < 0.2
    evidence = [("only increases" if fault is None else f"but {fault.text}", 0.0), reason]
    evidence.append((f"{1.0 / (period * scale):.4g} Hz", 0.5 if is_regular else -0.5))
    evidence.append(("", 1.5) if is_named else ("its name does not say it", 0.0))
    if wraps is not None:
        evidence.append((f"it begins again at {wraps:g}", 0.0))
    if is_given:
        evidence.append(("as given by log.time", 2.0))
    time = Column(column=text, scale=scale, offset=0.0, wraps=wraps)
    return TimeGuess(time, Guess(subject, text, evidence, (), is_given))


def _judge_unit(
    times: np.ndarray, unit: float | None, is_named: bool
) -> tuple[float, Evidence] | None:
    """Return seconds for one of a clock and why, `None` where no unit gives the rate of a log of joints.

    Args:
        times: Increasing times.
        unit: Seconds for one, where a name says it.
        is_named: The name says that it is a time.
    """
    period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if period <= 0.0:
        return None
    rates_hz = {scale: 1.0 / (period * scale) for scale in (1.0, 1e-3, 1e-6, 1e-9)}
    scales = [one for one, rate in rates_hz.items() if RATES_HZ[0] <= rate <= RATES_HZ[1]]
    if unit is not None:
        return unit, (f"1 = {unit:g} s (unit in its name)", 5.0 if unit in scales else -3.0)
    for scale in scales:
        if EPOCH_S[0] <= abs(times[0]) * scale <= EPOCH_S[1]:
            return scale, (f"1 = {scale:g} s (it counts from 1970)", 4.0 if is_named else 2.0)
    is_whole = bool((times == np.round(times)).all())
    if not scales or (period == 1.0 and is_whole and not is_named):
        return None  # whole numbers that count rows are no clock
    usual = [one for one in scales if USUAL_RATES_HZ[0] <= rates_hz[one] <= USUAL_RATES_HZ[1]]
    scale = (usual or scales)[0] if is_whole else scales[0]
    if len(scales) == 1 or (not is_whole and usual == [scale]):
        return scale, (f"1 = {scale:g} s (the only unit that gives a usual rate)", 1.0)
    return scale, (f"1 = {scale:g} s (a unit 1000 times longer or shorter would do too)", 0.0)


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
