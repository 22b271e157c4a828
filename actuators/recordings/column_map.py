"""Logs of other machines: the meaning of their columns, and conversion to recordings.

`log_files` says which logs can be read. A log is cut at its gaps and each piece is brought to the
machine's rate: positions linearly between samples, commands as the value in force (zero-order
hold). Signals on clocks of their own keep them; a piece ends where any of them has a gap. Pieces of
one run share the metadata `run`, so that no split into fit and test goes through a run.

A column is named as in the log, with its table where the log has several:
`/joint_states:position[elbow]`. In its place may stand arithmetic over columns, `target - q`; a
column of another clock is interpolated.

Rows in messages are those of the log's data, from 0 as in recordings, beside the line of the file
that an editor shows.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.stats import theilslopes

from actuators.recordings.expression import Expression
from actuators.recordings.log_files import Damaged, open_log
from actuators.recordings.log_signals import (
    Piece,
    Places,
    RunClocks,
    RunSignals,
    Signal,
    compute_by_slices,
    find_first,
    index_columns,
    locate,
    refuse_missing,
    resolve_column,
)
from actuators.recordings.log_tables import LogFile, LogRun, join_names
from actuators.recordings.text_log import CsvLayout
from actuators.recordings.whole_rows import HOW_TO_SKIP, leave_broken_rows_out
from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import NonNegative, Positive, spec

log = logging.getLogger(__name__)

CLOCK_POINTS = 200
"""Points of the line that ties one clock to another; its cost grows with their square, and 200
points of the fastest messages fix a drift of 1 ppm within minutes."""


@spec
class Column:
    """A column of numbers: `scale * value + offset`.

    Attributes:
        column: Its name in the log, or arithmetic over columns.
        scale: Unit of the recording for one of the log.
        offset: Added after scaling, in the unit of the recording.
    """

    column: str
    scale: float
    offset: float


@spec
class AlignedTime:
    """A clock that is tied to another one of the same table by a straight line.

    Samples carry the time of the sensor's own clock, whose zero and drift are unknown, and that of
    the recorder, which is late by the varying time of the transport. The line goes through the
    samples that were fastest.

    Attributes:
        column: Time of the sensor's clock.
        scale: Seconds for one of it.
        anchor: Time of the recorder's clock, to s.
    """

    column: str
    scale: float
    anchor: Column

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
class CommandColumn:
    """A column of commands, linear on either side of neutral.

    Attributes:
        column: Its name in the log, or arithmetic over columns.
        neutral: Value without motion.
        full_plus: Value of full command towards larger positions; may lie below `neutral`, which
            turns the sign. `null` for commands that go the other way only.
        full_minus: Value of full command towards smaller positions, or `null`.
    """

    column: str
    neutral: float
    full_plus: float | None
    full_minus: float | None

    def check(self) -> None:
        if self.full_plus is None or self.full_minus is None:
            full = self.full_plus if self.full_minus is None else self.full_minus
            if full is None or full == self.neutral:
                raise ConfigError(
                    f"column '{self.column}': expected full_plus or full_minus other than neutral {self.neutral:g}"
                )
        elif (self.full_plus - self.neutral) * (self.full_minus - self.neutral) >= 0:
            raise ConfigError(
                f"column '{self.column}': neutral {self.neutral:g} must lie between full_plus {self.full_plus:g} and full_minus "
                f"{self.full_minus:g}"
            )

    def command(self, values: np.ndarray) -> np.ndarray:
        """Return commands, full at -1 and 1, for values of the log; same shape.

        Where commands go one way only, those of the other way come out beyond full: NaN.
        """
        away = values - self.neutral
        if self.full_minus is None:
            plus = away / (self.full_plus - self.neutral)  # type: ignore[operator]
            return np.where(plus >= 0, plus, np.nan)
        if self.full_plus is None:
            minus = away / (self.full_minus - self.neutral)
            return np.where(minus >= 0, -minus, np.nan)
        plus = away / (self.full_plus - self.neutral)
        return np.where(plus >= 0, plus, -away / (self.full_minus - self.neutral))


@spec
class TargetColumn:
    """A column of target positions, for a servo that follows targets.

    On a machine whose joints are commanded by position the target is the command; -1 and 1 are the
    ends of the joint's travel. On one that is commanded by speed it is the speed of the target.

    Attributes:
        column: Its name in the log, or arithmetic over columns.
        scale: Unit of the recording for one of the log; negative turns the sign.
        full_speed: Speed of the target at full command, rad/s or m/s; that of the machine's
            `max_speed`, for a model that integrates commands to give the target. `null` for a
            machine that is commanded by position.
        offset: Added after scaling, in the unit of the recording.
    """

    column: str
    scale: float
    full_speed: float | None
    offset: float = 0.0  # maps from before this field have none

    def check(self) -> None:
        if (self.full_speed is not None and self.full_speed <= 0) or self.scale == 0:
            raise ConfigError(
                f"column '{self.column}': expected full_speed > 0 and a scale other than 0"
            )

    def command(self, values: np.ndarray, t_s: np.ndarray) -> np.ndarray:
        """Return the speed in force from each sample to the next, 0 at the last; same shape."""
        assert self.full_speed is not None, "checked against the machine"
        speed = np.diff(self.scale * values) / np.diff(t_s)
        return np.append(speed, 0.0) / self.full_speed


@spec
class JointColumns:
    """The columns of one joint.

    Attributes:
        command: Its command: a column of commands, or of targets.
        position: Its position, to rad or m.
    """

    command: CommandColumn | TargetColumn
    position: Column


@spec
class ColumnMap:
    """Reads logs of another machine by a map of their columns.

    Attributes:
        delimiter: Between the cells of a line of a CSV file.
        decimal: Decimal sign of its numbers.
        time: Time, to s; its zero does not matter. One column for all tables of a log, or one for
            each by its name.
        joints: Columns of each joint of the machine, by joint name.
        optional: Further columns, by their name in the recording (`ee_x_m`, `force_n`, …);
            interpolated like positions.
        overrun: Command beyond full that is taken for rounding and cut to full; more is refused.
        longest_gap_s: A longer time between two rows splits the log.
        shortest_s: Shorter pieces are left out.
        damaged: `refuse` a log with damage, or `skip` its damaged rows, messages, chunks and frames.
    """

    delimiter: Literal[",", ";", "\t", " "]
    decimal: Literal[".", ","]
    time: Column | AlignedTime | dict[str, Column | AlignedTime]
    joints: dict[str, JointColumns]
    optional: dict[str, Column]
    overrun: NonNegative
    longest_gap_s: Positive
    shortest_s: NonNegative
    damaged: Damaged = "refuse"  # maps from before this field have none

    def check(self) -> None:
        if self.delimiter == self.decimal:
            raise ConfigError(
                f"column map: '{self.decimal}' cannot be both delimiter and decimal sign"
            )
        for time in self.time.values() if isinstance(self.time, dict) else (self.time,):
            if time.scale <= 0:
                raise ConfigError(f"column map: time.scale {time.scale:g} must be positive")

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the pieces of the log at `path` as recordings of `machine`.

        Raises:
            ConfigError: the map is not for this machine.
            RecordingError: the log cannot be used; names file, line, row and column.
        """
        layout = CsvLayout(self.delimiter, self.decimal)
        return self.read_log(open_log(path, layout, damaged=self.damaged), machine)

    def read_log(self, opened: LogFile, machine: Machine) -> list[Recording]:
        """Return the pieces of an opened log; see `read`."""
        if set(self.joints) != set(machine.joint_names):
            raise ConfigError(
                f"import: the map names the joints {', '.join(self.joints)}, machine '{machine.name}' has "
                f"{', '.join(machine.joint_names)}; choose machine=… and import=… that belong together"
            )
        self._check_interface(machine)
        places = index_columns(opened.list_tables())
        sources = {text: resolve_column(text, places, opened.path) for text in self._list_texts()}
        wanted = self._list_wanted(sources, places, opened.path)
        found, num_rows = [], 0
        for run in opened.read_runs(wanted, None):
            if self.damaged == "skip":
                run = self._leave_broken_rows_out(run, sources, places)
            clocks = RunClocks(run, partial(_read_clock, run, column_map=self))
            found += self._read_run(RunSignals(run, sources, places, clocks), clocks, machine)
            num_rows += max(map(len, clocks.values()))
        if not found:
            raise RecordingError(
                f"{opened.path}: no piece of {self.shortest_s:g} s or more without a gap of {self.longest_gap_s:g} s among its "
                f"{num_rows} rows; mend longest_gap_s or the scale of time in the column map"
            )
        return found

    def _leave_broken_rows_out(
        self, run: LogRun, sources: Mapping[str, Expression | str], places: Places
    ) -> LogRun:
        """Return a run without rows of which a joint's cell or the time cannot be used."""
        needed: dict[str, set[str]] = {}
        for joint in self.joints.values():
            for text in (joint.command.column, joint.position.column):
                source = sources[text]
                for name in (source,) if isinstance(source, str) else source.names:
                    table, column = places[name]
                    needed.setdefault(table, set()).add(column)
        clocks = {}
        for table, columns in needed.items():
            time = self.find_time(table, run.where)
            clocks[table] = time.column
            if isinstance(time, AlignedTime):
                columns.add(time.anchor.column)
        return leave_broken_rows_out(run, clocks, needed)

    def _check_interface(self, machine: Machine) -> None:
        """Raise a `ConfigError` where targets are read as another quantity than the machine's command."""
        for name, joint in self.joints.items():
            if not isinstance(joint.command, TargetColumn):
                continue
            is_position = joint.command.full_speed is None
            if is_position != (machine.interface == "position"):
                mend = "a number" if is_position else "null"
                raise ConfigError(
                    f"import: machine '{machine.name}' is commanded by {machine.interface}; give joints.{name}.command.full_speed "
                    f"as {mend} in the column map"
                )

    def find_time(self, table: str, where: object) -> Column | AlignedTime:
        """Return the time of a table.

        Raises:
            RecordingError: The map has none.
        """
        if not isinstance(self.time, dict):
            return self.time
        if table not in self.time:
            raise RecordingError(
                f"{where}: the map has no time for table '{table}'; {list_choices(table, self.time)}"
            )
        return self.time[table]

    def _list_texts(self) -> list[str]:
        texts = [column.column for column in self.optional.values()]
        for joint in self.joints.values():
            texts += [joint.command.column, joint.position.column]
        return texts

    def _list_wanted(
        self, sources: Mapping[str, Expression | str], places: Places, where: Path
    ) -> dict[str, set[str]]:
        """Return the columns to read by table, those of the clocks too."""
        wanted: dict[str, set[str]] = {}
        for source in sources.values():
            for name in (source,) if isinstance(source, str) else source.names:
                table, column = places[name]
                wanted.setdefault(table, set()).add(column)
        for table, columns in wanted.items():
            time = self.find_time(table, where)
            texts = [time.column]
            if isinstance(time, AlignedTime):
                texts.append(time.anchor.column)
            for text in texts:
                refuse_missing(join_names(table, text), places, where)
                columns.add(text)
        return wanted

    def _read_run(
        self, signals: RunSignals, clocks: Mapping[str, np.ndarray], machine: Machine
    ) -> list[Recording]:
        """Return the pieces of a run; one column after the other is read and resampled."""
        spans_s, num_left_out = [], 0
        for begin_s, end_s in record.split_at_gaps(clocks.values(), self.longest_gap_s):
            if end_s - begin_s >= max(self.shortest_s, machine.period_s) - 1e-9:
                spans_s.append((begin_s, end_s))
            else:
                num_left_out += 1
        if num_left_out:
            log.warning(
                "%s: %d pieces shorter than %g s left out",
                signals.run.where,
                num_left_out,
                self.shortest_s,
            )
        pieces = [Piece(begin_s, end_s, machine) for begin_s, end_s in spans_s]
        for j, name in enumerate(machine.joint_names):
            command = self._read_command(signals, self.joints[name].command, machine, j)
            for piece in pieces:
                read = command.average if machine.interface == "torque" else command.hold
                piece.u[:, j] = read(piece.ticks_s, machine.period_s)
            position = _scale(signals, self.joints[name].position)
            for piece in pieces:
                piece.q[:, j] = position.interpolate(piece.ticks_s)
        for name, column in self.optional.items():
            optional = _scale(signals, column, True)
            for piece in pieces:
                piece.extra[name] = optional.interpolate(piece.ticks_s).astype(np.float32)
        clock_s = clocks[signals.find_table(self.joints[machine.joint_names[0]].position.column)]
        return [piece.make_recording(signals.run, clock_s) for piece in pieces]

    def _read_command(
        self,
        signals: RunSignals,
        column: CommandColumn | TargetColumn,
        machine: Machine,
        joint: int,
    ) -> Signal:
        signal = signals.read(column.column)
        if isinstance(column, TargetColumn) and column.full_speed is None:
            low, high = machine.lower[joint], machine.upper[joint]
            middle, half = (high + low) / 2.0, (high - low) / 2.0
            u = compute_by_slices(
                lambda part: (column.scale * part + column.offset - middle) / half, signal.values
            )
        elif isinstance(column, TargetColumn):
            u = column.command(signal.values, signal.t_s)
            # a gap between pieces is no motion of the target
            u[:-1][np.diff(signal.t_s) > self.longest_gap_s] = 0.0
        else:
            u = compute_by_slices(column.command, signal.values)
        row = find_first(u, lambda part: np.abs(part) <= 1.0 + self.overrun)
        if row is not None:
            where = locate(signals.run, signal.table, row, column.column)
            if np.isnan(u[row]):
                raise RecordingError(
                    f"{where}: {signal.values[row]:g} lies on the side of neutral for which the column map has no full "
                    "command; give both full_plus and full_minus, or mend neutral"
                )
            if isinstance(column, TargetColumn) and column.full_speed is None:
                target = column.scale * signal.values[row] + column.offset
                raise RecordingError(
                    f"{where}: the target is {target:.5g} {machine.joints[joint].unit}, beyond the limits {machine.lower[joint]:g} "
                    f"to {machine.upper[joint]:g} of '{machine.joints[joint].name}'; mend lower and upper in the machine file, "
                    "scale or offset in the column map, or the log"
                )
            raise RecordingError(
                f"{where}: command {u[row]:g} is beyond full by more than {self.overrun:g}; mend full_plus, full_minus, "
                "neutral or full_speed of the column map, or the log"
            )
        return Signal(signal.table, signal.t_s, np.clip(u, -1.0, 1.0, out=u), signal.text)


