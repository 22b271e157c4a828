"""Evidence of the numbers in a joint's columns: kind of command, motion, unit and target.

Each guess is the hypothesis with the most evidence. What a person gives is weighed like a guess: numbers that
speak against it make it unsure, but it is used as it was given. Axes: `T` samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NoReturn

import numpy as np

from actuators.recordings.clocks import put_near, unwrap
from actuators.recordings.guess import CommandKind, Evidence, GivenColumns, Guess, advise
from actuators.recordings.log_signals import RunSignals, Signal
from actuators.recordings.log_tables import LogRun
from actuators.recordings.name_evidence import UNITS, ColumnName, read_unit
from actuators.recordings.signal_checks import (
    LONGEST_LAG_S,
    Wrap,
    find_jumps,
    find_spikes,
    find_wrap,
)

KIND_TEXTS: dict[CommandKind, str] = {
    "velocity": "sets the speed",
    "position": "a target of the position",
    "torque": "sets a force or torque",
}
GIVEN_BY_KEY = ("command", "unit")
"""Guesses that a person can give."""
FOLLOWED = {"position": "position", "velocity": "speed", "torque": "acceleration"}
"""Quantity of the motion that follows each kind of command."""
TARGET_SLOPE = (0.5, 1.5)
"""Position over target: outside of it the target is in another unit, or no target."""
SAME_SHARE = 0.1
"""Part by which slope and offset of the line may differ from 1 : 1 for a target in the unit of the position."""
MOST_TURNS = 2.0
"""Turns beyond which a joint with a target is in doubt: joints of arms and legs stop before, winches do not."""
LAST_LAG = 0.95
"""Part of the longest lag that is tried, beyond which a lag was cut off by it."""
SPIKE_SHARE = 0.01
"""Share of spikes from which a column holds two sources."""
USUAL_TRAVEL_RAD = 1.5
"""Travel of a joint in a log of its motions: two in three lie within a factor e, 0.55 to 4 rad; by hand."""
UNIT_SHARES = {"rad": 0.65, "deg": 0.2, "turns": 0.15}
"""Shares of the units among positions whose names say none; by hand."""
SI_SHARE, OTHER_SHARE = 6.0, 0.15
"""Share of rad where the program that made the name logs rad; that of counts, per cent and lengths."""


REST_SPEED = 0.02
"""Part of the top speed below which a joint counts as at rest."""


@dataclass(frozen=True, kw_only=True)
class ColumnEntry(Signal):
    """The signal of a column with its name read; the text is its full name.

    Attributes:
        name: Its name as words.
        wrap: Wraps that were taken out of its numbers.
    """

    name: ColumnName
    wrap: Wrap | None = None

    @property
    def is_changing(self) -> bool:
        """False for a constant column."""
        return bool(np.ptp(self.values) > 0)

    @property
    def modulus(self) -> float | None:
        """Value at which it begins again, `None` for none."""
        return self.wrap.modulus if self.wrap else None

    def remove_wrap(self, wrap: Wrap | None) -> ColumnEntry:
        """Return it without its wraps."""
        if wrap is None:
            return self
        return replace(self, values=unwrap(self.values, wrap.modulus), wrap=wrap)


Entries = Sequence[ColumnEntry]


@dataclass
class JointSurvey:
    """Numbers of one joint over all logs, in the units of the logs.

    Attributes:
        lowest_command: Smallest command.
        highest_command: Largest command.
        lowest: Smallest position.
        highest: Largest position.
        top_speed: Fastest change of the position over a tenth of a second, per second.
        target_speed: Fastest change of the command from row to row, per second.
        rest: Most frequent command at rest; NaN where the joint never rests.
        rest_share: Share of all rows that are at rest with it, in the log with the most.
    """

    lowest_command: float = np.inf
    highest_command: float = -np.inf
    lowest: float = np.inf
    highest: float = -np.inf
    top_speed: float = 0.0
    target_speed: float = 0.0
    rest: float = np.nan
    rest_share: float = 0.0

    def add(self, command: Signal, position: Signal, joint: JointGuess) -> None:
        """Add a run; positions that begin again after a turn are put next to their targets, or to those before."""
        u, q, t_s = command.values, position.values, position.t_s
        if joint.q.modulus is not None:
            near = np.median(q) if self.lowest == np.inf else (self.lowest + self.highest) / 2.0
            if joint.kind == "position" and joint.target_wraps is None:
                near = (joint.target_scale * np.median(u) + joint.target_offset) / joint.scale
            q = put_near(q, float(near), joint.q.modulus)
        if joint.target_wraps is not None:
            u = put_near(u, float(np.median(np.interp(command.t_s, t_s, q))), joint.target_wraps)
        self.lowest_command = min(self.lowest_command, float(u.min()))
        self.highest_command = max(self.highest_command, float(u.max()))
        self.lowest, self.highest = min(self.lowest, q.min()), max(self.highest, q.max())
        target_speed = np.abs(np.diff(u) / np.diff(command.t_s)).max()
        self.target_speed = max(self.target_speed, float(target_speed))
        step = max(1, int(0.1 / float(np.median(np.diff(t_s)))))
        if len(q) <= step:
            return
        speed = np.abs((q[step:] - q[:-step]) / (t_s[step:] - t_s[:-step]))
        self.top_speed = max(self.top_speed, float(speed.max()))
        at_rest = np.interp(command.t_s, t_s[step:], speed) <= REST_SPEED * self.top_speed
        values, counts = np.unique(u[at_rest], return_counts=True)
        if len(values) and counts.max() / len(u) > self.rest_share:
            self.rest = float(values[counts.argmax()])
            self.rest_share = float(counts.max() / len(u))


@dataclass
class JointGuess:
    """The columns of a joint, and what they are.

    Attributes:
        name: Name of the joint.
        u: Column of its command.
        q: Column of its position.
        evidence: Why the two belong together.
        signals: Signals of the run that it is judged by.
        kind: Quantity that the command sets.
        sign: -1 where larger commands move to smaller positions.
        lag_s: Lag of the motion behind the command at the best correlation.
        unit: `rad` or `m`.
        scale: That unit for one of the log.
        target_scale: The same for its targets.
        target_offset: Position at a target of 0, in that unit.
        neutral: Command without motion, in the unit of the log.
        full_plus: Full command towards larger positions; `None` without such commands.
        full_minus: The same towards smaller positions.
        guesses: How sure each part is; `unit of targets` where that is in question.
        survey: Its numbers over all logs.
    """

    name: str
    u: ColumnEntry
    q: ColumnEntry
    evidence: list[Evidence]
    signals: RunSignals
    kind: CommandKind = "velocity"
    sign: int = 1
    lag_s: float = 0.0
    unit: str = "rad"
    scale: float = 1.0
    target_scale: float = 1.0
    target_offset: float = 0.0
    neutral: float = 0.0
    full_plus: float | None = None
    full_minus: float | None = None
    guesses: dict[str, Guess] = field(default_factory=dict)
    survey: JointSurvey = field(default_factory=JointSurvey)

    def rank(self) -> tuple[float, float]:
        """Return how sure its columns and its kind are, by which guesses from several logs are compared."""
        return self.guesses["columns"].probability, self.guesses["command"].probability

    @property
    def target_wraps(self) -> float | None:
        """Value at which a target begins again."""
        return self.u.modulus if self.kind == "position" else None

    def judge(self, matrix: Correlations, at: int, given: GivenColumns) -> None:
        """Weigh kind, motion and units by the numbers.

        Args:
            matrix: Correlations of all joints.
            at: Its place among them.
            given: Meanings that a person gives.
        """
        slope, rest = matrix.fit_target(at)
        r = {kind: float(several[at, at]) for kind, several in matrix.r.items()}
        self._judge_kind(r, slope, rest, given.command)
        if self.u.is_changing:
            self._judge_motion(matrix, at)
            self._check_steps(slope, rest)
        else:
            text = "its command does not change in the beginning of the log"
            self.evidence.append((text, 0.0))
        lead_s = matrix.find_lead(at) if self.kind == "position" else 0.0
        if lead_s > 0.0:
            text = f"but the position leads it by {lead_s:.2f} s: columns swapped, or clocks apart?"
            self.evidence.append((text, -8.0))
        is_given = given.joints is not None
        self.add_guess("columns", f"{self.u.text} → {self.q.text}", self.evidence, is_given)
        if self.q.wrap is not None:
            text = f"{self.q.wrap.explain()}: unwrapped; {advise('wraps', modulus=self.q.modulus)}"
            is_given = given.find("wraps", self.name) is not None
            evidence = [("as given by log.wraps", 5.0) if is_given else (text, 4.0)]
            self.add_guess("wraps", f"{self.q.modulus:.6g}", evidence, is_given)
        self._judge_unit(given.find("position_unit", self.name), slope)
        if self.kind == "position" and abs(r["position"]) >= CLEAR_CORRELATION:
            self._judge_target(slope, rest)

    def add_guess(
        self, what: str, value: str, evidence: list[Evidence], is_given: bool = False
    ) -> None:
        """Add a guess, with the key that gives it by hand where it is unsure."""
        guess = Guess(f"{self.name}: {what}", value, evidence, (), is_given)
        self.guesses[what] = guess.advise(advise(what)) if what in GIVEN_BY_KEY else guess

    def _judge_kind(
        self, r: Mapping[str, float], slope: float, rest: float, given: CommandKind | None
    ) -> None:
        """Choose which quantity the command sets."""
        named, size = self.u.name.quantity, {kind: abs(value) for kind, value in r.items()}
        weights = {}
        for kind in KIND_TEXTS:
            weights[kind] = 2.5 * (kind == named) - math.log(max(1.0 - size[kind], 0.005))
        # a line of 1 : 1 from targets to positions is no coincidence
        is_through = abs(rest) <= SAME_SHARE * float(np.ptp(self.q.values))
        if abs(slope - 1.0) <= SAME_SHARE and is_through:
            weights["position"] += 3.0
        else:
            weights["position"] += 0.5 if TARGET_SLOPE[0] <= slope <= TARGET_SLOPE[1] else -0.5
        if named != "torque":  # an acceleration that follows a target is that of a servo
            weights["torque"] = -math.inf
        self.kind = chosen = given or max(weights, key=lambda kind: weights[kind])
        text = (
            f"correlation with position {size['position']:.2f}, with speed {size['velocity']:.2f}"
        )
        if given is not None:
            is_refuted = given != "torque" and self.u.is_changing and size[given] < NO_CORRELATION
            evidence = [("as given by log.command", 5.0), (text, -6.0 if is_refuted else 0.0)]
        else:
            lead = weights[chosen] - max(weights[kind] for kind in weights if kind != chosen)
            evidence = [(text, min(lead, 6.0))]
            if named == "unknown":
                evidence.append(("its name does not say it", -0.3))
            elif named != chosen:
                evidence.append(("its name says otherwise", -0.5))
            elif size[chosen] < CLEAR_CORRELATION:
                evidence.append(("", -1.0))
        self.add_guess("command", KIND_TEXTS[chosen], evidence, given is not None)

    def _judge_motion(self, matrix: Correlations, at: int) -> None:
        """Add the evidence of correlations, and of another command that fits better."""
        r = float(matrix.r[self.kind][at, at])
        self.sign = -1 if self.kind == "velocity" and r < 0 else 1
        weight = weigh_correlation(abs(r))
        if self.kind == "torque":
            weight = 1.0 if abs(r) >= NO_CORRELATION else -2.0
        else:
            self.lag_s = matrix.find_lag(at, self.kind == "position")
        text = f"correlation of {FOLLOWED[self.kind]} with command {r:.2f}"
        self.evidence.append((f"{text}, {self.lag_s:.2f} s later", weight))
        if self.lag_s > LAST_LAG * LONGEST_LAG_S:
            text = "no longer lag is tried: its delay is longer, or it is no pair"
            self.evidence.append((text, -5.0))
        size = np.abs(matrix.r[self.kind][:, at])
        rival = int(np.argmax(size))
        if size[at] < CLEAR_CORRELATION and size[rival] > size[at] + MARGIN:
            weight = -6.0 if size[rival] > CLEAR_CORRELATION else -1.0
            text = f"with the command {matrix.commands[rival].text} {size[rival]:.2f}"
            self.evidence.append((text, weight))

    def _check_steps(self, slope: float, rest: float) -> None:
        """Add the evidence of steps that no machine makes."""
        q, t_s = self.q.values, self.q.t_s
        if self.q.wrap is None and (wrap := find_wrap(q)) is not None:
            self.evidence.append((f"{wrap.explain()}, and is taken as it is", -6.0))
            return
        cause = np.zeros(len(q))
        if self.kind == "position":
            cause = slope * self.u.interpolate(t_s) + rest
        spikes, jumps = find_spikes(q), find_jumps(t_s, q, cause)
        if len(spikes):
            is_mixed = len(spikes) > SPIKE_SHARE * len(q)
            asked = "two sources, or lost bits?" if is_mixed else "lost bits?"
            text = f"{len(spikes)} of {len(q)} samples leave their neighbours and come back"
            text += f", first at {t_s[spikes[0]] - t_s[0]:.2f} s: {asked}"
            self.evidence.append((text, -8.0 if is_mixed else -0.5))
        if len(jumps):
            row = jumps[0]
            first = f"the first by {abs(q[row + 1] - q[row]):.4g} at {t_s[row] - t_s[0]:.2f} s"
            text = f"{len(jumps)} jumps that no command causes, {first}"
            self.evidence.append((f"{text}: a reset, a wrap or another source?", -6.0))

    def _judge_unit(self, given: str | None, slope: float) -> None:
        """Choose the unit of the position: as given, named, that of its target, or by its travel."""
        named, target = self.q.name.unit, self.u.name
        if given is not None:
            value, evidence = given, [("as given by log.position_unit", 5.0)]
        elif named is not None:
            value, evidence = named, [("unit in its name", 5.0)]
        elif target.unit and target.quantity == "position" and 0.8 <= slope <= 1.2:
            text = f"unit in the name of its target, which it follows 1 : {slope:.2f}"
            value, evidence = target.unit, [(text, 4.0)]
        else:
            value, evidence = _guess_unit(self.q)
        self.unit, self.scale = read_unit(value) or ("rad", 1.0)
        self.target_scale = self.scale
        self.add_guess("unit", value, evidence + _check_travel(self), given is not None)

    def _judge_target(self, slope: float, rest: float) -> None:
        """Choose the unit of the targets; it is in question where the positions do not follow 1 : 1."""
        stated = self.u.name.unit
        if stated is not None and UNITS[stated][0] == self.unit:
            self.target_scale = UNITS[stated][1]
        ratio = slope * self.scale / self.target_scale
        if not TARGET_SLOPE[0] <= ratio <= TARGET_SLOPE[1]:
            self.target_scale, self.target_offset = slope * self.scale, rest * self.scale
            text = "this line fits the positions best; fill in scale and offset, those of the code that commands"
            value = f"{slope:.3g} × target + {rest:.3g}"
            self.add_guess("unit of targets", value, [(text, -1.0)])


def _guess_unit(entry: ColumnEntry) -> tuple[str, list[Evidence]]:
    """Return the unit that makes the travel a usual one, and the evidence.

    The travel of a joint is taken as log-normal about `USUAL_TRAVEL_RAD`, with a deviation of a factor e.
    """
    travel, unknown = float(np.ptp(entry.values)), entry.name.unknown_unit
    odds = {}
    for unit, share in UNIT_SHARES.items():
        apart = math.log(max(travel * UNITS[unit][1], 1e-9) / USUAL_TRAVEL_RAD)
        is_convention = entry.name.is_si and unit == "rad"
        odds[unit] = (SI_SHARE if is_convention else share) * math.exp(-0.5 * apart**2)
    best = max(odds, key=lambda unit: odds[unit])
    others = sum(odds.values()) - odds[best] + OTHER_SHARE * min(1.0, travel / 4.0 / math.pi)
    text = f"no name has a unit; a travel of {travel:.3g} is usual in {best}"
    weight = math.log(max(odds[best], 1e-6) / max(others, 1e-6))
    return best, [(f"its unit '{unknown}' is not known", -4.0)] if unknown else [(text, weight)]


def _check_travel(joint: JointGuess) -> list[Evidence]:
    """Return the evidence of a travel that no joint has in the unit of the position."""
    travel, largest = float(np.ptp(joint.q.values)), float(np.abs(joint.q.values).max())
    turns = largest * abs(joint.scale) / math.tau
    if joint.unit == "rad" and joint.kind == "position" and turns > MOST_TURNS:
        asked = "degrees?" if joint.scale == 1.0 else "another unit?"
        return [(f"but {largest * joint.scale:.4g} rad is {turns:.2g} turns: {asked}", -5.0)]
    plain = math.tau if joint.unit == "rad" else 2.0
    if abs(joint.scale) < 1.0 and 0.0 < travel < plain:
        text = f"but it moves by {travel:.2g} of them in all: is the log in {joint.unit}?"
        return [(text, -5.0)]
    return []


NUM_LAGS = 60
GRID_ROWS = 8000
"""Rows on which pairs are compared; correlations change by less than 0.01 beyond."""
HIGH_CORRELATION, CLEAR_CORRELATION, NO_CORRELATION = 0.95, 0.8, 0.3
"""Correlations that leave a tenth, a third and nine tenths of the variance unexplained."""

MARGIN = 0.1
"""A partner that correlates better by so much contradicts a pair."""


class Correlations:
    """Commands and positions of a run on one grid, and how they follow each other.

    Attributes:
        commands: The commands.
        r: Correlation at the best lag of each position, its speed or its acceleration with each command, by the
            kind of command that they follow, `(C, P)`.
        lag_s: That lag, `(C, P)`.
    """

    def __init__(self, run: LogRun, commands: Entries, positions: Entries) -> None:
        self.commands = commands
        signals = [*commands, *positions]
        begin_s = max(float(one.t_s[0]) for one in signals)
        end_s = min(float(one.t_s[-1]) for one in signals)
        if end_s <= begin_s:
            _refuse_clocks(run, signals)
        period_s = float(np.median([np.median(np.diff(one.t_s)) for one in signals]))
        num_rows = int(np.clip((end_s - begin_s) / max(period_s, 1e-9), 2, GRID_ROWS))
        grid_s = np.linspace(begin_s, end_s, num_rows)
        self._period_s = float(grid_s[1] - grid_s[0])
        values = np.stack([one.interpolate(grid_s) for one in signals], 1)
        self._u, self._q = values[:, : len(commands)], values[:, len(commands) :]
        self._v = self._differentiate(self._q)
        most = min(int(LONGEST_LAG_S / self._period_s), num_rows // 4)
        self._lags = np.arange(0, most + 1, max(1, most // NUM_LAGS))
        acceleration = self._differentiate(self._v)
        self.r: dict[CommandKind, np.ndarray] = {}
        self.lag_s: dict[CommandKind, np.ndarray] = {}
        for kind, followed in zip(KIND_TEXTS, (self._v, self._q, acceleration), strict=True):
            self.r[kind], self.lag_s[kind] = self._correlate(self._u, followed)

    @property
    def size(self) -> np.ndarray:
        """Size of the correlation of each position or its speed with each command, `(C, P)`."""
        return np.maximum(np.abs(self.r["position"]), np.abs(self.r["velocity"]))

    def find_lag(self, at: int, is_target: bool) -> float:
        """Return the lag of a joint's speed behind its command, or behind its target's speed, s."""
        if not is_target:
            return float(self.lag_s["velocity"][at, at])
        speed = self._differentiate(self._u[:, [at]])
        return float(self._correlate(speed, self._v[:, [at]])[1][0, 0])

    def fit_target(self, at: int) -> tuple[float, float]:
        """Return slope and offset of the line from targets to positions, at the best lag."""
        rows = round(float(self.lag_s["position"][at, at]) / self._period_s)
        u, q = self._u[: len(self._u) - rows, at], self._q[rows:, at]
        if np.ptp(u) == 0:
            return 0.0, 0.0
        slope, offset = np.polyfit(u, q, 1)
        return float(slope), float(offset)

    def find_lead(self, at: int) -> float:
        """Return the time by which the position leads its target, s; 0 where it does not, clearly."""
        r, lead_s = self._correlate(self._q[:, [at]], self._u[:, [at]])
        before, behind = abs(r[0, 0]), abs(self.r["position"][at, at])
        is_leading = before >= CLEAR_CORRELATION and 1.0 - before < 0.3 * (1.0 - behind)
        return float(lead_s[0, 0]) if is_leading else 0.0

    def _differentiate(self, values: np.ndarray) -> np.ndarray:
        return np.gradient(values, self._period_s, axis=0)

    def _correlate(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest correlations, in size, of the columns of `b` with those of `a` before them, and lags, s."""
        best = np.zeros((a.shape[1], b.shape[1]))
        lags_s = np.zeros_like(best)
        for lag in self._lags:
            x, y = a[: len(a) - lag], b[lag:]
            x, y = x - x.mean(0), y - y.mean(0)
            norm = np.linalg.norm(x, axis=0)[:, None] * np.linalg.norm(y, axis=0)
            with np.errstate(invalid="ignore", divide="ignore"):
                r = np.nan_to_num(x.T @ y / norm, nan=0.0, posinf=0.0, neginf=0.0)
            is_better = np.abs(r) > np.abs(best) + 1e-9
            best = np.where(is_better, r, best)
            lags_s = np.where(is_better, lag * self._period_s, lags_s)
        return best, lags_s


def weigh_correlation(size: float) -> float:
    """Return the log odds that a correlation of some size gives to a pair of columns."""
    if size >= CLEAR_CORRELATION:
        return 3.0 if size >= HIGH_CORRELATION else 2.0
    return -0.5 if size >= NO_CORRELATION else -4.5


def _refuse_clocks(run: LogRun, signals: Sequence[Signal]) -> NoReturn:
    """Raise a `RecordingError` with the clocks, which have no time in common."""
    ordered = sorted(signals, key=lambda one: one.t_s[0])
    first, last = ordered[0], ordered[-1]
    texts = {
        one.table: f"{one.table}: {one.t_s[0]:.12g} to {one.t_s[-1]:.12g} s" for one in ordered
    }
    apart_s = float(first.t_s[0] - last.t_s[0])
    mend = advise("offset", table=last.table, offset_s=apart_s)
    run.refuse(
        f"the clocks of its tables have no time in common ({', '.join(texts.values())}); {mend}"
    )
