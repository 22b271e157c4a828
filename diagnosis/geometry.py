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
from scipy import linalg

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
MIN_SIZE = 0.15
"""Smallest size, over the typical one, that is named: a tracker that was set up anew sees millimetres. Of 28 true
errors of 139 practice cases 19 are named with 0.3, 23 with this, 25 with 0; none falsely more."""


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

    def is_large(self, sizes: np.ndarray) -> bool:
        """Return whether a size is large enough to be named."""
        typical = [number.typical for number in self.numbers]
        return bool((np.abs(sizes) >= MIN_SIZE * np.array(typical)).any())


def is_tracked(recordings: Sequence[Recording], machine: Machine) -> bool:
    """Return whether there are enough measured tool points, of a machine with known geometry."""
    if not machine.has_bodies:
        return False
    total_s = 0.0
    for one in recordings:
        if is_measured(one):
            total_s += np.isfinite(stack_tool_points(one)).all(1).sum() / one.rate_hz
    return total_s >= MIN_SECONDS


def find_geometry_errors(
    case: GapCase, kinds: Sequence[EffectType], price: float, name_price: float
) -> list[DetectedEffect]:
    """Return the errors of geometry and encoders that the measured tool points show."""
    machine = case.machine
    if not is_tracked(case.field, machine):
        return []
    reference = case.reference if is_tracked(case.reference, machine) else ()
    geometric = [kind for kind in kinds if _is_geometric(kind)]
    points = _TrackedPoints(reference, case.field, machine, geometric)
    if not points.errors:
        return []
    everything = np.concatenate([cause.columns for cause in points.errors], 1)
    left = points.off - everything @ np.linalg.lstsq(everything, points.off, rcond=1e-9)[0]
    size_m = max(MIN_NOISE_M, float(np.std(left)))
    gains: dict[tuple[_GeometryError, ...], float] = {(): 0.0}
    worth = dict(gains)
    for count in range(1, MAX_ERRORS + 1):
        for some in combinations(points.errors, count):
            columns = np.concatenate([cause.columns for cause in some], 1)
            gains[some] = _solve(_join_numbers(some), columns, points.off, size_m).gain
            num_names = len({cause.kind for cause in some})
            worth[some] = gains[some] - price * count - name_price * num_names
    named = max(worth, key=worth.__getitem__)
    fit = points.refine(named, size_m)
    # The part behind the last error is empty.
    sizes = np.split(fit.sizes, np.cumsum([len(cause.numbers) for cause in named]))
    named = tuple(cause for cause, own in zip(named, sizes, strict=False) if cause.is_large(own))
    fit = points.refine(named, size_m)
    found = []
    for kind in dict.fromkeys(cause.kind for cause in named):
        rest = tuple(cause for cause in named if cause.kind is not kind)
        gain = gains[named] - gains[rest]
        without = [w for some, w in worth.items() if all(one.kind is not kind for one in some)]
        joints, parameters = _describe_numbers(kind, _join_numbers(named), fit, machine)
        net = worth[named] - max(without)
        found.append(DetectedEffect(kind, joints, parameters, net, gain))
    return found


def _is_geometric(kind: EffectType) -> bool:
    sides = ("kinematics", "measurement")
    return kind.target.side in sides and kind.target.smooth and not kind.target.stochastic


