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
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from actuators.recordings.clocks import AlignedTime, Column, RowTime, put_near
from actuators.recordings.guess import Damaged
from actuators.recordings.log_files import open_log
from actuators.recordings.log_signals import TICK_TOLERANCE, RunSignals, Signal, locate
from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import NonNegative, Positive, spec

log = logging.getLogger(__name__)


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
        given = [full for full in (self.full_plus, self.full_minus) if full is not None]
        away = [full - self.neutral for full in given]
        if not given or np.prod(away) == 0.0 or (len(given) == 2 and np.prod(away) > 0.0):
            raise ConfigError(
                f"column '{self.column}': neutral {self.neutral:g} must lie between full_plus and full_minus, or beside the one "
                f"that is given, got {self.full_plus} and {self.full_minus}"
            )

    def command(self, values: np.ndarray) -> np.ndarray:
        """Return commands, full at -1 and 1, for values of the log; same shape.

        Where commands go one way only, those of the other way come out beyond full: NaN.
        """
        plus = np.nan if self.full_plus is None else self.full_plus - self.neutral
        minus = np.nan if self.full_minus is None else self.neutral - self.full_minus
        away = values - self.neutral
        is_plus = away * (plus if self.full_minus is None else minus) > 0
        return np.where(away == 0.0, 0.0, away / np.where(is_plus, plus, minus))


