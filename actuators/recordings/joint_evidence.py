"""Evidence of the numbers in a joint's columns: kind of command, motion, unit and target.

Each guess is the hypothesis with the most evidence. What a person gives is weighed like a guess: numbers that
speak against it make it unsure, but it is used as it was given. Axes: `T` samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from actuators.recordings.advice import advise
from actuators.recordings.guess import CommandKind, Evidence, GivenColumns, Guess
from actuators.recordings.log_signals import Signal
from actuators.recordings.log_tables import LogRun
from actuators.recordings.name_evidence import UNITS, ColumnName, read_unit
from actuators.recordings.signal_checks import (
    LONGEST_LAG_S,
    Wrap,
    find_jumps,
    find_spikes,
    find_wrap,
)
from brokk_rl.errors import RecordingError

KIND_TEXTS: dict[CommandKind, str] = {
    "velocity": "sets the speed",
    "position": "a target of the position",
    "torque": "sets a force or torque",
}
ADVISED = {"kind": "command", "unit": "unit"}
"""Key that gives a guess by hand."""
FOLLOWED = {"position": "position", "velocity": "speed", "torque": "acceleration"}
"""Quantity of the motion that follows each kind of command."""
NAMED_KINDS: dict[str, CommandKind] = {
    "position": "position",
    "velocity": "velocity",
    "effort": "torque",
}
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


@dataclass(frozen=True)
class ColumnEntry:
    """A column with its name read, and its signal.

    Attributes:
        name: Its name as words.
        signal: Its numbers on their clock; the text is its full name.
        wrap: Wraps that were taken out of them.
    """

    name: ColumnName
    signal: Signal
    wrap: Wrap | None = None

    @property
    def text(self) -> str:
        """Its full name."""
        return self.signal.text

    @property
    def values(self) -> np.ndarray:
        """Its numbers, `(T,)`."""
        return self.signal.values

    @property
    def is_changing(self) -> bool:
        """False for a constant column."""
        return bool(np.ptp(self.values) > 0)

    @property
    def modulus(self) -> float | None:
        """Value at which it begins again, `None` for none."""
        return self.wrap.modulus if self.wrap else None


@dataclass
class JointGuess:
    """The columns of a joint, and what they are.

    Attributes:
        name: Name of the joint.
        u: Column of its command.
        q: Column of its position.
        evidence: Why the two belong together.
        kind: Quantity that the command sets.
        sign: -1 where larger commands move to smaller positions.
        lag_s: Lag of the motion behind the command at the best correlation.
        unit: `rad` or `m`.
        scale: That unit for one of the log.
        target_scale: The same for its targets.
        target_offset: Position at a target of 0, in that unit.
        guesses: How sure each part is; `target` where the unit of the targets is in question.
    """

    name: str
    u: ColumnEntry
    q: ColumnEntry
    evidence: list[Evidence]
    kind: CommandKind = "velocity"
    sign: int = 1
    lag_s: float = 0.0
    unit: str = "rad"
    scale: float = 1.0
    target_scale: float = 1.0
    target_offset: float = 0.0
    guesses: dict[str, Guess] = field(default_factory=dict)

    @property
    def target_wraps(self) -> float | None:
        """Value at which a target begins again."""
        return self.u.modulus if self.kind == "position" else None


class JointJudge:
    """Weighs kind, motion and units of one joint by the numbers.

    Args:
        joint: The joint, to be completed.
        matrix: Correlations of all joints.
        at: Its place among them.
        given: Meanings that a person gives.
    """

    def __init__(
        self, joint: JointGuess, matrix: Correlations, at: int, given: GivenColumns
    ) -> None:
        self._joint, self._matrix, self._at, self._given = joint, matrix, at, given
        self._slope, self._rest = matrix.fit_target(at)
        self._r = {kind: float(matrix.r[kind][at, at]) for kind in KIND_TEXTS}

    def judge_kind(self) -> None:
        """Choose which quantity the command sets."""
        joint, given = self._joint, self._given.command
        named = NAMED_KINDS.get(joint.u.name.quantity)
        r = {kind: abs(value) for kind, value in self._r.items()}
        weights = {}
        for kind in KIND_TEXTS:
            weights[kind] = 2.5 * (kind == named) - math.log(max(1.0 - r[kind], 0.005))
        weights["position"] += self._weigh_line()
        if named != "torque":  # an acceleration that follows a target is that of a servo
            weights["torque"] = -math.inf
        chosen = given or max(weights, key=lambda kind: weights[kind])
        joint.kind = chosen
        reason = f"correlation with position {r['position']:.2f}, with speed {r['velocity']:.2f}"
        if given is not None:
            is_refuted = given != "torque" and joint.u.is_changing and r[given] < NO_CORRELATION
            evidence = [("as given by log.command", 5.0), (reason, -6.0 if is_refuted else 0.0)]
        else:
            lead = weights[chosen] - max(weights[kind] for kind in weights if kind != chosen)
            evidence = [(reason, min(lead, 6.0))]
            if named is None:
                evidence.append(("its name does not say it", -0.3))
            elif named != chosen:
                evidence.append(("its name says otherwise", -0.5))
            elif r[chosen] < CLEAR_CORRELATION:
                evidence.append(("", -1.0))
        self._add("kind", "command", KIND_TEXTS[chosen], evidence, given is not None)

    def _weigh_line(self) -> float:
        """Return the log odds of a target by the line from commands to positions: one of 1 : 1 is no coincidence."""
        is_through = abs(self._rest) <= SAME_SHARE * float(np.ptp(self._joint.q.values))
        if abs(self._slope - 1.0) <= SAME_SHARE and is_through:
            return 3.0
        return 0.5 if TARGET_SLOPE[0] <= self._slope <= TARGET_SLOPE[1] else -0.5

    def judge_motion(self, commands: list[str]) -> None:
        """Add the evidence of correlations, of another command that fits better, and of odd steps."""
        joint, r = self._joint, self._r[self._joint.kind]
        if not joint.u.is_changing:
            joint.evidence.append(("its command does not change in the beginning of the log", 0.0))
            return
        joint.sign = -1 if joint.kind == "velocity" and r < 0 else 1
        weight = weigh_correlation(abs(r))
        if joint.kind == "torque":
            weight = 1.0 if abs(r) >= NO_CORRELATION else -2.0
        else:
            joint.lag_s = self._matrix.find_lag(self._at, joint.kind == "position")
        what = FOLLOWED[joint.kind]
        text = f"correlation of {what} with command {r:.2f}, {joint.lag_s:.2f} s later"
        joint.evidence.append((text, weight))
        if joint.lag_s > LAST_LAG * LONGEST_LAG_S:
            text = "no longer lag is tried: its delay is longer, or it is no pair"
            joint.evidence.append((text, -5.0))
        size = np.abs(self._matrix.r[joint.kind][:, self._at])
        rival = int(np.argmax(size))
        if size[self._at] < CLEAR_CORRELATION and size[rival] > size[self._at] + MARGIN:
            weight = -6.0 if size[rival] > CLEAR_CORRELATION else -1.0
            joint.evidence.append((f"with the command {commands[rival]} {size[rival]:.2f}", weight))
        self._check_steps()

    def _check_steps(self) -> None:
        """Add the evidence of steps that no machine makes."""
        joint, q, t_s = self._joint, self._joint.q.values, self._joint.q.signal.t_s
        if joint.q.wrap is None and (wrap := find_wrap(q)) is not None:
            joint.evidence.append((f"{wrap.explain()}, and is taken as it is", -6.0))
            return
        cause = np.zeros(len(q))
        if joint.kind == "position":
            cause = self._slope * joint.u.signal.interpolate(t_s) + self._rest
        spikes, jumps = find_spikes(q), find_jumps(t_s, q, cause)
        if len(spikes):
            is_mixed = len(spikes) > SPIKE_SHARE * len(q)
            text = f"{len(spikes)} of {len(q)} samples leave their neighbours and come back"
            asked = "two sources, or lost bits?" if is_mixed else "lost bits?"
            begin_s = t_s[spikes[0]] - t_s[0]
            joint.evidence.append(
                (f"{text}, first at {begin_s:.2f} s: {asked}", -8.0 if is_mixed else -0.5)
            )
        if len(jumps):
            row = jumps[0]
            text = (
                f"{len(jumps)} jumps that no command causes, the first by {abs(q[row + 1] - q[row]):.4g} at "
                f"{t_s[row] - t_s[0]:.2f} s: a reset, a wrap or another source?"
            )
            joint.evidence.append((text, -6.0))

    def judge_columns(self) -> None:
        """Add the evidence of a position that leads its target, and make the guesses of columns and wraps."""
        joint, wrap = self._joint, self._joint.q.wrap
        lead_s = self._matrix.find_lead(self._at) if joint.kind == "position" else 0.0
        if lead_s > 0.0:
            text = f"but the position leads it by {lead_s:.2f} s: columns swapped, or clocks apart?"
            joint.evidence.append((text, -8.0))
        is_given = self._given.joints is not None
        value = f"{joint.u.text} → {joint.q.text}"
        self._add("columns", "columns", value, joint.evidence, is_given)
        if wrap is not None:
            text = f"{wrap.explain()}: unwrapped; {advise('wraps', modulus=wrap.modulus)}"
            is_given = self._given.find_wraps(joint.name) is not None
            evidence = [("as given by log.wraps", 5.0) if is_given else (text, 4.0)]
            self._add("wraps", "wraps", f"{wrap.modulus:.6g}", evidence, is_given)

    def judge_unit(self) -> None:
        """Choose the unit of the position: as given, named, that of its target, or by its travel."""
        joint, named = self._joint, self._joint.q.name.unit
        given, target = self._given.find_unit(joint.name), joint.u.name
        if given is not None:
            value, evidence = given, [("as given by log.position_unit", 5.0)]
        elif named is not None:
            value, evidence = named, [("unit in its name", 5.0)]
        elif target.unit and target.quantity == "position" and 0.8 <= self._slope <= 1.2:
            text = f"unit in the name of its target, which it follows 1 : {self._slope:.2f}"
            value, evidence = target.unit, [(text, 4.0)]
        else:
            value, evidence = _guess_unit(joint.q)
        joint.unit, joint.scale = read_unit(value) or ("rad", 1.0)
        evidence += _check_travel(joint)
        self._add("unit", "unit", value, evidence, given is not None)

    def judge_target(self) -> None:
        """Choose the unit of the targets; it is in question where the positions do not follow 1 : 1."""
        joint, stated = self._joint, self._joint.u.name.unit
        joint.target_scale = joint.scale
        if joint.kind != "position" or abs(self._r["position"]) < CLEAR_CORRELATION:
            return
        if stated is not None and UNITS[stated][0] == joint.unit:
            joint.target_scale = UNITS[stated][1]
        ratio = self._slope * joint.scale / joint.target_scale
        if not TARGET_SLOPE[0] <= ratio <= TARGET_SLOPE[1]:
            joint.target_scale = self._slope * joint.scale
            joint.target_offset = self._rest * joint.scale
            text = "this line fits the positions best; fill in scale and offset, those of the code that commands"
            value = f"{self._slope:.3g} × target + {self._rest:.3g}"
            self._add("target", "unit of targets", value, [(text, -1.0)], False)

    def _add(
        self, key: str, what: str, value: str, evidence: list[Evidence], is_given: bool
    ) -> None:
        """Add a guess, with the key that gives it by hand where it is unsure."""
        guess = Guess(f"{self._joint.name}: {what}", value, evidence, (), is_given)
        if key in ADVISED:
            guess = guess.advise(advise(ADVISED[key]))
        self._joint.guesses[key] = guess


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
        r: Correlation at the best lag of each position, its speed or its acceleration with each command, by the
            kind of command that they follow, `(C, P)`.
    """

    def __init__(
        self, run: LogRun, commands: Sequence[Signal], positions: Sequence[Signal]
    ) -> None:
        signals = [*commands, *positions]
        begin_s = max(float(one.t_s[0]) for one in signals)
        end_s = min(float(one.t_s[-1]) for one in signals)
        if end_s <= begin_s:
            self._refuse(run, signals)
        period_s = float(np.median([np.median(np.diff(one.t_s)) for one in signals]))
        num_rows = int(np.clip((end_s - begin_s) / max(period_s, 1e-9), 2, GRID_ROWS))
        self._grid_s = np.linspace(begin_s, end_s, num_rows)
        self._period_s = float(self._grid_s[1] - self._grid_s[0])
        self._u = np.stack([np.interp(self._grid_s, one.t_s, one.values) for one in commands], 1)
        self._q = np.stack([np.interp(self._grid_s, one.t_s, one.values) for one in positions], 1)
        self._v = np.gradient(self._q, self._period_s, axis=0)
        most = min(int(LONGEST_LAG_S / self._period_s), num_rows // 4)
        self._lags = np.arange(0, most + 1, max(1, most // NUM_LAGS))
        acceleration = np.gradient(self._v, self._period_s, axis=0)
        followed = {"position": self._q, "velocity": self._v, "torque": acceleration}
        self.r = {kind: self._correlate(self._u, moved)[0] for kind, moved in followed.items()}

    def _refuse(self, run: LogRun, signals: Sequence[Signal]) -> None:
        spans = {one.table: (float(one.t_s[0]), float(one.t_s[-1])) for one in signals}
        listed = ", ".join(
            f"{table}: {begin:.12g} to {end:.12g} s" for table, (begin, end) in spans.items()
        )
        first = min(spans, key=lambda table: spans[table])
        last = max(spans, key=lambda table: spans[table])
        apart_s = spans[first][0] - spans[last][0]
        raise RecordingError(
            f"{run.where}: the clocks of its tables have no time in common ({listed}); "
            f"{advise('offset', table=last, offset_s=apart_s)}"
        )

    @property
    def size(self) -> np.ndarray:
        """Size of the correlation of each position or its speed with each command, `(C, P)`."""
        return np.maximum(np.abs(self.r["position"]), np.abs(self.r["velocity"]))

    def find_lag(self, at: int, is_target: bool) -> float:
        """Return the lag of a joint's speed behind its command, or behind its target's speed, s."""
        u = self._u[:, [at]]
        cause = np.gradient(u, self._period_s, axis=0) if is_target else u
        return float(self._correlate(cause, self._v[:, [at]])[1][0, 0])

    def fit_target(self, at: int) -> tuple[float, float]:
        """Return slope and offset of the line from targets to positions, at the best lag."""
        u, q = self._u[:, at], self._q[:, at]
        rows = round(float(self._correlate(u[:, None], q[:, None])[1][0, 0]) / self._period_s)
        u, q = u[: len(u) - rows], q[rows:]
        if np.ptp(u) == 0:
            return 0.0, 0.0
        slope, offset = np.polyfit(u, q, 1)
        return float(slope), float(offset)

    def find_lead(self, at: int) -> float:
        """Return the time by which the position leads its target, s; 0 where it does not, clearly."""
        u, q = self._u[:, [at]], self._q[:, [at]]
        behind, before = self._correlate(u, q), self._correlate(q, u)
        left, left_behind = 1.0 - abs(before[0][0, 0]), 1.0 - abs(behind[0][0, 0])
        is_leading = abs(before[0][0, 0]) >= CLEAR_CORRELATION and left < 0.3 * left_behind
        return float(before[1][0, 0]) if is_leading else 0.0

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
