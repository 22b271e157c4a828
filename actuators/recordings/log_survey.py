"""Ranges, rest values and rates of chosen columns over whole logs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from actuators.recordings.clock_evidence import TimeGuess
from actuators.recordings.clocks import put_near
from actuators.recordings.column_map import Column, ColumnMap, JointColumns, TargetColumn
from actuators.recordings.guess import GivenColumns
from actuators.recordings.joint_evidence import JointGuess
from actuators.recordings.log_signals import Signal

GAP_PERIODS = 4
"""Least number of periods without a sample that split a log; loggers without real time skip up to two."""
LOST_PERIODS = 20
"""A longer time without a sample is no row that was lost by chance."""
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
        top_speed: Fastest change of the position over a tenth of a second, per second.
        target_speed: Fastest change of the command from row to row, per second.
        rest: Most frequent command at rest; NaN where the joint never rests.
        rest_share: Share of all rows that are at rest with it, in the log with the most.
    """

    lowest_command: float = np.inf
    highest_command: float = -np.inf
    lowest: float = np.inf
    highest: float = -np.inf
    top_speed: float = 0.0
    target_speed: float = 0.0
    rest: float = np.nan
    rest_share: float = 0.0

    def add(self, command: Signal, position: Signal, joint: JointGuess) -> None:
        """Add a run; positions that begin again after a turn are put next to their targets, or to those before."""
        u, q, t_s = command.values, position.values, position.t_s
        if joint.q.modulus is not None:
            near = np.median(q) if self.lowest == np.inf else (self.lowest + self.highest) / 2.0
            if joint.kind == "position" and joint.target_wraps is None:
                near = (joint.target_scale * np.median(u) + joint.target_offset) / joint.scale
            q = put_near(q, float(near), joint.q.modulus)
        if joint.target_wraps is not None:
            u = put_near(u, float(np.median(np.interp(command.t_s, t_s, q))), joint.target_wraps)
        self.lowest_command = min(self.lowest_command, float(u.min()))
        self.highest_command = max(self.highest_command, float(u.max()))
        self.lowest, self.highest = min(self.lowest, q.min()), max(self.highest, q.max())
        target_speed = np.abs(np.diff(u) / np.diff(command.t_s)).max()
        self.target_speed = max(self.target_speed, float(target_speed))
        step = max(1, int(0.1 / float(np.median(np.diff(t_s)))))
        if len(q) <= step:
            return
        speed = np.abs((q[step:] - q[:-step]) / (t_s[step:] - t_s[:-step]))
        self.top_speed = max(self.top_speed, float(speed.max()))
        at_rest = np.interp(command.t_s, t_s[step:], speed) <= REST_SPEED * self.top_speed
        values, counts = np.unique(u[at_rest], return_counts=True)
        if len(values) and counts.max() / len(u) > self.rest_share:
            self.rest = float(values[counts.argmax()])
            self.rest_share = float(counts.max() / len(u))


@dataclass
class LogSurvey:
    """Numbers over all logs.

    Attributes:
        joints: By joint.
        periods_s: Median periods of the positions, one a run.
        slowest_period_s: Median period of the slowest signal.
        gap_periods: Periods without a sample that split the logs.
        num_runs: Number of runs.
        minutes: Length of all runs without their gaps.
        longest_s: Length of the longest piece without a gap.
        gaps: Gaps that split the logs, as text.
    """

    joints: dict[str, JointSurvey]
    periods_s: list[float] = field(default_factory=list)
    slowest_period_s: float = 0.0
    gap_periods: int = GAP_PERIODS
    num_runs: int = 0
    minutes: float = 0.0
    longest_s: float = 0.0
    gaps: list[str] = field(default_factory=list)

    @property
    def period_s(self) -> float:
        """Median period of the positions."""
        return float(np.median(self.periods_s))

    def add_clocks(self, where: str, signals: Sequence[Signal]) -> None:
        """Add the clocks of a run, that of a position first."""
        t_s = signals[0].t_s
        periods_s = np.diff(t_s)
        period_s = float(np.median(periods_s))
        self.periods_s.append(period_s)
        slowest_s = max(float(np.median(np.diff(signal.t_s))) for signal in signals)
        self.slowest_period_s = max(self.slowest_period_s, slowest_s)
        self.gap_periods = max(self.gap_periods, count_gap_periods(periods_s / period_s))
        gaps = np.flatnonzero(periods_s > self.gap_periods * slowest_s)
        if len(gaps):
            longest = gaps[np.argmax(periods_s[gaps])]
            self.gaps.append(
                f"{where}: {len(gaps)} gaps, {periods_s[gaps].sum():.4g} s without samples; the longest is "
                f"{periods_s[longest]:.4g} s "
                f"from {t_s[longest] - t_s[0]:.2f} s on: lost rows, or a clock that was set; the log is split there"
            )
        self.minutes += float(t_s[-1] - t_s[0] - periods_s[gaps].sum()) / 60.0
        edges_s = np.concatenate([t_s[:1], t_s[gaps], t_s[-1:]])
        self.longest_s = max(self.longest_s, float(np.diff(edges_s).max()))
        self.num_runs += 1


def count_gap_periods(periods: np.ndarray) -> int:
    """Return for how many periods rows that are lost one by one, by chance, leave no sample.

    Of `N` rows, each lost with probability `p`, the longest series of lost ones has about
    `log N / log(1 / p)` (Erdős and Rényi); one row more is a gap.

    Args:
        periods: Times between rows over their median, `(N,)`.
    """
    steps = np.maximum(np.round(periods[periods < LOST_PERIODS]), 1.0)
    lost = 1.0 - len(steps) / max(float(steps.sum()), 1.0)
    if lost <= 0.0:
        return GAP_PERIODS
    return max(GAP_PERIODS, 2 + math.ceil(math.log(len(steps)) / math.log(1.0 / lost)))


def measure_logs(
    paths: Sequence[Path],
    times: Mapping[str, TimeGuess],
    joints: Sequence[JointGuess],
    signs: tuple[Any, Any],
    given: GivenColumns,
) -> LogSurvey:
    """Return the numbers of all logs.

    Raises:
        RecordingError: A log is damaged, or lacks a column that the first one has.
    """
    columns = {}
    for joint in joints:
        command = TargetColumn(
            column=joint.u.text, scale=1.0, full_speed=None, wraps=joint.target_wraps
        )
        position = Column(column=joint.q.text, scale=1.0, offset=0.0, wraps=joint.q.modulus)
        columns[joint.name] = JointColumns(command=command, position=position)
    clocks = {table: one.time for table, one in times.items()}
    reader = ColumnMap(
        delimiter=signs[0], decimal=signs[1], time=clocks[""] if list(clocks) == [""] else clocks, joints=columns,
        optional={}, overrun=0.0, longest_gap_s=1.0, shortest_s=0.0, damaged=given.damaged, dbc=given.dbc, channel=given.channel,
    )  # fmt: skip
    survey = LogSurvey({joint.name: JointSurvey() for joint in joints})
    for path in paths:
        for signals in reader.open_runs(path):
            read = []
            for joint in joints:
                position = signals.read(joint.q.text, wraps=joint.q.modulus)
                command = signals.read(joint.u.text, wraps=joint.target_wraps)
                survey.joints[joint.name].add(command, position, joint)
                read += [position, command]
            survey.add_clocks(signals.run.where, read)
    return survey