@spec
class TargetColumn(Column):
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
        wraps: As of a `Column`.
    """

    full_speed: Positive | None
    offset: float = 0.0  # maps from before this field have none


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

    In a log of a CAN bus a column is `<message>:<signal>`, the time of each message `time`.

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
        dbc: DBC file of logs of a CAN bus: a path, or `package:path` in an installed package.
        channel: Channel of its recorder; `null` where each message comes on one.
    """

    delimiter: Literal[",", ";", "\t", " ", "|"]
    decimal: Literal[".", ","]
    time: Column | AlignedTime | RowTime | dict[str, Column | AlignedTime | RowTime]
    joints: dict[str, JointColumns]
    optional: dict[str, Column]
    overrun: NonNegative
    longest_gap_s: Positive
    shortest_s: NonNegative
    damaged: Damaged = "refuse"  # maps from before these fields have none
    dbc: str | None = None
    channel: int | str | None = None

    def read(self, path: Path, machine: Machine) -> list[Recording]:
        """Return the pieces of the log at `path` as recordings of `machine`.

        Raises:
            ConfigError: the map is not for this machine.
            RecordingError: the log cannot be used; names file, line, row and column.
        """
        if set(self.joints) != set(machine.joint_names):
            raise ConfigError(
                f"import: the map names the joints {', '.join(self.joints)}, machine '{machine.name}' has "
                f"{', '.join(machine.joint_names)}; choose machine=… and import=… that belong together"
            )
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
        signs = (self.delimiter, self.decimal)
        opened = open_log(path, signs, self.dbc, self.damaged, self.channel)
        found = []
        for run in opened.read_runs(None):
            time = self.time
            times = time if isinstance(time, dict) else dict.fromkeys(run.tables, time)
            signals = RunSignals(run, times, opened.keep_whole, self.longest_gap_s)
            found += self._read_run(signals, machine)
        if not found:
            raise RecordingError(
                f"{path}: no piece of {self.shortest_s:g} s or more without a gap of {self.longest_gap_s:g} s; "
                "mend longest_gap_s or the scale of time in the column map"
            )
        return found

    def _read_run(self, signals: RunSignals, machine: Machine) -> list[Recording]:
        """Return the pieces of a run, resampled to the rate of the machine."""
        commands, positions, optional = [], [], {}
        for j, name in enumerate(machine.joint_names):
            middle = float(machine.upper[j] + machine.lower[j]) / 2.0
            positions.append(read_column(signals, self.joints[name].position, middle))
            commands.append(self._read_command(signals, positions[j], machine, j))
        for name, column in self.optional.items():
            optional[name] = read_column(signals, column, None, empty=True)
        # arithmetic has the clock of its first column, and gaps of the others count too
        clocks = [signal.t_s for signal in (*commands, *positions)]
        spans_s = [*record.split_at_gaps(clocks, self.longest_gap_s)]
        shortest_s = max(self.shortest_s, machine.period_s) - 1e-9
        whole_s = [one for one in spans_s if one[1] - one[0] >= shortest_s]
        if num_left_out := len(spans_s) - len(whole_s):
            text = "%s: %d pieces shorter than %g s left out"
            log.warning(text, signals.run.where, num_left_out, self.shortest_s)
        found = []
        for begin_s, end_s in whole_s:
            num_rows = int((end_s - begin_s) / machine.period_s + TICK_TOLERANCE) + 1
            t_s = np.arange(num_rows) * machine.period_s
            read = Signal.average if machine.interface == "torque" else Signal.hold
            u = [read(command, begin_s + t_s, machine.period_s) for command in commands]
            q = [position.interpolate(begin_s + t_s) for position in positions]
            motion = (np.stack(u, 1), np.stack(q, 1))
            made = record.make_motion(machine, signals.run.name, t_s, *motion)
            extra = {}
            for name, signal in optional.items():
                extra[name] = signal.interpolate(begin_s + t_s).astype(np.float32)
            metadata = {
                "source": f"log: {Path(signals.run.where).name}",
                "run": signals.run.name,
                "fingerprint": record.format_fingerprint(machine),
            }
            found.append(replace(made, extra=extra, metadata=metadata))
        return found

    def _read_command(
        self, signals: RunSignals, position: Signal, machine: Machine, j: int
    ) -> Signal:
        """Return the commands of a joint, from -1 to 1; refuse those beyond full."""
        joint, column = machine.joints[j], self.joints[machine.joint_names[j]].command
        target: np.ndarray | None = None
        if isinstance(column, CommandColumn):
            signal = signals.read(column.column)
            u = column.command(signal.values)
        else:
            signal = read_column(signals, column, position)
            if column.full_speed is None:
                low, high = machine.lower[j], machine.upper[j]
                target = signal.values
                u = (target - (high + low) / 2.0) / ((high - low) / 2.0)
            else:  # the speed in force from each sample to the next
                speed = np.diff(signal.values) / np.diff(signal.t_s)
                # a gap between pieces is no motion of the target
                speed[np.diff(signal.t_s) > self.longest_gap_s] = 0.0
                u = np.append(speed, 0.0) / column.full_speed
        is_beyond = ~(np.abs(u) <= 1.0 + self.overrun)
        if not is_beyond.any():
            return replace(signal, values=np.clip(u, -1.0, 1.0))
        row = int(np.argmax(is_beyond))
        text = f"command {u[row]:g} is beyond full by more than {self.overrun:g}"
        mend = "mend full_plus, full_minus, neutral or full_speed of the column map, or the log"
        if np.isnan(u[row]):
            side = "the side of neutral for which the column map has no full command"
            text = f"{signal.values[row]:g} lies on {side}"
            mend = "give both full_plus and full_minus, or mend neutral"
        elif target is not None:
            limits = f"{machine.lower[j]:g} to {machine.upper[j]:g} of '{joint.name}'"
            text = f"the target is {target[row]:.5g} {joint.unit}, beyond the limits {limits}"
            mend = "mend lower and upper in the machine file, scale or offset in the column map, or the log"
        where = locate(signals.run, signal, row, column.column)
        raise RecordingError(f"{where}: {text}; {mend}")


def read_column(
    signals: RunSignals, column: Column, near: Signal | float | None, empty: bool = False
) -> Signal:
    """Return a column in the unit of the recording.

    Args:
        signals: Signals of the run.
        column: The column.
        near: Middle of the travel, or position that it follows, next to which an unwrapped angle is put; `None` for
            no joint.
        empty: Accept missing numbers.
    """
    signal = signals.read(column.column, empty, column.wraps)
    values = signal.values
    if column.wraps is not None and near is not None:
        place = np.median(near.interpolate(signal.t_s)) if isinstance(near, Signal) else near
        values = put_near(values, (float(place) - column.offset) / column.scale, column.wraps)
    return replace(signal, values=column.scale * values + column.offset)
