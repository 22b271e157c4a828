"""Drafts of a column map and of a machine file from logs of one kind.

The beginning of each log is looked at, then the whole of all. Each line says what it rests on.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from actuators.recordings.column_assignment import ColumnTable
from actuators.recordings.guess import GivenColumns, Guess
from actuators.recordings.joint_evidence import JointGuess
from actuators.recordings.log_files import open_log
from actuators.recordings.log_signals import RunSignals, Signal
from actuators.recordings.log_tables import LogFile
from actuators.recordings.text_log import TextLog
from brokk_rl.errors import RecordingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAP = "actuators.recordings.column_map"
MISSING = "???"
"""A value that a person must give; the configuration refuses to run without it."""
MAP_TEMPLATE, MACHINE_TEMPLATE = "column_map.yaml.jinja", "machine.yaml.jinja"
LEAST_HISTORY = 13
"""Least number of samples of the history of a policy."""
SAMPLED_ROWS = 20000
"""Rows from the beginning of a log from which its columns are guessed: some minutes."""
SAMPLED_LOGS = 12
"""Logs that are looked at: in one of them each joint should move."""
HIGHEST_RATE_HZ = 100.0
"""Rate of a machine made from a faster log: joints of arms and machines show nothing beyond."""
SHORTEST_S = 5.0
"""Shortest piece of a log, s: one free run of the diagnosis."""
SPARE = 0.1
"""Part of the travel that is added at its ends: the next log of the same kind goes a little further."""
REST_SHARE = 0.05
"""Share of all rows, at rest and with one command, from which it counts as neutral; by hand: a joint
that turns round passes through rest within 1 % of the rows."""


@dataclass(frozen=True)
class Draft:
    """All that was guessed about a kind of log.

    Attributes:
        name: Name of the machine.
        times: Clock of each table that is used.
        joints: Joints whose command changes.
        survey: Clocks and lengths of all logs.
        signs: Delimiter and decimal sign of text files.
        given: Meanings that a person gave.
        remarks: Further remarks.
    """

    name: str
    times: Mapping[str, Guess]
    joints: Sequence[JointGuess]
    survey: LogSurvey
    signs: tuple[str, str]
    given: GivenColumns
    remarks: Sequence[str]

    @property
    def has_targets(self) -> bool:
        """True if all joints are commanded by position; a machine is commanded by one quantity."""
        return all(joint.kind == "position" for joint in self.joints)

    @property
    def period_s(self) -> float:
        """Period of the machine."""
        period_s = max(self.survey.period_s, 1.0 / HIGHEST_RATE_HZ)
        return round(period_s, 3) if period_s >= 0.005 else period_s

    @property
    def dead_time_s(self) -> float:
        """Median lag of the joints, at least a period."""
        return round(max(float(np.median([one.lag_s for one in self.joints])), self.period_s), 3)

    @property
    def num_history(self) -> int:
        """Samples of the history."""
        return max(LEAST_HISTORY, math.ceil(4 * self.dead_time_s / self.period_s))

    @property
    def longest_gap_s(self) -> float:
        """Time between two rows from which on a log is split."""
        return _round_up(self.survey.gap_periods * self.survey.slowest_period_s)

    @property
    def shortest_s(self) -> float:
        """Shortest piece; a log of seconds is one piece, and a slow one has some rows in each."""
        return max(min(SHORTEST_S, 0.5 * self.survey.longest_s), 20.0 * self.survey.period_s)

    def find_reach(self, joint: JointGuess) -> tuple[float, float]:
        """Return the ends of the travel, rad or m: those of positions and targets, and some more."""
        numbers = joint.survey
        ends = [joint.scale * numbers.lowest, joint.scale * numbers.highest]
        if joint.kind == "position":
            for target in (numbers.lowest_command, numbers.highest_command):
                ends.append(joint.target_scale * target + joint.target_offset)
        spare = SPARE * (max(ends) - min(ends))
        low, high = min(ends) - spare, max(ends) + spare
        return math.floor(1000 * low) / 1000, math.ceil(1000 * high) / 1000

    def measure_full_speed(self, joint: JointGuess) -> float:
        """Return the speed at full command, rad/s or m/s.

        That of the command where its unit says it, else of the fastest motion. The fastest target says
        nothing about a machine: a step of a target is infinitely fast.
        """
        unit = joint.u.name.speed_unit
        if joint.kind == "velocity" and unit is not None and joint.neutral == 0.0:
            return unit * max(abs(joint.full_plus or 0.0), abs(joint.full_minus or 0.0))
        speed = abs(joint.scale) * joint.survey.top_speed
        if joint.kind == "position" and not self.has_targets:
            # beside joints commanded by speed the speed of the target is the command
            speed = max(speed, abs(joint.target_scale) * joint.survey.target_speed)
        return _round_up(speed)

    def list_guesses(self) -> list[Guess]:
        """Return all guesses, those of the clocks first."""
        found = [*self.times.values()]
        for joint in self.joints:
            found += joint.guesses.values()
        return found

    def format(self, template: str) -> str:
        """Return the column map or the machine as YAML, by `MAP_TEMPLATE` or `MACHINE_TEMPLATE`."""
        folder = FileSystemLoader(Path(__file__).parent)
        environment = Environment(loader=folder, undefined=StrictUndefined)
        environment.filters |= {
            "quote": partial(json.dumps, ensure_ascii=False),
            "explain": _explain,
        }
        names = {"map": MAP, "missing": MISSING, "spare": f"{SPARE:.0%}"}
        return environment.get_template(template).render(draft=self, **names)


def make_draft(paths: Sequence[Path], name: str, given: GivenColumns) -> Draft:
    """Return the draft of map and machine; joints that are never commanded are left out.

    Raises:
        RecordingError: A log cannot be read, nothing can be proposed, or no joint is ever commanded.
    """
    clocks: dict[str, Guess] = {}
    best: dict[str, JointGuess] = {}
    remarks: dict[str, None] = {}
    signs = (",", ".")
    for path in paths[:SAMPLED_LOGS]:
        opened = open_log(path, None, given.dbc, given.damaged, given.channel)
        if isinstance(opened, TextLog):
            signs = opened.signs
        sample = ColumnTable(next(opened.read_runs(SAMPLED_ROWS)), given)
        for table, time in sample.times.items():
            clocks.setdefault(table, time)
        remarks |= dict.fromkeys(sample.remarks)
        for joint in sample.joints:
            best[joint.name] = max(best.get(joint.name, joint), joint, key=JointGuess.rank)
    joints = [*best.values()]
    used = {one.u.table for one in joints} | {one.q.table for one in joints}
    times = {table: time for table, time in clocks.items() if table in used}
    survey = LogSurvey()
    for path in paths:
        opened = open_log(path, signs, given.dbc, given.damaged, given.channel)
        survey.add_log(opened, times, joints)
    moving = []
    for joint in joints:
        if joint.survey.highest_command > joint.survey.lowest_command:
            moving.append(joint)
            if joint.kind != "position":
                _scale_command(joint)
        else:
            remarks[f"{joint.name} is left out: its command never changes"] = None
    if not moving:
        raise RecordingError(f"{paths[0]}: no command of any joint changes in {len(paths)} logs")
    return Draft(name, times, moving, survey, signs, given, [*remarks, *survey.gaps])


def _scale_command(joint: JointGuess) -> None:
    """Choose neutral and full commands of a joint whose command sets its speed, or a force."""
    survey = joint.survey
    low, high, neutral = survey.lowest_command, survey.highest_command, 0.0
    largest = max(abs(low), abs(high))
    is_at_rest = survey.rest_share >= REST_SHARE and low <= survey.rest <= high
    full = "full commands are the largest of the logs"
    if joint.kind == "torque":  # a joint at rest may be held by a force, so 0 is neutral
        low, high = -largest, largest
        evidence = [("the largest command of the logs, both ways", 2.0)]
    elif -1.001 <= low < -0.5 and 0.5 < high <= 1.001:
        low, high = -1.0, 1.0
        largest = 1.0
        evidence = [(f"commands lie within -1 and 1, at rest {survey.rest:g}", 4.0)]
    elif is_at_rest:
        neutral = survey.rest
        share = f"{survey.rest_share:.0%} of the rows, all at rest"
        evidence = [(f"neutral {neutral:.6g} is the command of {share}; {full}", 2.0)]
    elif low <= 0.0 <= high:
        evidence = [(f"neutral 0: no command is frequent at rest; {full}", 2.0)]
    else:
        evidence = [("no command is frequent at rest, and none is 0", -1.0)]
    if neutral == 0.0 and joint.u.name.speed_unit is not None:  # a speed counts alike both ways
        low = -largest if low < 0.0 else low
        high = largest if high > 0.0 else high
    value = f"{low:.6g} to {high:.6g}, neutral {neutral:.6g}"
    least = 1e-9 * max(1.0, abs(neutral))
    above = high if high > neutral + least else None
    below = low if low < neutral - least else None
    if above is None or below is None:
        evidence.append(("commands go one way only", 0.0))
    if joint.sign < 0:
        above, below = below, above
    joint.neutral, joint.full_plus, joint.full_minus = neutral, above, below
    joint.add_guess("full command", value, evidence)


def _explain(guess: Guess) -> str:
    """Return a guess as a comment of one line."""
    others = f"; candidates: {guess.value}, {', '.join(guess.others)}" if guess.others else ""
    shown = f" ({guess.value})" if guess.sureness == "unsure" and not guess.others else ""
    return f"{guess.sureness}{shown}: {guess.reason}{others}".replace("\n", " ")


def _round_up(value: float) -> float:
    """Return a number rounded up to two digits."""
    if value <= 0.0:
        return 0.0
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / digit - 1e-9) * digit:.6g}")


def draw_draft(draft: Draft) -> Figure:
    """Draw command and position of each joint as they are in the logs, before anything is converted."""
    from brokk_rl.plot import BLUE, ORANGE, make_figure, remove_frame

    figure = make_figure(12.0, 0.6 + 1.6 * len(draft.joints))
    axes = figure.subplots(len(draft.joints), 1, squeeze=False)[:, 0]
    for joint, axis in zip(draft.joints, axes, strict=True):
        command, position = (joint.signals.read(one.text) for one in (joint.u, joint.q))
        begin_s = min(command.t_s[0], position.t_s[0])
        axis.plot(position.t_s - begin_s, position.values, color=BLUE, lw=1.2)
        is_same_unit = joint.kind == "position" and joint.target_scale == joint.scale
        other = axis if is_same_unit else axis.twinx()
        other.step(command.t_s - begin_s, command.values, color=ORANGE, lw=0.9, where="post")
        axis.set_ylabel(joint.q.text, color=BLUE, fontsize=7)
        if other is not axis:
            other.set_ylabel(joint.u.text, color=ORANGE, fontsize=7)
            other.spines["top"].set_visible(False)
        columns, kind = joint.guesses["columns"], joint.guesses["command"]
        verb = "is " if joint.kind == "position" else ""
        title = f"{joint.name} ({columns.sureness}): {joint.u.text} {verb}{kind.value} ({kind.sureness}); {joint.signals.run.name}"
        axis.set_title(title, loc="left", fontsize=8)
        remove_frame(axis)
    axes[-1].set_xlabel("s")
    return figure


GAP_PERIODS = 4
"""Least number of periods without a sample that split a log; loggers without real time skip up to two."""
LOST_PERIODS = 20
"""A longer time without a sample is no row that was lost by chance."""
USUAL_SHARE = 0.999
"""Share of the periods within half a gap: 20 % of the rows, lost by chance, leave gaps of 5 to 8 periods."""


@dataclass
class LogSurvey:
    """Numbers over all logs.

    Attributes:
        periods_s: Median periods of the positions, one a run.
        slowest_period_s: Median period of the slowest signal.
        gap_periods: Periods without a sample that split the logs.
        num_runs: Number of runs.
        minutes: Length of all runs without their gaps.
        longest_s: Length of the longest piece without a gap.
        gaps: Gaps that split the logs, as text.
    """

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

    def add_log(
        self, opened: LogFile, times: Mapping[str, Guess], joints: Sequence[JointGuess]
    ) -> None:
        """Add the numbers of a log.

        Raises:
            RecordingError: It is damaged, or lacks a column that the first one has.
        """
        clocks = {table: time.choice for table, time in times.items()}
        for run in opened.read_runs(None):
            signals = RunSignals(run, clocks, opened.keep_whole, 1.0)
            read = []
            for joint in joints:
                position = signals.read(joint.q.text, wraps=joint.q.modulus)
                command = signals.read(joint.u.text, wraps=joint.target_wraps)
                joint.survey.add(command, position, joint)
                read += [position, command]
            self._add_clocks(run.where, read)

    def _add_clocks(self, where: str, signals: Sequence[Signal]) -> None:
        """Add the clocks of a run, that of a position first."""
        t_s = signals[0].t_s
        periods_s = np.diff(t_s)
        period_s = float(np.median(periods_s))
        self.periods_s.append(period_s)
        slowest_s = max(float(np.median(np.diff(signal.t_s))) for signal in signals)
        self.slowest_period_s = max(self.slowest_period_s, slowest_s)
        by_chance_s = periods_s[periods_s < LOST_PERIODS * period_s]
        usual_s = float(np.quantile(by_chance_s, USUAL_SHARE))
        self.gap_periods = max(self.gap_periods, math.ceil(2.0 * usual_s / period_s - 1e-3))
        gaps = np.flatnonzero(periods_s > self.gap_periods * slowest_s)
        if len(gaps):
            longest = gaps[np.argmax(periods_s[gaps])]
            text = f"{len(gaps)} gaps, {periods_s[gaps].sum():.4g} s without samples"
            place = f"{periods_s[longest]:.4g} s from {t_s[longest] - t_s[0]:.2f} s on"
            cause = "lost rows, or a clock that was set; the log is split there"
            self.gaps.append(f"{where}: {text}; the longest is {place}: {cause}")
        self.minutes += float(t_s[-1] - t_s[0] - periods_s[gaps].sum()) / 60.0
        edges_s = np.concatenate([t_s[:1], t_s[gaps], t_s[-1:]])
        self.longest_s = max(self.longest_s, float(np.diff(edges_s).max()))
        self.num_runs += 1
