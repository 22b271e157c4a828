"""Effects with their numbers: the forms and sizes that are tried, and how errors follow the numbers.

Axes: `C` candidates, `J` joints, `P` numbers, `E` errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.effect_library import EffectType
from diagnosis.engine.decide import EffectFinding

SIZES = (0.12, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0, 7.0)
"""Sizes that are tried, over the typical one; less is within what a machine repeats."""
SHAPES = (0.35, 0.6, 1.0, 1.7)
"""Values of a number that only shapes an effect, over the typical one."""
DAMPINGS = (1e-4, 1e-2, 0.3, 10.0)


@dataclass(frozen=True)
class GrownEffect:
    """An effect with its numbers.

    Attributes:
        kind: The effect.
        values: Its numbers, `(J,)` or `(1,)` each.
        joints: Which joints have it, `(J,)` bool.
        nats: What it earned when it was found, less the cost of its joints.
    """

    kind: EffectType
    values: Mapping[str, np.ndarray]
    joints: np.ndarray
    nats: float

    def repeat(self, count: int) -> dict[str, np.ndarray]:
        """Return its numbers for some candidates, `(C, J)` or `(C, 1)` each."""
        return {name: np.repeat(value[None], count, 0) for name, value in self.values.items()}

    def count_numbers(self) -> int:
        """Return how many numbers make the effect; one that joints share counts once."""
        count = 0
        for name in self.kind.fitted:
            value = self.values[name]
            count += len(np.unique(value[value != self.kind.numbers[name].none]))
        return count

    def summarise(self) -> EffectFinding:
        """Return its name and its joints, and what it earned."""
        joints = tuple(np.flatnonzero(self.joints).tolist())
        return EffectFinding(self.kind.name, joints, self.nats)

    def keep(self, joints: np.ndarray) -> GrownEffect:
        """Return the effect on some of its joints only."""
        values = dict(self.values)
        for name in self.kind.fitted:
            if len(values[name]) > 1:
                values[name] = np.where(joints, values[name], self.kind.numbers[name].none)
        return replace(self, values=values, joints=joints)


def list_candidates(kind: EffectType) -> dict[str, np.ndarray]:
    """Return the numbers of an effect in all forms and sizes, `(C, J)` or `(C, 1)` each."""
    forms: list[tuple[str, ...]] = [(name,) for name in kind.fitted]
    if not kind.target.smooth:
        forms = [kind.fitted]
    if kind.target.smooth and len(kind.fitted) > 1:
        forms.append(kind.fitted)
    rows = []
    for shape in _list_shapes(kind):
        for form in forms:
            for size in (*SIZES, *(-size for size in SIZES)):
                rows.append(_place(kind, form, size, shape))
    found = {
        name: np.stack([row[name] for row in rows]) for name in kind.numbers if name in rows[0]
    }
    both = np.concatenate(list(found.values()), 1)
    # Sizes beyond the bounds of a number are one and the same.
    _, kept = np.unique(both.round(9), axis=0, return_index=True)
    return {name: values[np.sort(kept)] for name, values in found.items()}


def _list_shapes(kind: EffectType) -> Iterator[dict[str, float]]:
    """Yield values of the numbers that only shape an effect, over the typical ones; one varies at a time."""
    yield dict.fromkeys(kind.shaping, 1.0)
    for name in kind.shaping:
        number = kind.numbers[name]
        trials = [value / number.typical for value in getattr(number, "trials", ())] or SHAPES
        for value in trials:
            if value != 1.0:
                yield {**dict.fromkeys(kind.shaping, 1.0), name: value}


def _place(
    kind: EffectType, form: Sequence[str], size: float, shape: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Return the numbers of one form, size and shape, `(J,)` or `(1,)` each."""
    found = {}
    for name in kind.fitted:
        step = size * kind.size(name) if name in form else 0.0 * kind.size(name)
        found[name] = kind.clipped(name, kind.numbers[name].none + step)
    for name, factor in shape.items():
        found[name] = kind.clipped(name, factor * kind.typical(name))
    return found


