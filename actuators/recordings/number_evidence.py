"""What the columns of a log are: hypotheses that names propose and numbers weigh.

Each pair of a command and a position is a hypothesis. Its names give evidence (the same joint), its numbers as
well (how the motion follows the command). One assignment takes the pairs with the most evidence in all; kind and
unit of each joint are then those with the most evidence. What a person gives is weighed like a guess: numbers
that speak against it make it unsure, but it is used as it was given.

Axes: `C` commands, `P` positions, `T` samples.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from actuators.recordings.advice import advise, format_joints
from actuators.recordings.clock_evidence import TimeGuess, guess_times
from actuators.recordings.clocks import list_time_columns, unwrap
from actuators.recordings.correlations import (
    CLEAR_CORRELATION,
    LONGEST_LAG_S,
    NO_CORRELATION,
    Correlations,
    weigh_correlation,
)
from actuators.recordings.guess import CommandKind, Evidence, GivenColumns, Guess
from actuators.recordings.log_signals import RunSignals, Signal
from actuators.recordings.log_tables import LogRun, index_columns
from actuators.recordings.name_evidence import (
    COUNT_WORDS,
    ENABLE_WORDS,
    UNITS,
    ColumnName,
    name_joint,
    read_column_name,
    read_unit,
    read_words,
)
from actuators.recordings.signal_checks import Wrap, find_jumps, find_spikes, find_wrap
from brokk_rl.errors import RecordingError

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
SAME_NAME, OTHER_NAME = 3.0, -6.0
"""Log odds of a pair with one name of a joint, and of one in which a column shares it with another one."""
MARGIN = 0.1
"""A partner that correlates better by so much contradicts a pair."""
TARGET_SLOPE = (0.5, 1.5)
"""Position over target: outside of it the target is in another unit, or no target."""
DOUBLED_SHARE = 0.2
"""Share of equal stamps with other values from which two programs send to one topic."""
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
    times = guess_times(run, given)
    finder = _PairFinder(run, given, times)
    joints = finder.take(given.joints) if given.joints is not None else finder.find()
    matrix = finder.correlate([one.u for one in joints], [one.q for one in joints])
    for at, joint in enumerate(joints):
        judge = _JointJudge(joint, matrix, at, given)
        judge.judge_kind()
        judge.judge_motion([one.u.text for one in joints])
        finder.check_source(joint)
        finder.check_drive(joint)
        judge.judge_columns()
        judge.judge_unit()
        judge.judge_target()
    return ColumnTable(times, joints, finder.remarks, finder.signals)


class _PairFinder:
    """Finds the columns of the joints of a run.

    Args:
        run: Beginning of a log, with all columns.
        given: Meanings that a person gives.
        times: Clock of each table.

    Attributes:
        signals: Signals of the run.
        remarks: What was left out or seems odd.
    """

    def __init__(self, run: LogRun, given: GivenColumns, times: dict[str, TimeGuess]) -> None:
        self._run, self._given, self._times = run, given, times
        self._places = index_columns({name: [*run.tables[name].columns] for name in times})
        self.signals = RunSignals(
            run, self._places, lambda name: times[name].time, True, 1.0, quiet=True
        )
        self.remarks: list[str] = []

    def take(self, given: dict[str, tuple[str, str]]) -> list[JointGuess]:
        """Return the joints whose columns a person gives; refuse one that is missing."""
        joints = []
        for joint, columns in given.items():
            u, q = (self._read_entry(column) for column in columns)
            (u,), (q,) = self._unwrap([u], [q], [joint])
            joints.append(JointGuess(joint, u, q, [("as given by log.joints", 5.0)]))
        return joints

    def find(self) -> list[JointGuess]:
        """Return the joints with the most evidence; refuse columns that say nothing."""
        entries = self._read_entries()
        commands, positions = _choose_roles(entries)
        twice = next((one for one in (*commands, *positions) if "#" in one.name.column), None)
        if twice is not None:
            name = twice.name.column.partition("#")[0]
            listed = f"several columns are named '{name}'; they are read as {name}#1, {name}#2, …: rename them, or "
            self._refuse(listed, list(zip(commands, positions, strict=False)))
        if not commands or not positions:
            lacking = f"no column is named like {'positions' if commands else 'commands'}; "
            self._refuse(lacking, self._list_followers(entries))
        if _has_several_sources(commands) and _has_several_sources(positions):
            commands, positions = _name_sources(commands), _name_sources(positions)
        names = [name_joint(one.name.joint) for one in positions]
        commands, positions = self._unwrap(commands, positions, names)
        joints = self._assign(commands, positions)
        keys = {one.name.key for joint in joints for one in (joint.u, joint.q)}
        taken = {one.text for joint in joints for one in (joint.u, joint.q)}
        counts = []
        for several, text in (
            (commands, "other commands that were not taken"),
            (positions, "positions that move without a command"),
        ):
            left = [one for one in several if one.is_changing and one.text not in taken]
            counts.append(len({one.name.key for one in left} - keys))
            if left:
                self.remarks.append(f"{text}: {', '.join(one.text for one in left)}")
        if missed := min(counts):
            text = f"{missed} commands and positions that move have no partner"
            for joint in joints:
                joint.evidence.append((text, -4.0 if 2 * missed >= len(joints) else -1.0))
        return joints

    def _read_entries(self) -> list[ColumnEntry]:
        """Return the columns that are neither clock nor count nor switch."""
        entries = []
        for full_name, (table, column) in self._places.items():
            clocks = list_time_columns(self._times[table].time)
            is_time = any(column == one or column in re.findall(r"\w+", one) for one in clocks)
            is_time |= column.endswith("stamp") or column == self._run.tables[table].clock
            if not is_time and (COUNT_WORDS | ENABLE_WORDS).isdisjoint(read_words(column)):
                try:
                    entries.append(self._read_entry(full_name))
                except RecordingError:
                    continue  # it has no numbers
        return entries

    def _read_entry(self, full_name: str) -> ColumnEntry:
        signal = self.signals.read(full_name)
        _, column = self._places.get(full_name, (signal.table, full_name))
        unit = self._run.tables[signal.table].units.get(column)
        return ColumnEntry(read_column_name(signal.table, column, unit), signal)

    def _unwrap(
        self,
        commands: Sequence[ColumnEntry],
        positions: Sequence[ColumnEntry],
        names: Sequence[str],
    ) -> tuple[list[ColumnEntry], list[ColumnEntry]]:
        """Return positions without wraps, and targets that have the same ones."""
        plain, moduli = [], set[float]()
        for name, entry in zip(names, positions, strict=True):
            given, wrap = self._given.find_wraps(name), find_wrap(entry.values)
            if given is not None and (wrap is None or wrap.modulus != given):
                wrap = Wrap(float(given), np.empty(0, dtype=int)) if given else None
            moduli |= {wrap.modulus} if wrap else set()
            plain.append(_remove_wrap(entry, wrap))
        targets = []
        for entry in commands:
            wrap = find_wrap(entry.values) if moduli else None
            targets.append(_remove_wrap(entry, wrap if wrap and wrap.modulus in moduli else None))
        return targets, plain

    def _assign(
        self, commands: list[ColumnEntry], positions: list[ColumnEntry]
    ) -> list[JointGuess]:
        """Return the pairs of the assignment with the most evidence."""
        names = _weigh_names(commands, positions)
        size = self.correlate(commands, positions).size
        numbers = np.vectorize(weigh_correlation)(size) + size
        numbers[[not one.is_changing for one in commands]] = -1.0  # another log may move it
        usual = [_prefer(one, True) for one in commands], [_prefer(one, False) for one in positions]
        score = names + numbers + np.add.outer(*usual)
        pairs = sorted(
            zip(*linear_sum_assignment(-score), strict=True), key=lambda pair: -score[pair]
        )
        chosen: dict[str, tuple[int, int]] = {}
        for pair in pairs:
            if names[pair] == SAME_NAME:
                chosen.setdefault(commands[pair[0]].name.key, pair)
        found = [(*pair, "same name", SAME_NAME) for pair in chosen.values()]
        rest = [
            [
                at
                for at, one in enumerate(several)
                if one.name.key not in chosen and (one.is_changing or not chosen)
            ]
            for several in (commands, positions)
        ]
        clear = [pair for pair in pairs if _is_clear(size, *pair, *rest)]
        if len(rest[0]) == len(rest[1]) == 1:
            found.append((rest[0][0], rest[1][0], "the only command and the only position", 2.0))
        elif len(clear) == min(map(len, rest)):
            found += [(*pair, "paired by their numbers", 0.0) for pair in clear]
        elif not chosen:
            listed = (
                "commands and positions share no names, and not all follow each other clearly; "
            )
            self._refuse(listed, list(zip(commands, positions, strict=False)))
        joints = []
        for row, column, text, weight in sorted(found):
            u, q = commands[row], positions[column]
            name = name_joint(q.name.joint or u.name.joint)
            joints.append(JointGuess(name, u, q, [(text, weight)]))
        return joints

    def correlate(
        self, commands: Sequence[ColumnEntry], positions: Sequence[ColumnEntry]
    ) -> Correlations:
        """Return how positions follow commands."""
        u, q = ([one.signal for one in several] for several in (commands, positions))
        return Correlations(self._run, u, q)

    def _list_followers(
        self, entries: Sequence[ColumnEntry]
    ) -> list[tuple[ColumnEntry, ColumnEntry]]:
        """Return columns that clearly follow others, whose past tells more of them than theirs of those."""
        moving = [one for one in entries if one.is_changing]
        if not moving:
            return []
        size = self.correlate(moving, moving).size
        np.fill_diagonal(size, 0.0)
        size = np.where((size >= size.T) & (size >= CLEAR_CORRELATION), size, 0.0)
        pairs, used = [], set[int]()
        for flat in np.argsort(-size, axis=None)[: np.count_nonzero(size)]:
            row, column = (int(at) for at in np.unravel_index(flat, size.shape))
            if used.isdisjoint((row, column)):
                used |= {row, column}
                pairs.append((moving[row], moving[column]))
        return pairs

    def _refuse(self, text: str, pairs: Sequence[tuple[ColumnEntry, ColumnEntry]]) -> None:
        """Raise a `RecordingError` with the columns of each joint as they are given by hand."""
        proposed = {f"joint_{at}": (u.text, q.text) for at, (u, q) in enumerate(pairs, 1)}
        joints = format_joints(proposed) or 'boom: ["<command>", "<position>"]'
        raise RecordingError(
            f"{self._run.where}: {text}{advise('joints', joints=joints)}; its columns are {', '.join(self._places)}"
        )

    def check_drive(self, joint: JointGuess) -> None:
        """Add the evidence of a drive that is off by a column that says so, and remark it."""
        for full_name, (_, column) in self._places.items():
            words = read_words(column)
            left = [one for one in words if one not in ENABLE_WORDS | {"torque", "drive", "motor"}]
            if ENABLE_WORDS.isdisjoint(words) or "".join(left) not in ("", joint.q.name.key):
                continue
            signal = self.signals.read(full_name)
            off = signal.values == 0.0
            if off.any() and set(np.unique(signal.values)) <= {0.0, 1.0}:
                t_s = signal.t_s[off] - signal.t_s[0]
                text = f"its drive is off in {off.mean():.0%} of the rows"
                joint.evidence.append((text, -0.5))
                self.remarks.append(
                    f"{joint.name}: {text}, first at {t_s[0]:.2f} s, last at {t_s[-1]:.2f} s ({full_name} = 0)"
                )

    def check_source(self, joint: JointGuess) -> None:
        """Add the evidence of a topic on which two programs send."""
        table, num_rows = joint.q.name.table, len(joint.q.values)
        num_doubled = self._times[table].num_doubled
        if num_doubled > DOUBLED_SHARE * num_rows:
            text = f"{num_doubled} of {num_rows} messages repeat the stamp of the one before: two programs send to '{table}'"
            joint.evidence.append((text, -8.0))


class _JointJudge:
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
        self._r = {kind: float(matrix.get(kind)[at, at]) for kind in KIND_TEXTS}

    def judge_kind(self) -> None:
        """Choose which quantity the command sets."""
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
        size = np.abs(self._matrix.get(joint.kind)[:, self._at])
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
        spikes, jumps = find_spikes(q), find_jumps(t_s, q, cause, LONGEST_LAG_S)
        if len(spikes):
            is_mixed = len(spikes) > SPIKE_SHARE * len(q)
            cause_text = ": two sources, or lost bits" if is_mixed else ""
            begin_s = t_s[spikes[0]] - t_s[0]
            text = f"{len(spikes)} of {len(q)} samples leave their neighbours and come back, first at {begin_s:.2f} s{cause_text}"
            joint.evidence.append((text, -8.0 if is_mixed else -0.5))
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
        remedy = advise({"kind": "command"}.get(key, key)) if key in ("kind", "unit") else ""
        self._joint.guesses[key] = guess.advise(remedy)


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
        return [(f"but {largest:.4g} rad is {turns:.2g} turns: degrees?", -5.0)]
    plain = math.tau if joint.unit == "rad" else 2.0
    if abs(joint.scale) < 1.0 and 0.0 < travel < plain:
        text = f"but it moves by {travel:.2g} of them in all: is the log in {joint.unit}?"
        return [(text, -5.0)]
    return []


def _remove_wrap(entry: ColumnEntry, wrap: Wrap | None) -> ColumnEntry:
    """Return a column without its wraps."""
    if wrap is None:
        return entry
    signal = replace(entry.signal, values=unwrap(entry.values, wrap.modulus))
    return replace(entry, signal=signal, wrap=wrap)


def _choose_roles(entries: list[ColumnEntry]) -> tuple[list[ColumnEntry], list[ColumnEntry]]:
    """Return the columns that may be commands, and those that may be positions."""
    commands = [one for one in entries if one.name.role == "command"]
    commands = [one for one in commands if one.name.quantity != "effort"] or commands
    positions = []
    for one in entries:
        if one.name.role != "command" and one.name.quantity in ("position", "unknown"):
            positions.append(one)
    named = [one for one in positions if (one.name.quantity, one.name.role) != ("unknown", None)]
    return commands, named or positions


def _weigh_names(commands: Sequence[ColumnEntry], positions: Sequence[ColumnEntry]) -> np.ndarray:
    """Return the log odds of each pair by the names of its joint, `(C, P)`."""
    u, q = (np.array([one.name.key for one in several]) for several in (commands, positions))
    is_same = u[:, None] == q[None]
    has_other = is_same.any(1)[:, None] | is_same.any(0)[None]
    return np.where(is_same, SAME_NAME, np.where(has_other, OTHER_NAME, 0.0))


def _prefer(entry: ColumnEntry, is_command: bool) -> float:
    """Return the log odds of a column among others of its joint: that of the position, as measured."""
    is_usual = entry.name.quantity != "velocity" if is_command else entry.name.role == "measured"
    return 0.4 * (entry.name.quantity == "position") + 0.2 * is_usual


def _is_clear(size: np.ndarray, row: int, column: int, rows: list[int], columns: list[int]) -> bool:
    """Return whether two columns among some follow each other, and no other follows one of them as well."""
    if row not in rows or column not in columns:
        return False
    along = [size[row, one] for one in columns if one != column]
    across = [size[one, column] for one in rows if one != row]
    return bool(size[row, column] >= max(CLEAR_CORRELATION, max([0.0, *along, *across]) + MARGIN))


def _has_several_sources(entries: Sequence[ColumnEntry]) -> bool:
    """Return whether tables of different names have a joint of one name: two arms, each on its topics."""
    sources = {(one.name.key, one.name.source) for one in entries}
    return len(sources) > len({one.name.key for one in entries})


def _name_sources(entries: Sequence[ColumnEntry]) -> list[ColumnEntry]:
    """Return the columns with the words of their tables before those of their joints."""
    found = []
    for one in entries:
        joint = f"{one.name.source}_{one.name.joint}".strip("_")
        found.append(replace(one, name=replace(one.name, joint=joint)))
    return found
