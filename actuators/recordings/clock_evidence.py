"""Which column of a table is its clock, and in which unit: each that increases is a hypothesis that name and rate weigh."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
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
from actuators.recordings.guess import Evidence, GivenColumns, Guess
from actuators.recordings.log_tables import LogRun, Table, index_columns
from actuators.recordings.name_evidence import TIME_UNITS, WORDS, read_words, split_unit
from brokk_rl.errors import RecordingError, list_choices

RATES_HZ = (0.1, 5000.0)
"""Slowest and fastest rate of a log of joints; a unit of time that gives another one is wrong."""
USUAL_RATES_HZ = (10.0, 1000.0)
EPOCH_S = (1e9, 4e9)
"""Seconds since 1970 from 2001 to 2096."""
SECOND_WORDS = {"sec", "secs", "seconds", "s"}
NANO_WORDS = {"nanosec", "nsec", "nsecs", "nanosecs", "ns", "nanoseconds", "nanos"}
DOUBLED_SHARE = 0.2
"""Share of repeated stamps from which two programs send to one topic."""
MOST_DRIFT = 0.01
"""Drift of a sensor's clock from which on it does not count seconds; crystals drift by 1e-4 at most."""
TIME_MODULI = (2.0**16, 2.0**24, 2.0**32, 1e3, 1e4, 1e5, 1e6, 1e9, 3600.0, 86400.0)
"""Values at which counters of time begin again, in their own unit."""


@dataclass(frozen=True)
class TimeGuess:
    """The clock of a table.

    Attributes:
        time: Its column.
        guess: How sure it is.
    """

    time: TimeColumn
    guess: Guess


def guess_times(run: LogRun, given: GivenColumns) -> dict[str, TimeGuess]:
    """Return the clock of each table that has one.

    Raises:
        RecordingError: None has, or a clock that is given an offset is missing.
    """
    times, faults = {}, []
    for name, table in run.tables.items():
        found = _guess_time(f"time of '{name}'" if name else "time", table, given)
        if isinstance(found, TimeGuess):
            offset_s = (given.clock_offset_s or {}).get(name, 0.0)
            times[name] = replace(found, time=_shift_clock(found.time, offset_s))
        else:
            faults += found
    columns = index_columns({name: [*table.columns] for name, table in run.tables.items()})
    if not columns:
        raise RecordingError(f"{run.where}: no column of numbers can be read in it")
    if not times:
        rate = f"{advise('rate', rate_hz=50.0)} where they are at 50 Hz"
        broken = "; ".join(faults) or f"columns: {', '.join(columns)}; {rate}"
        raise RecordingError(
            f"{run.where}: no column is the time: none increases at a rate of {RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz; {broken}"
        )
    for name in given.clock_offset_s or {}:
        if name not in times:
            raise RecordingError(
                f"{run.where}: log.clock_offset_s: table '{name}' is missing or has no clock; {list_choices(name, times)}"
            )
    return times


def _shift_clock(time: TimeColumn, offset_s: float) -> TimeColumn:
    """Return a clock that is later by a time."""
    if isinstance(time, AlignedTime):
        return replace(time, anchor=replace(time.anchor, offset=time.anchor.offset + offset_s))
    return time if isinstance(time, RowTime) else replace(time, offset=time.offset + offset_s)


def _guess_time(subject: str, table: Table, given: GivenColumns) -> TimeGuess | list[str]:
    """Return the clock of a table, or what is wrong with the columns that could be one."""
    if given.rate_hz is not None:
        evidence = [("as given by log.rate_hz", 5.0)]
        guess = Guess(subject, f"row / {given.rate_hz:g} Hz", evidence, (), True)
        return TimeGuess(RowTime(rate_hz=given.rate_hz), guess)
    if table.clock is not None and given.time is None:
        return _guess_own_clock(subject, table, table.clock)
    candidates, faults = [], []
    for text, values in _list_clocks(table, given.time):
        judged = _ClockJudge(text, values, table, given).judge(subject)
        if isinstance(judged, TimeGuess):
            candidates.append(judged)
        elif judged:
            faults.append(judged)
    if not candidates:
        return faults
    best = max(candidates, key=lambda one: one.guess.probability)
    others = tuple(one.guess.value for one in candidates if one is not best)
    guess = replace(best.guess, others=others).advise(advise("time", columns=best.guess.value))
    return replace(best, guess=guess)


