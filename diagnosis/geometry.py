"""Errors of geometry and encoders, from measured tool points and forward kinematics alone.

No simulator takes part, so the actuators do not matter. `find_geometry_errors` compares sets of errors
by linear least squares: the errors are small, so their effects add up. The sizes of the best set are then
fitted to the tool points of a machine that has them.
Axes: `S` samples, `J` joints, `D` coordinates of all samples (`S` times 3), `P` numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

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
"""Steps of Gauss and Newton by which the sizes of the best set are fitted. Chosen by hand."""
MAX_ERRORS = 3
"""Most errors in a set: all sets are compared, and their number grows with this power."""
DIFFERENCE_STEP = 0.2
"""Step of the finite difference, of the typical size."""
MIN_NOISE_M = 3e-4
"""Smallest noise of a tool point, m: chosen by hand, no instrument outdoors is better."""
MIN_SIZE = 0.3
"""Smallest size, over the typical one, that is named; chosen by hand: trackers see millimetres
below the accuracy of any drawing or zero."""


@dataclass(frozen=True)
class SetFit:
    """Least-squares fit of a set of errors.

    Attributes:
        gain: Gain in log likelihood.
        sizes: Size of each number, as a difference from neutral, `(P,)`.
        covariance: Of the sizes, `(P, P)`.
    """

    gain: float
    sizes: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class _GeometryNumber:
    """A number of an effect on one joint; `None`: of the whole machine."""

    kind: EffectType
    name: str
    joint: int | None

    @property
    def typical(self) -> float:
        """Its typical size, positive."""
        return abs(self.kind.size_on(self.name, self.joint))


@dataclass(frozen=True, eq=False)
class _GeometryError:
    """One error: the numbers of an effect on one joint or of the whole machine; `columns` `(D, P)` per unit."""

    numbers: tuple[_GeometryNumber, ...]
    columns: np.ndarray

    @property
    def kind(self) -> EffectType:
        """The effect."""
        return self.numbers[0].kind


def is_tracked(recordings: Sequence[Recording], machine: Machine) -> bool:
    """Return whether there are enough measured tool points, of a machine with known geometry."""
    if not machine.has_bodies:
        return False
    total_s = 0.0
    for one in recordings:
        if _is_measured(one):
            total_s += np.isfinite(_stack_tool_points(one)).all(1).sum() / one.rate_hz
    return total_s >= MIN_SECONDS


def find_geometry_errors(
    case: GapCase, kinds: Sequence[EffectType], price: float, name_price: float
) -> list[DetectedEffect]:
    """Return the errors of geometry and encoders that the measured tool points show."""
    machine = case.machine
    if not is_tracked(case.field, machine):
        return []
    field = _TrackedPoints(case.field, machine)
    causes = field.list_errors([kind for kind in kinds if _is_geometric(kind)])
    everything = np.concatenate([cause.columns for cause in causes], 1)
    left = field.off - everything @ np.linalg.lstsq(everything, field.off, rcond=1e-9)[0]
    size_m = max(MIN_NOISE_M, float(np.std(left)))
    if is_tracked(case.reference, machine):
        size_m = max(size_m, float(np.std(_TrackedPoints(case.reference, machine).off)))
    gains: dict[tuple[_GeometryError, ...], float] = {(): 0.0}
    worth = dict(gains)
    for count in range(1, MAX_ERRORS + 1):
        for some in combinations(causes, count):
            gains[some] = _fit_set(some, field.off, size_m).gain
            names = {cause.kind for cause in some}
            worth[some] = gains[some] - price * count - name_price * len(names)
    named = max(worth, key=worth.__getitem__)
    fit = field.refine(named, size_m)
    named = tuple(cause for cause in named if _is_large(cause, named, fit))
    fit = field.refine(named, size_m)
    found = []
    for kind in dict.fromkeys(cause.kind for cause in named):
        rest = tuple(cause for cause in named if cause.kind is not kind)
        gain = gains[named] - gains[rest]
        without = [w for some, w in worth.items() if all(one.kind is not kind for one in some)]
        joints, parameters = _describe_numbers(kind, named, fit, machine)
        net = worth[named] - max(without)
        found.append(DetectedEffect(kind, joints, parameters, net, gain))
    return found


def _is_large(cause: _GeometryError, named: Sequence[_GeometryError], fit: SetFit) -> bool:
    """Return whether an error of a fitted set is large enough to be named."""
    sizes = _select_sizes(cause, named, fit)[0]
    shares = [abs(size) / n.typical for size, n in zip(sizes, cause.numbers, strict=True)]
    return max(shares) >= MIN_SIZE


def _is_geometric(kind: EffectType) -> bool:
    sides = ("kinematics", "measurement")
    return kind.target.side in sides and kind.target.smooth and not kind.target.stochastic


def _select_sizes(
    cause: _GeometryError, named: Sequence[_GeometryError], fit: SetFit
) -> tuple[np.ndarray, np.ndarray]:
    """Return sizes and standard errors of one error of a fitted set, `(P,)` each."""
    place = named.index(cause)
    first = sum(len(one.numbers) for one in named[:place])
    rows = slice(first, first + len(cause.numbers))
    return fit.sizes[rows], np.sqrt(np.diag(fit.covariance))[rows]


def _describe_numbers(
    kind: EffectType, named: Sequence[_GeometryError], fit: SetFit, machine: Machine
) -> tuple[np.ndarray, dict[str, dict[str, Estimate]]]:
    """Return which joints have an effect, `(J,)` bool, and its numbers by name and joint or `machine`."""
    joints = np.zeros(machine.num_joints, dtype=bool)
    parameters: dict[str, dict[str, Estimate]] = {}
    for cause in named:
        if cause.kind is not kind:
            continue
        sizes, errors = _select_sizes(cause, named, fit)
        for number, size, error in zip(cause.numbers, sizes, errors, strict=True):
            mean, half = float(kind.numbers[number.name].none + size), 1.96 * float(error)
            joint = "machine" if number.joint is None else machine.joint_names[number.joint]
            own = parameters.setdefault(number.name, {})
            own[joint] = Estimate(mean, (mean - half, mean + half))
            joints[slice(None) if number.joint is None else number.joint] = True
    return joints, parameters


class _TrackedPoints:
    """Measured tool points, once a second, and those that forward kinematics gives.

    Instruments beside the machine have a clock of their own: a period between them and the encoders
    moves the tool by centimetres. Errors along the way that the tool point goes are therefore left out.

    Args:
        recordings: The recordings.
        machine: The machine.
    """

    def __init__(self, recordings: Sequence[Recording], machine: Machine) -> None:
        self.machine = machine
        having = [r for r in recordings if _is_measured(r)]
        every = max(1, round(having[0].rate_hz))
        q, errors, ways = [], [], []
        for recording in having:
            seen = _stack_tool_points(recording)[::every]
            points = _compute_tool_points({}, recording.q, machine)
            step = np.diff(points, axis=0)
            none = np.zeros((1, 3))
            way = np.stack([np.concatenate([none, step]), np.concatenate([step, none])], -1)
            given = np.isfinite(seen).all(1)
            q.append(recording.q[::every][given].astype(float))
            errors.append((seen - points[::every])[given])
            ways.append(way[::every][given])
        self._q = np.concatenate(q)
        self._ways = np.concatenate(ways).reshape(-1, 2)
        self._plain = _compute_tool_points({}, self._q, machine)
        self.off = self._remove_timing(np.concatenate(errors).ravel())
        """Errors of the tool points, `(D,)`, m."""

    def _remove_timing(self, off: np.ndarray) -> np.ndarray:
        return off - self._ways @ np.linalg.lstsq(self._ways, off, rcond=1e-9)[0]

    def _displace(self, numbers: Sequence[_GeometryNumber], sizes: np.ndarray) -> np.ndarray:
        """Return how far errors of these sizes move the tool points, `(D,)`."""
        effects: dict[EffectType, dict[str, np.ndarray]] = {}
        for number, size in zip(numbers, sizes, strict=True):
            kind, facts = number.kind, number.kind.numbers[number.name]
            count = self.machine.num_joints if facts.per_joint else 1
            values = effects.setdefault(kind, {})
            row = values.setdefault(number.name, np.full(count, facts.none, dtype=float))
            row[slice(None) if number.joint is None else number.joint] += size
        moved = _compute_tool_points(effects, self._q, self.machine) - self._plain
        return self._remove_timing(moved.ravel())

    def _differentiate(self, numbers: Sequence[_GeometryNumber], sizes: np.ndarray) -> np.ndarray:
        """Return the displacement per unit of each number around these sizes, `(D, P)`."""
        columns, before = [], self._displace(numbers, sizes)
        for place, number in enumerate(numbers):
            step = np.zeros(len(numbers))
            step[place] = DIFFERENCE_STEP * number.typical
            columns.append((self._displace(numbers, sizes + step) - before) / step[place])
        return np.stack(columns, 1)

    def list_errors(self, kinds: Sequence[EffectType]) -> list[_GeometryError]:
        """Return the errors that move the tool point at all, other than along the ways that it goes."""
        found = []
        for kind in kinds:
            is_joined = all(not kind.numbers[name].per_joint for name in kind.fitted)
            for joint in [None] if is_joined else range(self.machine.num_joints):
                numbers = tuple(_GeometryNumber(kind, name, joint) for name in kind.fitted)
                columns = self._differentiate(numbers, np.zeros(len(numbers)))
                if np.abs(columns).max() > 1e-6:
                    found.append(_GeometryError(numbers, columns))
        return found

    def refine(self, causes: Sequence[_GeometryError], size_m: float) -> SetFit:
        """Return the fit of a set of errors as they act on the machine, by Gauss's and Newton's method."""
        numbers = [number for cause in causes for number in cause.numbers]
        fit = SetFit(0.0, np.zeros(len(numbers)), np.zeros((len(numbers), len(numbers))))
        for _ in range(NUM_ROUNDS if numbers else 0):
            columns = self._differentiate(numbers, fit.sizes)
            straight = self.off - self._displace(numbers, fit.sizes) + columns @ fit.sizes
            fit = _solve(numbers, columns, straight, size_m)
        return fit


def _fit_set(causes: Sequence[_GeometryError], off: np.ndarray, size_m: float) -> SetFit:
    """Return the fit of a set of errors that act in proportion to their sizes."""
    numbers = [number for cause in causes for number in cause.numbers]
    return _solve(numbers, np.concatenate([cause.columns for cause in causes], 1), off, size_m)


def _solve(
    numbers: Sequence[_GeometryNumber], columns: np.ndarray, off: np.ndarray, size_m: float
) -> SetFit:
    """Return the sizes by least squares with a normal prior."""
    typical = np.array([number.typical for number in numbers])
    # Instruments err together for a while: a sample a second counts as a third of one.
    normal = columns.T @ columns / size_m**2 / 3.0 + np.diag(1.0 / (3.0 * typical) ** 2)
    covariance = np.linalg.inv(normal)
    sizes = covariance @ (columns.T @ off) / size_m**2 / 3.0
    left = off - columns @ sizes
    gain = float((off @ off - left @ left) / 2.0 / size_m**2 / 3.0)
    return SetFit(gain, sizes, covariance)


def _is_measured(recording: Recording) -> bool:
    return all(column in recording.extra for column in TOOL_COLUMNS)


def _stack_tool_points(recording: Recording) -> np.ndarray:
    """Return the measured tool points, `(T, 3)`."""
    return np.stack([recording.extra[column] for column in TOOL_COLUMNS], 1)


def _compute_tool_points(
    effects: Mapping[EffectType, Mapping[str, np.ndarray]], q: np.ndarray, machine: Machine
) -> np.ndarray:
    """Return where the tool point is at measured positions, with some effects, `(S, 3)`."""
    at, device = torch.as_tensor(q, dtype=torch.float32), torch.device("cpu")
    pose = Kinematics(machine, device).pose
    if not effects:
        return pose(at).tip_in_base_m.numpy().astype(float)
    model: Any = Hold()
    for kind in sorted(effects, key=lambda one: one.order):
        model = kind.wrap(model, machine, len(q), device)
        for name, value in effects[kind].items():
            model.parameters[name].copy_(torch.as_tensor(value, dtype=torch.float32))
    true = model.truth(at)
    return model.tool(pose(true).tip_in_base_m, true).numpy().astype(float)
