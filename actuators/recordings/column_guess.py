"""Guesses what the columns of a log mean, and says how sure each guess is.

Names propose, numbers decide. A guess is `sure` where name and numbers agree, `likely` where one of
them speaks and the other does not contradict, and `unsure` else. An unsure guess is never used: the
column map that is written has `???` in its place, with the candidates beside it. A person who knows
columns that are named otherwise gives them, and nothing is guessed about these.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from actuators.recordings.clock_guess import Guess, Sureness, TimeGuess, read_times
from actuators.recordings.column_names import (
    UNITS,
    ColumnName,
    Quantity,
    Role,
    name_joint,
    read_column_name,
    read_speed_unit,
    read_unit,
    split_words,
)
from actuators.recordings.log_signals import index_columns
from actuators.recordings.log_tables import LogRun, join_names
from actuators.recordings.whole_rows import leave_broken_rows_out
from brokk_rl.errors import RecordingError, list_choices

CommandKind = Literal["velocity", "position", "torque"]
"""Quantity that commands set, as `command` of a joint in a machine file."""
Pairing = Literal["same name", "same place in their order", "as given by log.joints"]
"""Reason for which a command and a position belong to one joint."""

LONGEST_LAG_S = 1.5
"""Longest lag from command to motion that is tried: more than twice the 0.55 s of the slowest machine known."""
CLEAR_CORRELATION = 0.8
"""From here on the numbers confirm a pair: two thirds of the variance are explained."""
NO_CORRELATION = 0.3
"""Below it the numbers contradict a pair: less than a tenth of the variance is explained."""
MARGIN = 0.1
"""A partner that correlates better by so much contradicts a pair."""
COMMAND_KINDS: dict[CommandKind, str] = {
    "velocity": "sets the speed",
    "position": "a target of the position",
    "torque": "sets a force or torque",
}
TARGET_SLOPE = (0.5, 1.5)
"""Position over target: outside of it the target is in another unit, or no target."""
CLEAR_SHARE = 0.3
"""Largest ratio of what the better of two explanations leaves unexplained to what the other leaves;
by hand: swapped columns leave less than 0.1, servos with play or friction more than 0.5."""
GRID_ROWS = 20000
"""Rows on which pairs are compared; correlations change by less than 0.01 beyond."""


@dataclass(frozen=True)
class GivenColumns:
    """Meanings that a person gives, which are then not guessed.

    Attributes:
        joints: Columns of command and position by joint; `None` to find them by their names.
        command: Quantity that commands set; `None` to guess it.
        position_unit: Unit of the positions, for all joints or by joint; `None` to guess it.
        clock_offset_s: Seconds added to the clocks of tables.
    """

    joints: Mapping[str, tuple[str, str]] | None = None
    command: CommandKind | None = None
    position_unit: str | Mapping[str, str] | None = None
    clock_offset_s: Mapping[str, float] | None = None


@dataclass(frozen=True)
class JointGuess:
    """The columns of a joint.

    Attributes:
        name: Name of the joint.
        command: Full name of the column of its command.
        position: Full name of the column of its position.
        kind: The command is a target position, or sets the speed or a torque.
        sign: -1 where larger commands move to smaller positions.
        lag_s: Lag of the motion behind the command at the best correlation.
        unit: `rad` or `m`.
        scale: That unit for one of the log.
        target_scale: The same for its targets.
        target_offset: Position at a target of 0, in that unit.
        speed_scale: Speed, in that unit per s, for one of its commands, where the name has a unit of speed.
        guesses: How sure each part is; `target` where the unit of the targets is in question.
    """

    name: str
    command: str
    position: str
    kind: Literal["target", "speed", "torque"]
    sign: int
    lag_s: float
    unit: str
    scale: float
    target_scale: float
    target_offset: float
    speed_scale: float | None
    guesses: dict[str, Guess]


@dataclass(frozen=True)
class _Family:
    """Columns that differ by their joint only.

    Attributes:
        table: Their table.
        role: Their role.
        quantity: Their quantity.
        members: Columns by joint.
    """

    table: str
    role: Role | None
    quantity: Quantity
    members: Mapping[str, ColumnName]


def _list_families(run: LogRun, times: Mapping[str, TimeGuess]) -> list[_Family]:
    groups: dict[tuple[str, str], dict[str, ColumnName]] = {}
    for table, content in run.tables.items():
        if table not in times:
            continue
        time = times[table]
        for column in content.columns:
            if column in (time.column, time.anchor):
                continue
            name = read_column_name(table, column)
            base = column.partition("[")[0]  # a list is one family, whatever its items are called
            if base == column:
                joint = name.joint.split("_")
                words = [word for word in split_words(column) if word not in joint]
                # a hinge in rad beside a slide in mm: the unit does not part them
                base = " ".join(word for word in words if word not in UNITS)
                base = re.sub(r"\d+$", "", base)
                if name.joint in groups.get((table, base), {}):
                    base = re.sub(r"\d+$", "", " ".join(words))
            groups.setdefault((table, base), {})[name.joint] = name
    families = []
    for (table, _), members in groups.items():
        first = next(iter(members.values()))
        families.append(_Family(table, first.role, first.quantity, members))
    return families


def guess_joints(
    run: LogRun, times: Mapping[str, TimeGuess], given: GivenColumns
) -> tuple[list[JointGuess], list[str]]:
    """Return the joints of a run, and remarks on what was left out.

    Args:
        run: Beginning of a log, with all columns.
        times: Clock of each table.
        given: Meanings that a person gives.

    Raises:
        RecordingError: No command or no position can be proposed, or a given column is missing.
    """
    if given.joints is None:
        pairs, pairing, remarks = _pair_by_names(run, times)
    else:
        pairs, pairing, remarks = _pair_as_given(run, times, given.joints), "as given by log.joints", []  # fmt: skip
    comparison = _Comparison(run, times, pairs)
    return [
        _judge_joint(joint, *pair, comparison, pairing, given) for joint, pair in pairs.items()
    ], remarks


Pairs = dict[str, tuple[ColumnName, ColumnName]]
"""Columns of command and position by joint."""


def _pair_as_given(
    run: LogRun, times: Mapping[str, TimeGuess], given: Mapping[str, tuple[str, str]]
) -> Pairs:
    places = index_columns({name: [*table.columns] for name, table in run.tables.items()})
    pairs: Pairs = {}
    for joint, columns in given.items():
        for column in columns:
            if column not in places:
                raise RecordingError(
                    f"{run.where}: log.joints: '{joint}' has column '{column}', which is missing; {list_choices(column, places)}"
                )
            if places[column][0] not in times:
                raise RecordingError(
                    f"{run.where}: log.joints: column '{column}' of '{joint}' has no clock: no column of its table only increases"
                )
        command, position = (read_column_name(*places[column]) for column in columns)
        pairs[joint] = (command, position)
    return pairs


def _pair_by_names(run: LogRun, times: Mapping[str, TimeGuess]) -> tuple[Pairs, Pairing, list[str]]:
    """Return the pairs that the names propose, their reason, and remarks."""
    families = _list_families(run, times)
    commands = [f for f in families if f.role == "command" and f.quantity != "effort"]
    positions = [f for f in families if f.role != "command" and f.quantity in ("position", "unknown")]  # fmt: skip
    named = [f for f in positions if f.quantity == "position" or f.role == "measured"]
    positions = named or positions
    if not commands or not positions:
        lacking = "commands" if not commands else "positions"
        known = [join_names(t, c) for t, content in run.tables.items() for c in content.columns]
        raise RecordingError(
            f"{run.where}: no column is named like {lacking}; name those of each joint: "
            f'\'log.joints={{boom: ["<command>", "<position>"]}}\'; its columns are {", ".join(known)}'
        )

    def rank(pair: tuple[_Family, _Family]) -> tuple[int, int, int]:
        command, position = pair
        shared = len(command.members.keys() & position.members.keys())
        # Of two families of commands the one that says position or nothing is preferred.
        return shared, int(position.quantity == "position"), int(command.quantity != "velocity")

    command, position = max(((c, p) for c in commands for p in positions), key=rank)
    shared = [joint for joint in command.members if joint in position.members]
    remarks: list[str] = []
    pairing: Pairing = "same name"
    pairs: Pairs = {}
    if shared:
        pairs = {joint: (command.members[joint], position.members[joint]) for joint in shared}
    elif len(command.members) == len(position.members):
        if len(command.members) > 1:
            pairing = "same place in their order"
        for one, other in zip(command.members.values(), position.members.values(), strict=True):
            pairs[one.joint or other.joint] = (one, other)
        remarks.append("commands and positions have different names and are paired in their order")
    else:
        raise RecordingError(
            f"{run.where}: {len(command.members)} commands ({', '.join(c.column for c in command.members.values())}) and "
            f"{len(position.members)} positions ({', '.join(p.column for p in position.members.values())}) share no names; "
            'name those of each joint: \'log.joints={boom: ["<command>", "<position>"]}\''
        )
    rivals = [join_names(f.table, next(iter(f.members.values())).column) for f in commands if f is not command]  # fmt: skip
    if rivals:
        remarks.append(f"other commands that were not taken: {', '.join(rivals)}")
    return pairs, pairing, remarks


class _Comparison:
    """Commands and positions of a run on one grid."""

    def __init__(
        self,
        run: LogRun,
        times: Mapping[str, TimeGuess],
        pairs: Mapping[str, tuple[ColumnName, ColumnName]],
    ) -> None:
        run = leave_broken_rows_out(
            run, {name: time.column for name, time in times.items()}, {}, False
        )
        clocks = {name: read_times(run.tables[name], time) for name, time in times.items()}
        used = {name.table for pair in pairs.values() for name in pair}
        begin_s = max(clocks[table][0] for table in used)
        end_s = min(clocks[table][-1] for table in used)
        if end_s <= begin_s:
            spans = ", ".join(f"{t}: {clocks[t][0]:.12g} to {clocks[t][-1]:.12g} s" for t in used)
            first, last = min(used, key=lambda t: clocks[t][0]), max(used, key=lambda t: clocks[t][0])  # fmt: skip
            apart_s = float(clocks[first][0] - clocks[last][0])
            raise RecordingError(
                f"{run.where}: the clocks of its tables have no time in common ({spans}); if they began together, give "
                f"'log.clock_offset_s={{{last}: {apart_s:.12g}}}'"
            )
        slowest_s = max(float(np.median(np.diff(clocks[table]))) for table in used)
        num_rows = min(GRID_ROWS, max(int((end_s - begin_s) / slowest_s), 2))
        self.grid_s = np.linspace(begin_s, end_s, num_rows)
        self.period_s = float(self.grid_s[1] - self.grid_s[0])
        self.commands, self.positions = {}, {}
        for joint, (command, position) in pairs.items():
            for name, store in ((command, self.commands), (position, self.positions)):
                values = np.asarray(run.tables[name.table].columns[name.column], dtype=float)
                known = np.isfinite(values)
                store[joint] = np.zeros(num_rows)
                if known.any():
                    store[joint] = np.interp(self.grid_s, clocks[name.table][known], values[known])

    def correlate(self, command: str, position: str) -> tuple[float, float]:
        """Return the correlations, at the best lag, of position with target and of speed with command."""
        u, q = self.commands[command], self.positions[position]
        speed = np.gradient(q, self.period_s)
        return self._find_best(u, q)[0], self._find_best(u, speed)[0]

    def find_lag(self, joint: str, is_target: bool) -> float:
        """Return the lag of the joint's speed behind the command, or behind the target's speed, s."""
        u = self.commands[joint]
        speed = np.gradient(self.positions[joint], self.period_s)
        return self._find_best(np.gradient(u, self.period_s) if is_target else u, speed)[1]

    def fit_target(self, joint: str) -> tuple[float, float]:
        """Return slope and offset of the line from targets to positions, at the best lag."""
        u, q = self.commands[joint], self.positions[joint]
        rows = round(self._find_best(u, q)[1] / self.period_s)
        u, q = u[: len(u) - rows], q[rows:]
        if np.ptp(u) == 0:
            return 0.0, 0.0
        slope, offset = np.polyfit(u, q, 1)
        return float(slope), float(offset)

    def find_lead(self, joint: str) -> float:
        """Return the time by which the position leads its target, s; 0 where it does not, clearly."""
        u, q = self.commands[joint], self.positions[joint]
        (behind, _), (before, lead_s) = self._find_best(u, q), self._find_best(q, u)
        left, left_behind = 1.0 - abs(before), 1.0 - abs(behind)
        is_leading = abs(before) >= CLEAR_CORRELATION and left < CLEAR_SHARE * left_behind
        return lead_s if is_leading else 0.0

    def _find_best(self, a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
        """Return the largest correlation, in size, of `b` with `a` before it, and its lag."""
        if np.ptp(a) == 0 or np.ptp(b) == 0:
            return 0.0, 0.0
        most = min(int(LONGEST_LAG_S / self.period_s), len(a) // 4)
        best = (0.0, 0.0)
        for lag in range(0, most + 1, max(1, most // 60)):
            x, y = a[: len(a) - lag], b[lag:]
            if x.std() > 0 and y.std() > 0:
                r = float(np.corrcoef(x, y)[0, 1])
                best = max(best, (r, lag * self.period_s), key=lambda one: abs(one[0]))
        return best


def _judge_joint(
    joint: str,
    command: ColumnName,
    position: ColumnName,
    comparison: _Comparison,
    pairing: Pairing,
    given: GivenColumns,
) -> JointGuess:
    target_r, speed_r = comparison.correlate(joint, joint)
    u, q = comparison.commands[joint], comparison.positions[joint]
    slope, rest = comparison.fit_target(joint)
    says_target = command.quantity == "position"
    is_in_unit = TARGET_SLOPE[0] <= slope <= TARGET_SLOPE[1]
    is_target = (
        is_in_unit and target_r >= CLEAR_CORRELATION and (says_target or target_r > abs(speed_r))
    )
    is_target = is_target or (says_target and abs(speed_r) < CLEAR_CORRELATION)
    # A target in another unit, as of a policy whose actions are scaled and added to a pose.
    is_unnamed = command.quantity == "unknown" and abs(target_r) >= CLEAR_CORRELATION
    is_target = is_target or (
        is_unnamed and 1.0 - abs(target_r) < CLEAR_SHARE * (1.0 - abs(speed_r))
    )
    if given.command is not None:
        is_target = given.command == "position"
    r = target_r if is_target else speed_r
    # The motion that a force causes has no lag of its own: inertia delays it.
    lag_s = 0.0 if given.command == "torque" else comparison.find_lag(joint, is_target)
    name, full_command = name_joint(joint), join_names(command.table, command.column)
    full_position = join_names(position.table, position.column)
    rival, rival_r = "", 0.0
    for other in comparison.commands:
        if other != joint:
            found = comparison.correlate(other, joint)
            size = abs(found[0 if is_target else 1])
            rival, rival_r = max((rival, rival_r), (other, size), key=lambda one: one[1])
    signal = "position" if is_target else "speed"
    reason = f"correlation of {signal} with command {r:.2f}, {lag_s:.2f} s later"
    is_named = pairing != "same place in their order"
    sureness: Sureness = "likely" if is_named else "unsure"
    if pairing == "as given by log.joints":
        sureness = "sure"
    elif np.ptp(u) == 0:
        reason = "its command does not change in the beginning of the log"
    elif rival_r > abs(r) + MARGIN and abs(r) < CLEAR_CORRELATION:
        sureness = "unsure" if not is_named or rival_r > CLEAR_CORRELATION else "likely"
        reason += f"; with the command of {rival} {rival_r:.2f}"
    elif abs(r) >= CLEAR_CORRELATION:
        sureness = "sure" if is_named else "likely"
    elif max(abs(target_r), abs(speed_r)) < NO_CORRELATION:
        sureness = "unsure"
        reason += "; its position does not follow its command"
    lead_s = comparison.find_lead(joint) if is_target else 0.0
    if lead_s > 0.0:
        reason += (
            f"; but the position leads it by {lead_s:.2f} s: columns swapped, or clocks apart?"
        )
        if pairing != "as given by log.joints":
            sureness = "unsure"
    guesses = {
        "columns": Guess(
            f"{name}: columns",
            f"{full_command} → {full_position}",
            sureness,
            f"{pairing}; {reason}",
        )
    }
    guesses["kind"] = _judge_kind(name, is_target, command.quantity, target_r, speed_r)
    if given.command is not None:
        value = COMMAND_KINDS[given.command]
        guesses["kind"] = Guess(f"{name}: command", value, "sure", "as given by log.command")
    unit = given.position_unit
    if isinstance(unit, Mapping):
        unit = unit.get(name)
    unit, scale, guesses["unit"] = _judge_unit(name, position, q, unit)
    target_scale, target_offset = scale, 0.0
    if is_target and abs(target_r) >= CLEAR_CORRELATION:
        if command.unit is not None and UNITS[command.unit][0] == unit:
            target_scale = UNITS[command.unit][1]
        if not TARGET_SLOPE[0] <= slope * scale / target_scale <= TARGET_SLOPE[1]:
            target_scale, target_offset = slope * scale, rest * scale
            guesses["target"] = Guess(
                f"{name}: unit of targets",
                f"{slope:.3g} × target + {rest:.3g}",
                "unsure",
                "this line fits the positions best; fill in scale and offset, those of the code that commands",
            )
    is_torque = given.command == "torque"
    sign = 1 if is_target or is_torque or r >= 0 else -1
    return JointGuess(
        name,
        full_command,
        full_position,
        "torque" if is_torque else "target" if is_target else "speed",
        sign,
        lag_s,
        unit,
        scale,
        target_scale,
        target_offset,
        read_speed_unit(command.column),
        guesses,
    )


def _judge_kind(
    name: str, is_target: bool, quantity: Quantity, target_r: float, speed_r: float
) -> Guess:
    says_target = quantity == "position"
    value = COMMAND_KINDS["position" if is_target else "velocity"]
    reason = f"correlation with position {target_r:.2f}, with speed {speed_r:.2f}"
    clear = abs(target_r if is_target else speed_r) >= CLEAR_CORRELATION
    if is_target == says_target:
        return Guess(f"{name}: command", value, "sure" if clear else "likely", reason)
    says = "does not say it" if quantity == "unknown" else "says otherwise"
    return Guess(f"{name}: command", value, "likely" if clear else "unsure", f"{reason}; its name {says}")  # fmt: skip


def _judge_unit(
    name: str, position: ColumnName, q: np.ndarray, given: str | None
) -> tuple[str, float, Guess]:
    """Return unit of the recording, that unit for one of the log, and how sure it is."""
    subject = f"{name}: unit"
    if given is not None and (known := read_unit(given)) is not None:
        return *known, Guess(subject, given, "sure", "as given by log.position_unit")
    if position.unit is not None:
        return *UNITS[position.unit], Guess(subject, position.unit, "sure", "unit in its name")
    largest = float(np.abs(q).max())
    if largest <= 2 * math.pi:
        return (
            "rad",
            1.0,
            Guess(subject, "rad", "likely", f"largest value {largest:.3g}, at most a turn"),
        )
    reason = f"largest value {largest:.4g}: degrees, per cent, counts, or a length? Give log.position_unit"
    return "rad", math.pi / 180.0, Guess(subject, "deg", "unsure", reason, ("cm", "mm"))
