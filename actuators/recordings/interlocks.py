"""Interlocks: conditions under which a joint ignores its commands, found by what separates these stretches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from actuators.recordings.inspection import InspectionThresholds, RecordingFinding
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, find_stretches

MIN_STRETCHES = 5
"""Least number of ignored stretches; chosen by hand: fewer may share a condition by coincidence."""
MIN_AGREEMENT = 0.9
"""A condition holds in at least this share of the ignored time, and in at most the rest of the
obeyed time; chosen by hand."""
SPEED_ROWS = 3
"""Rows before and after a row that give its speed; chosen by hand: 0.3 s at 20 Hz."""
NUM_POSITIONS = 15
"""Positions of a joint that are tried as a threshold; chosen by hand."""


@dataclass(frozen=True)
class Interlock:
    """A condition under which a joint ignores its command.

    Attributes:
        joint: The joint.
        text: The condition, and how well it holds.
        rows: Ignored rows of each recording.
        num_stretches: Ignored stretches of each recording.
    """

    joint: str
    text: str
    rows: list[np.ndarray]
    num_stretches: list[int]


def find_interlock(
    inspected: Sequence[tuple[Recording, Sequence[RecordingFinding]]],
    machine: Machine,
    joint: int,
    thresholds: InspectionThresholds,
) -> Interlock | None:
    """Return the condition that separates ignored commands of a joint from obeyed ones, or `None`.

    Conditions tried: another joint is commanded, none is, the command's own sign, a joint is beyond
    a position.
    """
    name = machine.joint_names[joint]
    lead = round((machine.dead_time_s + thresholds.settle_s) / machine.period_s)
    ignored, driven, rows, counts = [], [], [], []
    for recording, findings in inspected:
        mask, held = np.zeros((2, recording.num_samples), dtype=bool)
        mine = [
            finding
            for finding in findings
            if finding.kind == "command without motion" and finding.joint == name
        ]
        for finding in mine:
            mask[finding.row : finding.row + finding.num_rows] = True
        for row, count in find_stretches(np.abs(recording.u[:, joint]) > thresholds.driving):
            held[row + lead : row + count] = True
        speed = (
            (
                np.roll(recording.q[:, joint], -SPEED_ROWS)
                - np.roll(recording.q[:, joint], SPEED_ROWS)
            )
            * recording.rate_hz
            / (2 * SPEED_ROWS)
        )
        held &= np.abs(speed) > 2.0 * thresholds.still * machine.max_speed[joint]
        ignored.append(mask)
        driven.append(held)
        rows.append(np.flatnonzero(mask))
        counts.append(len(mine))
    if sum(counts) < MIN_STRETCHES:
        return None
    ignores, holds = np.concatenate(ignored), np.concatenate(driven)
    obeys = holds & ~_dilate(ignores, lead)
    if not obeys.any():
        return Interlock(name, f"{name} ignores every command", rows, counts)
    u = np.concatenate([recording.u for recording, _ in inspected])
    q = np.concatenate([recording.q for recording, _ in inspected])
    best = 0.0, 1.0, ""
    for text, condition in _list_conditions(u, q, machine, joint, thresholds):
        for delay_s in (
            0.0,
            machine.dead_time_s,
        ):  # a lock may stop the motion itself, or the command on its way
            found = _measure_agreement(
                np.roll(condition, round(delay_s / machine.period_s)),
                ignores,
                obeys,
                thresholds,
                machine,
            )
            best = max(best, (*found, text), key=lambda row: row[0] - row[1])
    if best[0] < MIN_AGREEMENT or best[1] > 1.0 - MIN_AGREEMENT:
        return None
    of_ignored, of_obeyed = (f"{100 * share:.0f} %" for share in best[:2])
    text = f"{name} ignores its command when {best[2]}: so in {of_ignored} of the ignored and {of_obeyed} of the obeyed time"
    return Interlock(name, text, rows, counts)


def _measure_agreement(
    condition: np.ndarray,
    ignores: np.ndarray,
    obeys: np.ndarray,
    thresholds: InspectionThresholds,
    machine: Machine,
) -> tuple[float, float]:
    """Return the shares of ignored and of obeyed time in which a steady condition holds."""
    steady = ~_dilate(
        np.append(False, np.diff(condition)), round(thresholds.settle_s / machine.period_s)
    )
    either = steady & ignores, steady & obeys
    if min(mask.sum() for mask in either) < MIN_STRETCHES:
        return 0.0, 1.0
    return float(condition[either[0]].mean()), float(condition[either[1]].mean())


def _list_conditions(
    u: np.ndarray, q: np.ndarray, machine: Machine, joint: int, thresholds: InspectionThresholds
) -> Iterator[tuple[str, np.ndarray]]:
    commanded = np.abs(u) > thresholds.commanded
    others = np.delete(commanded, joint, axis=1)
    yield "any other joint is commanded", np.asarray(others.any(1))
    yield "no other joint is commanded", ~np.asarray(others.any(1))
    for k, name in enumerate(machine.joint_names):
        if k != joint:
            yield f"{name} is commanded", commanded[:, k]
        for value in np.quantile(q[:, k], np.linspace(0.0, 1.0, NUM_POSITIONS + 2)[1:-1]):
            unit = machine.joints[k].unit
            yield f"{name} is above {value:.2f} {unit}", q[:, k] > value
            yield f"{name} is below {value:.2f} {unit}", q[:, k] < value
    yield "its command is positive", u[:, joint] > 0
    yield "its command is negative", u[:, joint] < 0


def _dilate(mask: np.ndarray, num_rows: int) -> np.ndarray:
    """Return the rows within `num_rows` of the mask, `(T,)`: there the answer may still come."""
    return np.convolve(mask, np.ones(2 * num_rows + 1), mode="same") > 0.5
