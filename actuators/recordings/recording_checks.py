"""Remarks on recordings: findings of one kind on one joint together, locks, and joints at rest.

`inspection` finds stretches in single recordings. Stretches in which a joint ignores its commands under one
condition become a lock. Axes: `T` time, `J` joints.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from actuators.recordings.inspection import DRIVING, SETTLE_S, STILL, Inspection, inspect_recording
from actuators.recordings.split import COMMANDED, measure_commanded_s
from actuators.scales import choose_horizon_s
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

MIN_COMMANDED_RUNS = 2
"""Least time with a command, in free runs; chosen by hand."""
MIN_STRETCHES = 5
"""Least number of ignored stretches of a lock; chosen by hand: fewer may share a condition by coincidence."""
MIN_AGREEMENT = 0.9
"""A lock holds in at least this share of the ignored rows, and in at most the rest of the obeyed ones; chosen by hand."""
NUM_POSITIONS = 15
"""Positions of a joint that are tried as the edge of a lock; chosen by hand."""
Severity = Literal["note", "warn", "bad"]
ORDER: tuple[Severity, ...] = ("bad", "warn", "note")


@dataclass(frozen=True)
class FindingKind:
    """Severity, meaning and remedy of a kind of finding.

    Attributes:
        severity: `bad`: conclusions about this joint are likely wrong; `warn`: they may be; `note`: good to know.
        meaning: Possible causes.
        advice: The remedy.
    """

    severity: Severity
    meaning: str
    advice: str


REMARKS: dict[str, FindingKind] = {}
"""All kinds by name: findings in single recordings, and what only several of them show."""
for _name, _facts in yaml.safe_load(Path(__file__).with_name("remarks.yaml").read_text()).items():
    REMARKS[_name] = FindingKind(**_facts)


@dataclass(frozen=True)
class RecordingRemark:
    """A finding that limits the conclusions from a recording.

    Attributes:
        name: Kind of the finding, a key of `REMARKS`.
        joint: Joint concerned, `None` where it is all of them.
        recording: Its file's stem or run.
        from_s: Begin of the first stretch.
        to_s: End of the last one.
        count: Number of stretches.
        amount: How much, with its unit.
        share: Its time over that of the recording.
    """

    name: str
    joint: str | None
    recording: str
    from_s: float
    to_s: float
    count: int
    amount: str
    share: float = 0.0

    @property
    def kind(self) -> FindingKind:
        """Its severity, meaning and remedy."""
        return REMARKS[self.name]

    def plain(self) -> dict[str, Any]:
        """Return it as plain JSON data."""
        return asdict(self) | asdict(self.kind)


MOST_ROWS = 40
"""Rows of the table of remarks; a page of a terminal."""
IGNORED = "command without motion"


def examine_recordings(recordings: Sequence[Recording], machine: Machine) -> list[RecordingRemark]:
    """Return all remarks about recordings of `machine`, the most severe first."""
    inspections = [inspect_recording(one, machine) for one in recordings]
    return list_remarks(inspections, machine)


def list_remarks(inspections: Sequence[Inspection], machine: Machine) -> list[RecordingRemark]:
    """Return all remarks about inspected recordings of `machine`, the most severe first."""
    locks = {}
    for j, name in enumerate(machine.joint_names):
        if text := _find_lock(inspections, machine, j):
            locks[name] = text
    remarks = [*_check_excitation(inspections, machine)] if inspections else []
    for one in inspections:
        remarks += _group_findings(one, machine, locks)
    return sorted(
        remarks,
        key=lambda one: (ORDER.index(one.kind.severity), one.name, one.joint or "", one.recording),
    )


def tabulate_remarks(remarks: Sequence[RecordingRemark]) -> tuple[list[str], list[list[str]]]:
    """Return heading and cells of a table: the most severe remarks, without notes."""
    rows = []
    for one in remarks[:MOST_ROWS]:
        if one.kind.severity != "note":
            span = f"{one.from_s:.2f} to {one.to_s:.2f} s"
            rows.append([one.name, one.joint or "all", one.recording, span, one.amount])
    return ["remark", "joint", "run", "when", "what"], rows


def name_recording(recording: Recording) -> str:
    """Return how a recording is called in a report: by its file, else by its run."""
    return recording.path.stem if recording.path else recording.run


def _group_findings(
    inspection: Inspection, machine: Machine, locks: dict[str, str]
) -> Iterator[RecordingRemark]:
    """Yield one remark for all stretches of one kind and joint."""
    recording = inspection.recording
    groups = defaultdict(list)
    for finding in inspection.findings:
        groups[finding.kind, finding.joint].append(finding)
    for (name, joint), some in groups.items():
        seconds = sum(finding.num_rows for finding in some) / recording.rate_hz
        part = seconds / max(recording.duration_s, 1.0 / recording.rate_hz)
        if name == "jumps":  # each spoils the free run that it lies in
            part = min(1.0, len(some) * choose_horizon_s(machine) / max(recording.duration_s, 1e-9))
        text = f"{some[0].text}; {seconds:.1f} s in all, {100 * part:.1f} % of the recording"
        if name == IGNORED and joint in locks:
            name, text = "interlock", locks[joint]
        span_s = some[0].t_s, some[-1].t_s + some[-1].duration_s
        where = name_recording(recording)
        yield RecordingRemark(name, joint, where, *span_s, len(some), text, part)


def _find_lock(inspections: Sequence[Inspection], machine: Machine, joint: int) -> str | None:
    """Return the condition that separates ignored commands of a joint from obeyed ones, as text, or `None`."""
    name = machine.joint_names[joint]
    lead = round((machine.dead_time_s + SETTLE_S) / machine.period_s)
    ignored, obeyed, count = [], [], 0
    for inspection in inspections:
        recording = inspection.viewed
        is_ignored, near = np.zeros((2, recording.num_samples), dtype=bool)
        for finding in inspection.findings:
            if finding.kind == IGNORED and finding.joint == name:
                count += 1
                end = finding.row + finding.num_rows
                is_ignored[finding.row : end] = True
                near[max(0, finding.row - lead) : end + lead] = True
        is_driven = np.abs(recording.u[:, joint]) > DRIVING
        speed = np.gradient(recording.q[:, joint].astype(float)) * recording.rate_hz
        is_moving = np.abs(speed) > 2.0 * STILL * machine.max_speed[joint]
        ignored.append(is_ignored)
        obeyed.append(is_driven & is_moving & ~near)
    if count < MIN_STRETCHES:
        return None
    ignores, obeys = np.concatenate(ignored), np.concatenate(obeyed)
    if not obeys.any():
        return f"{name} ignores every command"
    u = np.concatenate([one.viewed.u for one in inspections])
    q = np.concatenate([one.viewed.q for one in inspections])
    best = (0.0, 1.0, "")
    for text, condition in _list_conditions(u, q, machine, joint):
        # a lock may stop the motion itself, or the command on its way
        for delay in (0, round(machine.dead_time_s / machine.period_s)):
            holds = np.roll(condition, delay)
            found = float(holds[ignores].mean()), float(holds[obeys].mean()), text
            best = max(best, found, key=lambda one: one[0] - one[1])
    if best[0] < MIN_AGREEMENT or best[1] > 1.0 - MIN_AGREEMENT:
        return None
    return (
        f"{name} ignores its command when {best[2]}: so in {100 * best[0]:.0f} % of the ignored and "
        f"{100 * best[1]:.0f} % of the obeyed time"
    )


def _list_conditions(
    u: np.ndarray, q: np.ndarray, machine: Machine, joint: int
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what may lock a joint, with the rows in which it holds, `(T,)`."""
    commanded = np.abs(u) > COMMANDED
    others = np.asarray(np.delete(commanded, joint, axis=1).any(1))
    yield "any other joint is commanded", others
    yield "no other joint is commanded", ~others
    yield "its command is positive", u[:, joint] > 0
    yield "its command is negative", u[:, joint] < 0
    for k, name in enumerate(machine.joint_names):
        if k != joint:
            yield f"{name} is commanded", commanded[:, k]
        for value in np.quantile(q[:, k], np.linspace(0.0, 1.0, NUM_POSITIONS + 2)[1:-1]):
            unit = machine.joints[k].unit
            yield f"{name} is above {value:.2f} {unit}", q[:, k] > value
            yield f"{name} is below {value:.2f} {unit}", q[:, k] < value


def _check_excitation(
    inspections: Sequence[Inspection], machine: Machine
) -> Iterator[RecordingRemark]:
    """Yield the joints that are hardly commanded."""
    viewed = [one.viewed for one in inspections]
    total_s = sum(one.duration_s for one in viewed)
    commanded_s = measure_commanded_s(viewed)
    for name, seconds in zip(machine.joint_names, commanded_s.tolist(), strict=True):
        if seconds < MIN_COMMANDED_RUNS * choose_horizon_s(machine):
            text = f"commanded for {seconds:.1f} s of {total_s:.0f} s"
            yield RecordingRemark("joint at rest", name, "all recordings", 0.0, total_s, 1, text)
