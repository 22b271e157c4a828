"""Drafts of a column map and of a machine file from logs of one kind.

The beginning of each log is looked at, then the whole of all. Each line says what it rests on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from actuators.recordings.clocks import AlignedTime, RowTime
from actuators.recordings.column_table import ColumnTable, JointGuess, read_columns
from actuators.recordings.guess import Evidence, GivenColumns, Guess
from actuators.recordings.log_files import Damaged, open_log
from actuators.recordings.log_survey import GAP_PERIODS, JointSurvey, LogSurvey, measure_logs
from actuators.recordings.log_tables import index_columns
from actuators.recordings.text_log import TextLog
from actuators.recordings.time_guess import TimeGuess
from brokk_rl.errors import RecordingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAP = "actuators.recordings.column_map"
MISSING = "???"
"""A value that a person must give; the configuration refuses to run without it."""
QUOTED_MISSING = f'"{MISSING}"'
"""The same within braces, where YAML takes a bare question mark for something else."""
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
class CommandDraft:
    """Scale of a command.

    Attributes:
        neutral: Value without motion.
        full_plus: Value of full command towards larger positions; `None` without such commands.
        full_minus: The same towards smaller positions.
        guess: How sure it is.
    """

    neutral: float
    full_plus: float | None
    full_minus: float | None
    guess: Guess


@dataclass(frozen=True)
class Draft:
    """All that was guessed about a kind of log.

    Attributes:
        name: Name of the machine.
        times: Clock of each table that is used.
        joints: Joints whose command changes.
        survey: Their numbers over all logs.
        samples: What the columns of the first logs are.
        best: Number of the sample that each joint was judged by.
        signs: Delimiter and decimal sign of text files.
        dbc: DBC file of logs of a CAN bus.
        channel: Channel of the recorder.
        damaged: What is done about damaged parts.
        remarks: Further remarks.
    """

    name: str
    times: Mapping[str, TimeGuess]
    joints: Sequence[JointGuess]
    survey: LogSurvey
    samples: Sequence[ColumnTable]
    best: Mapping[str, int]
    signs: tuple[str, str]
    dbc: str | None
    channel: int | None
    damaged: Damaged
    remarks: Sequence[str]

    @property
    def has_targets(self) -> bool:
        """True if all joints are commanded by position; a machine is commanded by one quantity."""
        return all(joint.kind == "position" for joint in self.joints)

    def list_guesses(self) -> list[Guess]:
        """Return all guesses, those of the clocks first."""
        found = [time.guess for time in self.times.values()]
        for joint in self.joints:
            found += joint.guesses.values()
            if joint.kind != "position":
                found.append(scale_command(joint, self.survey.joints[joint.name]).guess)
        return found


def make_draft(
    paths: Sequence[Path],
    name: str,
    given: GivenColumns,
    dbc: str | None,
    damaged: Damaged = "refuse",
    channel: int | None = None,
) -> Draft:
    """Return the draft of map and machine; joints that are never commanded are left out.

    Raises:
        RecordingError: A log cannot be read, nothing can be proposed, or no joint is ever commanded.
    """
    samples: list[ColumnTable] = []
    best: dict[str, int] = {}
    remarks: dict[str, None] = {}
    signs = (",", ".")
    for path in paths[:SAMPLED_LOGS]:
        opened = open_log(path, None, dbc, damaged, channel)
        if isinstance(opened, TextLog):
            signs = (opened.layout.delimiter, opened.layout.decimal)
        run = next(opened.read_runs(opened.list_tables(), SAMPLED_ROWS), None)
        if run is None:
            raise RecordingError(f"{path}: no row")
        samples.append(read_columns(run, given, damaged == "skip"))
        remarks |= dict.fromkeys(samples[-1].remarks)
        for joint in samples[-1].joints:
            number = best.get(joint.name)
            if number is None or _rank(joint) > _rank(find_joint(samples[number], joint.name)):
                best[joint.name] = len(samples) - 1
    joints = [find_joint(samples[number], joint) for joint, number in best.items()]
    places = index_columns({table: [*columns] for table, columns in _list_places(samples)})
    used = {places[column][0] for joint in joints for column in (joint.command, joint.position)}
    times = {table: time for table, time in samples[0].times.items() if table in used}
    survey = measure_logs(paths, times, joints, dbc, damaged, channel)
    moving = []
    for joint in joints:
        numbers = survey.joints[joint.name]
        if numbers.highest_command > numbers.lowest_command:
            moving.append(joint)
        else:
            remarks[f"{joint.name} is left out: its command never changes"] = None
    if not moving:
        raise RecordingError(f"{paths[0]}: no command of any joint changes in {len(paths)} logs")
    all_remarks = [*remarks, *survey.gaps]
    return Draft(
        name, times, moving, survey, samples, best, signs, dbc, channel, damaged, all_remarks
    )


def find_joint(table: ColumnTable, name: str) -> JointGuess:
    """Return a joint of a sample by its name."""
    return next(joint for joint in table.joints if joint.name == name)


def _list_places(samples: Sequence[ColumnTable]) -> list[tuple[str, list[str]]]:
    return [
        (name, [*table.columns])
        for sample in samples
        for name, table in sample.signals.run.tables.items()
    ]


def _rank(joint: JointGuess) -> tuple[float, float]:
    return joint.guesses["columns"].probability, joint.guesses["kind"].probability


def scale_command(joint: JointGuess, survey: JointSurvey) -> CommandDraft:
    """Return neutral and full commands of a joint whose command sets its speed, or a force."""
    low, high = survey.lowest_command, survey.highest_command
    subject = f"{joint.name}: full command"
    if joint.kind == "torque":  # a joint at rest may be held by a force, so 0 is neutral
        full = max(abs(low), abs(high))
        guess = Guess(
            subject,
            f"-{full:.6g} to {full:.6g}",
            (Evidence("the largest command of the logs, both ways", 2.0),),
        )
        return CommandDraft(0.0, full, -full, guess)
    if -1.001 <= low < -0.5 and 0.5 < high <= 1.001:
        neutral, low, high = 0.0, -1.0, 1.0
        text = f"commands lie within -1 and 1, at rest {survey.rest:g}"
        guess = Guess(subject, "-1 to 1", (Evidence(text, 4.0),))
    else:
        is_known = survey.rest_share >= REST_SHARE and low <= survey.rest <= high
        neutral = survey.rest if is_known else 0.0
        reason = (
            f"neutral {neutral:.6g} is the command of {survey.rest_share:.0%} of the rows, all at rest; full commands are the "
            "largest of the logs"
        )
        weight = 2.0
        if not is_known and not low <= 0.0 <= high:
            weight, reason = -1.0, "no command is frequent at rest, and none is 0"
        elif not is_known:
            reason = "neutral 0: no command is frequent at rest; full commands are the largest of the logs"
        if neutral == 0.0 and joint.speed_scale is not None:  # a speed counts alike both ways
            largest = max(-low, high)
            low = -largest if low < 0.0 else low
            high = largest if high > 0.0 else high
        value = f"{low:.6g} to {high:.6g}, neutral {neutral:.6g}"
        guess = Guess(subject, value, (Evidence(reason, weight),))
    above = high if high > neutral + 1e-9 * max(1.0, abs(neutral)) else None
    below = low if low < neutral - 1e-9 * max(1.0, abs(neutral)) else None
    if above is None or below is None:
        guess = Guess(
            subject, guess.value, (*guess.evidence, Evidence("commands go one way only", 0.0))
        )
    if joint.sign < 0:
        above, below = below, above
    return CommandDraft(neutral, above, below, guess)


def format_map(draft: Draft) -> str:
    """Return the column map as YAML."""
    lines = [
        "# @package reader",
        f"# Logs of {draft.name}, as guessed from {draft.survey.num_runs} of them.",
        f"# {MISSING} stands where the guess was unsure: fill it in. Used with machine=@machine.yaml.",
        f"_target_: {MAP}.ColumnMap",
        f"delimiter: {_quote(draft.signs[0])}   # of text files only",
        f"decimal: {_quote(draft.signs[1])}",
        "time:",
    ]
    for table, time in draft.times.items():
        lines.append(f"  {_quote(table)}: {_format_time(time)}")
    if list(draft.times) == [""]:
        lines[-2:] = [f"time: {_format_time(draft.times[''])}"]
    lines.append("joints:")
    for joint in draft.joints:
        lines += _format_joint(joint, draft.survey.joints[joint.name], draft.has_targets)
    period_s = draft.survey.slowest_period_s
    # a log of seconds is one piece, and a slow one has some rows in each
    shortest_s = max(min(SHORTEST_S, 0.5 * draft.survey.longest_s), 20.0 * draft.survey.period_s)
    lines += [
        "optional: {}",
        "overrun: 0.001        # of full command; rounding",
        f"longest_gap_s: {_round_up(GAP_PERIODS * period_s):g}   # s; {GAP_PERIODS} periods of {period_s:.4g} s",
        f"shortest_s: {shortest_s:.4g}         # s; shorter ones hold no free run worth judging",
        f"damaged: {draft.damaged}       # skip: leave damaged rows, messages, chunks and frames out",
    ]
    if draft.dbc is not None:
        head, body = lines[:3], [f"  {line}" for line in lines[3:]]
        channel = "null" if draft.channel is None else draft.channel
        lines = [
            *head,
            f"_target_: {MAP}.CanColumnMap",
            f"dbc: {_quote(draft.dbc)}",
            f"channel: {channel}",
            "columns:",
            *body,
        ]
    return "\n".join(lines) + "\n"


def _format_time(time: TimeGuess) -> str:
    clock = time.time
    if isinstance(clock, RowTime):
        text = f"{{_target_: {MAP}.RowTime, rate_hz: {clock.rate_hz!r}}}"
        return f"{text}   # {_explain(time.guess)}"
    column = MISSING if time.guess.is_open else clock.column
    if isinstance(clock, AlignedTime):
        anchor = f"{{_target_: {MAP}.Column, column: {_quote(clock.anchor.column)}, scale: 1.0, offset: {clock.anchor.offset!r}}}"
        text = f"{{_target_: {MAP}.AlignedTime, column: {_quote(column)}, scale: {clock.scale!r}, anchor: {anchor}}}"
    else:
        wraps = "" if clock.wraps is None else f", wraps: {clock.wraps!r}"
        text = f"{{_target_: {MAP}.Column, column: {_quote(column)}, scale: {clock.scale!r}, offset: {clock.offset!r}{wraps}}}"
    return f"{text}   # {_explain(time.guess)}"


def _format_joint(joint: JointGuess, survey: JointSurvey, has_targets: bool) -> list[str]:
    columns, kind, unit = (joint.guesses[key] for key in ("columns", "kind", "unit"))
    command = MISSING if columns.is_open else joint.command
    position = MISSING if columns.is_open else joint.position
    scale = QUOTED_MISSING if unit.is_open else repr(joint.scale)
    lines = [
        f"  {joint.name}:   # {_explain(columns)}",
        f"    _target_: {MAP}.JointColumns",
        f"    # command: {_explain(kind)}",
    ]
    wraps = "" if joint.wraps is None else f", wraps: {joint.wraps!r}"
    if kind.is_open:
        lines.append(f"    command: {QUOTED_MISSING}")
    elif joint.kind == "position":
        target_scale = repr(joint.target_scale) if scale != QUOTED_MISSING else scale
        target_wraps = "" if joint.target_wraps is None else f", wraps: {joint.target_wraps!r}"
        offset, remark = "", f"{joint.unit} for one of the log; a target is the command itself"
        if (target := joint.guesses.get("target")) is not None:
            target_scale, offset = QUOTED_MISSING, f", offset: {QUOTED_MISSING}"
            remark = f"{_explain(target)}"
        speed = "null"
        if not has_targets:
            speed = (
                f"{measure_full_speed(joint, survey):g}"
                if target_scale != QUOTED_MISSING
                else QUOTED_MISSING
            )
            remark += f"; full_speed in {joint.unit}/s is the fastest motion of the logs"
        lines.append(
            f"    command: {{_target_: {MAP}.TargetColumn, column: {_quote(command)}, scale: {target_scale}, "
            f"full_speed: {speed}{offset}{target_wraps}}}   # {remark}"
        )
    else:
        full = scale_command(joint, survey)
        numbers = [QUOTED_MISSING] * 3
        if not full.guess.is_open:
            numbers = [
                "null" if v is None else repr(v)
                for v in (full.neutral, full.full_plus, full.full_minus)
            ]
        lines += [
            f"    # {_explain(full.guess)}",
            f"    command: {{_target_: {MAP}.CommandColumn, column: {_quote(command)}, neutral: {numbers[0]}, "
            f"full_plus: {numbers[1]}, full_minus: {numbers[2]}}}",
        ]
    lines.append(
        f"    position: {{_target_: {MAP}.Column, column: {_quote(position)}, scale: {scale}, offset: 0.0{wraps}}}"
        f"   # {joint.unit} for one of the log; {_explain(unit)}"
    )
    return lines


def measure_full_speed(joint: JointGuess, survey: JointSurvey) -> float:
    """Return the speed at full command, rad/s or m/s: that of the command where its unit says it, else of the fastest motion.

    The fastest target says nothing about a machine: a step of a target is infinitely fast.
    """
    if joint.kind == "velocity" and joint.speed_scale is not None:
        full = scale_command(joint, survey)
        if full.neutral == 0.0:
            return joint.speed_scale * max(abs(full.full_plus or 0.0), abs(full.full_minus or 0.0))
    return _round_up(abs(joint.scale) * survey.top_speed)


def format_machine(draft: Draft) -> str:
    """Return the machine as YAML: joints without bodies, limits and speeds as the logs show them."""
    period_s = max(draft.survey.period_s, 1.0 / HIGHEST_RATE_HZ)
    period_s = round(period_s, 3) if period_s >= 0.005 else period_s
    lags_s = sorted(joint.lag_s for joint in draft.joints)
    dead_time_s = round(max(lags_s[len(lags_s) // 2], period_s), 3)
    num_history = max(13, math.ceil(4 * dead_time_s / period_s))
    lines = [
        f"# {draft.name}, as its logs show it: joints only.",
        "# It can be recorded, identified and diagnosed, not simulated: bodies and tool are unknown.",
        "_target_: brokk_rl.machine.Machine",
        f"name: {draft.name}",
        f"title: {_quote(f'{draft.name}, {len(draft.joints)} joints, drafted from {draft.survey.minutes:.1f} minutes of logs')}",
        "mjcf: null",
        f"period_s: {period_s:g}   # s; median of its logs is {draft.survey.period_s:.4g} s",
        f"dead_time_s: {dead_time_s:g}   # s; median lag of the joints at the best correlation; mode=inspect estimates it",
        f"num_history: {num_history}   # samples; four times the dead time, at least 13",
        "exclusive: []",
        "tool_m: null",
        "levers: []",
        "joints:",
    ]
    for joint in draft.joints:
        lines += _format_machine_joint(joint, draft.survey.joints[joint.name], draft.has_targets)
    return "\n".join(lines) + "\n"


def _format_machine_joint(joint: JointGuess, survey: JointSurvey, has_targets: bool) -> list[str]:
    ends = [joint.scale * survey.lowest, joint.scale * survey.highest]
    if joint.kind == "position":
        for target in (survey.lowest_command, survey.highest_command):
            ends.append(joint.target_scale * target + joint.target_offset)
    spare = SPARE * (max(ends) - min(ends))
    low, high = min(ends) - spare, max(ends) + spare
    speed: float | None = measure_full_speed(joint, survey)
    is_known = not joint.guesses["unit"].is_open
    home = f"{(low + high) / 2:.3f}" if is_known else QUOTED_MISSING
    lower: float | None = math.floor(1000 * low) / 1000
    upper: float | None = math.ceil(1000 * high) / 1000
    if not is_known:
        lower = upper = speed = None
    reach = f"of its logs, {SPARE:.0%} of the travel further"
    lines = [
        f"  - name: {joint.name}",
        "    part: null",
        f"    kind: {'hinge' if joint.unit == 'rad' else 'slide'}",
        f"    lower: {_format_dimension(lower, f'smallest position or target {reach}')}",
        f"    upper: {_format_dimension(upper, f'largest position or target {reach}')}",
        f"    home: {home}   # {joint.unit}; middle of the range",
        f"    max_speed: {_format_dimension(speed, f'fastest motion in its logs, {joint.unit}/s')}",
        "    body: null",
    ]
    if has_targets:
        lines.append("    command: position   # full commands are the ends of the travel")
    elif joint.kind == "velocity" and joint.speed_scale is not None:
        lines.append("    command: velocity")
    elif joint.kind == "torque":
        full = scale_command(joint, survey).full_plus
        force = "Nm" if joint.unit == "rad" else "N"
        lines += [
            "    command: torque",
            f"    # {MISSING}: {force} at full command, which is {full:g} of '{joint.command}'",
            f"    max_force: {{value: {QUOTED_MISSING}, "
            'source: "given by hand", confidence: medium}',
        ]
    return lines


def _format_dimension(value: float | None, source: str) -> str:
    shown = QUOTED_MISSING if value is None else f"{value:g}"
    return f"{{value: {shown}, source: {_quote(source)}, confidence: low}}"


def _explain(guess: Guess) -> str:
    """Return a guess as a comment of one line."""
    others = f"; candidates: {guess.value}, {', '.join(guess.others)}" if guess.others else ""
    shown = f" ({guess.value})" if guess.sureness == "unsure" and not guess.others else ""
    return f"{guess.sureness}{shown}: {guess.reason}{others}".replace("\n", " ")


def _quote(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\t", "\\t") + '"'


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
        signals = draft.samples[draft.best[joint.name]].signals
        command, position = signals.read(joint.command), signals.read(joint.position)
        begin_s = min(command.t_s[0], position.t_s[0])
        axis.plot(position.t_s - begin_s, position.values, color=BLUE, lw=1.2)
        is_same_unit = joint.kind == "position" and joint.target_scale == joint.scale
        other = axis if is_same_unit else axis.twinx()
        other.step(command.t_s - begin_s, command.values, color=ORANGE, lw=0.9, where="post")
        axis.set_ylabel(joint.position, color=BLUE, fontsize=7)
        if other is not axis:
            other.set_ylabel(joint.command, color=ORANGE, fontsize=7)
            other.spines["top"].set_visible(False)
        columns, kind = joint.guesses["columns"], joint.guesses["kind"]
        verb = "is " if joint.kind == "position" else ""
        title = f"{joint.name} ({columns.sureness}): {joint.command} {verb}{kind.value} ({kind.sureness}); {signals.run.name}"
        axis.set_title(title, loc="left", fontsize=8)
        remove_frame(axis)
    axes[-1].set_xlabel("s")
    return figure
