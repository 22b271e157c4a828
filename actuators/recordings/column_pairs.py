"""Columns of command and position that belong to one joint: by their names, their numbers, or as given."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from actuators.recordings.advice import advise, format_joints
from actuators.recordings.clocks import list_time_columns, unwrap
from actuators.recordings.column_names import (
    COUNT_WORDS,
    ENABLE_WORDS,
    ColumnName,
    name_joint,
    read_column_name,
    split_unit,
    split_words,
)
from actuators.recordings.correlations import CLEAR_CORRELATION, Correlations
from actuators.recordings.guess import CommandKind, Evidence, Guess
from actuators.recordings.log_signals import Places, RunSignals, Signal
from actuators.recordings.log_tables import LogRun, index_columns, join_names
from actuators.recordings.signal_checks import Wrap
from actuators.recordings.time_guess import TimeGuess
from brokk_rl.errors import RecordingError, list_choices

MARGIN = 0.1
"""A partner that correlates better by so much contradicts a pair."""


@dataclass(frozen=True)
class ColumnEntry:
    """A row of the table: a column with its name read, and its signal.

    Attributes:
        name: Its name as words.
        signal: Its numbers on their clock.
        wrap: Wraps that were taken out of them.
        is_changing: False for a constant column.
    """

    name: ColumnName
    signal: Signal
    wrap: Wrap | None
    is_changing: bool

    @property
    def full_name(self) -> str:
        """Name with its table."""
        return join_names(self.name.table, self.name.column)

    @property
    def key(self) -> str:
        """Name of its joint without signs that people set differently."""
        return self.name.joint.replace("_", "")

    @property
    def values(self) -> np.ndarray:
        """Its numbers, `(T,)`."""
        return self.signal.values

    @property
    def modulus(self) -> float | None:
        """Value at which it begins again, `None` for none."""
        return self.wrap.modulus if self.wrap else None


def remove_wrap(entry: ColumnEntry, wrap: Wrap) -> ColumnEntry:
    """Return a column without its wraps."""
    signal = replace(entry.signal, values=unwrap(entry.signal.values, wrap.modulus))
    return replace(entry, signal=signal, wrap=wrap)


def read_words(column: str) -> list[str]:
    """Return the words of a column's name without its unit."""
    return split_words(split_unit(column)[0])


