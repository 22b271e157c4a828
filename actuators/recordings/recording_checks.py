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
from typing import Any

import numpy as np

from actuators.recordings.inspection import (
    FINDINGS,
    FindingKind,
    InspectionThresholds,
    RecordingFinding,
    Severity,
    inspect_recording,
)
from actuators.recordings.interlocks import Interlock, find_interlock
from actuators.scales import choose_horizon_s
from brokk_rl.commands import read_targets, view_recordings
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, find_stretches

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


REMARKS = FINDINGS | {
    "interlock": FindingKind(
        "bad",
        "the joint ignores its command whenever that condition holds: a lock that is not logged",
        "log the lock as a command of 0, or leave these stretches out",
    ),
    "irregular clock": FindingKind(
        "warn",
        "rows are not equally spaced in time",
        "stamp rows where they are measured, not where they are written",
    ),
    "clock jumps": FindingKind(
        "warn", "single periods are much longer than the others", "record frame counters"
    ),
    "clock rate": FindingKind(
        "note",
        "the clock runs faster or slower than the stated rate",
        "state the true rate, or discipline the clock",
    ),
    "saturated sensor": FindingKind(
        "bad",
        "the sensor stays at one end of its range, away from the joint's stops: it cannot say more, or a stop is nearer than known",
        "check the sensor's range and the machine's limits",
    ),
    "joint at rest": FindingKind(
        "note",
        "hardly commanded here: nothing can be said about this joint",
        "record runs that move it",
    ),
}
"""All remarks: findings in single recordings, and what only whole recordings show."""


def examine_recordings(
    recordings: Sequence[Recording], machine: Machine, thresholds: InspectionThresholds
) -> list[RecordingRemark]:
    """Return all remarks about recordings of `machine`, the most severe first."""
    inspected = []
    for one, seen in zip(recordings, view_recordings(recordings, machine), strict=True):
        targets = find_targets(one, machine)
        inspected.append((seen, inspect_recording(seen, machine, thresholds, targets).findings))
    recordings = [recording for recording, _ in inspected]
    remarks: list[RecordingRemark] = []
    locked = set()
    for j, name in enumerate(machine.joint_names):
        lock = find_interlock(inspected, machine, j, thresholds)
        if lock is not None:
            locked.add(name)
            remarks += _report_interlock(lock, recordings)
    for recording, findings in inspected:
        left = [f for f in findings if f.kind != "command without motion" or f.joint not in locked]
        remarks += _group_findings(recording, left, machine)
        remarks += _check_clock(recording)
        remarks += _check_saturation(recording, machine, thresholds)
    remarks += _check_excitation(recordings, machine, thresholds)
    order = ("bad", "warn", "note")
    return sorted(
        remarks,
        key=lambda one: (order.index(one.severity), one.name, one.joint or "", one.recording),
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
    kind = REMARKS[name]
    where = recording if isinstance(recording, str) else name_recording(recording)
    begin_s, end_s = map(float, span_s)
    return RecordingRemark(
        name, kind.severity, joint, where, begin_s, end_s, count, amount, kind.meaning, kind.advice, share
    )  # fmt: skip


def _group_findings(
    recording: Recording, findings: Sequence[RecordingFinding], machine: Machine
) -> Iterator[RecordingRemark]:
    """Yield one remark for all stretches of one kind and joint."""

    def key(finding: RecordingFinding) -> tuple[str, str]:
        return finding.kind, finding.joint or ""

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
    t_s, period_s = recording.t_s, np.diff(recording.t_s)
    median_s = float(np.median(period_s))
    is_odd = np.abs(period_s / median_s - 1.0) > 0.1
    late = np.flatnonzero(period_s > JUMP_PERIODS * median_s)
    if is_odd.mean() > MAX_IRREGULAR_SHARE:
        low, high = np.percentile(period_s, (5, 95)) * 1e3
        text = f"periods of {low:.1f} to {high:.1f} ms (5 to 95 %), median {median_s * 1e3:.1f} ms"
        span_s = t_s[0], t_s[-1]
        yield _make_remark("irregular clock", None, recording, span_s, int(is_odd.sum()), text)
    elif len(late):
        text = f"up to {period_s.max() * 1e3:.1f} ms, median {median_s * 1e3:.1f} ms"
        span_s = t_s[late[0]], t_s[late[-1] + 1]
        yield _make_remark("clock jumps", None, recording, span_s, len(late), text)
    mean_s = (t_s[-1] - t_s[0]) / len(period_s)
    ppm = 1e6 * (mean_s * recording.rate_hz - 1.0)
    if abs(ppm) > MAX_CLOCK_PPM:
        text = f"{ppm:+.0f} ppm: {1.0 / mean_s:.3f} Hz, stated {recording.rate_hz:g} Hz"
        yield _make_remark("clock rate", None, recording, (t_s[0], t_s[-1]), 1, text)


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
