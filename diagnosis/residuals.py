"""Errors of a simulator on recordings, divided by the standard deviation that they have anyway.

Errors are compared as increments over `INCREMENT_SAMPLES` samples. Their covariance has three parts: the
sensor's (each increment by itself), one at changes of speed, and a speed that wanders by a few
percent over some seconds. Whitening divides by the root of that covariance, so that all increments
count alike
and independently: a wandering speed is then no evidence for another gain.
Axes: `C` candidates, `W` windows, `I` increments in a window, `J` joints, `B` blocks of `S`
increments in a row, `E` entries (increments of all windows, `W` times `I`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np

from diagnosis.effect_library import EffectSimulator, EffectType
from diagnosis.error_covariance import ErrorCovariance

INCREMENT_SAMPLES = 5
"""Samples in an increment: a quarter of a second at 20 Hz."""
MAX_BLOCK_INCREMENTS = 80
"""Increments in a block."""


def to_increments(paths: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the increments of positions `(…, W, K, J)` that begin at `start` `(W, J)`: `(…, W, I, J)`."""
    count = paths.shape[-2] // INCREMENT_SAMPLES
    ends = paths[..., INCREMENT_SAMPLES - 1 : count * INCREMENT_SAMPLES : INCREMENT_SAMPLES, :]
    first = np.broadcast_to(start[:, None], (*ends.shape[:-2], 1, ends.shape[-1]))
    return np.diff(ends, axis=-2, prepend=first)


SIZE_GRID = (0.12, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0)
"""Sizes, over the typical one, at which an effect is simulated; in between its doing is
interpolated."""

GAIN_FAULT = 0.01
"""What a simulator gets wrong from day to day, and what is no effect: speeds by a percent. For its
own numbers see `EffectSimulator.fault_runs`."""

MEAN_FORM_ERROR = 0.5
"""What effects of chance change on average is known up to so much of it: their forms differ."""


@dataclass(frozen=True, eq=False)
class ParameterRay:
    """A way to make an effect grow: one of its numbers, or all at once where they make sense only together.

    Attributes:
        kind: The effect.
        name: Of the number; empty for all at once.
        sizes: Sizes at which it is simulated, over the typical one, rising, 0 among them.
        shape: Values of the numbers that only shape the effect, over the typical ones, by name,
            each `(J,)`; 1 where not given.
        is_tied: The size is known up to `sizes`, and goes no further.
    """

    kind: EffectType
    name: str
    sizes: np.ndarray
    shape: Mapping[str, np.ndarray] = field(default_factory=dict)
    is_tied: bool = False

    def values(self, size: np.ndarray) -> dict[str, np.ndarray]:
        """Return the numbers at sizes `(C, J)`, each `(C, J)` or `(C, 1)`."""
        found = {}
        for name in (self.name,) if self.name else self.kind.fitted:
            number = self.kind.numbers[name]
            step = size if number.per_joint else size.max(1, keepdims=True)
            found[name] = self.kind.clipped(name, number.none + step * self.kind.size(name))
        for name, part in self.shape.items():
            number = self.kind.numbers[name]
            value = self.kind.clipped(name, part * self.kind.typical(name))
            found[name] = np.repeat(
                value[None] if number.per_joint else value[None, :1], len(size), 0
            )
        return found


def build_rays(kind: EffectType, grid: Sequence[float] = SIZE_GRID) -> list[ParameterRay]:
    """Return the ways in which an effect can grow."""
    found = []
    for name in kind.fitted if kind.target.smooth else ("",):
        ends = [_find_size_bounds(kind, one) for one in ((name,) if name else kind.fitted)]
        low, high = max(end[0] for end in ends), min(end[1] for end in ends)
        sizes = np.array([-size for size in grid[::-1]] + [0.0, *grid])
        sizes = np.unique(np.clip(sizes, low, high))
        if len(sizes) > 1:
            found.append(ParameterRay(kind, name, sizes))
    return found


def _find_size_bounds(kind: EffectType, name: str) -> tuple[float, float]:
    """Return the smallest and largest size of a number within its bounds."""
    number = kind.numbers[name]
    # typical size and bounds grow alike from joint to joint
    ends = [(bound - number.none) / (number.typical - number.none) for bound in number.bounds]
    return min(ends), max(ends)


