"""Whether recordings can be trusted, before any physics: clocks, lost frames, interlocks, sensors, and joints that nobody moved.

What a single stretch shows is found by `brokk_rl.inspection`; here stretches of one kind become one
remark a recording, those that share a condition an interlock, and what only a whole recording shows
(clock, saturation, excitation) is added.
Axes: `T` time, `J` joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any, Literal

import numpy as np

from brokk_rl.inspection import InspectionThresholds, RecordingFinding, inspect_recording
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, find_stretches
from diagnosis.interlock import Interlock, interlock

Severity = Literal["note", "warn", "bad"]
IRREGULAR = 0.05
"""Of the periods further than 10 % from the median, as a part of all, above which a clock is
irregular."""
JUMP_PERIODS = 1.15
"""A period so many times the median is a jump; the format refuses those beyond 1.2."""
CLOCK_PPM = 2000.0
"""Largest deviation of the clock's rate from the stated one; 1e-5 to 4e-3 is what loggers show."""
AT_EXTREME = 10
"""So many equal samples on end at the very end of what a sensor ever says, away from the joint's
stops, are no coincidence."""
THIN_S = 10.0
"""A joint commanded for less says nothing about itself."""


@dataclass(frozen=True)
class Remark:
    """Something about a recording that a person should know before believing what follows from it.

    Attributes:
        name: What it is.
        severity: `bad`: conclusions about this joint are likely wrong; `warn`: they may be; `note`:
            good to know.
        joint: Joint concerned, `None` where it is all of them.
        recording: Its file's stem or run.
        from_s: Begin of the first stretch.
        to_s: End of the last one.
        count: Number of stretches.
        amount: How much, with its unit.
        meaning: What it may come from.
        advice: What to do.
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

    def plain(self) -> dict[str, Any]:
        """Returns it as plain JSON data."""
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
    "motion without command": (
        "warn",
        "the load sinks (a leak), or the joint was moved by something that is not logged",
        "log every input; a slow sinking towards the load is the effect 'creep'",
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
NAMES = {
    "no motion": "command without motion",
    "no command": "motion without command",
    "frozen": "frozen sensor",
    "repeated rows": "lost frames",
    "beyond limit": "beyond limit",
    "exclusive": "exclusive joint",
}
"""What `brokk_rl.inspection` calls them."""


def examine(
    recordings: Sequence[Recording], machine: Machine, thresholds: InspectionThresholds
) -> list[Remark]:
    """Returns what is to be said about recordings of `machine`, the gravest first."""
    inspected = [
        (recording, inspect_recording(recording, machine, thresholds).findings)
        for recording in recordings
    ]
    locks = list(
        filter(
            None, (interlock(inspected, machine, j, thresholds) for j in range(machine.num_joints))
        )
    )
    remarks = [remark for lock in locks for remark in _locked(lock, recordings)]
    locked = {lock.joint for lock in locks}
    for recording, findings in inspected:
        rest = [f for f in findings if not (f.kind == "no motion" and f.joint in locked)]
        remarks += [
            *_grouped(recording, rest),
            *_clock(recording),
            *_saturated(recording, machine, thresholds),
        ]
    remarks += _at_rest(recordings, machine, thresholds)
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


def name_of(recording: Recording) -> str:
    """Returns how a recording is called in a report: by its file, else by its run."""
    return recording.path.stem if recording.path else recording.run


def _remark(
    name: str,
    joint: str | None,
    recording: Recording | str,
    span_s: tuple[float | np.ndarray, float | np.ndarray],
    count: int,
    amount: str,
) -> Remark:
    severity, meaning, advice = TEXTS[name]
    where = recording if isinstance(recording, str) else name_of(recording)
    return Remark(
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
    )


def _grouped(recording: Recording, findings: Sequence[RecordingFinding]) -> Iterator[Remark]:
    """Yields one remark for all stretches of one kind and joint."""

    def key(finding: RecordingFinding) -> tuple[str, str]:
        return finding.kind, finding.joint or ""

    for (kind, joint), group in groupby(sorted(findings, key=key), key):
        some = sorted(group, key=lambda finding: finding.row)
        seconds = sum(finding.num_rows for finding in some) / recording.rate_hz
        part = seconds / max(recording.duration_s, 1.0 / recording.rate_hz)
        text = f"{some[0].text}; {seconds:.1f} s in all, {100 * part:.1f} % of the recording"
        span_s = some[0].t_s, some[-1].t_s + some[-1].duration_s
        yield _remark(NAMES[kind], joint or None, recording, span_s, len(some), text)


def _locked(lock: Interlock, recordings: Sequence[Recording]) -> Iterator[Remark]:
    for number, recording in enumerate(recordings):
        rows = lock.rows[number]
        if len(rows):
            span_s = recording.t_s[rows[0]], recording.t_s[rows[-1]]
            yield _remark(
                "interlock", lock.joint, recording, span_s, lock.num_stretches[number], lock.text
            )


def _clock(recording: Recording) -> Iterator[Remark]:
    period_s = np.diff(recording.t_s)
    median_s = float(np.median(period_s))
    whole = recording.t_s[0], recording.t_s[-1]
    odd = np.abs(period_s / median_s - 1.0)
    if (odd > 0.1).mean() > IRREGULAR:
        low, high = np.percentile(period_s, (5, 95)) * 1e3
        text = f"periods of {low:.1f} to {high:.1f} ms (5 to 95 %), median {median_s * 1e3:.1f} ms"
        yield _remark("irregular clock", None, recording, whole, int((odd > 0.1).sum()), text)
    elif len(late := np.flatnonzero(period_s > JUMP_PERIODS * median_s)):
        text = f"up to {period_s.max() * 1e3:.1f} ms, median {median_s * 1e3:.1f} ms"
        yield _remark(
            "clock jumps",
            None,
            recording,
            (recording.t_s[late[0]], recording.t_s[late[-1] + 1]),
            len(late),
            text,
        )
    mean_s = (recording.t_s[-1] - recording.t_s[0]) / len(period_s)
    ppm = 1e6 * (mean_s * recording.rate_hz - 1.0)
    if abs(ppm) > CLOCK_PPM:
        yield _remark(
            "clock rate",
            None,
            recording,
            whole,
            1,
            f"{ppm:+.0f} ppm: {1.0 / mean_s:.3f} Hz, stated {recording.rate_hz:g} Hz",
        )


def _saturated(
    recording: Recording, machine: Machine, thresholds: InspectionThresholds
) -> Iterator[Remark]:
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
            stuck = [run for run in find_stretches((q == extreme) & driven) if run[1] >= AT_EXTREME]
            if stuck:
                rows = sum(count for _, count in stuck)
                span_s = recording.t_s[stuck[0][0]], recording.t_s[sum(stuck[-1]) - 1]
                text = f"{rows} samples at {extreme:.4g} {recording.units[j]} while driven further"
                yield _remark("saturated sensor", name, recording, span_s, len(stuck), text)


def _at_rest(
    recordings: Sequence[Recording], machine: Machine, thresholds: InspectionThresholds
) -> Iterator[Remark]:
    if not recordings:
        return
    for j, name in enumerate(machine.joint_names):
        seconds = sum(
            float((np.abs(r.u[:, j]) > thresholds.commanded).sum()) / r.rate_hz for r in recordings
        )
        if seconds < THIN_S:
            total_s = sum(recording.duration_s for recording in recordings)
            text = f"commanded for {seconds:.1f} s of {total_s:.0f} s"
            yield _remark("joint at rest", name, "all recordings", (0.0, total_s), 1, text)
