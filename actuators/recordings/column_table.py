"""One table of what the columns of a log are: candidates, evidence for each, and a probability.

Names propose, numbers decide. What a person gives is weighed like a guess: numbers that speak against
it make it unsure, but it is used as it was given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from actuators.recordings.advice import advise
from actuators.recordings.column_names import (
    ENABLE_WORDS,
    UNITS,
    find_bracketed,
    read_unit,
    split_unit,
    split_words,
)
from actuators.recordings.column_pairs import (
    MARGIN,
    ColumnEntry,
    ColumnPair,
    PairFinder,
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
TARGET_SLOPE = (0.5, 1.5)
"""Position over target: outside of it the target is in another unit, or no target."""
DOUBLED_SHARE = 0.2
"""Share of equal stamps with other values from which two programs send to one topic."""


@dataclass(frozen=True)
class JointGuess:
    """The columns of a joint.

    Attributes:
        name: Name of the joint.
        command: Full name of the column of its command.
        position: Full name of the column of its position.
        kind: Quantity that the command sets.
        sign: -1 where larger commands move to smaller positions.
        lag_s: Lag of the motion behind the command at the best correlation.
        unit: `rad` or `m`.
        scale: That unit for one of the log.
        target_scale: The same for its targets.
        target_offset: Position at a target of 0, in that unit.
        speed_scale: Speed, in that unit per s, for one of its commands, where the name has a unit of speed.
        wraps: Value at which the position begins again, `None` for none.
        target_wraps: The same of a target.
        guesses: How sure each part is; `target` where the unit of the targets is in question.
    """

    name: str
    command: str
    position: str
    kind: CommandKind
    sign: int
    lag_s: float
    unit: str
    scale: float
    target_scale: float
    target_offset: float
    speed_scale: float | None
    wraps: float | None
    target_wraps: float | None
    guesses: dict[str, Guess]


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


def read_columns(run: LogRun, given: GivenColumns, skip: bool) -> ColumnTable:
    """Return what the columns of a run are.

    Args:
        run: Beginning of a log, with all columns.
        given: Meanings that a person gives.
        skip: Rows whose time does not increase will be left out.

    Raises:
        RecordingError: No time, no command or no position can be proposed, or a given column is missing.
    """
    times, faults = {}, []
    for name, table in run.tables.items():
        found = guess_time(name, table, given, skip)
        if isinstance(found, TimeGuess):
            times[name] = found
        else:
            faults += found
    if not times:
        places = index_columns(list_columns(run))
        if not places:
            raise RecordingError(f"{run.where}: no column of numbers can be read in it")
        broken = (
            "; ".join(faults)
            or f"columns: {', '.join(places)}; {advise('rate', rate_hz=50.0)} where they are at 50 Hz"
        )
        raise RecordingError(
            f"{run.where}: no column is the time: none increases at a rate of {RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz; {broken}"
        )
    for name, offset_s in (given.clock_offset_s or {}).items():
        if name not in times:
            raise RecordingError(
                f"{run.where}: log.clock_offset_s: table '{name}' is missing or has no clock; {list_choices(name, times)}"
            )
        times[name] = replace(times[name], time=shift_clock(times[name].time, float(offset_s)))
    return _JointFinder(run, times, given).find()


def list_columns(run: LogRun) -> dict[str, list[str]]:
    """Return the columns of each table of a run."""
    return {name: [*table.columns] for name, table in run.tables.items()}


class _JointFinder:
    """Finds the joints of a run."""

    def __init__(self, run: LogRun, times: dict[str, TimeGuess], given: GivenColumns) -> None:
        self._run, self._times, self._given = run, times, given
        places = index_columns(list_columns(run))
        self._places = {name: place for name, place in places.items() if place[0] in times}
        self._signals = RunSignals(
            run, self._places, lambda name: times[name].time, True, 1.0, quiet=True
        )
        self._remarks: list[str] = []
        self._commands: list[str] = []

    def find(self) -> ColumnTable:
        """Return the table of the run."""
        finder = PairFinder(self._run, self._places, self._times, self._signals, self._remarks)
        pairs = finder.find(self._given.joints)
        for name, pair in pairs.items():
            self._unwrap(name, pair)
        commands = [pair.command for pair in pairs.values()]
        positions = [pair.position.signal for pair in pairs.values()]
        matrix = Correlations(self._run, [one.signal for one in commands], positions)
        self._commands = [one.full_name for one in commands]
        enabled = self._list_enabled()
        joints = []
        for at, (name, pair) in enumerate(pairs.items()):
            joints.append(self._judge_joint(name, pair, matrix, at, enabled))
        return ColumnTable(self._times, joints, self._remarks, self._signals)

    def _unwrap(self, joint: str, pair: ColumnPair) -> None:
        """Take the wraps out of a position, and out of a target that has the same ones."""
        given = self._given.wraps
        given = given.get(joint) if isinstance(given, Mapping) else given
        wrap = find_wrap(pair.position.values)
        if given is not None:
            is_same = wrap is not None and wrap.modulus == given
            rows = wrap.rows if wrap is not None and is_same else np.empty(0, dtype=int)
            wrap = Wrap(float(given), rows) if given else None
        if wrap is None:
            return
        pair.position = remove_wrap(pair.position, wrap)
        other = find_wrap(pair.command.values)
        if other is not None and other.modulus == wrap.modulus:
            pair.command = remove_wrap(pair.command, wrap)

    def _list_enabled(self) -> dict[str, tuple[str, Signal]]:
        """Return the columns that say whether a drive is on, by joint; an empty name for all of them."""
        found = {}
        for full_name, (_, column) in self._places.items():
            words = split_words(split_unit(column)[0])
            if not any(word in ENABLE_WORDS for word in words):
                continue
            signal = self._signals.read(full_name)
            if set(np.unique(signal.values)) <= {0.0, 1.0}:
                left = [
                    word
                    for word in words
                    if word not in ENABLE_WORDS and word not in ("torque", "drive", "motor")
                ]
                found["".join(left)] = (full_name, signal)
        return found

    def _judge_joint(
        self,
        name: str,
        pair: ColumnPair,
        matrix: Correlations,
        at: int,
        enabled: Mapping[str, tuple[str, Signal]],
    ) -> JointGuess:
        command, position = pair.command, pair.position
        wraps = self._guess_wrap(name, position)
        kind, kind_guess = self._judge_kind(name, command, matrix, at)
        is_target = kind == "position"
        r = float(matrix.get(kind)[at, at])
        lag_s = 0.0 if kind == "torque" else matrix.find_lag(at, is_target)
        evidence = [pair.evidence]
        shown = {"position": "position", "velocity": "speed", "torque": "acceleration"}[kind]
        if not command.is_changing:
            evidence.append(
                Evidence("its command does not change in the beginning of the log", 0.0)
            )
        else:
            text = f"correlation of {shown} with command {r:.2f}, {lag_s:.2f} s later"
            evidence.append(Evidence(text, _weigh_correlation(r, kind)))
            evidence += self._compare_rivals(matrix, at, kind, pair.is_given)
            evidence += self._check_steps(position, command, matrix, at, is_target)
        evidence += self._check_source(position)
        evidence += self._check_drive(name, position, enabled)
        lead_s = matrix.find_lead(at) if is_target else 0.0
        if lead_s > 0.0:
            evidence.append(
                Evidence(
                    f"but the position leads it by {lead_s:.2f} s: columns swapped, or clocks apart?",
                    -8.0,
                )
            )
        value = f"{command.full_name} → {position.full_name}"
        guesses = {"columns": Guess(f"{name}: columns", value, tuple(evidence), (), pair.is_given)}
        guesses["kind"] = kind_guess
        if wraps is not None:
            guesses["wraps"] = wraps
        unit, scale, guesses["unit"] = self._judge_unit(name, position, command, matrix, at)
        target_scale, target_offset = scale, 0.0
        slope, rest = matrix.fit_target(at)
        if is_target and abs(matrix.target[at, at]) >= CLEAR_CORRELATION:
            if command.name.unit is not None and UNITS[command.name.unit][0] == unit:
                target_scale = UNITS[command.name.unit][1]
            if not TARGET_SLOPE[0] <= slope * scale / target_scale <= TARGET_SLOPE[1]:
                target_scale, target_offset = slope * scale, rest * scale
                text = "this line fits the positions best; fill in scale and offset, those of the code that commands"
                guesses["target"] = Guess(
                    f"{name}: unit of targets",
                    f"{slope:.3g} × target + {rest:.3g}",
                    (Evidence(text, -1.0),),
                )
        sign = 1 if kind != "velocity" or r >= 0 else -1
        return JointGuess(
            name,
            command.full_name,
            position.full_name,
            kind,
            sign,
            lag_s,
            unit,
            scale,
            target_scale,
            target_offset,
            command.name.speed_unit,
            position.wrap.modulus if position.wrap else None,
            command.wrap.modulus if command.wrap and is_target else None,
            guesses,
        )

    def _guess_wrap(self, name: str, position: ColumnEntry) -> Guess | None:
        """Return the guess of the value at which a position begins again."""
        wrap = position.wrap
        if wrap is None:
            return None
        evidence = Evidence(
            f"{wrap.explain()}: unwrapped; {advise('wraps', modulus=wrap.modulus)}", 4.0
        )
        if self._given.wraps is not None:
            evidence = Evidence("as given by log.wraps", 5.0)
        return Guess(f"{name}: wraps", f"{wrap.modulus:.6g}", (evidence,))

    def _judge_kind(
        self, name: str, command: ColumnEntry, matrix: Correlations, at: int
    ) -> tuple[CommandKind, Guess]:
        """Return the quantity that a command sets."""
        quantity = command.name.quantity
        slope = matrix.fit_target(at)[0]
        r = {kind: float(abs(matrix.get(kind)[at, at])) for kind in KIND_TEXTS}
        named = {"position": "position", "velocity": "velocity", "effort": "torque"}.get(quantity)
        weights: dict[CommandKind, float] = {}
        for kind in KIND_TEXTS:
            weights[kind] = 2.5 * (kind == named) - math.log(max(1.0 - r[kind], 0.005))
        is_in_unit = TARGET_SLOPE[0] <= slope <= TARGET_SLOPE[1]
        weights["position"] += 0.5 if is_in_unit else -0.5
        if named != "torque":
            weights[
                "torque"
            ] = -math.inf  # an acceleration that follows a target is that of a servo
        given = self._given.command
        chosen = given or max(weights, key=lambda kind: weights[kind])
        reason = f"correlation with position {r['position']:.2f}, with speed {r['velocity']:.2f}"
        rivals = [weight for kind, weight in weights.items() if kind != chosen]
        evidence = [Evidence(reason, min(max(weights[chosen] - max(rivals), -6.0), 6.0))]
        if given is not None:
            is_refuted = given != "torque" and command.is_changing and r[given] < NO_CORRELATION
            evidence = [
                Evidence("as given by log.command", 5.0),
                Evidence(reason, -6.0 if is_refuted else 0.0),
            ]
        elif named is None:
            evidence.append(Evidence("its name does not say it", -0.3))
        elif named != chosen:
            evidence.append(Evidence("its name says otherwise", -0.5))
        elif r[chosen] < CLEAR_CORRELATION:
            evidence.append(Evidence("", -1.0))
        subject, text = f"{name}: command", KIND_TEXTS[chosen]
        guess = Guess(subject, text, tuple(evidence), (), given is not None)
        return chosen, guess.advise(advise("command"))

    def _compare_rivals(
        self, matrix: Correlations, at: int, kind: CommandKind, is_given: bool
    ) -> list[Evidence]:
        """Return the evidence of another command that the position follows better."""
        size = np.abs(matrix.get(kind)[:, at])
        rival = int(np.argmax(np.where(np.arange(len(size)) == at, -1.0, size)))
        is_better = rival != at and size[rival] > size[at] + MARGIN and size[at] < CLEAR_CORRELATION
        if not is_better:
            return []
        weight = -6.0 if size[rival] > CLEAR_CORRELATION else -1.0
        return [Evidence(f"with the command {self._commands[rival]} {size[rival]:.2f}", weight)]

    def _check_steps(
        self,
        position: ColumnEntry,
        command: ColumnEntry,
        matrix: Correlations,
        at: int,
        is_target: bool,
    ) -> list[Evidence]:
        """Return the evidence of steps that no machine makes."""
        q, t_s = position.values, position.signal.t_s
        cause = np.zeros(len(q))
        if is_target:
            slope, offset = matrix.fit_target(at)
            cause = slope * np.interp(t_s, command.signal.t_s, command.values) + offset
        if position.wrap is None and (wrap := find_wrap(q)) is not None:
            return [Evidence(f"{wrap.explain()}, and is taken as it is", -6.0)]
        spikes = find_spikes(q)
        jumps = find_jumps(t_s, q, cause, LONGEST_LAG_S)
        found = []
        if len(spikes) > 0.01 * len(q):
            text = f"{len(spikes)} of {len(q)} samples leave their neighbours and come back: two sources, or lost bits"
            found.append(Evidence(text, -8.0))
        elif len(spikes):
            found.append(
                Evidence(
                    f"{len(spikes)} spikes, the first at {t_s[spikes[0]] - t_s[0]:.2f} s", -0.5
                )
            )
        if len(jumps):
            text = (
                f"{len(jumps)} jumps that no command causes, the first by {abs(q[jumps[0] + 1] - q[jumps[0]]):.4g} at "
                f"{t_s[jumps[0]] - t_s[0]:.2f} s: a reset, a wrap or another source?"
            )
            found.append(Evidence(text, -6.0))
        return found

    def _check_source(self, position: ColumnEntry) -> list[Evidence]:
        """Return the evidence of a topic on which two programs send."""
        table = position.name.table
        num_doubled, num_rows = self._times[table].num_doubled, len(position.values)
        if num_doubled <= DOUBLED_SHARE * num_rows:
            return []
        text = f"{num_doubled} of {num_rows} messages repeat the stamp of the one before: two programs send to '{table}'"
        return [Evidence(text, -8.0)]

    def _check_drive(
        self, name: str, position: ColumnEntry, enabled: Mapping[str, tuple[str, Signal]]
    ) -> list[Evidence]:
        """Return the evidence of a drive that is off, and remark it."""
        key = name.replace("_", "")
        if key not in enabled and "" not in enabled:
            return []
        column, signal = enabled.get(key) or enabled[""]
        off = signal.values == 0.0
        if not off.any():
            return []
        t_s = signal.t_s[off] - signal.t_s[0]
        text = (
            f"{name}: its drive is off in {off.mean():.0%} of the rows, first at {t_s[0]:.2f} s, last at {t_s[-1]:.2f} s "
            f"({column} = 0)"
        )
        self._remarks.append(text)
        return [Evidence(f"its drive is off in {off.mean():.0%} of the rows", -0.5)]

    def _judge_unit(
        self, name: str, position: ColumnEntry, command: ColumnEntry, matrix: Correlations, at: int
    ) -> tuple[str, float, Guess]:
        """Return unit of the recording, that unit for one of the log, and how sure it is."""
        subject, q = f"{name}: unit", position.values
        given = self._given.position_unit
        given = given.get(name) if isinstance(given, Mapping) else given
        if given is not None and (known := read_unit(given)) is not None:
            return *known, Guess(
                subject, given, (Evidence("as given by log.position_unit", 5.0),), (), True
            )
        stated = position.name.unit
        if stated is not None:
            return *UNITS[stated], Guess(subject, stated, (Evidence("unit in its name", 5.0),))
        slope = matrix.fit_target(at)[0]
        other = command.name.unit
        if other is not None and command.name.quantity == "position" and 0.8 <= slope <= 1.2:
            text = f"unit in the name of its target, which it follows 1 : {slope:.2f}"
            return *UNITS[other], Guess(subject, other, (Evidence(text, 4.0),))
        largest = float(np.abs(q).max())
        table, column = position.name.table, position.name.column
        unknown = self._run.tables[table].units.get(column) or find_bracketed(column)
        if largest <= 2 * math.pi:
            evidence = [Evidence(f"largest value {largest:.3g}, at most a turn", 2.0)]
            if unknown:
                text = f"its unit '{unknown}' is not known; {advise('unit')}"
                evidence.append(Evidence(text, -4.0))
            return "rad", 1.0, Guess(subject, "rad", tuple(evidence))
        text = (
            f"largest value {largest:.4g}: degrees, per cent, counts, or a length? {advise('unit')}"
        )
        return "rad", math.pi / 180.0, Guess(subject, "deg", (Evidence(text, -1.0),), ("cm", "mm"))


def _weigh_correlation(r: float, kind: CommandKind) -> float:
    """Return the weight of a correlation for a pair of columns."""
    size = abs(r)
    if kind == "torque":
        return 1.0 if size >= NO_CORRELATION else -2.0
    if size >= HIGH_CORRELATION:
        return 3.0
    if size >= CLEAR_CORRELATION:
        return 2.0
    return -0.5 if size >= NO_CORRELATION else -4.5