@dataclass
class JointGuess:
    """The columns of a joint, and what they are.

    Attributes:
        name: Name of the joint.
        u: Column of its command.
        q: Column of its position.
        evidence: Why the two belong together.
        is_given: A person gave them.
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
    is_given: bool = False
    kind: CommandKind = "velocity"
    sign: int = 1
    lag_s: float = 0.0
    unit: str = "rad"
    scale: float = 1.0
    target_scale: float = 1.0
    target_offset: float = 0.0
    guesses: dict[str, Guess] = field(default_factory=dict)

    @property
    def command(self) -> str:
        """Full name of the column of its command."""
        return self.u.full_name

    @property
    def position(self) -> str:
        """Full name of the column of its position."""
        return self.q.full_name

    @property
    def speed_scale(self) -> float | None:
        """Speed, in its unit per s, for one of its commands, where the name has a unit of speed."""
        return self.u.name.speed_unit

    @property
    def wraps(self) -> float | None:
        """Value at which the position begins again."""
        return self.q.modulus

    @property
    def target_wraps(self) -> float | None:
        """The same of a target."""
        return self.u.modulus if self.kind == "position" else None


class PairFinder:
    """Finds the columns of the joints of a run.

    Args:
        run: Beginning of a log, with all columns.
        places: Table and column of each full name that has a clock.
        times: Clock of each table.
        signals: Signals of the run.

    Attributes:
        remarks: What was left out.
    """

    def __init__(
        self, run: LogRun, places: Places, times: Mapping[str, TimeGuess], signals: RunSignals
    ) -> None:
        self._run, self._places, self._times, self._signals = run, places, times, signals
        self.remarks: list[str] = []

    def take(self, given: Mapping[str, tuple[str, str]]) -> list[JointGuess]:
        """Return the joints whose columns a person gives; refuse one that is missing."""
        known = index_columns({name: [*table.columns] for name, table in self._run.tables.items()})
        joints = []
        for joint, (command, position) in given.items():
            u, q = (self._read_given(joint, column, known) for column in (command, position))
            joints.append(JointGuess(joint, u, q, [("as given by log.joints", 5.0)], True))
        return joints

    def _read_given(self, joint: str, column: str, known: Places) -> ColumnEntry:
        """Return a column that a person gives."""
        place = f"{self._run.where}: log.joints"
        if column not in known:
            raise RecordingError(
                f"{place}: '{joint}' has column '{column}', which is missing; {list_choices(column, known)}"
            )
        entry = self._read_entry(*known[column]) if column in self._places else None
        if entry is None:
            raise RecordingError(
                f"{place}: column '{column}' of '{joint}' has no clock or no numbers: no column of its table only increases"
            )
        return entry

    def find(self) -> list[JointGuess]:
        """Return the joints that names and numbers propose; refuse columns that say nothing."""
        entries = self._read_entries()
        commands, positions = _choose_roles(entries)
        twice = next((one for one in (*commands, *positions) if "#" in one.name.column), None)
        if twice is not None:
            name = twice.name.column.partition("#")[0]
            listed = f"several columns are named '{name}'; they are read as {name}#1, {name}#2, …: rename them, or "
            self._refuse(listed, list(zip(commands, positions, strict=False)), "")
        if not commands or not positions:
            changing = [one for one in entries if one.is_changing]
            pairs = self._pair_by_numbers(changing, changing)
            lacking = f"no column is named like {'positions' if commands else 'commands'}; "
            by = " (these follow each other by their numbers)" if pairs else ""
            self._refuse(lacking, pairs, f"{by}; its columns are {', '.join(self._places)}")
        if _has_several_sources(commands) and _has_several_sources(positions):
            commands, positions = _name_sources(commands), _name_sources(positions)
        chosen, free = _choose_by_key(commands, True), _choose_by_key(positions, False)
        joints = []
        for key in [key for key in chosen if key in free]:
            u, q = chosen.pop(key), free.pop(key)
            joints.append(JointGuess(name_joint(q.name.joint), u, q, [("same name", 3.0)]))
        left = [one for one in chosen.values() if one.is_changing or not joints]
        lone = [one for one in free.values() if one.is_changing or not joints]
        if left and lone:
            joints += self._pair_rest(left, lone, is_all=not joints)
        taken = {one.full_name for joint in joints for one in (joint.u, joint.q)}
        left = [one for one in left if one.full_name not in taken]
        lone = [one for one in lone if one.full_name not in taken]
        rivals = [one.full_name for one in commands if one.is_changing]
        rivals = [name for name in rivals if name not in taken]
        if rivals:
            self.remarks.append(f"other commands that were not taken: {', '.join(rivals)}")
        if moving := [one.full_name for one in lone if one.is_changing]:
            self.remarks.append(f"positions that move without a command: {', '.join(moving)}")
        if left and lone:
            missed = min(len(left), len(lone))
            listed = ", ".join(one.full_name for one in (*left, *lone))
            text = f"{missed} commands and positions that move have no partner: {listed}"
            for joint in joints:
                joint.evidence.append((text, -4.0 if 2 * missed >= len(joints) else -1.0))
        return joints

    def _read_entries(self) -> list[ColumnEntry]:
        entries = []
        for table, column in self._places.values():
            clocks = list_time_columns(self._times[table].time)
            is_time = any(column == one or column in re.findall(r"\w+", one) for one in clocks)
            is_time |= column.endswith("stamp") or column == self._run.tables[table].clock
            is_number = not is_time and (COUNT_WORDS | ENABLE_WORDS).isdisjoint(read_words(column))
            entry = self._read_entry(table, column) if is_number else None
            if entry is not None:
                entries.append(entry)
        return entries

    def _read_entry(self, table: str, column: str) -> ColumnEntry | None:
        unit = self._run.tables[table].units.get(column)
        try:
            signal = self._signals.read(join_names(table, column))
        except RecordingError:
            return None  # it has no numbers
        is_changing = bool(np.ptp(signal.values) > 0)
        return ColumnEntry(read_column_name(table, column, unit), signal, None, is_changing)

    def _pair_rest(
        self, commands: list[ColumnEntry], positions: list[ColumnEntry], is_all: bool
    ) -> list[JointGuess]:
        """Return joints of columns whose names share nothing: by their numbers, else by their order."""
        pairs = self._pair_by_numbers(commands, positions)
        evidence = ("paired by their numbers", 0.0)
        if len(commands) == len(positions) == 1:
            pairs = [(commands[0], positions[0])]
            evidence = ("the only command and the only position", 2.0)
        elif len(pairs) == min(len(commands), len(positions)):
            if is_all:
                self.remarks.append(
                    "commands and positions have different names and are paired by their numbers"
                )
        elif not is_all:
            return []
        elif len(commands) == len(positions):
            pairs = list(zip(commands, positions, strict=True))
            evidence = ("same place in their order", -0.5)
            self.remarks.append(
                "commands and positions have different names and are paired in their order"
            )
        else:
            listed = (
                f"{len(commands)} commands ({', '.join(c.full_name for c in commands)}) and "
                f"{len(positions)} positions ({', '.join(p.full_name for p in positions)}) share no names; "
            )
            self._refuse(listed, pairs, "")
        by_order = evidence[1] < 0
        found = []
        for u, q in pairs:
            first, second = (u, q) if by_order else (q, u)
            name = name_joint(first.name.joint or second.name.joint)
            found.append(JointGuess(name, u, q, [evidence]))
        return found

    def _pair_by_numbers(
        self, commands: Sequence[ColumnEntry], positions: Sequence[ColumnEntry]
    ) -> list[tuple[ColumnEntry, ColumnEntry]]:
        """Return the columns that clearly follow others, the clearest first, each with the one that it follows.

        Where both lists are the same, the cause of two is the one whose past tells more of the other.
        """
        if min(len(commands), len(positions)) < 1:
            return []
        is_same = commands is positions
        try:
            found = Correlations(
                self._run, [one.signal for one in commands], [one.signal for one in positions]
            )
        except RecordingError:
            return []
        size = np.maximum(np.abs(found.target), np.abs(found.speed))
        if is_same:
            np.fill_diagonal(size, 0.0)
            size = np.where(size >= size.T, size, 0.0)
        pairs, causes = [], set[int]()
        effects = causes if is_same else set[int]()  # of the same list each takes part once
        for flat in np.argsort(-size, axis=None):
            row, column = (int(at) for at in np.unravel_index(flat, size.shape))
            rest = np.concatenate([np.delete(size[row], column), np.delete(size[:, column], row)])
            rival = 0.0 if is_same else float(rest.max(initial=0.0))
            is_clear = size[row, column] >= max(CLEAR_CORRELATION, rival + MARGIN)
            if is_clear and row not in causes and column not in effects:
                causes.add(row)
                effects.add(column)
                pairs.append((commands[row], positions[column]))
        return pairs

    def _refuse(
        self, text: str, pairs: Sequence[tuple[ColumnEntry, ColumnEntry]], end: str
    ) -> None:
        """Raise a `RecordingError` with the columns of each joint as they are given by hand."""
        proposed = {}
        for number, (u, q) in enumerate(pairs):
            proposed[f"joint_{number + 1}"] = (u.full_name, q.full_name)
        joints = format_joints(proposed) or 'boom: ["<command>", "<position>"]'
        raise RecordingError(f"{self._run.where}: {text}{advise('joints', joints=joints)}{end}")


def _choose_roles(entries: list[ColumnEntry]) -> tuple[list[ColumnEntry], list[ColumnEntry]]:
    """Return the columns that may be commands, and those that may be positions."""
    commands = [one for one in entries if one.name.role == "command"]
    commands = [one for one in commands if one.name.quantity != "effort"] or commands
    known = ("position", "unknown")
    positions = [one for one in entries if one.name.role != "command"]
    positions = [one for one in positions if one.name.quantity in known]
    named = []
    for one in positions:
        if one.name.quantity == "position" or one.name.role == "measured":
            named.append(one)
    return commands, named or positions


def _choose_by_key(entries: Sequence[ColumnEntry], are_commands: bool) -> dict[str, ColumnEntry]:
    """Return one column for each joint: one that changes, then one that says position."""

    def rank(entry: ColumnEntry) -> tuple[bool, bool, bool]:
        name = entry.name
        is_second = name.quantity != "velocity" if are_commands else name.role == "measured"
        return entry.is_changing, name.quantity == "position", is_second

    chosen: dict[str, ColumnEntry] = {}
    for entry in entries:
        if entry.key not in chosen or rank(entry) > rank(chosen[entry.key]):
            chosen[entry.key] = entry
    return chosen


def _has_several_sources(entries: Sequence[ColumnEntry]) -> bool:
    """Return whether tables of different names have a joint of one name: two arms, each on its topics."""
    sources = {(one.key, one.name.source) for one in entries}
    return len(sources) > len({one.key for one in entries})


def _name_sources(entries: Sequence[ColumnEntry]) -> list[ColumnEntry]:
    """Return the columns with the words of their tables before those of their joints."""
    found = []
    for one in entries:
        joint = f"{one.name.source}_{one.name.joint}".strip("_")
        found.append(replace(one, name=replace(one.name, joint=joint)))
    return found
