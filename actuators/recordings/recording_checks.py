"""Checks of recordings before any physics: clocks, lost frames, interlocks, sensors, idle joints.

`inspection` finds single stretches. This module merges stretches of one kind into one
remark a recording, and stretches that share a condition into an interlock. It adds the checks that
need a whole recording: clock, saturation, excitation.
Axes: `T` time, `J` joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any, Literal

import numpy as np

from actuators.recordings.inspection import (
    InspectionThresholds,
    RecordingFinding,
    inspect_recording,
)
from actuators.recordings.interlocks import SPEED_ROWS, Interlock, find_interlock
from actuators.scales import choose_horizon_s
from brokk_rl.commands import read_targets, view_recordings
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, find_stretches

FAST_SHARE = 0.2
"""Speed, of full speed, from which motion without command is no sinking load but an input that is
not logged. The effect `creep` sinks at a few percent; chosen by hand."""

Severity = Literal["note", "warn", "bad"]
MAX_IRREGULAR_SHARE = 0.05
"""Share of periods further than 10 % from the median from which a clock is irregular; chosen by
hand."""
JUMP_PERIODS = 1.15
"""Period over the median that counts as a jump; the format of recordings refuses 1.2."""
MAX_CLOCK_PPM = 2000.0
"""Largest deviation of the clock's rate from the stated one, ppm; chosen by hand: loggers are off
by 10 to 4000."""
MIN_SATURATED_ROWS = 10
"""Least number of consecutive samples at the extreme of a sensor, away from the stops, that count
as saturation; chosen by hand: half a second at 20 Hz."""
MIN_COMMANDED_RUNS = 2
"""Least time with a command, in free runs; chosen by hand."""


@dataclass(frozen=True)
class RecordingRemark:
    """A finding that limits the conclusions from a recording.

    Attributes:
        name: Kind of the finding.
        severity: `bad`: conclusions about this joint are likely wrong; `warn`: they may be; `note`:
            good to know.
        joint: Joint concerned, `None` where it is all of them.
        recording: Its file's stem or run.
        from_s: Begin of the first stretch.
        to_s: End of the last one.
        count: Number of stretches.
        amount: How much, with its unit.
        meaning: Possible causes.
        advice: The remedy.
        share: Its time over that of the recording.
    """

    name: str
    severity: Severity
    joint: str | None
    recording: str
    from_s: float
    to_s: float
    count: int
    amount: str
    meaning: str
    advice: str
    share: float = 0.0

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return asdict(self)


TEXTS: dict[str, tuple[Severity, str, str]] = {
    "command without motion": (
        "warn",
        "a dead band wider than expected, an interlock or dead-man that is not logged, or a load too heavy",
        "log the interlocks; leave these stretches out if the machine was not allowed to move",
    ),
    "interlock": (
        "bad",
        "the joint ignores its command whenever that condition holds: a lock that is not logged",
        "log the lock as a command of 0, or leave these stretches out",
    ),
    "does not obey": (
        "bad",
        "the joint stays away from its target: its drive is off or blocked, or too weak for the load",
        "leave these stretches out, or log the enable signal and use the parts in which the drive is on",
    ),
    "jumps": (
        "bad",
        "the position steps by more than a machine moves: an angle or a counter that wraps, a sign bit, a reset, or two sources",
        "import again with log.wraps, or leave the other source out; no model can follow these steps",
    ),
    "motion without command": (
        "warn",
        "the load sinks (a leak), or the joint was moved by something that is not logged",
        "log every input; a slow sinking towards the load is the effect 'creep'",
    ),
    "unlogged input": (
        "bad",
        "the joint moves at a working speed without command: something moves it that is not logged",
        "log every input that moves the machine: levers, a second operator, automatic functions",
    ),
    "frozen sensor": (
        "warn",
        "the sensor did not measure for a while, then jumped",
        "check sensor and cable; the motion is real",
    ),
    "lost frames": (
        "note",
        "rows repeat the row before although the machine moves: positions were lost on their way",
        "record frame counters; small rates are the effect 'frame_loss' or a slow sensor",
    ),
    "beyond limit": (
        "warn",
        "measured beyond the limits of the machine's file",
        "measure the end stops; correct the machine's file",
    ),
    "exclusive joint": (
        "bad",
        "an exclusive joint is commanded together with others, which the machine forbids: one of both is not carried out",
        "record what was really sent",
    ),
    "irregular clock": (
        "warn",
        "rows are not equally spaced in time",
        "stamp rows where they are measured, not where they are written",
    ),
    "clock jumps": (
        "warn",
        "single periods are much longer than the others",
        "record frame counters",
    ),
    "clock rate": (
        "note",
        "the clock runs faster or slower than the stated rate",
        "state the true rate, or discipline the clock",
    ),
    "saturated sensor": (
        "bad",
        "the sensor stays at one end of its range, away from the joint's stops: it cannot say more, or a stop is nearer than known",
        "check the sensor's range and the machine's limits",
    ),
    "joint at rest": (
        "note",
        "hardly commanded here: nothing can be said about this joint",
        "record runs that move it",
    ),
}
"""Severity, meaning and advice of each remark."""
FINDING_NAMES = {
    "no motion": "command without motion",
    "not obeyed": "does not obey",
    "jump": "jumps",
    "no command": "motion without command",
    "frozen": "frozen sensor",
    "repeated rows": "lost frames",
    "beyond limit": "beyond limit",
    "exclusive": "exclusive joint",
}
"""Name of a remark by kind of finding in `actuators.recordings.inspection`."""


def examine_recordings(
    recordings: Sequence[Recording], machine: Machine, thresholds: InspectionThresholds
) -> list[RecordingRemark]:
    """Return all remarks about recordings of `machine`, the most severe first."""
    inspected = [
        (seen, inspect_recording(seen, machine, thresholds, find_targets(one, machine)).findings)
        for one, seen in zip(recordings, view_recordings(recordings, machine), strict=True)
    ]
    recordings = [recording for recording, _ in inspected]
    locks = list(
        filter(
            None,
            (find_interlock(inspected, machine, j, thresholds) for j in range(machine.num_joints)),
        )
    )
    remarks = [remark for lock in locks for remark in _report_interlock(lock, recordings)]
    locked = {lock.joint for lock in locks}
    for recording, findings in inspected:
        rest = [f for f in findings if not (f.kind == "no motion" and f.joint in locked)]
        remarks += [
            *_group_findings(recording, rest, machine),
            *_check_clock(recording),
            *_check_saturation(recording, machine, thresholds),
        ]
    remarks += _check_excitation(recordings, machine, thresholds)
    order = {"bad": 0, "warn": 1, "note": 2}
    return sorted(
        remarks,
        key=lambda remark: (
            order[remark.severity],
            remark.name,
            remark.joint or "",
            remark.recording,
        ),
    )


def find_targets(recording: Recording, machine: Machine) -> np.ndarray | None:
    """Return the targets of joints that are commanded by position, `(T, J)`, rad or m; `None` for others."""
    if machine.interface != "position":
        return None
    return read_targets(recording.u.astype(float), machine)


def name_recording(recording: Recording) -> str:
    """Return how a recording is called in a report: by its file, else by its run."""
    return recording.path.stem if recording.path else recording.run


def _make_remark(
    name: str,
    joint: str | None,
    recording: Recording | str,
    span_s: tuple[float | np.ndarray, float | np.ndarray],
    count: int,
    amount: str,
    share: float = 0.0,
) -> RecordingRemark:
    severity, meaning, advice = TEXTS[name]
    where = recording if isinstance(recording, str) else name_recording(recording)
    return RecordingRemark(
        name,
        severity,
        joint,
        where,
        float(span_s[0]),
        float(span_s[1]),
        count,
        amount,
        meaning,
        advice,
        share,
    )


def _name_finding(finding: RecordingFinding, recording: Recording, machine: Machine) -> str:
    """Return the name of the remark about a finding; fast motion without command has one of its own."""
    if finding.kind != "no command":
        return FINDING_NAMES[finding.kind]
    j = machine.joint_names.index(finding.joint or "")
    q = recording.q[finding.row : finding.row + finding.num_rows, j]
    ahead = 2 * SPEED_ROWS
    if len(q) <= ahead:
        return FINDING_NAMES[finding.kind]
    speed = np.abs(q[ahead:] - q[:-ahead]) * recording.rate_hz / ahead
    is_fast = np.quantile(speed, 0.9) > FAST_SHARE * machine.max_speed[j]
    return "unlogged input" if is_fast else FINDING_NAMES[finding.kind]


def _group_findings(
    recording: Recording, findings: Sequence[RecordingFinding], machine: Machine
) -> Iterator[RecordingRemark]:
    """Yield one remark for all stretches of one kind and joint."""

    def key(finding: RecordingFinding) -> tuple[str, str]:
        return _name_finding(finding, recording, machine), finding.joint or ""

    for (name, joint), group in groupby(sorted(findings, key=key), key):
        some = sorted(group, key=lambda finding: finding.row)
        seconds = sum(finding.num_rows for finding in some) / recording.rate_hz
        part = seconds / max(recording.duration_s, 1.0 / recording.rate_hz)
        if name == "jumps":  # each spoils the free run that it lies in
            part = min(1.0, len(some) * choose_horizon_s(machine) / max(recording.duration_s, 1e-9))
        text = f"{some[0].text}; {seconds:.1f} s in all, {100 * part:.1f} % of the recording"
        span_s = some[0].t_s, some[-1].t_s + some[-1].duration_s
        yield _make_remark(name, joint or None, recording, span_s, len(some), text, part)


def _report_interlock(
    lock: Interlock, recordings: Sequence[Recording]
) -> Iterator[RecordingRemark]:
    for number, recording in enumerate(recordings):
        rows = lock.rows[number]
        if len(rows):
            span_s = recording.t_s[rows[0]], recording.t_s[rows[-1]]
            share = len(rows) / recording.num_samples
            yield _make_remark(
                "interlock",
                lock.joint,
                recording,
                span_s,
                lock.num_stretches[number],
                lock.text,
                share,
            )


def _check_clock(recording: Recording) -> Iterator[RecordingRemark]:
    period_s = np.diff(recording.t_s)
    median_s = float(np.median(period_s))
    whole = recording.t_s[0], recording.t_s[-1]
    odd = np.abs(period_s / median_s - 1.0)
    if (odd > 0.1).mean() > MAX_IRREGULAR_SHARE:
        low, high = np.percentile(period_s, (5, 95)) * 1e3
        text = f"periods of {low:.1f} to {high:.1f} ms (5 to 95 %), median {median_s * 1e3:.1f} ms"
        yield _make_remark("irregular clock", None, recording, whole, int((odd > 0.1).sum()), text)
    elif len(late := np.flatnonzero(period_s > JUMP_PERIODS * median_s)):
        text = f"up to {period_s.max() * 1e3:.1f} ms, median {median_s * 1e3:.1f} ms"
        yield _make_remark(
            "clock jumps",
            None,
            recording,
            (recording.t_s[late[0]], recording.t_s[late[-1] + 1]),
            len(late),
            text,
        )
    mean_s = (recording.t_s[-1] - recording.t_s[0]) / len(period_s)
    ppm = 1e6 * (mean_s * recording.rate_hz - 1.0)
    if abs(ppm) > MAX_CLOCK_PPM:
        yield _make_remark(
            "clock rate",
            None,
            recording,
            whole,
            1,
            f"{ppm:+.0f} ppm: {1.0 / mean_s:.3f} Hz, stated {recording.rate_hz:g} Hz",
        )


def _check_saturation(
    recording: Recording, machine: Machine, thresholds: InspectionThresholds
) -> Iterator[RecordingRemark]:
    margin, back = (
        thresholds.at_limit * (machine.upper - machine.lower),
        round(machine.dead_time_s * recording.rate_hz),
    )
    for j, name in enumerate(recording.joints):
        q, acting = recording.q[:, j], np.roll(recording.u[:, j], back)
        if np.ptp(q) <= margin[j]:
            continue
        for extreme, outward in ((q.max(), 1.0), (q.min(), -1.0)):
            stop = machine.upper[j] if outward > 0 else machine.lower[j]
            if abs(stop - extreme) < margin[j]:
                continue
            driven = outward * acting > thresholds.driving
            stuck = [
                run
                for run in find_stretches((q == extreme) & driven)
                if run[1] >= MIN_SATURATED_ROWS
            ]
            if stuck:
                rows = sum(count for _, count in stuck)
                span_s = recording.t_s[stuck[0][0]], recording.t_s[sum(stuck[-1]) - 1]
                text = f"{rows} samples at {extreme:.4g} {recording.units[j]} while driven further"
                yield _make_remark("saturated sensor", name, recording, span_s, len(stuck), text)


def _check_excitation(
    recordings: Sequence[Recording], machine: Machine, thresholds: InspectionThresholds
) -> Iterator[RecordingRemark]:
    if not recordings:
        return
    for j, name in enumerate(machine.joint_names):
        seconds = sum(
            float((np.abs(r.u[:, j]) > thresholds.commanded).sum()) / r.rate_hz for r in recordings
        )
        if seconds < MIN_COMMANDED_RUNS * choose_horizon_s(machine):
            total_s = sum(recording.duration_s for recording in recordings)
            text = f"commanded for {seconds:.1f} s of {total_s:.0f} s"
            yield _make_remark("joint at rest", name, "all recordings", (0.0, total_s), 1, text)
