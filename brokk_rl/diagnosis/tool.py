"""Errors of geometry and of encoders, by measured tool points: no simulator takes part, only forward kinematics.

The errors are small, so their doings add up: sets of them are compared by least squares.
Axes: `S` samples (one a second), `J` joints, `D` coordinates of all samples, `S` times 3.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from brokk_rl.diagnosis.answer import Estimate
from brokk_rl.diagnosis.case import Case
from brokk_rl.diagnosis.found import Found
from brokk_rl.diagnosis.library import Kind, Still
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

COLUMNS = ("ee_x_m", "ee_y_m", "ee_z_m")
FEWEST = 40
MOST = 3
"""Errors in a set."""
STEP = 0.2
"""Finite difference, of the typical size."""
LEAST_M = 3e-4
"""No instrument is better."""
LEAST = 0.15
"""Smallest size, over the typical one, that is worth naming."""


Fit = tuple[float, np.ndarray, np.ndarray]
"""What a set of errors earns, their numbers, and the covariance of these."""


@dataclass(frozen=True)
class _Cause:
    """One error: an effect on one joint, or of the whole machine; `columns` `(D, P)` per unit of `names`."""

    kind: Kind
    joint: int | None
    names: tuple[str, ...]
    columns: np.ndarray


def is_tracked(recordings: Sequence[Recording], machine: Machine) -> bool:
    """Says whether the recordings hold enough measured tool points of a machine whose geometry is known."""
    return machine.has_bodies and len(_samples(recordings)[0]) >= FEWEST


@dataclass(frozen=True)
class Seen:
    """What measured tool points show.

    Attributes:
        found: Errors of geometry and encoders.
        left: Root mean square of what they leave over that of the reference; 1 where nothing is measured.
    """

    found: Sequence[Found]
    left: float


def search(case: Case, kinds: Sequence[Kind], price: float, name_price: float) -> Seen:
    """Returns the errors of geometry and encoders that the measured tool points of the field show; none where there are none."""
    field, reference, machine = case.field, case.reference, case.machine
    if not is_tracked(field, machine):
        return Seen([], 1.0)
    kinds = [k for k in kinds if not k.target.stochastic and k.target.smooth and k.target.side in ("kinematics", "measurement")]
    q, seen = _samples(field)
    off = (seen - _points(None, {}, q, machine)).ravel()
    causes = _causes(kinds, q, machine)
    size_m = LEAST_M
    if is_tracked(reference, machine):
        at, known = _samples(reference)
        size_m = max(size_m, float(np.std(known - _points(None, {}, at, machine))))
    else:
        everything = np.concatenate([cause.columns for cause in causes], 1)
        size_m = max(size_m, float(np.std(off - everything @ np.linalg.lstsq(everything, off, rcond=1e-9)[0])))
    fits: dict[tuple[int, ...], Fit] = {(): (0.0, np.zeros(0), np.zeros((0, 0)))}
    worth: dict[tuple[int, ...], float] = {(): 0.0}
    for count in range(1, MOST + 1):
        for chosen in combinations(range(len(causes)), count):
            fits[chosen] = _fit([causes[c] for c in chosen], off, size_m)
            names = {causes[c].kind.name for c in chosen}
            split = zip(chosen, _split(causes, chosen, fits[chosen][1]), strict=True)
            large = all(_size(causes[c], part) >= LEAST for c, part in split)
            worth[chosen] = fits[chosen][0] - price * count - name_price * len(names) if large else -np.inf
    best = max(worth, key=worth.__getitem__)
    names = dict.fromkeys(causes[c].kind.name for c in best)
    left = np.sqrt(max(off @ off - 6.0 * size_m**2 * fits[best][0], 0.0) / len(off)) / size_m
    return Seen([_found(name, best, causes, fits, worth, machine) for name in names], float(left))


def _found(
    name: str,
    best: tuple[int, ...],
    causes: Sequence[_Cause],
    fits: Mapping[tuple[int, ...], Fit],
    worth: Mapping[tuple[int, ...], float],
    machine: Machine,
) -> Found:
    gain, values, covariance = fits[best]
    deviation, parameters, mask, place = np.sqrt(np.diag(covariance)), {}, np.zeros(machine.num_joints, dtype=bool), 0
    kind = next(causes[c].kind for c in best if causes[c].kind.name == name)
    for c in best:
        cause = causes[c]
        for number in cause.names:
            if cause.kind is kind:
                mean, half = kind.numbers[number].none + values[place], 1.96 * deviation[place]
                joint = "machine" if cause.joint is None else machine.joint_names[cause.joint]
                estimate = Estimate(float(mean), (float(mean - half), float(mean + half)))
                parameters.setdefault(number, {})[joint] = estimate
                mask[slice(None) if cause.joint is None else cause.joint] = True
            place += 1
    mine = tuple(c for c in best if causes[c].kind is kind)
    rest = tuple(c for c in best if c not in mine)
    own = gain - fits[rest][0]
    rivals = {}
    for c, cause in enumerate(causes):
        swapped = tuple(sorted({*rest, c}))
        if cause.kind is not kind and swapped in fits:
            rivals[cause.kind.name] = max(rivals.get(cause.kind.name, -np.inf), fits[swapped][0] - fits[rest][0])
    without = max(value for chosen, value in worth.items() if not any(causes[c].kind is kind for c in chosen))
    closed = float(np.clip(own / max(gain, 1e-9), 0.0, 1.0))
    return Found(kind, mask, parameters, worth[best] - without, own, closed, rivals)


def _causes(kinds: Sequence[Kind], q: np.ndarray, machine: Machine) -> list[_Cause]:
    """Returns the errors that move the tool point at all."""
    plain, found = _points(None, {}, q, machine), []
    for kind in kinds:
        joined = all(not kind.numbers[name].per_joint for name in kind.fitted)
        for joint in [None] if joined else range(machine.num_joints):
            columns = []
            for name in kind.fitted:
                step = STEP * kind.size(name)
                value = np.full(machine.num_joints if kind.numbers[name].per_joint else 1, kind.numbers[name].none, dtype=float)
                value[slice(None) if joint is None else joint] += step
                columns.append((_points(kind, {name: value}, q, machine) - plain).ravel() / step)
            column = np.stack(columns, 1)
            if np.abs(column).max() > 1e-6:
                found.append(_Cause(kind, joint, kind.fitted, column))
    return found


def _fit(causes: Sequence[_Cause], off: np.ndarray, size_m: float) -> Fit:
    """Returns what a set of errors earns, their numbers (as differences from neutral), and their covariance."""
    x = np.concatenate([cause.columns for cause in causes], 1)
    unit = np.concatenate([[abs(cause.kind.size(name)) for name in cause.names] for cause in causes])
    # instruments err together for a while: a sample a second counts as a third of one
    normal = x.T @ x / size_m**2 / 3.0 + np.diag(1.0 / (3.0 * unit) ** 2)
    covariance = np.linalg.inv(normal)
    values = covariance @ (x.T @ off) / size_m**2 / 3.0
    left = off - x @ values
    return float((off @ off - left @ left) / 2.0 / size_m**2 / 3.0), values, covariance


def _split(causes: Sequence[_Cause], chosen: Sequence[int], values: np.ndarray) -> list[np.ndarray]:
    return np.split(values, np.cumsum([len(causes[c].names) for c in chosen])[:-1])


def _size(cause: _Cause, values: np.ndarray) -> float:
    return max(abs(value / cause.kind.size(name)) for name, value in zip(cause.names, values, strict=True))


def _samples(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and measured tool points, about one a second."""
    having = [r for r in recordings if all(column in r.extra for column in COLUMNS)]
    if not having:
        return np.zeros((0, 0)), np.zeros((0, 3))
    every = max(1, round(having[0].rate_hz))
    seen = np.concatenate([np.stack([r.extra[column] for column in COLUMNS], 1)[::every] for r in having]).astype(float)
    q = np.concatenate([r.q[::every] for r in having]).astype(float)
    given = np.isfinite(seen).all(1)
    return q[given], seen[given]


def _points(kind: Kind | None, values: Mapping[str, np.ndarray], q: np.ndarray, machine: Machine) -> np.ndarray:
    """Returns where the tool point is at measured positions, with an effect or none, `(S, 3)`."""
    at, device = torch.as_tensor(q, dtype=torch.float32), torch.device("cpu")
    kinematics = Kinematics(machine, device)
    if kind is None:
        return kinematics.pose(at).tip_in_base_m.numpy().astype(float)
    model = kind.wrap(Still(), machine, len(q), device)
    for name, value in values.items():
        model.parameters[name].copy_(torch.as_tensor(value, dtype=torch.float32))
    true = model.truth(at)
    return model.tool(kinematics.pose(true).tip_in_base_m, true).numpy().astype(float)
