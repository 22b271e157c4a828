"""Residual features of a case, by joint: what a simple model of the reference leaves over in the field, weighed with probes.

The model: how far a joint gets in a quarter of a second, linear in pieces of its delayed commands
(Hammerstein). Each probe is what some effect would leave over; a feature is the slope of the
residual on a probe in the field less that in the reference, over how much that slope varies from
one minute of the reference to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from brokk_rl import record
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

STEP = 5
"""Samples over which a joint's way is predicted."""
LAGS = range(4, 18)
"""Delays of the commands that it depends on, samples."""
KNEES = (0.0, 0.1, 0.3, 0.6)
"""Commands where the slope of the flow curve may change, on both sides."""
BLOCK = 1200
"""Samples of a block of the reference."""
RIDGE = 1e-3
TOOL = ("ee_x_m", "ee_y_m", "ee_z_m")


def of_case(case: Path, machine: Machine) -> np.ndarray:
    """Returns the features of each joint of a case, `(J, F)`."""
    reference, field = (
        record.read_recordings(str(case / half / "*.parquet"), machine)
        for half in ("reference", "field")
    )
    rows = []
    for joint in range(machine.num_joints):
        inputs, ways = (
            np.concatenate(parts)
            for parts in zip(*(_pieces(one, joint) for one in reference), strict=True)
        )
        weights = np.linalg.solve(
            inputs.T @ inputs + RIDGE * len(inputs) * np.eye(inputs.shape[1]), inputs.T @ ways
        )
        there = [_slopes(one, joint, weights, machine) for one in reference]
        here = np.concatenate([_slopes(one, joint, weights, machine) for one in field])
        before = np.concatenate(there)
        rows.append((here.mean(0) - before.mean(0)) / (before.std(0) + 1e-6))
    own = np.clip(np.stack(rows), -50.0, 50.0)
    tool = _tool(field, machine) - _tool(reference, machine)
    others = np.stack([np.abs(np.delete(own, j, 0)).max(0) for j in range(machine.num_joints)])
    return np.concatenate(
        [own, others, np.tile(tool, (machine.num_joints, 1)), np.eye(machine.num_joints)], 1
    )


def _pieces(recording: Recording, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the inputs `(T, P)` and the way of the next `STEP` samples, `(T,)`."""
    u, q = recording.u[:, joint].astype(float), recording.q[:, joint].astype(float)
    curve = np.stack(
        [np.maximum(side * u - knee, 0.0) for knee in KNEES for side in (1.0, -1.0)], 1
    )
    count, first = len(u) - STEP - max(LAGS), max(LAGS)
    inputs = np.concatenate(
        [curve[first + STEP - lag : first + STEP - lag + count] for lag in LAGS], 1
    )
    return np.concatenate([inputs, np.ones((count, 1))], 1), q[
        first + STEP : first + STEP + count
    ] - q[first : first + count]


def _slopes(recording: Recording, joint: int, weights: np.ndarray, machine: Machine) -> np.ndarray:
    """Returns slopes of the residual on all probes and its own statistics in each block of a recording, `(B, F)`."""
    inputs, ways = _pieces(recording, joint)
    left, first = ways - inputs @ weights, max(LAGS)
    q, u = recording.q[first:].astype(float), recording.u.astype(float)
    late = np.stack(
        [u[first + STEP - lag : first + STEP - lag + len(left)] for lag in (7, 9, 11, 13)]
    )
    own, sign = late[1, :, joint], np.sign(late[1, :, joint])
    change = late[:, :, joint][0] - late[:, :, joint][3]
    others = np.abs(np.delete(late[1], joint, 1)).sum(1)
    angle = np.cumsum(q[: len(left), 1:], 1).T
    probes = [
        own, np.abs(own), sign * (np.abs(own) < 0.15), sign * (np.abs(own) > 0.75), sign * np.maximum(np.abs(own) - 0.5, 0.0),
        change, np.abs(change), sign * np.abs(change), own * others, sign * np.maximum(others + np.abs(own) - 1.0, 0.0),
        np.sign(change) * (np.abs(late[2, :, joint]) < 0.02), sign * (late[1, :, joint] * late[3, :, joint] < 0),
        own * np.arange(len(left)) / len(left), np.ones(len(left)), (np.abs(own) < 0.02) * np.cos(angle[min(joint, 3)]),
        *(np.abs(own) * np.cos(row) for row in angle), *(own * np.cos(row) for row in angle),
    ]  # fmt: skip
    design, found = np.stack(probes, 1), []
    jitter = np.diff(recording.q[first : first + len(left) + 2, joint].astype(float), 2)
    for begin in range(0, max(len(left) - BLOCK // 2, 1), BLOCK):
        part = slice(begin, begin + BLOCK)
        x, r = design[part], left[part]
        slopes = (x * r[:, None]).sum(0) / ((x * x).sum(0) + 1e-3 * len(x))
        centred = r - r.mean()
        power = float((centred**2).mean()) + 1e-12
        echoes = [
            float((centred[lag:] * centred[:-lag]).mean()) / power for lag in (1, 3, 5, 7, 10, 15)
        ]
        quiet = np.abs(np.diff(recording.q[first:, joint].astype(float)[part]))
        figures = [
            np.log(power),
            np.log((jitter[part] ** 2).mean() + 1e-12),
            float((quiet < 1e-6).mean()),
            _kurtosis(centred),
        ]
        found.append([*slopes, *echoes, *figures])
    return np.array(found)


def _kurtosis(values: np.ndarray) -> float:
    return float(np.log((values**4).mean() / ((values**2).mean() ** 2 + 1e-18) + 1e-9))


def _tool(recordings: Sequence[Recording], machine: Machine) -> np.ndarray:
    """Returns mean and spread of measured less computed tool point, and its slope on the angles, as one row; 0 without one."""
    offs, angles = [], []
    for one in recordings:
        if not all(name in one.extra for name in TOOL):
            return np.zeros(6 + 3 * machine.num_joints)
        seen = np.stack([one.extra[name] for name in TOOL], 1)
        offs.append(seen - Kinematics(machine).pose(torch.as_tensor(one.q)).tip_in_base_m.numpy())
        angles.append(one.q)
    off, q = np.concatenate(offs), np.concatenate(angles)
    slopes = np.linalg.lstsq(np.concatenate([q, np.ones((len(q), 1))], 1), off, rcond=None)[0][:-1]
    return np.concatenate([off.mean(0), off.std(0), slopes.ravel()])
