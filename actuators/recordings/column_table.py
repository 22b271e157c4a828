"""One table of what the columns of a log are: candidates, evidence for each, and a probability.

Names propose, numbers decide. What a person gives is weighed like a guess: numbers that speak against
it make it unsure, but it is used as it was given. `column_pairs` proposes which columns are a joint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from actuators.recordings.advice import advise
from actuators.recordings.column_names import ENABLE_WORDS, UNITS, find_bracketed, read_unit
from actuators.recordings.column_pairs import (
    MARGIN,
    JointGuess,
    PairFinder,
    read_words,
    remove_wrap,
)
from actuators.recordings.correlations import (
    CLEAR_CORRELATION,
    HIGH_CORRELATION,
    LONGEST_LAG_S,
    NO_CORRELATION,
    Correlations,
)
from actuators.recordings.guess import CommandKind, Evidence, GivenColumns, Guess
from actuators.recordings.log_signals import RunSignals, Signal
from actuators.recordings.log_tables import LogRun, index_columns
from actuators.recordings.signal_checks import Wrap, find_jumps, find_spikes, find_wrap
from actuators.recordings.time_guess import RATES_HZ, TimeGuess, guess_time, shift_clock
from brokk_rl.errors import RecordingError, list_choices

KIND_TEXTS: dict[CommandKind, str] = {
    "velocity": "sets the speed",
    "position": "a target of the position",
    "torque": "sets a force or torque",
}
FOLLOWED = {"position": "position", "velocity": "speed", "torque": "acceleration"}
"""Quantity of the motion that follows each kind of command."""
NAMED_KINDS: dict[str, CommandKind] = {
    "position": "position",
    "velocity": "velocity",
    "effort": "torque",
}
TARGET_SLOPE = (0.5, 1.5)
"""Position over target: outside of it the target is in another unit, or no target."""
DOUBLED_SHARE = 0.2
"""Share of equal stamps with other values from which two programs send to one topic."""
MOST_TURNS = 2.0
"""Turns beyond which a target in rad is in doubt: joints of arms and legs stop before, winches do not."""
LAST_LAG = 0.95
"""Part of the longest lag that is tried, beyond which a lag was cut off by it."""
SPIKE_SHARE = 0.01
"""Share of spikes from which a column holds two sources."""


@dataclass(frozen=True)
class ColumnTable:
    """Meanings of the columns of a run.

    Attributes:
        times: Clock of each table.
        joints: The joints.
        remarks: What was left out or seems odd.
        signals: Signals of the run.
    """

    times: dict[str, TimeGuess]
    joints: list[JointGuess]
    remarks: list[str]
    signals: RunSignals


def read_columns(run: LogRun, given: GivenColumns) -> ColumnTable:
    """Return what the columns of a run are.

    Args:
        run: Beginning of a log, with all columns.
        given: Meanings that a person gives.

    Raises:
        RecordingError: No time, no command or no position can be proposed, or a given column is missing.
    """
    times = _guess_times(run, given)
    places = index_columns({name: [*table.columns] for name, table in run.tables.items()})
    places = {name: place for name, place in places.items() if place[0] in times}
    signals = RunSignals(run, places, lambda name: times[name].time, True, 1.0, quiet=True)
    finder = PairFinder(run, places, times, signals)
    joints = finder.take(given.joints) if given.joints is not None else finder.find()
    for joint in joints:
        _unwrap(joint, given.find_wraps(joint.name))
    matrix = Correlations(run, [one.u.signal for one in joints], [one.q.signal for one in joints])
    switches = _list_switches(places, signals)
    remarks = finder.remarks
    for at, joint in enumerate(joints):
        judge = _JointJudge(joint, matrix, at, given)
        judge.judge_kind()
        if joint.u.is_changing:
            judge.judge_motion([one.u.full_name for one in joints])
        else:
            joint.evidence.append(("its command does not change in the beginning of the log", 0.0))
        table = joint.q.name.table
        joint.evidence += _check_source(table, times[table].num_doubled, len(joint.q.values))
        joint.evidence += _check_drive(joint.name, switches, remarks)
        judge.judge_lead()
        judge.judge_unit(run)
        judge.judge_target()
    return ColumnTable(times, joints, remarks, signals)


def _guess_times(run: LogRun, given: GivenColumns) -> dict[str, TimeGuess]:
    """Return the clock of each table that has one."""
    times, faults = {}, []
    for name, table in run.tables.items():
        found = guess_time(name, table, given)
        if isinstance(found, TimeGuess):
            times[name] = found
        else:
            faults += found
    if not times:
        places = index_columns({name: [*table.columns] for name, table in run.tables.items()})
        if not places:
            raise RecordingError(f"{run.where}: no column of numbers can be read in it")
        rate = f"{advise('rate', rate_hz=50.0)} where they are at 50 Hz"
        broken = "; ".join(faults) or f"columns: {', '.join(places)}; {rate}"
        raise RecordingError(
            f"{run.where}: no column is the time: none increases at a rate of {RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz; {broken}"
        )
    for name, offset_s in (given.clock_offset_s or {}).items():
        if name not in times:
            raise RecordingError(
                f"{run.where}: log.clock_offset_s: table '{name}' is missing or has no clock; {list_choices(name, times)}"
            )
        times[name] = replace(times[name], time=shift_clock(times[name].time, float(offset_s)))
    return times


def _unwrap(joint: JointGuess, given: float | None) -> None:
    """Take the wraps out of a position, and out of a target that has the same ones."""
    wrap = find_wrap(joint.q.values)
    if given is not None and (wrap is None or wrap.modulus != given):
        wrap = Wrap(float(given), np.empty(0, dtype=int)) if given else None
    if wrap is None:
        return
    joint.q = remove_wrap(joint.q, wrap)
    other = find_wrap(joint.u.values)
    if other is not None and other.modulus == wrap.modulus:
        joint.u = remove_wrap(joint.u, wrap)
    text = f"{wrap.explain()}: unwrapped; {advise('wraps', modulus=wrap.modulus)}"
    evidence = (text, 4.0) if given is None else ("as given by log.wraps", 5.0)
    joint.guesses["wraps"] = Guess(f"{joint.name}: wraps", f"{wrap.modulus:.6g}", [evidence])


def _list_switches(
    places: dict[str, tuple[str, str]], signals: RunSignals
) -> dict[str, tuple[str, Signal]]:
    """Return the columns that say whether a drive is on, by joint; an empty name for all of them."""
    found = {}
    for full_name, (_, column) in places.items():
        words = read_words(column)
        if not ENABLE_WORDS.isdisjoint(words):
            signal = signals.read(full_name)
            if set(np.unique(signal.values)) <= {0.0, 1.0}:
                no_joint = ENABLE_WORDS | {"torque", "drive", "motor"}
                left = [word for word in words if word not in no_joint]
                found["".join(left)] = (full_name, signal)
    return found


def _check_drive(
    name: str, switches: dict[str, tuple[str, Signal]], remarks: list[str]
) -> list[Evidence]:
    """Return the evidence of a drive that is off, and remark it."""
    column, signal = switches.get(name.replace("_", "")) or switches.get("") or ("", None)
    if signal is None or (signal.values != 0.0).all():
        return []
    off = signal.values == 0.0
    t_s = signal.t_s[off] - signal.t_s[0]
    text = f"its drive is off in {off.mean():.0%} of the rows"
    remarks.append(
        f"{name}: {text}, first at {t_s[0]:.2f} s, last at {t_s[-1]:.2f} s ({column} = 0)"
    )
    return [(text, -0.5)]


def _check_source(table: str, num_doubled: int, num_rows: int) -> list[Evidence]:
    """Return the evidence of a topic on which two programs send."""
    if num_doubled <= DOUBLED_SHARE * num_rows:
        return []
    text = f"{num_doubled} of {num_rows} messages repeat the stamp of the one before: two programs send to '{table}'"
    return [(text, -8.0)]


class _JointJudge:
    """Judges kind, motion and units of one joint by the numbers.

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
        self._r = {kind: float(matrix.get(kind)[at, at]) for kind in KIND_TEXTS}

    def judge_kind(self) -> None:
        """Decide which quantity the command sets."""
        joint, given = self._joint, self._given.command
        named = NAMED_KINDS.get(joint.u.name.quantity)
        r = {kind: abs(value) for kind, value in self._r.items()}
        weights = {}
        for kind in KIND_TEXTS:
            weights[kind] = 2.5 * (kind == named) - math.log(max(1.0 - r[kind], 0.005))
        weights["position"] += 0.5 if TARGET_SLOPE[0] <= self._slope <= TARGET_SLOPE[1] else -0.5
        if named != "torque":  # an acceleration that follows a target is that of a servo
            weights["torque"] = -math.inf
        chosen = given or max(weights, key=lambda kind: weights[kind])
        joint.kind = chosen
        reason = f"correlation with position {r['position']:.2f}, with speed {r['velocity']:.2f}"
        lead = weights[chosen] - max(weights[kind] for kind in weights if kind != chosen)
        evidence = [(reason, min(max(lead, -6.0), 6.0))]
        if given is not None:
            is_refuted = given != "torque" and joint.u.is_changing and r[given] < NO_CORRELATION
            evidence = [("as given by log.command", 5.0), (reason, -6.0 if is_refuted else 0.0)]
        elif named is None:
            evidence.append(("its name does not say it", -0.3))
        elif named != chosen:
            evidence.append(("its name says otherwise", -0.5))
        elif r[chosen] < CLEAR_CORRELATION:
            evidence.append(("", -1.0))
        subject, is_given = f"{joint.name}: command", given is not None
        guess = Guess(subject, KIND_TEXTS[chosen], evidence, (), is_given)
        joint.guesses["kind"] = guess.advise(advise("command"))

    def judge_motion(self, commands: list[str]) -> None:
        """Add the evidence of correlations, of another command that fits better, and of odd steps."""
        joint, r = self._joint, self._r[self._joint.kind]
        joint.sign = -1 if joint.kind == "velocity" and r < 0 else 1
        if joint.kind != "torque":
            joint.lag_s = self._matrix.find_lag(self._at, joint.kind == "position")
        text = (
            f"correlation of {FOLLOWED[joint.kind]} with command {r:.2f}, {joint.lag_s:.2f} s later"
        )
        joint.evidence.append((text, _weigh_correlation(r, joint.kind)))
        if joint.lag_s > LAST_LAG * LONGEST_LAG_S:
            joint.evidence.append(
                ("no longer lag is tried: its delay is longer, or it is no pair", -5.0)
            )
        size = np.abs(self._matrix.get(joint.kind)[:, self._at])
        others = np.delete(size, self._at)
        if size[self._at] < CLEAR_CORRELATION and others.max(initial=0.0) > size[self._at] + MARGIN:
            rival = int(np.flatnonzero(size == others.max())[0])
            weight = -6.0 if size[rival] > CLEAR_CORRELATION else -1.0
            joint.evidence.append((f"with the command {commands[rival]} {size[rival]:.2f}", weight))
        joint.evidence += self._check_steps()

    def _check_steps(self) -> list[Evidence]:
        """Return the evidence of steps that no machine makes."""
        q, t_s, command = self._joint.q.values, self._joint.q.signal.t_s, self._joint.u
        if self._joint.q.wrap is None and (wrap := find_wrap(q)) is not None:
            return [(f"{wrap.explain()}, and is taken as it is", -6.0)]
        cause = np.zeros(len(q))
        if self._joint.kind == "position":
            target = np.interp(t_s, command.signal.t_s, command.values)
            cause = self._slope * target + self._rest
        found = []
        spikes, jumps = find_spikes(q), find_jumps(t_s, q, cause, LONGEST_LAG_S)
        if len(spikes) > SPIKE_SHARE * len(q):
            text = f"{len(spikes)} of {len(q)} samples leave their neighbours and come back: two sources, or lost bits"
            found.append((text, -8.0))
        elif len(spikes):
            text = f"{len(spikes)} spikes, the first at {t_s[spikes[0]] - t_s[0]:.2f} s"
            found.append((text, -0.5))
        if len(jumps):
            row = jumps[0]
            text = (
                f"{len(jumps)} jumps that no command causes, the first by {abs(q[row + 1] - q[row]):.4g} at "
                f"{t_s[row] - t_s[0]:.2f} s: a reset, a wrap or another source?"
            )
            found.append((text, -6.0))
        return found

    def judge_lead(self) -> None:
        """Add the evidence of a position that leads its target, and make the guess of the columns."""
        joint = self._joint
        lead_s = self._matrix.find_lead(self._at) if joint.kind == "position" else 0.0
        if lead_s > 0.0:
            text = f"but the position leads it by {lead_s:.2f} s: columns swapped, or clocks apart?"
            joint.evidence.append((text, -8.0))
        value = f"{joint.command} → {joint.position}"
        guess = Guess(f"{joint.name}: columns", value, joint.evidence, (), joint.is_given)
        joint.guesses = {"columns": guess, **joint.guesses}

    def judge_unit(self, run: LogRun) -> None:
        """Decide the unit of the position."""
        joint, name = self._joint, self._joint.q.name
        given, target = self._given.find_unit(joint.name), joint.u.name
        is_target = target.unit is not None and target.quantity == "position"
        largest, others = float(np.abs(joint.q.values).max()), ()
        if given is not None and read_unit(given) is not None:
            value, evidence = given, [("as given by log.position_unit", 5.0)]
        elif name.unit is not None:
            value, evidence = name.unit, [("unit in its name", 5.0)]
            if name.unit == "rad" and joint.kind == "position" and largest > MOST_TURNS * math.tau:
                text = f"but {largest:.4g} rad is {largest / math.tau:.2g} turns: degrees? {advise('unit')}"
                evidence.append((text, -5.0))
        elif is_target and 0.8 <= self._slope <= 1.2:
            text = f"unit in the name of its target, which it follows 1 : {self._slope:.2f}"
            value, evidence = str(target.unit), [(text, 4.0)]
        elif largest <= 2 * math.pi:
            value, evidence = "rad", [(f"largest value {largest:.3g}, at most a turn", 2.0)]
            stated = run.tables[name.table].units.get(name.column) or find_bracketed(name.column)
            if stated:
                evidence.append((f"its unit '{stated}' is not known; {advise('unit')}", -4.0))
        else:
            asked = "degrees, per cent, counts, or a length?"
            evidence = [(f"largest value {largest:.4g}: {asked} {advise('unit')}", -1.0)]
            value, others = "deg", ("cm", "mm")
        joint.unit, joint.scale = read_unit(value) or ("rad", 1.0)
        is_given = given is not None and value == given
        joint.guesses["unit"] = Guess(f"{joint.name}: unit", value, evidence, others, is_given)

    def judge_target(self) -> None:
        """Decide the unit of the targets; it is in question where the positions do not follow 1 : 1."""
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
            joint.guesses["target"] = Guess(f"{joint.name}: unit of targets", value, [(text, -1.0)])


def _weigh_correlation(r: float, kind: CommandKind) -> float:
    """Return the weight of a correlation for a pair of columns."""
    size = abs(r)
    if kind == "torque":
        return 1.0 if size >= NO_CORRELATION else -2.0
    if size >= CLEAR_CORRELATION:
        return 3.0 if size >= HIGH_CORRELATION else 2.0
    return -0.5 if size >= NO_CORRELATION else -4.5
