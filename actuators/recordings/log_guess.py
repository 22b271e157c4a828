"""Guesses over several logs of one kind: the beginning of each is looked at, then the whole of all."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from actuators.recordings.clock_guess import (
    TimeGuess,
    describe_broken_clocks,
    guess_times,
    read_times,
)
from actuators.recordings.column_guess import GivenColumns, JointGuess, guess_joints
from actuators.recordings.log_files import Damaged, open_log
from actuators.recordings.log_signals import index_columns
from actuators.recordings.log_survey import measure_logs
from actuators.recordings.log_tables import LogRun
from actuators.recordings.map_draft import Draft
from actuators.recordings.text_log import CsvLayout, CsvLog
from actuators.recordings.whole_rows import HOW_TO_SKIP
from brokk_rl.errors import RecordingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

SAMPLED_ROWS = 20000
"""Rows from the beginning of a log from which its columns are guessed: some minutes."""
SAMPLED_LOGS = 12
"""Logs that are looked at: in one of them each joint should move."""
RANK = {"sure": 2, "likely": 1, "unsure": 0}


@dataclass(frozen=True)
class LogGuess:
    """Guesses about logs of one kind.

    Attributes:
        times: Clock of each table that is used.
        joints: Best guess of each joint over the logs.
        samples: Beginnings of the logs.
        best: Number of the sample that each joint was judged by.
        layout: Signs of CSV files.
        dbc: DBC file of logs of a CAN bus.
        damaged: What is done about damaged parts.
        remarks: Further remarks.
    """

    times: dict[str, TimeGuess]
    joints: list[JointGuess]
    samples: list[LogRun]
    best: dict[str, int]
    layout: CsvLayout
    dbc: str | None
    damaged: Damaged
    remarks: list[str]


def guess_logs(
    paths: Sequence[Path], given: GivenColumns, dbc: str | None, damaged: Damaged = "refuse"
) -> LogGuess:
    """Return the guesses from the beginnings of the logs.

    Raises:
        RecordingError: A log cannot be read, or nothing can be proposed.
    """
    samples, remarks = [], []
    layout = CsvLayout(",", ".")
    times: dict[str, TimeGuess] = {}
    best: dict[str, tuple[JointGuess, int]] = {}
    for path in paths[:SAMPLED_LOGS]:
        opened = open_log(path, dbc=dbc, damaged=damaged)
        if isinstance(opened, CsvLog):
            layout = opened.layout
        run = next(opened.read_runs(opened.list_tables(), SAMPLED_ROWS), None)
        if run is None:
            raise RecordingError(f"{path}: no row")
        clocks = guess_times(run, damaged == "skip", given.clock_offset_s)
        if not clocks:
            columns = ", ".join(index_columns(opened.list_tables()))
            if not columns:
                raise RecordingError(f"{path}: no column of numbers can be read in it")
            broken = "; ".join(describe_broken_clocks(run))
            raise RecordingError(
                f"{path}: no column only increases at a rate of 1 to 5000 Hz, so none can be the time; "
                + (f"{broken}; {HOW_TO_SKIP}" if broken else f"columns: {columns}")
            )
        joints, more = guess_joints(run, clocks, given)
        samples.append(run)
        times = times or clocks
        remarks += [remark for remark in more if remark not in remarks]
        for joint in joints:
            before = best.get(joint.name)
            if before is None or _rank_joint(joint) > _rank_joint(before[0]):
                best[joint.name] = (joint, len(samples) - 1)
    places = index_columns(open_log(paths[0], dbc=dbc, damaged=damaged).list_tables())
    used = {places[name][0] for joint, _ in best.values() for name in (joint.command, joint.position)}  # fmt: skip
    return LogGuess(
        {name: time for name, time in times.items() if name in used},
        [joint for joint, _ in best.values()],
        samples,
        {name: number for name, (_, number) in best.items()},
        layout,
        dbc,
        damaged,
        remarks,
    )


def _rank_joint(joint: JointGuess) -> tuple[int, int]:
    return RANK[joint.guesses["columns"].sureness], RANK[joint.guesses["kind"].sureness]


def make_draft(guess: LogGuess, paths: Sequence[Path], name: str) -> Draft:
    """Return the draft of map and machine; joints that are never commanded are left out.

    Raises:
        RecordingError: A log is damaged, or no joint is ever commanded.
    """
    survey = measure_logs(paths, guess.times, guess.joints, guess.dbc, guess.damaged)
    moving, remarks = [], list(guess.remarks)
    for joint in guess.joints:
        numbers = survey.joints[joint.name]
        if numbers.highest_command > numbers.lowest_command:
            moving.append(joint)
        else:
            remarks.append(f"{joint.name} is left out: its command never changes")
    if not moving:
        raise RecordingError(f"{paths[0]}: no command of any joint changes in {len(paths)} logs")
    return Draft(name, guess.times, moving, survey, guess.layout, guess.dbc, guess.damaged, remarks)


def draw_guess(guess: LogGuess) -> Figure:
    """Draw command and position of each joint as they are in the logs, before anything is converted."""
    from brokk_rl.plot import BLUE, ORANGE, make_figure, remove_frame

    figure = make_figure(12.0, 0.6 + 1.6 * len(guess.joints))
    axes = figure.subplots(len(guess.joints), 1, squeeze=False)[:, 0]
    for joint, axis in zip(guess.joints, axes, strict=True):
        run = guess.samples[guess.best[joint.name]]
        places = index_columns({name: [*table.columns] for name, table in run.tables.items()})
        curves = {}
        for full_name in (joint.command, joint.position):
            table, column = places[full_name]
            t_s = read_times(run.tables[table], guess.times[table])
            curves[full_name] = (t_s, np.asarray(run.tables[table].columns[column]))
        begin_s = min(t_s[0] for t_s, _ in curves.values())
        (command_s, u), (position_s, q) = curves[joint.command], curves[joint.position]
        axis.plot(position_s - begin_s, q, color=BLUE, lw=1.2)
        is_same_unit = joint.kind == "target" and joint.target_scale == joint.scale
        other = axis if is_same_unit else axis.twinx()
        other.step(command_s - begin_s, u, color=ORANGE, lw=0.9, where="post")
        axis.set_ylabel(joint.position, color=BLUE, fontsize=7)
        if other is not axis:
            other.set_ylabel(joint.command, color=ORANGE, fontsize=7)
            other.spines["top"].set_visible(False)
        columns, kind = joint.guesses["columns"], joint.guesses["kind"]
        relation = f"{joint.command} is {kind.value}" if joint.kind == "target" else f"{joint.command} {kind.value}"  # fmt: skip
        axis.set_title(
            f"{joint.name} ({columns.sureness}): {relation} ({kind.sureness}); {run.name}",
            loc="left",
            fontsize=8,
        )
        remove_frame(axis)
    axes[-1].set_xlabel("s")
    return figure
