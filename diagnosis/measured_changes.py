"""Changes between two sets of recordings, measured joint by joint, whatever the cause.

Every quantity is measured in parts of the recordings. Their scatter, and what the machine repeats from day
to day, give the interval of a change. No simulator takes part. Efforts are optional columns: `current_q1_a`,
`torque_q1_nm`, `force_q1_n` or `pressure_q1_pa` of a joint `q1`.
Axes: `T` samples, `F` columns of the motion.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.ndimage import minimum_filter1d

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.case import number_days, select_rows

PART_S = 30.0
"""Length of the parts of recordings that are measured by themselves, s."""
MIN_RECORDINGS = 3
"""So many recordings stay whole."""
SPAN_S = 0.12
"""Time to either side over which a speed is taken, s."""
STEADY_S = 1.0
"""Time after which motion, or rest, counts as steady, s."""
MOVING = 0.05
"""Speed over the top speed above which a joint moves."""
RESTING = 0.01
"""Command below which a joint is to rest."""
LEAST_COMMAND = 0.3
"""Speeds are measured at commands above this, beyond a usual dead band."""
LEAST_SAMPLES = 10
"""Samples without which a part says nothing about a quantity."""
FALSE_DISCOVERY_RATE = 0.05
"""The usual level."""
EFFORT = re.compile(r"(current|torque|force|pressure)_(.+)_([a-z]+)")
UNITS = {"a": "A", "nm": "Nm", "n": "N", "pa": "Pa"}
"""Units as columns name them, and as they are written."""
STATES = {"moving out": 1.0, "moving in": -1.0, "at rest": 0.0}
"""Steady states of a joint, each with the sign of its motion."""


@dataclass(frozen=True)
class MeasuredChange:
    """Change of one quantity of one joint.

    Attributes:
        joint: The joint.
        quantity: What was measured, in words.
        unit: Its unit.
        before: Mean over the parts of the reference.
        change: Mean over the parts of the field less that.
        half_width: Half of its 95 % interval.
        is_beyond: It is beyond what the machine repeats, at most 5 % of such statements falsely.
    """

    joint: str
    quantity: str
    unit: str
    before: float
    change: float
    half_width: float
    is_beyond: bool = False


def measure_changes(
    reference: Sequence[Recording],
    field: Sequence[Recording],
    machine: Machine,
    repeatability: float,
) -> list[MeasuredChange]:
    """Return the changes of all quantities that both sides show.

    Args:
        reference: The machine as it was.
        field: The machine as it is.
        machine: The machine.
        repeatability: Standard deviation between days over the value, for a reference of one day.
    """
    laws = {}
    for name in _list_efforts(reference, field, machine):
        laws[name] = _EffortLaw(reference, name, machine)
    known, now = _cut_parts(reference), _cut_parts(field)
    before = [_measure_part(part, machine, laws) for part in known]
    after = [_measure_part(part, machine, laws) for part in now]
    day, found, chances = number_days(known), [], []
    for key in dict.fromkeys(key for part in before for key in part):
        then = np.array([part.get(key, np.nan) for part in before])
        later = np.array([part[key] for part in after if key in part])
        told = np.isfinite(then)
        if min(told.sum(), len(later)) < 2:
            continue
        mean = float(then[told].mean())
        between = repeatability * abs(mean)
        if len(np.unique(day[told])) > 1:
            days = [then[told & (day == one)].mean() for one in np.unique(day[told])]
            between = float(np.std(days, ddof=1))
        samples = (later, then[told])
        counts = np.array([len(sample) for sample in samples])
        squares = np.array([sample.var(ddof=1) for sample in samples]) / counts
        own = float(squares.sum())
        # Degrees of freedom of two means after Welch and Satterthwaite.
        freedom = own**2 / float((squares**2 / (counts - 1)).sum())
        error = float(np.sqrt(own + between**2))
        change = float(later.mean()) - mean
        half = float(stats.t.ppf(0.975, freedom)) * error
        found.append(MeasuredChange(*key, mean, change, half))
        chances.append(2.0 * stats.t.sf(abs(change) / max(error, 1e-12), freedom))
    # Of many quantities some would differ by chance.
    adjusted = stats.false_discovery_control(chances) if chances else []
    return [
        replace(one, is_beyond=bool(chance <= FALSE_DISCOVERY_RATE))
        for one, chance in zip(found, adjusted, strict=True)
    ]


def _list_efforts(
    reference: Sequence[Recording], field: Sequence[Recording], machine: Machine
) -> list[str]:
    """Return the columns of efforts of joints that all recordings have."""
    names = set.intersection(*(set(one.extra) for one in (*reference, *field)))
    found = []
    for name in sorted(names):
        told = EFFORT.fullmatch(name)
        if told is not None and told[2] in machine.joint_names:
            found.append(name)
    return found


def _cut_parts(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings; a few long ones in parts, which a motion that goes on makes alike."""
    found = []
    for one in recordings:
        count = max(1, round(one.duration_s / PART_S)) if len(recordings) < MIN_RECORDINGS else 1
        for rows in np.array_split(np.arange(one.num_samples), count):
            found.append(select_rows(one, rows))
    return found


def _measure_speed(q: np.ndarray, period_s: float) -> np.ndarray:
    """Return the speed over `SPAN_S` to either side of positions `(T,)`, `(T,)`."""
    span = max(1, round(SPAN_S / period_s))
    found = np.zeros(len(q))
    found[span:-span] = (q[2 * span :] - q[: -2 * span]) / (2.0 * span * period_s)
    return found


