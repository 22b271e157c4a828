"""Columns of command and position that belong to one joint: by their names, their numbers, or as given."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from actuators.recordings.advice import advise, format_joints
from actuators.recordings.clocks import unwrap
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
from actuators.recordings.guess import Evidence
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

    def name_source(self) -> ColumnEntry:
        """Return it with the words of its table before those of its joint."""
        joint = f"{self.name.source}_{self.name.joint}".strip("_")
        return replace(self, name=replace(self.name, joint=joint))

    @property
    def values(self) -> np.ndarray:
        """Its numbers, `(T,)`."""
        return self.signal.values


def remove_wrap(entry: ColumnEntry, wrap: Wrap) -> ColumnEntry:
    """Return a column without its wraps."""
    signal = replace(entry.signal, values=unwrap(entry.signal.values, wrap.modulus))
    return replace(entry, signal=signal, wrap=wrap)


@dataclass
class ColumnPair:
    """Command and position of a joint.

    Attributes:
        evidence: Why the two belong together.
        is_given: A person gave them.
    """

    command: ColumnEntry
    position: ColumnEntry
    evidence: Evidence
    is_given: bool = False


class PairFinder:
    """Finds the columns of the joints of a run.

    Args:
        run: Beginning of a log, with all columns.
        places: Table and column of each full name that has a clock.
        times: Clock of each table.
        signals: Signals of the run.
        remarks: Takes remarks on what was left out.
    """

    def __init__(
        self,
        run: LogRun,
        places: Places,
        times: Mapping[str, TimeGuess],
        signals: RunSignals,
        remarks: list[str],
    ) -> None:
        self._run, self._places, self._times = run, places, times
        self._signals, self._remarks = signals, remarks

    def find(self, given: Mapping[str, tuple[str, str]] | None) -> dict[str, ColumnPair]:
        """Return the pair of each joint.

        Raises:
            RecordingError: A given column is missing, or names and numbers say nothing.
        """
        if given is not None:
            return self._pair_as_given(given)
        return self._pair_by_names(self._read_entries())

    def _read_entries(self) -> list[ColumnEntry]:
        entries = []
        for table, column in self._places.values():
            time = self._times[table].time
            used = getattr(time, "column", ""), getattr(getattr(time, "anchor", None), "column", "")
            is_time = any(column == text or column in re.findall(r"\w+", text) for text in used)
            words = split_words(split_unit(column)[0])
            is_count = any(word in COUNT_WORDS for word in words)
            is_switch = any(word in ENABLE_WORDS for word in words)
            if (
                is_time
                or is_count
                or is_switch
                or column.endswith("stamp")
                or column == self._run.tables[table].clock
            ):
                continue
            entry = self._read_entry(table, column)
            if entry is not None:
                entries.append(entry)
        return entries

    def _read_entry(self, table: str, column: str) -> ColumnEntry | None:
        unit = self._run.tables[table].units.get(column)
        name = read_column_name(table, column, unit)
        try:
            signal = self._signals.read(join_names(table, column))
        except RecordingError:
            return None  # it has no numbers
        return ColumnEntry(name, signal, None, bool(np.ptp(signal.values) > 0))

    def _pair_as_given(self, given: Mapping[str, tuple[str, str]]) -> dict[str, ColumnPair]:
        pairs = {}
        for joint, columns in given.items():
            entries = []
            for column in columns:
                known = index_columns(
                    {name: [*table.columns] for name, table in self._run.tables.items()}
                )
                if column not in known:
                    raise RecordingError(
                        f"{self._run.where}: log.joints: '{joint}' has column '{column}', which is missing; "
                        f"{list_choices(column, known)}"
                    )
                entry = self._read_entry(*known[column]) if column in self._places else None
                if entry is None:
                    raise RecordingError(
                        f"{self._run.where}: log.joints: column '{column}' of '{joint}' has no clock or no numbers: no column of "
                        "its table only increases"
                    )
                entries.append(entry)
            command, position = entries
            evidence = Evidence("as given by log.joints", 5.0)
            pairs[joint] = ColumnPair(command, position, evidence, True)
        return pairs

    def _pair_by_names(self, entries: list[ColumnEntry]) -> dict[str, ColumnPair]:
        """Return the pairs that names and numbers propose."""
        commands = [
            one for one in entries if one.name.role == "command" and one.name.quantity != "effort"
        ]
        commands = commands or [one for one in entries if one.name.role == "command"]
        positions = [
            one
            for one in entries
            if one.name.role != "command" and one.name.quantity in ("position", "unknown")
        ]
        named = [
            one
            for one in positions
            if one.name.quantity == "position" or one.name.role == "measured"
        ]
        positions = named or positions
        twice = next((one for one in (*commands, *positions) if "#" in one.name.column), None)
        if twice is not None:
            self._refuse_twice(twice.name.column.partition("#")[0], commands, positions)
        if not commands or not positions:
            self._refuse_names("commands" if not commands else "positions", entries)
        if _has_several_sources(commands) and _has_several_sources(positions):
            commands = [one.name_source() for one in commands]
            positions = [one.name_source() for one in positions]
        commands, rivals = self._choose_by_key(commands, True)
        positions, _ = self._choose_by_key(positions, False)
        pairs: dict[str, ColumnPair] = {}
        for key in [key for key in commands if key in positions]:
            pair = ColumnPair(commands.pop(key), positions.pop(key), Evidence("same name", 3.0))
            pairs[name_joint(pair.position.name.joint)] = pair
        left = [one for one in commands.values() if one.is_changing or not pairs]
        free = [one for one in positions.values() if one.is_changing or not pairs]
        if left and free:
            pairs |= self._pair_by_numbers(left, free, is_all=not pairs)
            taken = {
                one.full_name for pair in pairs.values() for one in (pair.command, pair.position)
            }
            left = [one for one in left if one.full_name not in taken]
            free = [one for one in free if one.full_name not in taken]
        rivals = [one.full_name for one in (*left, *rivals)]
        if rivals:
            self._remarks.append(f"other commands that were not taken: {', '.join(rivals)}")
        if left and free:
            missed = min(len(left), len(free))
            listed = ", ".join(one.full_name for one in (*left, *free))
            text = f"{missed} commands and positions that move have no partner: {listed}"
            for pair in pairs.values():
                weight = pair.evidence.weight - (4.0 if 2 * missed >= len(pairs) else 1.0)
                pair.evidence = Evidence(f"{pair.evidence.text}; {text}", weight)
        return pairs

    def _choose_by_key(
        self, entries: list[ColumnEntry], are_commands: bool
    ) -> tuple[dict[str, ColumnEntry], list[ColumnEntry]]:
        """Return one column for each joint, and commands that were not taken."""

        def rank(entry: ColumnEntry) -> tuple[bool, bool, bool]:
            name = entry.name
            # a column that says position is preferred, then one that says nothing
            is_second = name.quantity != "velocity" if are_commands else name.role == "measured"
            return entry.is_changing, name.quantity == "position", is_second

        chosen: dict[str, ColumnEntry] = {}
        for entry in entries:
            key = entry.key
            if key not in chosen or rank(entry) > rank(chosen[key]):
                chosen[key] = entry
        names = {one.full_name for one in chosen.values()}
        others = [one for one in entries if one.full_name not in names and one.is_changing]
        return chosen, others

    def _pair_by_numbers(
        self, commands: list[ColumnEntry], positions: list[ColumnEntry], is_all: bool
    ) -> dict[str, ColumnPair]:
        """Return pairs of columns whose names share nothing: by their numbers, else by their order."""
        found = Correlations(
            self._run, [one.signal for one in commands], [one.signal for one in positions]
        )
        size = np.maximum(np.abs(found.target), np.abs(found.speed))
        chosen = dict(zip(*(axis.tolist() for axis in linear_sum_assignment(-size)), strict=True))
        is_clear, pairs = True, {}
        for one, other in chosen.items():
            rest = np.concatenate([np.delete(size[one], other), np.delete(size[:, other], one)])
            rival = float(rest.max()) if rest.size else 0.0
            is_clear &= bool(
                size[one, other] >= CLEAR_CORRELATION and rival < size[one, other] - MARGIN
            )
            text = f"paired by their numbers, the next best correlation is {rival:.2f}"
            pair = ColumnPair(commands[one], positions[other], Evidence(text, 0.0))
            if len(commands) == 1 and len(positions) == 1:
                pair.evidence = Evidence("the only command and the only position", 2.0)
            pairs[name_joint(pair.position.name.joint or pair.command.name.joint)] = pair
        if is_clear:
            if is_all and len(chosen) > 1:
                self._remarks.append(
                    "commands and positions have different names and are paired by their numbers"
                )
            return pairs
        if len(commands) == len(positions) and is_all:
            self._remarks.append(
                "commands and positions have different names and are paired in their order"
            )
            pairs = {}
            for one, other in zip(commands, positions, strict=True):
                weight = 2.0 if len(commands) == 1 else -0.5
                name = name_joint(one.name.joint or other.name.joint)
                pairs[name] = ColumnPair(one, other, Evidence("same place in their order", weight))
            return pairs
        if not is_all:
            return {}
        proposed = {
            name: (one.command.full_name, one.position.full_name) for name, one in pairs.items()
        }
        raise RecordingError(
            f"{self._run.where}: {len(commands)} commands ({', '.join(c.full_name for c in commands)}) and "
            f"{len(positions)} positions ({', '.join(p.full_name for p in positions)}) share no names; "
            f"{advise('joints', joints=format_joints(proposed))}"
        )

    def _refuse_twice(
        self, name: str, commands: list[ColumnEntry], positions: list[ColumnEntry]
    ) -> None:
        pairs = {}
        for number, (one, other) in enumerate(zip(commands, positions, strict=False)):
            pairs[f"joint_{number + 1}"] = (one.full_name, other.full_name)
        advised = format_joints(pairs) or 'boom: ["<command>", "<position>"]'
        raise RecordingError(
            f"{self._run.where}: several columns are named '{name}'; they are read as {name}#1, {name}#2, …: rename them, or "
            f"{advise('joints', joints=advised)}"
        )

    def _refuse_names(self, lacking: str, entries: list[ColumnEntry]) -> None:
        """Refuse columns whose names say nothing, with the pairs that their numbers propose."""
        pairs = _propose_pairs(self._run, [one for one in entries if one.is_changing])
        advised = format_joints(pairs) or 'boom: ["<command>", "<position>"]'
        by = " (these follow each other by their numbers)" if pairs else ""
        raise RecordingError(
            f"{self._run.where}: no column is named like {lacking}; {advise('joints', joints=advised)}{by}; "
            f"its columns are {', '.join(self._places)}"
        )


def _has_several_sources(entries: Sequence[ColumnEntry]) -> bool:
    """Return whether tables of different names have a joint of one name: two arms, each on its topics."""
    sources: dict[str, set[str]] = {}
    for one in entries:
        sources.setdefault(one.key, set()).add(one.name.source)
    return any(len(several) > 1 for several in sources.values())


def _propose_pairs(run: LogRun, entries: Sequence[ColumnEntry]) -> dict[str, tuple[str, str]]:
    """Return columns that follow others, by their numbers only: each after the one that it follows best."""
    if len(entries) < 2:
        return {}
    try:
        signals = [one.signal for one in entries]
        found = Correlations(run, signals, signals)
    except RecordingError:
        return {}
    forward = np.maximum(np.abs(found.target), np.abs(found.speed))
    np.fill_diagonal(forward, 0.0)
    # of two columns that follow each other the cause is the one whose past tells more of the other
    is_cause = forward >= forward.T
    size = np.where(is_cause, forward, 0.0)
    pairs, taken = {}, set()
    for flat in np.argsort(-size, axis=None):
        one, other = (int(i) for i in np.unravel_index(flat, size.shape))
        if size[one, other] < CLEAR_CORRELATION:
            break
        if one not in taken and other not in taken:
            taken |= {one, other}
            pairs[f"joint_{len(pairs) + 1}"] = (entries[one].full_name, entries[other].full_name)
    return pairs
