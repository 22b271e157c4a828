"""Drafts of a column map and of a machine file, made of guesses; each line says what it rests on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from actuators.recordings.clock_guess import Guess, TimeGuess
from actuators.recordings.column_guess import JointGuess
from actuators.recordings.log_files import Damaged
from actuators.recordings.log_survey import JointSurvey, LogSurvey
from actuators.recordings.text_log import CsvLayout

MAP = "actuators.recordings.column_map"
MISSING = "???"
"""A value that a person must give; the configuration refuses to run without it."""
QUOTED_MISSING = f'"{MISSING}"'
"""The same within braces, where YAML takes a bare question mark for something else."""
HIGHEST_RATE_HZ = 100.0
"""Rate of a machine made from a faster log: joints of arms and machines show nothing beyond."""
SHORTEST_S = 5.0
"""Shortest piece of a log, s: one free run of the diagnosis."""
GAP_PERIODS = 4
"""Periods without a sample that split a log; loggers without real time skip up to two."""
UNSURE_SPARE = 0.1
"""Part of the travel that is added at its ends where the unit of the targets was fitted; by hand."""
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
        layout: Signs of CSV files.
        dbc: DBC file of logs of a CAN bus.
        damaged: What is done about damaged parts.
        remarks: Further remarks.
    """

    name: str
    times: Mapping[str, TimeGuess]
    joints: Sequence[JointGuess]
    survey: LogSurvey
    layout: CsvLayout
    dbc: str | None
    damaged: Damaged
    remarks: Sequence[str]

    @property
    def has_targets(self) -> bool:
        """True if all joints are commanded by position; a machine is commanded by one quantity."""
        return all(joint.kind == "target" for joint in self.joints)

    def list_guesses(self) -> list[Guess]:
        """Return all guesses, those of the clocks first."""
        found = [time.guess for time in self.times.values()]
        for joint in self.joints:
            found += joint.guesses.values()
            if joint.kind != "target":
                found.append(scale_command(joint, self.survey.joints[joint.name]).guess)
        return found


def scale_command(joint: JointGuess, survey: JointSurvey) -> CommandDraft:
    """Return neutral and full commands of a joint whose command sets its speed, or a force."""
    low, high = survey.lowest_command, survey.highest_command
    subject = f"{joint.name}: full command"
    if joint.kind == "torque":  # a joint at rest may be held by a force, so 0 is neutral
        full = max(abs(low), abs(high))
        guess = Guess(subject, f"-{full:.6g} to {full:.6g}", "likely", "the largest command of the logs, both ways")  # fmt: skip
        return CommandDraft(0.0, full, -full, guess)
    is_unit = -1.001 <= low < -0.5 and 0.5 < high <= 1.001
    if is_unit:
        neutral, low, high = 0.0, -1.0, 1.0
        guess = Guess(
            subject, "-1 to 1", "sure", f"commands lie within -1 and 1, at rest {survey.rest:g}"
        )
    else:
        is_known = survey.rest_share >= REST_SHARE and low <= survey.rest <= high
        neutral = survey.rest if is_known else 0.0
        reason = (
            f"neutral {neutral:.6g} is the command of {survey.rest_share:.0%} of the rows, all at rest; full commands are the "
            "largest of the logs"
        )
        sureness = "likely"
        if not is_known and not low <= 0.0 <= high:
            sureness, reason = "unsure", "no command is frequent at rest, and none is 0"
        elif not is_known:
            reason = "neutral 0: no command is frequent at rest; full commands are the largest of the logs"
        if neutral == 0.0 and joint.speed_scale is not None:  # a speed counts alike both ways
            low, high = (
                (-max(-low, high) if low < 0.0 else low),
                (max(-low, high) if high > 0.0 else high),
            )
        guess = Guess(subject, f"{low:.6g} to {high:.6g}, neutral {neutral:.6g}", sureness, reason)
    above = high if high > neutral + 1e-9 * max(1.0, abs(neutral)) else None
    below = low if low < neutral - 1e-9 * max(1.0, abs(neutral)) else None
    if above is None or below is None:
        guess = Guess(subject, guess.value, guess.sureness, f"{guess.reason}; commands go one way only")  # fmt: skip
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
        f"delimiter: {_quote(draft.layout.delimiter)}   # of CSV files only",
        f"decimal: {_quote(draft.layout.decimal)}",
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
    lines += [
        "optional: {}",
        "overrun: 0.001        # of full command; rounding",
        f"longest_gap_s: {_round_up(GAP_PERIODS * period_s):g}   # s; {GAP_PERIODS} periods of {period_s:.4g} s",
        f"shortest_s: {SHORTEST_S:g}         # s; shorter ones hold no free run worth judging",
        f"damaged: {draft.damaged}       # skip: leave damaged rows, messages, chunks and frames out",
    ]
    if draft.dbc is not None:
        head, body = lines[:3], [f"  {line}" for line in lines[3:]]
        lines = [
            *head,
            f"_target_: {MAP}.CanColumnMap",
            f"dbc: {_quote(draft.dbc)}",
            "columns:",
            *body,
        ]
    return "\n".join(lines) + "\n"


def _format_time(time: TimeGuess) -> str:
    column = MISSING if time.guess.sureness == "unsure" else time.column
    if time.anchor is not None:
        anchor = f"{{_target_: {MAP}.Column, column: {_quote(time.anchor)}, scale: 1.0, offset: {time.offset_s!r}}}"
        text = f"{{_target_: {MAP}.AlignedTime, column: {_quote(column)}, scale: {time.scale!r}, anchor: {anchor}}}"
    else:
        text = f"{{_target_: {MAP}.Column, column: {_quote(column)}, scale: {time.scale!r}, offset: {time.offset_s!r}}}"
    return f"{text}   # {_explain(time.guess)}"