@dataclass(frozen=True, eq=False)
class Residuals:
    """A simulator held against recordings.

    Attributes:
        simulator: The simulator, which makes the free runs.
        noise: Of each joint; `None` while it is still to be found.
        valid_mask: Whether each window counts for each joint, `(W, J)`.
        mean: Mean response of known stochastic effects, `(W, K, J)`.
        bias: Increments that the simulator misses already on the reference, `(W, I, J)`; see
            `residual_model`.
        widths: Size of faults of the simulator's own numbers over the usual, `(P,)`; see
            `residual_model`.
        late: Response to each change of a command that is one standard deviation late, `(W, C, I,
            J)`, where delays are random.
        runs: Its free runs without any effect, `(W, K, J)`, where they are known already.
    """

    simulator: EffectSimulator
    noise: Sequence[ErrorCovariance] | None
    valid_mask: np.ndarray
    mean: np.ndarray | None = None
    bias: np.ndarray | None = None
    widths: np.ndarray | None = None
    late: np.ndarray | None = None
    runs: np.ndarray | None = None

    @cached_property
    def base(self) -> np.ndarray:
        """Positions without any effect, `(W, K, J)`."""
        return self.simulator.plain_runs if self.runs is None else self.runs

    @cached_property
    def start(self) -> np.ndarray:
        """Measured positions at which the free runs begin, `(W, J)`."""
        return self.simulator.cut.q[:, self.simulator.cut.num_before - 1]

    @cached_property
    def increments(self) -> np.ndarray:
        """Increments that the simulator makes, `(W, I, J)`."""
        return to_increments(self.base, self.start)

    @cached_property
    def error(self) -> np.ndarray:
        """Measured less simulated increments, `(W, I, J)`."""
        return self.compute_error(self.base)

    def compute_error(self, paths: np.ndarray) -> np.ndarray:
        """Return measured less simulated increments, `(…, W, I, J)`, of free runs `(…, W, K, J)`."""
        still = np.zeros_like(self.start)
        known = 0.0 if self.mean is None else to_increments(self.mean, still)
        known = known if self.bias is None else known + self.bias
        return (
            to_increments(self.simulator.cut.measured, self.start)
            - to_increments(paths, self.start)
            - known
        )

    @cached_property
    def groups(self) -> list[np.ndarray]:
        """Windows in a row that are whitened together."""
        size = max(1, MAX_BLOCK_INCREMENTS // self.increments.shape[1])
        runs = self.simulator.cut.run
        breaks = [0, *(np.flatnonzero(runs[1:] != runs[:-1]) + 1), len(runs)]
        return [
            np.arange(i, min(i + size, b)) for a, b in pairwise(breaks) for i in range(a, b, size)
        ]

    @cached_property
    def fold(self) -> np.ndarray:
        """Half of the recordings, 0 or 1, that each entry belongs to, `(E,)`."""
        steps = self.increments.shape[1]
        half = np.empty(len(self.increments), dtype=int)
        for number, group in enumerate(self.groups):
            half[group] = number % 2
        return np.repeat(half, steps)

    @cached_property
    def block(self) -> np.ndarray:
        """Number of the group that each entry belongs to, `(E,)`."""
        of = np.empty(len(self.increments), dtype=int)
        for number, group in enumerate(self.groups):
            of[group] = number
        return np.repeat(of, self.increments.shape[1])

    @cached_property
    def _whiteners(self) -> list[list[np.ndarray]]:
        return [
            [
                np.linalg.inv(np.linalg.cholesky(self._covariance(group, j)))
                for j in range(self.increments.shape[2])
            ]
            for group in self.groups
        ]

    def _covariance(self, group: np.ndarray, j: int) -> np.ndarray:
        """Return the covariance of the increments of joint `j` in windows in a row, `(S, S)`."""
        assert self.noise is not None, "noise is found before anything is whitened"
        found = self.noise[j].covariance(self.increments[group, :, j].reshape(1, -1))[0]
        for place, window in enumerate(group if self.late is not None else ()):
            assert self.late is not None, "asked before"
            own, moved = (
                slice(place * self.increments.shape[1], (place + 1) * self.increments.shape[1]),
                self.late[window, ..., j],
            )
            found[own, own] += moved.T @ moved
        return found

    def rewhiten(self, other: Residuals, values: np.ndarray, j: int) -> np.ndarray:
        """Return values of joint `j` over the noise of `other`, `(…, E)`, over this one's: the same windows, another noise."""
        found, steps = np.empty_like(values), self.increments.shape[1]
        for group, mine, theirs in zip(self.groups, self._whiteners, other._whiteners, strict=True):
            entries = slice(group[0] * steps, (group[-1] + 1) * steps)
            found[..., entries] = np.linalg.solve(theirs[j], values[..., entries].T).T @ mine[j].T
        return found

    def whiten(self, ways: np.ndarray) -> np.ndarray:
        """Return increments `(C, W, I, J)` over their noise, `(J, C, E)`; 0 where a window says nothing."""
        count, _, steps, joints = ways.shape
        ways = ways * self.valid_mask[:, None]
        found = np.empty((joints, count, len(self.increments) * steps), dtype=np.float64)
        for group, whiteners in zip(self.groups, self._whiteners, strict=True):
            entries = slice(group[0] * steps, (group[-1] + 1) * steps)
            for j in range(joints):
                found[j, :, entries] = (
                    ways[..., j][:, group].reshape(count, len(group) * steps) @ whiteners[j].T
                )
        return found

    def whiten_joint(self, columns: np.ndarray, j: int) -> np.ndarray:
        """Return columns of increments of joint `j`, `(W, I, F)`, over its noise, `(E, F)`."""
        count, steps, size = columns.shape
        columns, found = (
            columns * self.valid_mask[:, j, None, None],
            np.empty((count * steps, size)),
        )
        for group, whiteners in zip(self.groups, self._whiteners, strict=True):
            found[group[0] * steps : (group[-1] + 1) * steps] = whiteners[j] @ columns[
                group
            ].reshape(-1, size)
        return found

    @cached_property
    def z(self) -> np.ndarray:
        """The error over its noise, `(J, E)`."""
        return self.whiten(self.error[None])[:, 0]

    @cached_property
    def faults(self) -> np.ndarray:
        """Whitened change by small faults of the simulator, `(J, P, E)`, at one prior sigma each."""
        found = [
            self.whiten((self.increments * GAIN_FAULT * side)[None])
            for side in (self.increments > 0, self.increments < 0)
        ]
        found.append(
            self.whiten(to_increments(self.simulator.fault_runs, self.start) - self.increments)
        )
        lines = np.concatenate(found, 1)
        lines = lines if self.widths is None else lines * self.widths[:, None]
        if self.mean is None:
            return lines
        known = to_increments(self.mean, np.zeros_like(self.start))
        return np.concatenate([lines, self.whiten(MEAN_FORM_ERROR * known[None])], 1)

    def response(self, ray: ParameterRay) -> np.ndarray:
        """Return the whitened response to an effect on all joints at each size of the ray, `(J, C, E)`."""
        return self.list_responses([ray])[0]

    def list_responses(self, rays: Sequence[ParameterRay]) -> list[np.ndarray]:
        """Return `response` of each of the rays of one effect, which are simulated together."""
        kind, joints = rays[0].kind, self.increments.shape[2]
        sizes = [ray.sizes[ray.sizes != 0.0] for ray in rays]
        values: dict[str, list[np.ndarray]] = {}
        names = {
            name
            for ray in rays
            for name in (*ray.shape, *((ray.name,) if ray.name else kind.fitted))
        }
        for ray, own in zip(rays, sizes, strict=True):
            known = ray.values(np.repeat(own[:, None], joints, 1))
            for name in names:
                off = np.full((len(own), len(kind.typical(name))), getattr(kind.neutral, name))
                values.setdefault(name, []).append(known.get(name, off))
        together = {name: np.concatenate(parts) for name, parts in values.items()}
        count = sum(len(own) for own in sizes)
        moved = to_increments(self.simulator.simulate([(kind, together)], count), self.start)
        found, first = [], 0
        for ray, own in zip(rays, sizes, strict=True):
            changed = np.zeros((len(ray.sizes), *self.increments.shape))
            changed[ray.sizes != 0.0] = moved[first : first + len(own)] - self.increments
            found.append(self.whiten(changed))
            first += len(own)
        return found