@dataclass(frozen=True)
class NumberSlopes:
    """Errors of free runs as linear functions of the numbers of effects.

    Attributes:
        spots: Place of the effect and name of each number, `P` of them.
        steps: Finite difference of each number, `(J,)` or `(1,)`.
        errors: What is new in each error, `(E, J)`.
        changes: What a step of each number adds to it, `(P, E, J)`.
    """

    spots: Sequence[tuple[int, str]]
    steps: Sequence[np.ndarray]
    errors: np.ndarray
    changes: np.ndarray

    def _list_unknowns(self, effects: Sequence[GrownEffect]) -> list[list[tuple[int, int]]]:
        """Return the numbers that act on each joint, each with the place of its unknown."""
        found: list[list[tuple[int, int]]] = [[] for _ in range(self.errors.shape[1])]
        count = 0
        for number, (place, _) in enumerate(self.spots):
            is_single = len(self.steps[number]) == 1
            for j in np.flatnonzero(effects[place].joints).tolist():
                found[j].append((number, count))
                count += not is_single
            count += is_single
        return found

    def _form_normal(
        self, effects: Sequence[GrownEffect]
    ) -> tuple[np.ndarray, np.ndarray, list[list[tuple[int, int]]]]:
        """Return normal matrix and gradient of all unknowns, in steps, and the unknowns of each joint.

        Errors count by the inverse of their size, as those of a Laplace distribution do.
        """
        unknowns = self._list_unknowns(effects)
        size = 1 + max([place for row in unknowns for _, place in row], default=-1)
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        for j, row in enumerate(unknowns):
            if not row:
                continue
            numbers = [number for number, _ in row]
            places = [place for _, place in row]
            left = self.errors[:, j]
            scale = max(float(np.abs(left).mean()), 1e-12)
            weight = 1.0 / (scale * np.maximum(np.abs(left), scale))
            columns = self.changes[numbers, :, j]
            normal[np.ix_(places, places)] += (columns * weight) @ columns.T
            gradient[places] -= (columns * weight) @ left
        return normal, gradient, unknowns

    def list_steps(self, effects: Sequence[GrownEffect]) -> dict[tuple[int, str], np.ndarray]:
        """Return the numbers after a step with each of `DAMPINGS`, `(C, J)` or `(C, 1)` each."""
        normal, gradient, unknowns = self._form_normal(effects)
        moves = []
        for damping in DAMPINGS:
            damped = normal + np.diag(damping * np.diag(normal) + 1e-9)
            moves.append(np.linalg.solve(damped, gradient))
        found = {}
        for number, (place, name) in enumerate(self.spots):
            kind = effects[place].kind
            rows = np.repeat(effects[place].values[name][None], len(moves), 0)
            for j, row in enumerate(unknowns):
                where = dict(row).get(number)
                if where is not None:
                    own = j if rows.shape[1] > 1 else 0
                    change = np.array([move[where] for move in moves]) * self.steps[number][own]
                    rows[:, own] = effects[place].values[name][own] + change
            found[place, name] = kind.clipped(name, rows)
        return found

    def estimate_deviations(
        self, effects: Sequence[GrownEffect]
    ) -> dict[tuple[int, str], np.ndarray]:
        """Return the standard error of each number, `(J,)` or `(1,)`, all fitted together."""
        normal, _, unknowns = self._form_normal(effects)
        variance = np.diag(np.linalg.pinv(normal + 1e-9 * np.eye(len(normal))))
        found = {}
        for number, spot in enumerate(self.spots):
            deviation = np.zeros_like(self.steps[number])
            for j, row in enumerate(unknowns):
                where = dict(row).get(number)
                if where is not None:
                    own = j if len(deviation) > 1 else 0
                    deviation[own] = np.sqrt(variance[where]) * abs(self.steps[number][own])
            found[spot] = deviation
        return found
