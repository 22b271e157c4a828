"""Clocks of the tables of a log: how they are read, what is done where they do not increase, and which column is one.

A clock that wraps, is set back, repeats rows or is coarser than the rows is named, with the key that reads
it. Each column that increases is a hypothesis of a clock, which its name and its rate weigh.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import theilslopes

from actuators.recordings.guess import Evidence, GivenColumns, Guess, advise
from actuators.recordings.log_tables import LogRun, Table, parse_expression
from actuators.recordings.name_evidence import TIME_UNITS, WORDS, read_words, split_unit
from actuators.recordings.signal_checks import find_wrap
from brokk_rl.errors import list_choices
from brokk_rl.spec import NonZero, Positive, spec

CLOCK_POINTS = 200
"""Points of the line that ties one clock to another; its cost grows with their square, and 200
points of the fastest messages fix a drift of 1 ppm within minutes."""
MOST_UNORDERED = 0.1
"""Share of rows out of their order from which a clock is useless: its other times may be wrong too."""
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
    scale: NonZero
    offset: float
    wraps: float | None = None  # maps from before this field have none

    def compute(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return its numbers, `(T,)` in the unit of the recording, from columns of one clock."""
        values = columns.get(self.column)
        if values is None:
            values = parse_expression(self.column).evaluate(columns)
        return self.scale * unwrap(np.asarray(values, dtype=float), self.wraps) + self.offset


@spec
class AlignedTime(Column):
    """A clock that is tied to another one of the same table by a straight line.

    Samples carry the time of the sensor's own clock, whose zero and drift are unknown, and that of
    the recorder, which is late by the varying time of the transport. The line goes through the
    samples that were fastest.

    Attributes:
        column: Time of the sensor's clock.
        scale: Seconds for one of it.
        offset: As of a `Column`; the line takes it out again.
        anchor: Time of the recorder's clock, to s.
    """

    anchor: Column
    offset: float = 0.0

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
        rows: Rows concerned.
        text: Description.
        advice: How the log is read all the same.
        is_damage: The other rows can be used.
        is_set_back: The clock was set back before each of the rows.
    """

    rows: np.ndarray
    text: str
    advice: str
    is_damage: bool = True
    is_set_back: bool = False


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
        table: Its table.
        clock: Column of the clock, which the others are held against.
    """
    later = is_later(t_s)
    if later.all():
        return None
    bad = np.flatnonzero(~later)
    steps = np.diff(t_s, prepend=-np.inf)
    repeats = steps[bad] == 0
    for name, values in table.columns.items():
        if name != clock:
            now, before = values[bad], values[bad - 1]
            repeats &= (now == before) | (np.isnan(now) & np.isnan(before))
    most = MOST_UNORDERED * len(t_s)
    is_coarse = ((steps[bad] == 0) & ~repeats).sum() > most
    period_s = float(np.median(steps[later][1:])) if later.sum() > 1 else 0.0
    back = np.flatnonzero(steps < -SETBACK_PERIODS * period_s)
    if 0 < len(back) <= max(3, 0.01 * len(t_s)) and not is_coarse:
        text = f"the clock is set back {len(back)} times, by {-steps[back[0]]:.4g} s at first; what follows is a piece of its own"
        return ClockFault(back, text, advise("damaged"), is_set_back=True)
    text = f"the time does not increase in {len(bad)} of {len(t_s)} rows"
    if (~repeats).sum() > most:
        text = (
            f"{text}, which have other values: it is coarser than the rows, or its digits are wrong"
        )
        return ClockFault(bad, text, _advise_rate(t_s), is_damage=False)
    if repeats.sum() > 0.5 * len(bad):
        text = f"{text}, which repeat the row before"
    return ClockFault(bad, text, advise("damaged"))


def _advise_rate(t_s: np.ndarray) -> str:
    """Return the advice to take rows as equally spaced, at their mean rate."""
    seconds, counts = np.unique(np.floor(t_s[np.isfinite(t_s)]), return_counts=True)
    # the first and the last second may have only a part of their rows
    span_s = seconds[-1] - seconds[1] if len(seconds) > 2 else 1.0
    rate_hz = float(counts[1:-1].sum() / span_s) or len(t_s)
    return advise("rate", rate_hz=float(f"{rate_hz:.3g}"))


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
TIME_MODULI = (1e3, 3600.0, 1e4, 2.0**16, 86400.0, 1e5, 1e6, 2.0**24, 1e9, 2.0**32)
"""Values at which counters of time begin again, in their own unit."""


def guess_times(run: LogRun, given: GivenColumns) -> dict[str, Guess]:
    """Return the clock of each table that has one; the choice of a guess is a `TimeColumn`.

    Raises:
        RecordingError: None has, or a clock that is given an offset is missing.
    """
    times, faults = {}, []
    for name, table in run.tables.items():
        found = _guess_time(f"time of '{name}'" if name else "time", table, given)
        if isinstance(found, Guess):
            offset_s = (given.clock_offset_s or {}).get(name, 0.0)
            times[name] = replace(found, choice=_shift_clock(found.choice, offset_s))
        else:
            faults += found
    if not run.places:
        run.refuse("no column of numbers can be read in it")
    if not times:
        rate = f"{advise('rate', rate_hz=50.0)} where they are at 50 Hz"
        broken = "; ".join(faults) or f"columns: {', '.join(run.places)}; {rate}"
        rates = f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz"
        run.refuse(f"no column is the time: none increases at a rate of {rates}; {broken}")
    for name in given.clock_offset_s or {}:
        if name not in times:
            known = list_choices(name, times)
            run.refuse(f"log.clock_offset_s: table '{name}' is missing or has no clock; {known}")
    return times