def _format_joint(joint: JointGuess, survey: JointSurvey, has_targets: bool) -> list[str]:
    columns, kind, unit = (joint.guesses[key] for key in ("columns", "kind", "unit"))
    is_unsure = columns.sureness == "unsure"
    command = MISSING if is_unsure else joint.command
    position = MISSING if is_unsure else joint.position
    scale = QUOTED_MISSING if unit.sureness == "unsure" else repr(joint.scale)
    lines = [
        f"  {joint.name}:   # {_explain(columns)}",
        f"    _target_: {MAP}.JointColumns",
        f"    # command: {_explain(kind)}",
    ]
    if kind.sureness == "unsure":
        lines.append(f"    command: {QUOTED_MISSING}")
    elif joint.kind == "target":
        target_scale = repr(joint.target_scale) if scale != QUOTED_MISSING else scale
        offset, remark = "", f"{joint.unit} for one of the log; a target is the command itself"
        if (target := joint.guesses.get("target")) is not None:
            target_scale, offset = QUOTED_MISSING, f", offset: {QUOTED_MISSING}"
            remark = f"{_explain(target)}"
        speed = "null"
        if not has_targets:
            speed = f"{measure_full_speed(joint, survey):g}" if target_scale != QUOTED_MISSING else QUOTED_MISSING  # fmt: skip
            remark += f"; full_speed in {joint.unit}/s is the fastest target of the logs"
        lines.append(
            f"    command: {{_target_: {MAP}.TargetColumn, column: {_quote(command)}, scale: {target_scale}, "
            f"full_speed: {speed}{offset}}}   # {remark}"
        )
    else:
        full = scale_command(joint, survey)
        numbers = [QUOTED_MISSING] * 3
        if full.guess.sureness != "unsure":
            numbers = ["null" if v is None else repr(v) for v in (full.neutral, full.full_plus, full.full_minus)]  # fmt: skip
        lines += [
            f"    # {_explain(full.guess)}",
            f"    command: {{_target_: {MAP}.CommandColumn, column: {_quote(command)}, neutral: {numbers[0]}, "
            f"full_plus: {numbers[1]}, full_minus: {numbers[2]}}}",
        ]
    lines.append(
        f"    position: {{_target_: {MAP}.Column, column: {_quote(position)}, scale: {scale}, offset: 0.0}}"
        f"   # {joint.unit} for one of the log; {_explain(unit)}"
    )
    return lines


def measure_full_speed(joint: JointGuess, survey: JointSurvey) -> float:
    """Return the speed at full command, rad/s or m/s: of the fastest target, else of the fastest motion."""
    if joint.kind == "target":
        return _round_up(abs(joint.target_scale) * survey.top_target_speed)
    full = scale_command(joint, survey)
    if joint.kind == "speed" and joint.speed_scale is not None and full.neutral == 0.0:
        return joint.speed_scale * max(abs(full.full_plus or 0.0), abs(full.full_minus or 0.0))
    return _round_up(joint.scale * survey.top_speed)


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
        survey = draft.survey.joints[joint.name]
        low, high = joint.scale * survey.lowest, joint.scale * survey.highest
        if joint.kind == "target":
            for target in (survey.lowest_command, survey.highest_command):
                position = joint.target_scale * target + joint.target_offset
                low, high = min(low, position), max(high, position)
            if "target" in joint.guesses:  # its line is a fit, and the true one may reach further
                spare = UNSURE_SPARE * (high - low)
                low, high = low - spare, high + spare
        speed = measure_full_speed(joint, survey)
        unit = f"{joint.unit}/s"
        is_known = joint.guesses["unit"].sureness != "unsure"
        home = f"{(low + high) / 2:.3f}" if is_known else QUOTED_MISSING
        low, high = math.floor(1000 * low) / 1000, math.ceil(1000 * high) / 1000
        if not is_known:
            low = high = speed = None
        lines += [
            "  - _target_: brokk_rl.machine.Joint",
            f"    name: {joint.name}",
            "    part: null",
            f"    kind: {'hinge' if joint.unit == 'rad' else 'slide'}",
            f"    lower: {_format_dimension(low, 'smallest position or target in its logs')}",
            f"    upper: {_format_dimension(high, 'largest position or target in its logs')}",
            f"    home: {home}   # {joint.unit}; middle of the range",
            f"    max_speed: {_format_dimension(speed, f'fastest target or motion in its logs, {unit}')}",
            "    body: null",
        ]
        if draft.has_targets:
            lines.append("    command: position   # full commands are the ends of the travel")
        elif joint.kind == "torque":
            full = scale_command(joint, survey).full_plus
            force = "Nm" if joint.unit == "rad" else "N"
            lines += [
                "    command: torque",
                f"    # {MISSING}: {force} at full command, which is {full:g} of '{joint.command}'",
                f"    max_force: {{_target_: brokk_rl.machine.Dimension, value: {QUOTED_MISSING}, "
                'source: "given by hand", confidence: medium}',
            ]
    return "\n".join(lines) + "\n"


def _format_dimension(value: float | None, source: str) -> str:
    shown = QUOTED_MISSING if value is None else f"{value:g}"
    return f"{{_target_: brokk_rl.machine.Dimension, value: {shown}, source: {_quote(source)}, confidence: low}}"


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