def _guess_own_clock(subject: str, table: Table, clock: str) -> TimeGuess:
    """Return the clock that the reader of the log made, or that of the sensor tied to it."""
    stamp_s, anchor_s = table.columns.get("header.stamp", np.zeros(1)), table.columns[clock]
    anchor = Column(column=clock, scale=1.0, offset=0.0)
    steps_s, late_s = np.diff(stamp_s), anchor_s - stamp_s
    is_later = len(steps_s) > 1 and bool((steps_s > 0).all())
    drift = float(np.polyfit(stamp_s - stamp_s[0], late_s, 1)[0]) if is_later else math.inf
    if abs(drift) > MOST_DRIFT:  # it repeats, or is not in s
        evidence = [("the recorder's own clock, in s", 5.0)]
        num_doubled = int((steps_s == 0).sum())
        # a driver may leave all stamps at 0
        if steps_s.any() and num_doubled > DOUBLED_SHARE * len(steps_s):
            text = f"{num_doubled} of {len(stamp_s)} messages repeat the stamp of the one before"
            evidence.append((f"{text}: two programs send on one topic", -8.0))
        return TimeGuess(anchor, Guess(subject, clock, evidence))
    scatter_s = np.quantile(late_s, 0.95) - late_s.min()
    reason = (
        f"the sensor's own clock; behind the recorder's by {np.median(late_s):.4g} s, drift {1e6 * drift:.3g} ppm, "
        f"scatter of the transport {1000 * scatter_s:.3g} ms"
    )
    time = AlignedTime(column="header.stamp", scale=1.0, anchor=anchor)
    return TimeGuess(time, Guess(subject, "header.stamp", ((reason, 5.0),), (clock,)))