def _shift_clock(time: TimeColumn, offset_s: float) -> TimeColumn:
    """Return a clock that is later by a time."""
    if isinstance(time, AlignedTime):
        return replace(time, anchor=replace(time.anchor, offset=time.anchor.offset + offset_s))
    return time if isinstance(time, RowTime) else replace(time, offset=time.offset + offset_s)


def _guess_time(subject: str, table: Table, given: GivenColumns) -> Guess | list[str]:
    """Return the clock of a table, or what is wrong with the columns that could be one."""
    if given.rate_hz is not None:
        evidence = [("as given by log.rate_hz", 5.0)]
        time = RowTime(rate_hz=given.rate_hz)
        return Guess(subject, f"row / {given.rate_hz:g} Hz", evidence, (), True, time)
    if table.clock is not None and given.time is None:
        return _guess_own_clock(subject, table, table.clock)
    candidates, faults = [], []
    for text, values in _list_clocks(table, given.time):
        judged = _judge_clock(subject, text, values, table, given)
        if isinstance(judged, Guess):
            candidates.append(judged)
        elif judged:
            faults.append(judged)
    if not candidates:
        return faults
    best = max(candidates, key=lambda one: one.probability)
    others = tuple(one.value for one in candidates if one is not best)
    return replace(best, others=others).advise(advise("time", columns=best.value))


def _guess_own_clock(subject: str, table: Table, clock: str) -> Guess:
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
        return Guess(subject, clock, evidence, choice=anchor)
    scatter_s = np.quantile(late_s, 0.95) - late_s.min()
    behind = f"behind the recorder's by {np.median(late_s):.4g} s, drift {1e6 * drift:.3g} ppm"
    scatter = f"scatter of the transport {1000 * scatter_s:.3g} ms"
    evidence = [(f"the sensor's own clock; {behind}, {scatter}", 5.0)]
    time = AlignedTime(column="header.stamp", scale=1.0, anchor=anchor)
    return Guess(subject, "header.stamp", evidence, (clock,), choice=time)


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


def _judge_clock(
    subject: str, text: str, values: np.ndarray, table: Table, given: GivenColumns
) -> Guess | str | None:
    """Return a column as a clock, a sentence about one that is broken, or `None` for no clock.

    Args:
        subject: What is guessed.
        text: Name of the column, or the arithmetic of a pair.
        values: Its numbers, `(T,)`.
        table: Its table.
        given: Meanings that a person gives.
    """
    words = set(read_words(text))
    is_pair, is_given = text not in table.columns, given.time is not None
    is_count = not (is_pair or is_given or words.isdisjoint(WORDS["count"]))
    if is_count or len(values) < 2 or not np.isfinite(values).any():
        return None
    is_named = is_pair or is_given or not words.isdisjoint(WORDS["time"] | TIME_UNITS.keys())
    named = [split_unit(text)[1] or "", *reversed(read_words(text))]
    units = [TIME_UNITS[one] for one in named if one in TIME_UNITS and is_named]
    unit = 1.0 if is_pair else next(iter(units), None)  # a pair is chosen by its two units
    wrap = find_wrap(values, TIME_MODULI) if is_named else None
    is_counter = wrap is not None and 0 <= np.nanmin(values) <= np.nanmax(values) < wrap.modulus
    wraps = wrap.modulus if wrap is not None and is_counter else None
    values = unwrap(values, wraps)
    fault = find_fault((unit or 1.0) * values, table, text)
    later = is_later(values)
    if is_named and is_later(-values).all():
        return f"'{text}' only decreases: the newest row comes first; sort the rows, oldest first"
    if fault is not None:
        if later.mean() < (0.02 if is_named else 0.9):
            return None
        if not words.isdisjoint(("dt", "delta", "diff", "period")):
            rate_hz = float(f"{1.0 / max(float(np.mean(values)), 1e-9):.3g}")
            mend = advise("rate", rate_hz=rate_hz)
            return f"'{text}' holds the time since the row before; {mend}"
        if not fault.is_damage:  # damage is refused, or skipped, where the whole log is read
            place = table.locate(int(fault.rows[0]))
            return f"'{text}': {fault.text}, first in {place}; {fault.advice}"
    weighed = _weigh_time_unit(values[later], unit, is_named)
    if weighed is None:
        return None
    scale, reason = weighed
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
    return Guess(subject, text, evidence, (), is_given, time)


def _weigh_time_unit(
    times: np.ndarray, unit: float | None, is_named: bool
) -> tuple[float, Evidence] | None:
    """Return seconds for one of a clock and why, `None` where no unit gives the rate of a log of joints."""
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
