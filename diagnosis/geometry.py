"""Errors of geometry and encoders, from measured tool points and forward kinematics alone.

No simulator takes part, so the actuators do not matter. `find_geometry_errors` compares sets of errors
by linear least squares: the errors are small, so their effects add up. The sizes of the best set are then
fitted to the tool points of a machine that has them.
Axes: `S` samples, `J` joints, `D` coordinates of all samples (`S` times 3), `P` numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
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
from diagnosis.engine.decide import DIRECT_NATS, NUMBER_NATS
from diagnosis.engine.sizes import SIGMAS

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
class _GeometryNumber:
    """A number of an effect on one joint; `None`: of the whole machine."""

    kind: EffectType
    name: str
    joint: int | None

    @property
    def typical(self) -> float:
        """Its typical size, positive."""
        return abs(self.kind.size_on(self.name, self.joint))


_GeometryError = tuple[_GeometryNumber, ...]
"""The numbers of an effect on one joint or of the whole machine."""
_FittedSizes = Mapping[_GeometryNumber, Sequence[float]]
"""Size and standard deviation of each number, as a difference from neutral."""


def is_tracked(recordings: Sequence[Recording], machine: Machine) -> bool:
    """Return whether there are enough measured tool points, of a machine with known geometry."""
    if not machine.has_bodies:
        return False
    total_s = 0.0
    for one in recordings:
        if is_measured(one):
            total_s += np.isfinite(stack_tool_points(one)).all(1).sum() / one.rate_hz
    return total_s >= MIN_SECONDS


def find_geometry_errors(case: GapCase, kinds: Sequence[EffectType]) -> list[DetectedEffect]:
    """Return the errors of geometry and encoders that the measured tool points show.

    With less than half of `DIRECT_NATS` for a name four of 139 practice cases named geometry falsely beside a true name.
    """
    machine = case.machine
    if not is_tracked(case.field, machine):
        return []
    reference = case.reference if is_tracked(case.reference, machine) else ()
    geometric = [kind for kind in kinds if _is_geometric(kind)]
    points = _TrackedPoints(reference, case.field, machine, geometric)
    gains, worth = {}, {}
    for count in range(MAX_ERRORS + 1):
        for some in combinations(points.errors, count):
            num_names = len({error[0].kind for error in some})
            gains[some] = points.measure_gain(some)
            worth[some] = gains[some] - NUMBER_NATS * count - DIRECT_NATS * num_names
    named = max(worth, key=worth.__getitem__)
    sizes = points.refine(named)
    large = {number for number in sizes if abs(sizes[number][0]) >= MIN_SIZE * number.typical}
    named = tuple(error for error in named if not large.isdisjoint(error))
    sizes = points.refine(named)
    found = []
    for kind in dict.fromkeys(error[0].kind for error in named):
        own = [number for error in named for number in error if number.kind is kind]
        joints, parameters = _describe_numbers(own, sizes, machine)
        rest = tuple(error for error in named if error[0].kind is not kind)
        without = [
            net for some, net in worth.items() if all(error[0].kind is not kind for error in some)
        ]
        net, gain = worth[named] - max(without), gains[named] - gains[rest]
        found.append(DetectedEffect(kind, joints, parameters, net, gain))
    return found


def measure_scatter_growth(case: GapCase, kinds: Sequence[EffectType]) -> float:
    """Return how much more tool points scatter about any law of geometry than on the reference; 1 where it is not known."""
    sides = (case.reference, case.field)
    if not all(is_tracked(side, case.machine) for side in sides):
        return 1.0
    geometric = [kind for kind in kinds if _is_geometric(kind)]
    before, now = (_TrackedPoints((), side, case.machine, geometric) for side in sides)
    return now.size_m / before.size_m


def _is_geometric(kind: EffectType) -> bool:
    sides = ("kinematics", "measurement")
    return kind.target.side in sides and kind.target.smooth and not kind.target.stochastic


def _describe_numbers(
    numbers: Sequence[_GeometryNumber], sizes: _FittedSizes, machine: Machine
) -> tuple[np.ndarray, dict[str, dict[str, Estimate]]]:
    """Return which joints have an effect, `(J,)` bool, and its numbers by name and joint or `machine`."""
    joints = np.zeros(machine.num_joints, dtype=bool)
    parameters: dict[str, dict[str, Estimate]] = {}
    for number in numbers:
        size, deviation = sizes[number]
        mean, half = number.kind.numbers[number.name].none + size, SIGMAS * deviation
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
        size_m: Standard deviation of what no error explains, m.
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
        for numbers in _list_errors(kinds, machine):
            moved.append((numbers, self._differentiate(numbers, np.zeros(len(numbers)), both)))
        drawn = [columns for _, columns in moved] if reference else []
        self._shared = linalg.orth(np.concatenate([ways_of_both, *drawn], 1))
        self.off = self._remove_shared(np.concatenate([known_off, off]))
        self.errors: list[_GeometryError] = []
        kept = [np.zeros((len(self.off), 0))]
        for error, columns in moved:
            left = self._change_field(columns[self._num_known :])
            if np.abs(left).max() > 1e-6:
                self.errors.append(error)
                kept.append(left)
        columns = np.concatenate(kept, 1)
        explained = columns @ np.linalg.lstsq(columns, self.off, rcond=1e-9)[0]
        self.size_m = max(MIN_NOISE_M, float(np.std(self.off - explained)))
        numbers = list(chain.from_iterable(self.errors))
        self._place = {number: place for place, number in enumerate(numbers)}
        self._normal, self._gradient = self._form_normal(columns, self.off)

    def _form_normal(self, columns: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the normal matrix `(P, P)` and the gradient `(P,)` of least squares."""
        # Instruments err together for a while: a sample a second counts as a third of one.
        weight = 1.0 / self.size_m**2 / 3.0
        return weight * columns.T @ columns, weight * columns.T @ off

    def measure_gain(self, causes: Sequence[_GeometryError]) -> float:
        """Return the gain in log likelihood of a set of errors, to first order."""
        numbers = list(chain.from_iterable(causes))
        places = [self._place[number] for number in numbers]
        normal, gradient = self._normal[np.ix_(places, places)], self._gradient[places]
        sizes = np.linalg.solve(normal + _form_prior(numbers), gradient)
        return float(gradient @ sizes - 0.5 * sizes @ normal @ sizes)

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

    def refine(self, causes: Sequence[_GeometryError]) -> _FittedSizes:
        """Return the numbers of a set of errors as they act on the machine, by Gauss's and Newton's method."""
        numbers = list(chain.from_iterable(causes))
        sizes, covariance = np.zeros(len(numbers)), np.zeros((len(numbers), len(numbers)))
        for _ in range(NUM_ROUNDS if numbers else 0):
            columns = self._change_field(self._differentiate(numbers, sizes, self._q))
            moved = self._change_field(self._displace(numbers, sizes, self._q))
            normal, gradient = self._form_normal(columns, self.off - moved + columns @ sizes)
            covariance = np.linalg.inv(normal + _form_prior(numbers))
            sizes = covariance @ gradient
        pairs = np.stack([sizes, np.sqrt(np.diag(covariance))], 1).tolist()
        return dict(zip(numbers, pairs, strict=True))


def _form_prior(numbers: Sequence[_GeometryNumber]) -> np.ndarray:
    """Return the inverse covariance of a normal prior, three typical sizes wide, `(P, P)`."""
    return np.diag([1.0 / (3.0 * number.typical) ** 2 for number in numbers])


def _list_errors(kinds: Sequence[EffectType], machine: Machine) -> list[_GeometryError]:
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