def _find_states(
    recording: Recording, machine: Machine, joint: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the speed of a joint over its top speed, `(T,)`, and where it is in each steady state, `(T,)` bool."""
    period_s, most = 1.0 / recording.rate_hz, machine.max_speed[joint]
    speed = _measure_speed(recording.q[:, joint].astype(float), period_s) / most
    asked = np.abs(recording.u[:, joint].astype(float))
    if machine.interface == "position":
        half = 0.5 * (machine.upper - machine.lower)[joint]
        asked = np.abs(_measure_speed(half * recording.u[:, joint], period_s)) / most
    steps = max(1, round(STEADY_S / period_s))
    masks = (speed > MOVING, speed < -MOVING, asked < RESTING)
    found = {}
    for name, mask in zip(STATES, masks, strict=True):
        # The minimum over the time before: the state has lasted since then.
        lasting = minimum_filter1d(mask.astype(np.uint8), steps, origin=(steps - 1) // 2)
        found[name] = lasting.astype(bool)
    return speed, found


class _EffortLaw:
    """Effort of a joint as a function of its steady motion on the reference."""

    def __init__(self, reference: Sequence[Recording], name: str, machine: Machine) -> None:
        kind, joint, unit = EFFORT.fullmatch(name).groups()  # pyright: ignore[reportOptionalMemberAccess]
        self.unit = UNITS.get(unit, unit)
        self.name, self.kind, self.machine = name, kind, machine
        self.joint = machine.joint_names.index(joint)
        q = np.concatenate([one.q[:, self.joint] for one in reference])
        self._reach = float(q.min()), float(q.max())
        columns = np.concatenate([self._describe(one) for one in reference])
        effort = np.concatenate([one.extra[name] for one in reference])
        # Starts and stops have laws of their own.
        direction = columns[:, 1]
        steady = np.isfinite(direction)
        self._law = np.linalg.lstsq(columns[steady], effort[steady], rcond=1e-9)[0]
        self.means = {}
        for state, sign in STATES.items():
            if (direction == sign).any():
                self.means[state] = float(effort[direction == sign].mean())

    def _describe(self, recording: Recording) -> np.ndarray:
        """Return direction, speed and place, `(T, F)`; NaN where the motion is not steady."""
        machine, j = self.machine, self.joint
        speed, states = _find_states(recording, machine, j)
        direction = np.full(len(speed), np.nan)
        for state, mask in states.items():
            direction[mask] = STATES[state]
        # Where the reference never was, the effort of the nearest place counts.
        place = np.clip(recording.q[:, j], *self._reach) / (machine.upper - machine.lower)[j]
        rows = [np.ones_like(speed), direction, np.abs(direction), speed, np.abs(speed)]
        rows += [place, place**2]
        return np.stack(rows, 1)

    def subtract(self, recording: Recording) -> np.ndarray:
        """Return the effort beyond that of the same motion on the reference, `(T,)`."""
        return recording.extra[self.name] - self._describe(recording) @ self._law


def shift_by_dead_time(u: np.ndarray, dead_time_s: float, period_s: float) -> np.ndarray:
    """Return the command that moved each joint before each row, `(T, J)`."""
    found = np.zeros(u.shape)
    back = round(dead_time_s / period_s) + 1  # row k - 1 is in force until row k is measured
    found[back:] = u[: max(0, len(u) - back)]
    return found


def _measure_part(
    part: Recording, machine: Machine, laws: Mapping[str, _EffortLaw]
) -> dict[tuple[str, str, str], float]:
    """Return the quantities that a part shows, by joint, words and unit."""
    period_s = 1.0 / part.rate_hz
    asked = shift_by_dead_time(part.u, machine.dead_time_s, period_s)
    found: dict[tuple[str, str, str], float] = {}
    for j, joint in enumerate(machine.joints):
        q = part.q[:, j].astype(float)
        speed, states = _find_states(part, machine, j)
        bend = np.diff(q, 2, prepend=q[0], append=q[-1])
        target = 0.5 * (machine.upper + machine.lower)[j]
        target = target + 0.5 * (machine.upper - machine.lower)[j] * part.u[:, j]
        for state, mask in states.items():
            if mask.sum() < LEAST_SAMPLES:
                continue
            told = {("roughness", joint.unit): float(np.sqrt(np.mean(bend[mask] ** 2)))}
            if machine.interface == "position":
                behind = (target - q)[mask]
                told["target less position", joint.unit] = float(behind.mean())
                told["scatter of target less position", joint.unit] = float(behind.std())
            commanded = mask & (np.abs(asked[:, j]) > LEAST_COMMAND)
            if machine.interface == "speed" and commanded.sum() > LEAST_SAMPLES:
                per_command = machine.max_speed[j] * speed[commanded] / asked[commanded, j]
                told["speed at full command", f"{joint.unit}/s"] = float(np.median(per_command))
            for law in laws.values():
                if law.joint == j and state in law.means:
                    beyond = law.subtract(part)[mask]
                    told[law.kind, law.unit] = law.means[state] + float(beyond.mean())
                    told[f"scatter of {law.kind}", law.unit] = float(beyond.std())
            for (quantity, unit), value in told.items():
                found[joint.name, f"{quantity}, {state}", unit] = value
    return found


def list_changes(changes: Sequence[MeasuredChange]) -> list[dict[str, Any]]:
    """Return the changes as plain JSON data, those beyond what the machine repeats first."""
    order = sorted(changes, key=lambda one: -abs(one.change) / max(one.half_width, 1e-12))
    return [asdict(one) for one in order]
