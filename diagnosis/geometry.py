"""Errors of geometry and encoders, from measured tool points and forward kinematics alone.

No simulator takes part, so the actuators do not matter. `find_geometry_errors` compares sets of errors
by least squares: the errors are small, so their effects add up.
Axes: `S` samples, `J` joints, `D` coordinates of all samples (`S` times 3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from actuators.models.linear import Hold
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.answer import Estimate
from diagnosis.case import GapCase
from diagnosis.effect_library import DetectedEffect, EffectType

TOOL_COLUMNS = ("ee_x_m", "ee_y_m", "ee_z_m")
MIN_SECONDS = 40
"""Least time with measured tool points, s; chosen by hand."""
NUM_ROUNDS = 3
"""Rounds of linearisation: about no error, then about the errors of the round before. Chosen by
hand."""
MAX_ERRORS = 3
"""Most errors in a set: all sets are compared, and their number grows with this power."""
DIFFERENCE_STEP = 0.2
"""Step of the finite difference, of the typical size; the rounds correct the curvature."""
MIN_NOISE_M = 3e-4
"""Smallest noise of a tool point, m: chosen by hand, no instrument outdoors is better."""
MIN_SIZE = 0.3
"""Smallest size, over the typical one, that is named; chosen by hand: trackers see millimetres
below the accuracy of any drawing or zero."""

MIN_RATIO = 1.0
"""Least displacement by an error of geometry, over that of tool points on the reference (both root
mean square per coordinate): an error below the instruments' own is no cause of a gap. On 120
answers from practice plants of other making, this drops every link length that is named without
being off, and no error that is there."""


@dataclass(frozen=True)
class SetFit:
    """Least-squares fit of a set of errors.

    Attributes:
        gain: Gain in log likelihood.
        sizes: Size of each parameter, as a difference from neutral, `(P,)`.
        covariance: Of the sizes, `(P, P)`.
    """

    gain: float
    sizes: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class _GeometryError:
    """One error: an effect on one joint or of the whole machine; `columns` `(D, P)` per unit."""

    kind: EffectType
    joint: int | None
    names: tuple[str, ...]
    columns: np.ndarray


def is_tracked(recordings: Sequence[Recording], machine: Machine) -> bool:
    """Return whether there are enough measured tool points, of a machine with known geometry."""
    if not machine.has_bodies:
        return False
    given = [
        np.isfinite(np.stack([r.extra[column] for column in TOOL_COLUMNS])).all(0).sum() / r.rate_hz
        for r in recordings
        if _is_measured(r)
    ]
    return sum(given) >= MIN_SECONDS


def find_geometry_errors(
    case: GapCase, kinds: Sequence[EffectType], price: float, name_price: float
) -> list[DetectedEffect]:
    """Return the errors of geometry and encoders that the measured tool points show."""
    field, reference, machine = case.field, case.reference, case.machine
    if not is_tracked(field, machine):
        return []
    kinds = [
        k
        for k in kinds
        if not k.target.stochastic
        and k.target.smooth
        and k.target.side in ("kinematics", "measurement")
    ]
    q, off, ways = _measure_errors(field, machine)
    causes = _list_errors(kinds, q, ways, machine)
    everything = np.concatenate([cause.columns for cause in causes], 1)
    left = off - everything @ np.linalg.lstsq(everything, off, rcond=1e-9)[0]
    size_m = max(MIN_NOISE_M, float(np.std(left)))
    if is_tracked(reference, machine):
        size_m = max(size_m, float(np.std(_measure_errors(reference, machine)[1])))
    straight, chosen = off, ()
    for _ in range(NUM_ROUNDS):  # errors act linearly about the sizes of the round before
        fits, worth = _score_sets(causes, straight, size_m, price, name_price)
        before, chosen = chosen, max(worth, key=worth.__getitem__)
        if chosen in ((), before):
            break
        values = _split(causes, chosen, fits[chosen].sizes)
        bent = [
            _compute_nonlinearity(causes[c], own, q, machine)
            for c, own in zip(chosen, values, strict=True)
        ]
        straight = off - _remove_timing(np.sum(bent, 0), ways)
    large = _select_relevant(causes, chosen, fits, size_m, len(off))
    names = dict.fromkeys(causes[c].kind.name for c in large)
    return [_describe_effect(name, large, causes, fits, worth, machine) for name in names]


def _select_relevant(
    causes: Sequence[_GeometryError],
    chosen: tuple[int, ...],
    fits: Mapping[tuple[int, ...], SetFit],
    size_m: float,
    count: int,
) -> tuple[int, ...]:
    """Return those of the errors `chosen` that matter: large, and beyond what instruments err by.

    Args:
        causes: All errors.
        chosen: Places of the errors that were chosen together.
        fits: Fits of all sets of errors.
        size_m: Noise of tool points for which gains were computed, m; an error explains as much
            beside the others.
        count: Coordinates, `D`.
    """
    relevant = []
    if not chosen:
        return ()
    for c, own in zip(chosen, _split(causes, chosen, fits[chosen].sizes), strict=True):
        rest = tuple(one for one in chosen if one != c)
        gain = fits[chosen].gain - fits[rest].gain
        # undoes the scale of `_fit`: a gain is a sum of squares over 2 * 3 * size_m ** 2
        explained_m = np.sqrt(max(gain, 0.0) * 6.0 * size_m**2 / count)
        if _measure_size(causes[c], own) >= MIN_SIZE and explained_m >= MIN_RATIO * size_m:
            relevant.append(c)
    return tuple(relevant)


def _score_sets(
    causes: Sequence[_GeometryError],
    off: np.ndarray,
    size_m: float,
    price: float,
    name_price: float,
) -> tuple[dict[tuple[int, ...], SetFit], dict[tuple[int, ...], float]]:
    """Return the fits of all sets of errors, and their gains less the penalties."""
    fits: dict[tuple[int, ...], SetFit] = {(): SetFit(0.0, np.zeros(0), np.zeros((0, 0)))}
    worth: dict[tuple[int, ...], float] = {(): 0.0}
    for count in range(1, MAX_ERRORS + 1):
        for chosen in combinations(range(len(causes)), count):
            fits[chosen] = _fit([causes[c] for c in chosen], off, size_m)
            names = {causes[c].kind.name for c in chosen}
            worth[chosen] = fits[chosen].gain - price * count - name_price * len(names)
    return fits, worth


def _describe_effect(
    name: str,
    best: tuple[int, ...],
    causes: Sequence[_GeometryError],
    fits: Mapping[tuple[int, ...], SetFit],
    worth: Mapping[tuple[int, ...], float],
    machine: Machine,
) -> DetectedEffect:
    gain, values, covariance = fits[best].gain, fits[best].sizes, fits[best].covariance
    deviation, parameters, mask, place = (
        np.sqrt(np.diag(covariance)),
        {},
        np.zeros(machine.num_joints, dtype=bool),
        0,
    )
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
    own = gain - fits[rest].gain
    without = max(
        value for chosen, value in worth.items() if not any(causes[c].kind is kind for c in chosen)
    )
    closed = float(np.clip(own / max(gain, 1e-9), 0.0, 1.0))
    return DetectedEffect(kind, mask, parameters, worth[best] - without, own, closed)


def _list_errors(
    kinds: Sequence[EffectType], q: np.ndarray, ways: np.ndarray, machine: Machine
) -> list[_GeometryError]:
    """Return the errors that move the tool point at all, other than along the ways that it goes."""
    plain, found = _compute_tool_points(None, {}, q, machine), []
    for kind in kinds:
        joined = all(not kind.numbers[name].per_joint for name in kind.fitted)
        for joint in [None] if joined else range(machine.num_joints):
            columns = []
            for name in kind.fitted:
                step = DIFFERENCE_STEP * kind.size_on(name, joint)
                moved = (
                    _compute_tool_points(
                        kind,
                        {name: _shift_from_neutral(kind, name, joint, step, machine)},
                        q,
                        machine,
                    )
                    - plain
                )
                columns.append(_remove_timing(moved.ravel() / step, ways))
            column = np.stack(columns, 1)
            if np.abs(column).max() > 1e-6:
                found.append(_GeometryError(kind, joint, kind.fitted, column))
    return found


def _shift_from_neutral(
    kind: EffectType, name: str, joint: int | None, by: float, machine: Machine
) -> np.ndarray:
    """Return a parameter `by` above neutral on one joint or on all, `(J,)` or `(1,)`."""
    value = np.full(
        machine.num_joints if kind.numbers[name].per_joint else 1,
        kind.numbers[name].none,
        dtype=float,
    )
    value[slice(None) if joint is None else joint] += by
    return value


def _compute_nonlinearity(
    cause: _GeometryError, values: np.ndarray, q: np.ndarray, machine: Machine
) -> np.ndarray:
    """Return the displacement by an error beyond the linear one, `(D,)`."""
    given = {
        n: _shift_from_neutral(cause.kind, n, cause.joint, value, machine)
        for n, value in zip(cause.names, values, strict=True)
    }
    steps = {n: DIFFERENCE_STEP * cause.kind.size_on(n, cause.joint) for n in cause.names}
    small = [
        _compute_tool_points(
            cause.kind,
            {n: _shift_from_neutral(cause.kind, n, cause.joint, by, machine)},
            q,
            machine,
        )
        for n, by in steps.items()
    ]
    plain = _compute_tool_points(None, {}, q, machine)
    line = sum(
        (
            value / by * (one - plain)
            for value, by, one in zip(values, steps.values(), small, strict=True)
        ),
        np.zeros(()),
    )
    return (_compute_tool_points(cause.kind, given, q, machine) - plain - line).ravel()


def _remove_timing(off: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return errors `(D,)` without their part along the ways `(D, 2)` that the tool point goes.

    Instruments beside the machine have a clock of their own: a period between them and the encoders
    moves the tool by centimetres.
    """
    return off - ways @ np.linalg.lstsq(ways, off, rcond=1e-9)[0]