def _list_clocks(table: Table, given: Sequence[str] | None) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the columns that could be a time, and pairs of seconds and nanoseconds."""
    columns = table.columns
    pairs = [given] if given and len(given) > 1 else []
    for name in columns if given is None else ():
        for other, parts in columns.items():
            is_pair = SECOND_WORDS & {*read_words(name)} and NANO_WORDS & {*read_words(other)}
            if is_pair and other != name and np.nanmin(parts) >= 0 and np.nanmax(parts) < 1e9:
                pairs.append((name, other))
    for second, nano, *_ in pairs:
        if second in columns and nano in columns:
            text = f"{_quote(second)} + 1e-9 * {_quote(nano)}"
            yield text, columns[second] + 1e-9 * columns[nano]
    if not (given and pairs):
        yield from ((name, columns[name]) for name in given or columns if name in columns)


def _quote(name: str) -> str:
    """Return a name as arithmetic over columns takes it."""
    return name if re.fullmatch(r"[A-Za-z_]\w*", name) else f"`{name}`"


class _ClockJudge:
    """Weighs whether a column is the clock of its table.

    Args:
        text: Its name, or the arithmetic of a pair.
        values: Its numbers, `(T,)`.
        table: Its table.
        given: Meanings that a person gives.
    """

    def __init__(self, text: str, values: np.ndarray, table: Table, given: GivenColumns) -> None:
        self._text, self._values, self._table, self._given = text, values, table, given
        self._words = set(read_words(text))
        is_pair = text not in table.columns  # chosen by its two units
        is_time = not self._words.isdisjoint(WORDS["time"] | TIME_UNITS.keys())
        self._is_named = is_pair or given.time is not None or is_time
        self._is_count = (
            not is_pair and given.time is None and not self._words.isdisjoint(WORDS["count"])
        )
        named = [split_unit(text)[1] or "", *reversed(read_words(text))]
        units = [TIME_UNITS[one] for one in named if one in TIME_UNITS]
        self._unit = 1.0 if is_pair else (units[0] if units and self._is_named else None)

    def judge(self, subject: str) -> TimeGuess | str | None:
        """Return the clock, a sentence about one that is broken, or `None` for no clock."""
        if self._is_count or len(self._values) < 2 or not np.isfinite(self._values).any():
            return None
        wraps = _find_time_wrap(self._values) if self._is_named else None
        values = unwrap(self._values, wraps)
        fault = find_fault((self._unit or 1.0) * values, self._table, self._text)
        later = is_later(values)
        if self._is_named and is_later(-values).all():
            return f"'{self._text}' only decreases: the newest row comes first; sort the rows, oldest first"
        if fault is not None:
            if later.mean() < (0.02 if self._is_named else 0.9):
                return None
            if not self._words.isdisjoint(("dt", "delta", "diff", "period")):
                rate_hz = float(f"{1.0 / max(float(np.mean(values)), 1e-9):.3g}")
                return f"'{self._text}' holds the time since the row before; {advise('rate', rate_hz=rate_hz)}"
            if not fault.is_damage:  # damage is refused, or skipped, where the whole log is read
                place = self._table.locate(int(fault.rows[0]))
                return f"'{self._text}': {fault.text}, first in {place}; {fault.advice}"
        weighed = self._weigh_unit(values[later])
        if weighed is None:
            return None
        scale, reason = weighed
        steps = np.diff(values[later])
        period = float(np.median(steps))
        is_regular = float(np.quantile(np.abs(steps / period - 1.0), 0.9)) < 0.2
        evidence = [("only increases" if fault is None else f"but {fault.text}", 0.0), reason]
        evidence.append((f"{1.0 / (period * scale):.4g} Hz", 0.5 if is_regular else -0.5))
        evidence.append(("", 1.5) if self._is_named else ("its name does not say it", 0.0))
        if wraps is not None:
            evidence.append((f"it begins again at {wraps:g}", 0.0))
        is_given = self._given.time is not None
        if is_given:
            evidence.append(("as given by log.time", 2.0))
        time = Column(column=self._text, scale=scale, offset=0.0, wraps=wraps)
        return TimeGuess(time, Guess(subject, self._text, evidence, (), is_given))

    def _weigh_unit(self, times: np.ndarray) -> tuple[float, Evidence] | None:
        """Return seconds for one of the clock and why, `None` where no unit gives the rate of a log of joints."""
        period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        if period <= 0.0:
            return None
        rates_hz = {scale: 1.0 / (period * scale) for scale in (1.0, 1e-3, 1e-6, 1e-9)}
        scales = [one for one, rate in rates_hz.items() if RATES_HZ[0] <= rate <= RATES_HZ[1]]
        if self._unit is not None:
            weight = 5.0 if self._unit in scales else -3.0
            return self._unit, (f"1 = {self._unit:g} s (unit in its name)", weight)
        for scale in scales:
            if EPOCH_S[0] <= abs(times[0]) * scale <= EPOCH_S[1]:
                weight = 4.0 if self._is_named else 2.0
                return scale, (f"1 = {scale:g} s (it counts from 1970)", weight)
        is_whole = bool((times == np.round(times)).all())
        if not scales or (period == 1.0 and is_whole and not self._is_named):
            return None  # whole numbers that count rows are no clock
        usual = [one for one in scales if USUAL_RATES_HZ[0] <= rates_hz[one] <= USUAL_RATES_HZ[1]]
        scale = (usual or scales)[0] if is_whole else scales[0]
        if len(scales) == 1 or (not is_whole and usual == [scale]):
            return scale, (f"1 = {scale:g} s (the only unit that gives a usual rate)", 1.0)
        return scale, (f"1 = {scale:g} s (a unit 1000 times longer or shorter would do too)", 0.0)


def _find_time_wrap(values: np.ndarray) -> float | None:
    """Return the value at which a counter of time begins again, `None` for one that does not."""
    steps = np.diff(values[np.isfinite(values)])
    forward, back = steps[steps > 0], steps[steps < 0]
    if not len(back) or len(forward) < 10 or len(back) > 0.2 * len(steps) or np.nanmin(values) < 0:
        return None
    period = float(np.median(forward))
    for modulus in TIME_MODULI:
        # from the last value before the wrap to the first after it one period passes
        if np.abs(back + modulus - period).max() <= max(1.5 * period, 0.001 * modulus):
            return modulus
    return None