@spec
class CanColumnMap:
    """Reads logs of a CAN bus by a DBC file and a map of its signals.

    Attributes:
        dbc: The DBC file: a path, or `package:path` in an installed package.
        columns: The map; a signal is `<message>:<signal>`, the time of each message `time`.
    """

    dbc: str
    columns: ColumnMap

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the pieces of the log at `path`; see `ColumnMap.read`."""
        # Imported here, since a desk without CAN has no python-can.
        from actuators.recordings.can_log import CanLog

        opened = CanLog(path, self.dbc)
        opened.keep_whole = self.columns.damaged == "skip"
        return self.columns.read_log(opened, machine)


def _scale(signals: RunSignals, column: Column, empty: bool = False) -> Signal:
    """Return a column in the unit of the recording."""
    signal = signals.read(column.column, empty)
    values = compute_by_slices(lambda part: column.scale * part + column.offset, signal.values)
    return replace(signal, values=values)


def _read_clock(run: LogRun, name: str, column_map: ColumnMap) -> np.ndarray:
    """Return the times of a table, `(T,)` s.

    Raises:
        RecordingError: They do not increase.
    """
    table, time = run.tables[name], column_map.find_time(name, run.where)
    t_s = time.scale * np.asarray(table.columns[time.column], dtype=float)
    if isinstance(time, Column):
        t_s += time.offset
    if len(t_s) < 2:
        raise RecordingError(
            f"{run.where}: table '{name}' has {len(t_s)} rows; a log has at least 2"
        )
    if (row := find_first(t_s, np.isfinite)) is not None:
        text = table.show_cell(row, time.column)
        raise RecordingError(
            f"{locate(run, name, row, time.column)}: {text} is not a number; {HOW_TO_SKIP}"
        )
    if (row := find_first(np.diff(t_s), lambda step_s: step_s > 0)) is not None:
        raise RecordingError(
            f"{locate(run, name, row + 1, time.column)}: time does not increase ({t_s[row]:g} s, then {t_s[row + 1]:g} s); "
            f"{HOW_TO_SKIP}"
        )
    if isinstance(time, AlignedTime):
        anchor = np.asarray(table.columns[time.anchor.column], dtype=float)
        t_s = time.align(t_s, time.anchor.scale * anchor + time.anchor.offset)
    return t_s