def _fit(causes: Sequence[_GeometryError], off: np.ndarray, size_m: float) -> SetFit:
    """Fit a set of errors by least squares with a normal prior."""
    x = np.concatenate([cause.columns for cause in causes], 1)
    unit = np.concatenate(
        [[abs(one.kind.size_on(name, one.joint)) for name in one.names] for one in causes]
    )
    # instruments err together for a while: a sample a second counts as a third of one
    normal = x.T @ x / size_m**2 / 3.0 + np.diag(1.0 / (3.0 * unit) ** 2)
    covariance = np.linalg.inv(normal)
    values = covariance @ (x.T @ off) / size_m**2 / 3.0
    left = off - x @ values
    gain = float((off @ off - left @ left) / 2.0 / size_m**2 / 3.0)
    return SetFit(gain, values, covariance)


def _split(
    causes: Sequence[_GeometryError], chosen: Sequence[int], values: np.ndarray
) -> list[np.ndarray]:
    return np.split(values, np.cumsum([len(causes[c].names) for c in chosen])[:-1])


def _measure_size(cause: _GeometryError, values: np.ndarray) -> float:
    return max(
        abs(value / cause.kind.size_on(name, cause.joint))
        for name, value in zip(cause.names, values, strict=True)
    )


def _measure_errors(
    recordings: Sequence[Recording], machine: Machine
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions `(S, J)`, errors of the tool points `(D,)`, and how they travel `(D, 2)`, once a second.

    Errors along the way that the tool goes are left out.
    """
    having = [r for r in recordings if _is_measured(r)]
    every = max(1, round(having[0].rate_hz))
    q, errors, ways = [], [], []
    for recording in having:
        seen = np.stack([recording.extra[column] for column in TOOL_COLUMNS], 1)[::every]
        points = _compute_tool_points(None, {}, recording.q, machine)
        step = np.diff(points, axis=0)
        none = np.zeros((1, 3))
        way = np.stack([np.concatenate([none, step]), np.concatenate([step, none])], -1)
        given = np.isfinite(seen).all(1)
        q.append(recording.q[::every][given].astype(float))
        errors.append((seen - points[::every])[given])
        ways.append(way[::every][given])
    both = np.concatenate(ways).reshape(-1, 2)
    return np.concatenate(q), _remove_timing(np.concatenate(errors).ravel(), both), both


def _is_measured(recording: Recording) -> bool:
    return all(column in recording.extra for column in TOOL_COLUMNS)


def _compute_tool_points(
    kind: EffectType | None, values: Mapping[str, np.ndarray], q: np.ndarray, machine: Machine
) -> np.ndarray:
    """Return where the tool point is at measured positions, with an effect or none, `(S, 3)`."""
    at, device = torch.as_tensor(q, dtype=torch.float32), torch.device("cpu")
    kinematics = Kinematics(machine, device)
    if kind is None:
        return kinematics.pose(at).tip_in_base_m.numpy().astype(float)
    model = kind.wrap(Hold(), machine, len(q), device)
    for name, value in values.items():
        model.parameters[name].copy_(torch.as_tensor(value, dtype=torch.float32))
    true = model.truth(at)
    return model.tool(kinematics.pose(true).tip_in_base_m, true).numpy().astype(float)
