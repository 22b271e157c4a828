"""Effects with their numbers: the forms and sizes that are tried, and how errors follow the numbers.

Axes: `C` candidates, `J` joints, `P` numbers, `E` errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from diagnosis.effect_library import EffectType
from diagnosis.engine.decide import EffectFinding

SIZES = (0.12, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0, 7.0)
"""Sizes that are tried, over the typical one; less is within what a machine repeats."""
SHAPES = (0.35, 0.6, 1.0, 1.7)
"""Values of a number that only shapes an effect, over the typical one."""
DAMPINGS = (1e-4, 1e-2, 0.3, 10.0)

NumberTrials = Mapping[tuple[int, str], np.ndarray]
"""Values of some numbers for each candidate, by place of the effect and name, `(C, J)` or `(C, 1)`."""


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

    def count_numbers(self) -> int:
        """Return how many numbers make the effect; one that joints share counts once."""
        count = 0
        for name in self.kind.fitted:
            value = self.values[name]
            count += len(np.unique(value[value != self.kind.numbers[name].none]))
        return count

    def summarise(self) -> EffectFinding:
        """Return its name, and what it earned in equal parts on its joints."""
        joints = np.flatnonzero(self.joints).tolist()
        return EffectFinding(self.kind.name, dict.fromkeys(joints, self.nats / max(len(joints), 1)))

    def keep(self, joints: np.ndarray) -> GrownEffect:
        """Return the effect on some of its joints only."""
        values = dict(self.values)
        for name in self.kind.fitted:
            if len(values[name]) > 1:
                values[name] = np.where(joints, values[name], self.kind.numbers[name].none)
        return replace(self, values=values, joints=joints)


def list_candidates(kind: EffectType) -> dict[str, np.ndarray]:
    """Return the numbers of an effect in all forms and sizes, `(C, J)` or `(C, 1)` each."""
    forms = [kind.fitted]
    if kind.target.smooth:
        forms = [*((name,) for name in kind.fitted), kind.fitted]
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
        effects: The effects.
        spots: Place of the effect and name of each number, `P` of them.
        steps: Finite difference of each number, `(J,)` or `(1,)`.
        errors: What is new in each error, `(E, J)`.
        changes: What a step of each number adds to it, `(P, E, J)`.
    """

    effects: Sequence[GrownEffect]
    spots: Sequence[tuple[int, str]]
    steps: Sequence[np.ndarray]
    errors: np.ndarray
    changes: np.ndarray

    @cached_property
    def _unknowns(self) -> list[tuple[int, np.ndarray]]:
        """The `U` unknowns: place of the number, and the joints that have it together."""
        found = []
        for number, (place, _) in enumerate(self.spots):
            joints = np.flatnonzero(self.effects[place].joints)
            together = [joints] if len(self.steps[number]) == 1 else joints[:, None]
            found += [(number, some) for some in together]
        return found

    def _form_normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Return normal matrix and gradient of all unknowns, in steps.

        Errors count by the inverse of their size, as those of a Laplace distribution do.
        """
        columns = np.zeros((len(self._unknowns), *self.errors.shape))
        for place, (number, joints) in enumerate(self._unknowns):
            columns[place][:, joints] = self.changes[number][:, joints]
        size = np.abs(self.errors)
        scale = np.maximum(size.mean(0), 1e-12)
        weighted = columns / (scale * np.maximum(size, scale))
        normal = np.einsum("aej,bej->ab", weighted, columns)
        return normal, -np.einsum("aej,ej->a", weighted, self.errors)

    def _spread(self, moves: np.ndarray) -> NumberTrials:
        """Return what moves of the unknowns, in steps, `(C, U)`, add to each number."""
        found = {}
        for spot, step in zip(self.spots, self.steps, strict=True):
            found[spot] = np.zeros((len(moves), len(step)))
        for move, (number, joints) in zip(moves.T, self._unknowns, strict=True):
            step = self.steps[number]
            own = joints if len(step) > 1 else [0]
            found[self.spots[number]][:, own] = move[:, None] * step[own]
        return found

    def list_steps(self) -> NumberTrials:
        """Return the numbers after a step with each of `DAMPINGS`."""
        normal, gradient = self._form_normal()
        moves = []
        for damping in DAMPINGS:
            damped = normal + np.diag(damping * np.diag(normal) + 1e-9)
            moves.append(np.linalg.solve(damped, gradient))
        found = {}
        for (place, name), added in self._spread(np.stack(moves)).items():
            one = self.effects[place]
            found[place, name] = one.kind.clipped(name, one.values[name] + added)
        return found

    def estimate_deviations(self) -> dict[tuple[int, str], np.ndarray]:
        """Return the standard error of each number, `(J,)` or `(1,)`, all fitted together."""
        normal, _ = self._form_normal()
        variance = np.diag(np.linalg.pinv(normal + 1e-9 * np.eye(len(normal))))
        return {spot: np.abs(one[0]) for spot, one in self._spread(np.sqrt(variance)[None]).items()}