def _describe_numbers(
    kind: EffectType, numbers: Sequence[_GeometryNumber], fit: SetFit, machine: Machine
) -> tuple[np.ndarray, dict[str, dict[str, Estimate]]]:
    """Return which joints have an effect, `(J,)` bool, and its numbers by name and joint or `machine`."""
    joints = np.zeros(machine.num_joints, dtype=bool)
    parameters: dict[str, dict[str, Estimate]] = {}
    errors = np.sqrt(np.diag(fit.covariance))
    for number, size, error in zip(numbers, fit.sizes, errors, strict=True):
        if number.kind is kind:
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
    So are errors that the reference has too: a drawing that is wrong is no change of the machine.

    Args:
        reference: The machine as it was; empty without measured tool points.
        field: The machine as it is.
        machine: The machine.
        kinds: Effects on geometry and encoders.

    Attributes:
        off: Errors of the tool points, `(D,)`, m, those of the reference first.
        errors: Errors of geometry and encoders that move a tool point at all, other than as is left out.
    """

    def __init__(
        self,
        reference: Sequence[Recording],
        field: Sequence[Recording],
        machine: Machine,
        kinds: Sequence[EffectType],
    ) -> None:
        self.machine = machine
        known_q, known_off, known_ways = _sample_tool_points(reference, machine)
        self._q, off, ways = _sample_tool_points(field, machine)
        self._num_known = len(known_off)
        both = np.concatenate([known_q, self._q])
        ways_of_both = np.asarray(linalg.block_diag(known_ways, ways))
        moved = []
        for numbers in _list_numbers(kinds, machine):
            moved.append((numbers, self._differentiate(numbers, np.zeros(len(numbers)), both)))
        drawn = [columns for _, columns in moved] if reference else []
        self._shared = linalg.orth(np.concatenate([ways_of_both, *drawn], 1))
        self.off = self._remove_shared(np.concatenate([known_off, off]))
        self.errors = []
        for numbers, columns in moved:
            left = self._change_field(columns[self._num_known :])
            if np.abs(left).max() > 1e-6:
                self.errors.append(_GeometryError(numbers, left))

    def _remove_shared(self, off: np.ndarray) -> np.ndarray:
        """Return errors `(D, …)` without what lies along the ways, and what both sides may share."""
        return off - self._shared @ (self._shared.T @ off)

    def _displace(
        self, numbers: Sequence[_GeometryNumber], sizes: np.ndarray, q: np.ndarray
    ) -> np.ndarray:
        """Return how far errors of these sizes move the tool points at positions `(S, J)`, `(3 S,)`."""
        effects: dict[EffectType, dict[str, np.ndarray]] = {}
        for number, size in zip(numbers, sizes, strict=True):
            kind, facts = number.kind, number.kind.numbers[number.name]
            count = self.machine.num_joints if facts.per_joint else 1
            values = effects.setdefault(kind, {})
            row = values.setdefault(number.name, np.full(count, facts.none, dtype=float))
            row[slice(None) if number.joint is None else number.joint] += size
        plain = _compute_tool_points({}, q, self.machine)
        return (_compute_tool_points(effects, q, self.machine) - plain).ravel()

    def _differentiate(
        self, numbers: Sequence[_GeometryNumber], sizes: np.ndarray, q: np.ndarray
    ) -> np.ndarray:
        """Return the displacement per unit of each number around these sizes, `(3 S, P)`."""
        columns, before = [], self._displace(numbers, sizes, q)
        for place, number in enumerate(numbers):
            step = np.zeros(len(numbers))
            step[place] = DIFFERENCE_STEP * number.typical
            columns.append((self._displace(numbers, sizes + step, q) - before) / step[place])
        return np.stack(columns, 1)

    def _change_field(self, moved: np.ndarray) -> np.ndarray:
        """Return displacements of the field `(3 S, …)` beside a reference that has none, `(D, …)`."""
        none = np.zeros((self._num_known, *moved.shape[1:]))
        return self._remove_shared(np.concatenate([none, moved]))

    def refine(self, causes: Sequence[_GeometryError], size_m: float) -> SetFit:
        """Return the fit of a set of errors as they act on the machine, by Gauss's and Newton's method."""
        numbers = _join_numbers(causes)
        fit = SetFit(0.0, np.zeros(len(numbers)), np.zeros((len(numbers), len(numbers))))
        for _ in range(NUM_ROUNDS if numbers else 0):
            columns = self._change_field(self._differentiate(numbers, fit.sizes, self._q))
            moved = self._change_field(self._displace(numbers, fit.sizes, self._q))
            straight = self.off - moved + columns @ fit.sizes
            fit = _solve(numbers, columns, straight, size_m)
        return fit


def _join_numbers(causes: Sequence[_GeometryError]) -> list[_GeometryNumber]:
    return [number for cause in causes for number in cause.numbers]


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


def _list_numbers(
    kinds: Sequence[EffectType], machine: Machine
) -> list[tuple[_GeometryNumber, ...]]:
    """Return the numbers of each effect on each joint, or on the whole machine."""
    found = []
    for kind in kinds:
        is_joined = all(not kind.numbers[name].per_joint for name in kind.fitted)
        for joint in [None] if is_joined else range(machine.num_joints):
            found.append(tuple(_GeometryNumber(kind, name, joint) for name in kind.fitted))
    return found


def _sample_tool_points(
    recordings: Sequence[Recording], machine: Machine
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions `(S, J)`, errors of the tool points `(3 S,)` and the ways before and after `(3 S, 2)`."""
    q, errors = [np.zeros((0, machine.num_joints))], [np.zeros(0)]
    ways = [np.zeros((0, 2))]
    for recording in recordings:
        if not is_measured(recording):
            continue
        every = max(1, round(recording.rate_hz))
        seen = stack_tool_points(recording)[::every]
        points = _compute_tool_points({}, recording.q, machine)
        step = np.diff(points, axis=0)
        none = np.zeros((1, 3))
        way = np.stack([np.concatenate([none, step]), np.concatenate([step, none])], -1)
        given = np.isfinite(seen).all(1)
        q.append(recording.q[::every][given].astype(float))
        errors.append((seen - points[::every])[given].ravel())
        ways.append(way[::every][given].reshape(-1, 2))
    return np.concatenate(q), np.concatenate(errors), np.concatenate(ways)


def is_measured(recording: Recording) -> bool:
    """Return whether a recording holds measured tool points."""
    return all(column in recording.extra for column in TOOL_COLUMNS)


def stack_tool_points(recording: Recording) -> np.ndarray:
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
