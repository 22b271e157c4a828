"""Columns of a log as hypotheses, which names propose and numbers weigh.

Each pair of a command and a position is a hypothesis. Its names give evidence (the same joint), its numbers as
well (how the motion follows the command).

Axes: `C` commands, `P` positions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from actuators.recordings.clocks import guess_times, list_time_columns
from actuators.recordings.guess import GivenColumns, advise
from actuators.recordings.joint_evidence import (
    CLEAR_CORRELATION,
    MARGIN,
    ColumnEntry,
    Correlations,
    Entries,
    JointGuess,
    weigh_correlation,
)
from actuators.recordings.log_signals import RunSignals
from actuators.recordings.log_tables import LogRun
from actuators.recordings.name_evidence import WORDS, name_joint, read_column_name, read_words
from actuators.recordings.signal_checks import Wrap, find_wrap
from brokk_rl.errors import RecordingError

SAME_NAME = 3.0
"""Log odds of a pair with one name of a joint."""


class ColumnTable:
    """Meanings of the columns of a run.

    Args:
        run: Beginning of a log, with all columns.
        given: Meanings that a person gives.

    Attributes:
        times: Clock of each table.
        signals: Signals of the run.
        remarks: What was left out or seems odd.
        joints: The joints.

    Raises:
        RecordingError: No time, no command or no position can be proposed, or a given column is missing.
    """

    def __init__(self, run: LogRun, given: GivenColumns) -> None:
        self._given = given
        self.times = times = guess_times(run, given)
        self._run = run = replace(run, tables={name: run.tables[name] for name in times})
        clocks = {name: time.choice for name, time in times.items()}
        self.signals = RunSignals(run, clocks, True, 1.0, quiet=True)
        self.remarks: list[str] = []
        self.joints = self._find() if given.joints is None else self._take(given.joints)
        u, q = [one.u for one in self.joints], [one.q for one in self.joints]
        matrix = Correlations(run, u, q)
        for at, joint in enumerate(self.joints):
            self._check_drive(joint)
            joint.judge(matrix, at, given)

    def _take(self, given: Mapping[str, tuple[str, str]]) -> list[JointGuess]:
        """Return the joints whose columns a person gives; refuse one that is missing."""
        joints = []
        for name, columns in given.items():
            u, q = (self._read_entry(column) for column in columns)
            (u,), (q,) = self._unwrap([u], [q], [name])
            evidence = [("as given by log.joints", 5.0)]
            joints.append(JointGuess(name, u, q, evidence, self.signals))
        return joints

    def _find(self) -> list[JointGuess]:
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
        commands, positions = _tell_sources(commands, positions)
        names = [name_joint(one.name.joint) for one in positions]
        commands, positions = self._unwrap(commands, positions, names)
        joints = self._assign(commands, positions)
        self._weigh_lone(joints, commands, positions)
        return joints

    def _weigh_lone(self, joints: list[JointGuess], commands: Entries, positions: Entries) -> None:
        """Remark the columns that move and belong to no joint; several of both speak against the others."""
        used = [*(joint.u for joint in joints), *(joint.q for joint in joints)]
        keys, taken = {one.name.key for one in used}, {one.text for one in used}
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

    def _read_entries(self) -> list[ColumnEntry]:
        """Return the columns that are neither clock nor count nor switch."""
        entries = []
        for full_name, (table, column) in self._run.places.items():
            clocks = list_time_columns(self.times[table].choice)
            is_time = any(column == one or column in re.findall(r"\w+", one) for one in clocks)
            is_time |= column.endswith("stamp") or column == self._run.tables[table].clock
            if not is_time and (WORDS["count"] | WORDS["enable"]).isdisjoint(read_words(column)):
                try:
                    entries.append(self._read_entry(full_name))
                except RecordingError:
                    continue  # it has no numbers
        return entries

    def _read_entry(self, full_name: str) -> ColumnEntry:
        signal = self.signals.read(full_name)
        _, column = self._run.places.get(full_name, (signal.table, full_name))
        unit = self._run.tables[signal.table].units.get(column)
        return ColumnEntry(**vars(signal), name=read_column_name(signal.table, column, unit))

    def _unwrap(
        self, commands: Entries, positions: Entries, names: Sequence[str]
    ) -> tuple[list[ColumnEntry], list[ColumnEntry]]:
        """Return positions without wraps, and targets that have the same ones."""
        plain, moduli = [], set[float]()
        for name, entry in zip(names, positions, strict=True):
            given, wrap = self._given.find("wraps", name), find_wrap(entry.values)
            if given is not None and (wrap is None or wrap.modulus != given):
                wrap = Wrap(float(given), np.empty(0, dtype=int)) if given else None
            moduli |= {wrap.modulus} if wrap else set()
            plain.append(entry.remove_wrap(wrap))
        targets = []
        for entry in commands:
            wrap = find_wrap(entry.values) if moduli else None
            targets.append(entry.remove_wrap(wrap if wrap and wrap.modulus in moduli else None))
        return targets, plain

    def _assign(self, commands: Entries, positions: Entries) -> list[JointGuess]:
        """Return a pair for each name that both sides have, and the others that their numbers pair clearly."""
        size = Correlations(self._run, commands, positions).size
        score = np.vectorize(weigh_correlation)(size) + size
        score[[not one.is_changing for one in commands]] = -1.0  # another log may move it
        score += _prefer(commands, positions)
        u, q = (np.array([one.name.key for one in several]) for several in (commands, positions))
        same = np.argwhere(u[:, None] == q[None]).tolist()
        chosen: dict[str, tuple[int, int]] = {}
        for row, column in sorted(same, key=lambda pair: -score[*pair]):
            chosen.setdefault(u[row], (row, column))
        found = [(*pair, "same name", SAME_NAME) for pair in chosen.values()]
        rows, columns = _list_rest(commands, chosen), _list_rest(positions, chosen)
        rest = np.zeros_like(size)
        rest[np.ix_(rows, columns)] = size[np.ix_(rows, columns)]
        best = [(row, int(np.argmax(rest[row]))) for row in rows]
        clear = [pair for pair in best if _is_clear(rest, *pair)]
        if len(rows) == len(columns) == 1:
            found.append((rows[0], columns[0], "the only command and the only position", 2.0))
        elif len(clear) == min(len(rows), len(columns)):
            found += [(*pair, "paired by their numbers", 0.0) for pair in clear]
        elif not chosen:
            text = "commands and positions share no names, and not all follow each other clearly; "
            self._refuse(text, list(zip(commands, positions, strict=False)))
        joints = []
        for row, column, text, weight in sorted(found):
            command, position = commands[row], positions[column]
            name = name_joint(position.name.joint or command.name.joint)
            joints.append(JointGuess(name, command, position, [(text, weight)], self.signals))
        return joints

    def _list_followers(self, entries: Entries) -> list[tuple[ColumnEntry, ColumnEntry]]:
        """Return columns that clearly follow others, whose past tells more of them than theirs of those."""
        moving = [one for one in entries if one.is_changing]
        if not moving:
            return []
        size = Correlations(self._run, moving, moving).size
        np.fill_diagonal(size, 0.0)
        size = np.where((size > size.T) | np.triu(size == size.T), size, 0.0)
        pairs = [(u, moving[np.argmax(row)]) for u, row in zip(moving, size, strict=True)]
        return [
            pair for pair, row in zip(pairs, size, strict=True) if max(row) >= CLEAR_CORRELATION
        ]

    def _refuse(self, text: str, pairs: Sequence[Entries]) -> None:
        """Raise a `RecordingError` with the columns of each joint as they are given by hand."""
        proposed = [f'joint_{at}: ["{u.text}", "{q.text}"]' for at, (u, q) in enumerate(pairs, 1)]
        joints = ", ".join(proposed) or 'boom: ["<command>", "<position>"]'
        columns = ", ".join(self._run.places)
        self._run.refuse(f"{text}{advise('joints', joints=joints)}; its columns are {columns}")

    def _check_drive(self, joint: JointGuess) -> None:
        """Add the evidence of a drive that is off by a column that says so, and remark it."""
        for full_name, (_, column) in self._run.places.items():
            words = read_words(column)
            known = WORDS["enable"] | {"torque", "drive", "motor"}
            left = "".join(one for one in words if one not in known)
            if WORDS["enable"].isdisjoint(words) or left not in ("", joint.q.name.key):
                continue
            signal = self.signals.read(full_name)
            off = signal.values == 0.0
            if off.any() and set(np.unique(signal.values)) <= {0.0, 1.0}:
                t_s = signal.t_s[off] - signal.t_s[0]
                text = f"its drive is off in {off.mean():.0%} of the rows"
                joint.evidence.append((text, -0.5))
                times = f"first at {t_s[0]:.2f} s, last at {t_s[-1]:.2f} s"
                self.remarks.append(f"{joint.name}: {text}, {times} ({full_name} = 0)")


def _choose_roles(entries: Entries) -> tuple[list[ColumnEntry], list[ColumnEntry]]:
    """Return the columns that may be commands, and those that may be positions."""
    commands = [one for one in entries if one.name.role == "command"]
    commands = [one for one in commands if one.name.quantity != "torque"] or commands
    positions = []
    for one in entries:
        if one.name.role != "command" and one.name.quantity in ("position", "unknown"):
            positions.append(one)
    named = [one for one in positions if (one.name.quantity, one.name.role) != ("unknown", None)]
    return commands, named or positions


def _prefer(commands: Entries, positions: Entries) -> np.ndarray:
    """Return log odds of pairs among others of their joint, `(C, P)`: targets and measured positions come first."""
    weights = {"position": 0.6, "velocity": 0.0}
    of_command = [weights.get(one.name.quantity, 0.2) for one in commands]
    of_position = []
    for one in positions:
        is_position, is_measured = one.name.quantity == "position", one.name.role == "measured"
        of_position.append(0.4 * is_position + 0.2 * is_measured)
    return np.add.outer(of_command, of_position)


def _list_rest(entries: Entries, chosen: Mapping[str, tuple[int, int]]) -> list[int]:
    """Return the places of the columns whose joint has no pair yet; constant ones only where no joint has."""
    found = []
    for at, one in enumerate(entries):
        if one.name.key not in chosen and (one.is_changing or not chosen):
            found.append(at)
    return found


def _is_clear(size: np.ndarray, row: int, column: int) -> bool:
    """Return whether two columns follow each other, and no other follows one of them as well."""
    rivals = [*np.delete(size[row], column), *np.delete(size[:, column], row)]
    return size[row, column] >= max(CLEAR_CORRELATION, max(rivals, default=0.0) + MARGIN)


def _tell_sources(*sides: Entries) -> list[list[ColumnEntry]]:
    """Return commands and positions, with the words of their tables where both have a joint of one name twice.

    Two arms, each on its topics, have joints of the same names.
    """
    found = []
    for entries in sides:
        sources = {(one.name.key, one.name.source) for one in entries}
        if len(sources) == len({one.name.key for one in entries}):
            return [list(entries) for entries in sides]
        names = [f"{one.name.source}_{one.name.joint}".strip("_") for one in entries]
        pairs = zip(entries, names, strict=True)
        found.append([replace(one, name=replace(one.name, joint=name)) for one, name in pairs])
    return found
