"""Ranges, rest values and rates of chosen columns over whole logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from actuators.recordings.clock_guess import TimeGuess, read_times
from actuators.recordings.column_guess import JointGuess
from actuators.recordings.log_files import Damaged, open_log
from actuators.recordings.log_signals import index_columns
from actuators.recordings.whole_rows import leave_broken_rows_out
from brokk_rl.errors import RecordingError

REST_SPEED = 0.02
"""Part of the top speed below which a joint counts as at rest."""


@dataclass
class JointSurvey:
    """Numbers of one joint over all logs, in the units of the logs.

    Attributes:
        lowest_command: Smallest command.
        highest_command: Largest command.
        lowest: Smallest position.
        highest: Largest position.
        top_target_speed: Fastest change of the command, per second.
        top_speed: Fastest change of the position over a tenth of a second, per second.
        rest: Most frequent command at rest; NaN where the joint never rests.
        rest_share: Share of all rows that are at rest with it, in the log with the most.
    """

    lowest_command: float = np.inf
    highest_command: float = -np.inf
    lowest: float = np.inf
    highest: float = -np.inf
    top_target_speed: float = 0.0
    top_speed: float = 0.0
    rest: float = np.nan
    rest_share: float = 0.0

    def add(self, command: np.ndarray, clock_s: np.ndarray, q: np.ndarray, t_s: np.ndarray) -> None:
        """Add a run: commands and positions, each `(T,)` on its clock."""
        self.lowest_command = min(self.lowest_command, float(np.nanmin(command)))
        self.highest_command = max(self.highest_command, float(np.nanmax(command)))
        self.lowest, self.highest = min(self.lowest, float(np.nanmin(q))), max(self.highest, float(np.nanmax(q)))  # fmt: skip
        period_s = np.diff(clock_s)
        steady = period_s <= 3 * np.median(period_s)
        self.top_target_speed = max(
            self.top_target_speed, float(np.nanmax(np.abs(np.diff(command) / period_s)[steady]))
        )
        step = max(1, int(0.1 / np.median(np.diff(t_s))))
        speed = np.abs((q[step:] - q[:-step]) / (t_s[step:] - t_s[:-step]))
        self.top_speed = max(self.top_speed, float(np.nanmax(speed, initial=0.0)))
        at_rest = np.interp(clock_s, t_s[step:], speed) <= REST_SPEED * self.top_speed
        values, counts = np.unique(command[at_rest], return_counts=True)
        if len(values) and counts.max() / len(command) > self.rest_share:
            self.rest = float(values[counts.argmax()])
            self.rest_share = float(counts.max() / len(command))


@dataclass(frozen=True)
class LogSurvey:
    """Numbers over all logs.

    Attributes:
        joints: By joint.
        period_s: Median period of the positions.
        slowest_period_s: Median period of the slowest table.
        num_runs: Number of runs.
        minutes: Length of all runs.
    """

    joints: Mapping[str, JointSurvey]
    period_s: float
    slowest_period_s: float
    num_runs: int
    minutes: float


def measure_logs(
    paths: Sequence[Path],
    times: Mapping[str, TimeGuess],
    joints: Sequence[JointGuess],
    dbc: str | None,
    damaged: Damaged = "refuse",
) -> LogSurvey:
    """Return the numbers of all logs; one column after the other is held in memory.

    Raises:
        RecordingError: A log is damaged, or lacks a column that the first one has.
    """
    found = {joint.name: JointSurvey() for joint in joints}
    periods_s, slowest_s, num_runs, seconds = [], 0.0, 0, 0.0
    for path in paths:
        opened = open_log(path, dbc=dbc, damaged=damaged)
        places = index_columns(opened.list_tables())
        wanted: dict[str, set[str]] = {}
        for joint in joints:
            for name in (joint.command, joint.position):
                if name not in places:
                    raise RecordingError(
                        f"{path}: column '{name}' is missing, which {paths[0]} has; import logs of one kind at a time"
                    )
                table, column = places[name]
                columns = wanted.setdefault(table, set())
                columns |= {column, times[table].column, times[table].anchor or column}
        for run in opened.read_runs(wanted, None):
            if opened.keep_whole:
                columns_of_time = {name: times[name].column for name in wanted}
                run = leave_broken_rows_out(run, columns_of_time, wanted)
            clocks = {name: read_times(table, times[name]) for name, table in run.tables.items()}
            for joint in joints:
                (one, command), (other, position) = places[joint.command], places[joint.position]
                found[joint.name].add(
                    run.tables[one].columns[command],
                    clocks[one],
                    run.tables[other].columns[position],
                    clocks[other],
                )
            clock_s = clocks[places[joints[0].position][0]]
            periods_s.append(float(np.median(np.diff(clock_s))))
            slowest_s = max(slowest_s, *(float(np.median(np.diff(t_s))) for t_s in clocks.values()))
            seconds += float(clock_s[-1] - clock_s[0])
            num_runs += 1
    return LogSurvey(found, float(np.median(periods_s)), slowest_s, num_runs, seconds / 60.0)
