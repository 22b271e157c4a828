"""Responses of the whitened residuals to effects, and the sizes that explain the residuals best.

The score of a set of effects is the logarithm of its Bayes factor against the simulator alone, by
Laplace's approximation: the likelihood at the best sizes, less the priors of sizes and of faults of
the simulator, less Occam's factor. The response at a size is interpolated between simulated sizes,
and effects are added up. Both are near enough to choose by; the chosen set is simulated again.
Axes: `E` entries (whitened increments), `S` sizes of a growth path, `J` joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from brokk_rl.parallel import map_parallel
from diagnosis.effect_library import EffectType, list_shared_effects
from diagnosis.error_covariance import T_FREEDOM, compute_loss, weigh_residuals
from diagnosis.residuals import SIZE_GRID, ParameterRay, Residuals, build_rays

# Chosen by hand; not searched.
BETWEEN = (0.25, 0.5, 0.75)
"""Of the way between two simulated sizes: a fit also begins there."""
MAX_SIZE_STEPS = 10
"""Gauss-Newton steps at most. It was 8, then 6; no comparison is recorded."""
MIN_STEP_GAIN = 0.02
"""Gain in log likelihood below which the steps end."""
MAX_FAULT = 6.0
"""Faults of a simulator are no larger, in standard deviations."""
SIZE_PRIOR = 1.0
"""Standard deviation of a size, over the typical one: tells nothing where the recordings do, and
settles what they leave open."""


@dataclass(frozen=True, eq=False)
class Response:
    """Response of one joint along a ray: `change` `(S, E)` at `sizes` `(S,)`."""

    sizes: np.ndarray
    change: np.ndarray

    def at(self, size: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the change at a size and its slope over the size, each `(E,)`."""
        cell = min(
            max(int(np.searchsorted(self.sizes, size, side="right")) - 1, 0), len(self.sizes) - 2
        )
        slope = (self.change[cell + 1] - self.change[cell]) / (
            self.sizes[cell + 1] - self.sizes[cell]
        )
        return self.change[cell] + (size - self.sizes[cell]) * slope, slope


def sum_responses(shapes: Sequence[Response], sizes: np.ndarray) -> np.ndarray:
    """Return the sum of the changes, `(E,)`."""
    return np.sum([shape.at(size)[0] for shape, size in zip(shapes, sizes, strict=True)], 0)


def fit_sizes(
    z: np.ndarray,
    shapes: Sequence[Response],
    start: np.ndarray | None = None,
    faults: np.ndarray | None = None,
    used: np.ndarray | None = None,
) -> np.ndarray:
    """Return the sizes that explain the errors best: most likely under a t distribution and a wide prior.

    Args:
        z: Errors over the noise, `(E,)`.
        shapes: Responses to the effects.
        start: Sizes from which the search begins; `None`: the best size of each effect alone.
        faults: Responses to small faults of the simulator, each of one standard deviation, `(P,
            E)`.
        used: Weight of each entry, `(E,)`; `None`: all count.

    Returns:
        Sizes of the shapes, then those of the faults.
    """
    count = len(shapes)
    lines = np.zeros((0, len(z))) if faults is None else faults
    used = np.ones(len(z)) if used is None else used
    if start is None:
        start = np.array([fit_single_size(z, shape, used) for shape in shapes]) * (
            1.0 if count == 1 else 0.7
        )
    size = np.concatenate([start, np.zeros(count + len(lines) - len(start))])
    if not len(size):
        return size
    high = np.concatenate([[shape.sizes[-1] for shape in shapes], np.full(len(lines), MAX_FAULT)])
    low = np.concatenate([[shape.sizes[0] for shape in shapes], np.full(len(lines), -MAX_FAULT)])
    precision = np.concatenate([np.full(count, SIZE_PRIOR**-2.0), np.ones(len(lines))])

    def left_at(at: np.ndarray) -> np.ndarray:
        change = np.zeros(len(z))
        for shape, one in zip(shapes, at, strict=False):
            change = change + shape.at(one)[0]
        return z - at[count:] @ lines - change

    def total(left: np.ndarray, at: np.ndarray) -> float:
        return 0.5 * (T_FREEDOM + 1.0) * float(
            used @ np.log1p(np.square(left) / T_FREEDOM)
        ) + 0.5 * float(precision @ np.square(at))

    left = left_at(size)
    now, damping = total(left, size), 1e-3
    for _ in range(MAX_SIZE_STEPS):
        slope = _stack_slopes(shapes, lines, size)
        weighted = slope * (weigh_residuals(left) * used)
        normal, gradient = (
            weighted @ slope.T + np.diag(precision),
            weighted @ left - precision * size,
        )
        # Sizes at a bound that would leave it are held, else the step of the others is wrong.
        free = ~((size <= low) & (gradient < 0.0) | (size >= high) & (gradient > 0.0))
        gain = 0.0
        for _ in range(3):
            damped = (normal + damping * np.diag(np.diag(normal)))[np.ix_(free, free)]
            trial = size.copy()
            trial[free] = np.clip(
                size[free] + np.linalg.solve(damped, gradient[free]), low[free], high[free]
            )
            remains = left_at(trial)
            then = total(remains, trial)
            if then < now - 1e-9:
                gain, size, left, now, damping = now - then, trial, remains, then, damping / 5
                break
            damping = 10 * max(damping, 1e-3)
        if gain < MIN_STEP_GAIN:
            break
    return size


def _stack_slopes(shapes: Sequence[Response], lines: np.ndarray, size: np.ndarray) -> np.ndarray:
    return np.concatenate(
        [*(shape.at(one)[1][None] for shape, one in zip(shapes, size, strict=False)), lines]
    )


def fit_single_size(z: np.ndarray, shape: Response, used: np.ndarray | None = None) -> float:
    """Return the best of the simulated sizes and those `BETWEEN` them: some begin just there."""
    used = np.ones(len(z)) if used is None else used
    between = [(1.0 - part) * shape.change[:-1] + part * shape.change[1:] for part in BETWEEN]
    sizes = [(1.0 - part) * shape.sizes[:-1] + part * shape.sizes[1:] for part in BETWEEN]
    trials = np.concatenate([shape.sizes, *sizes])
    left = z - np.concatenate([shape.change, *between])
    totals = 0.5 * (T_FREEDOM + 1.0) * np.log1p(
        np.square(left) / T_FREEDOM
    ) @ used + 0.5 * np.square(trials / SIZE_PRIOR)
    return float(trials[int(np.argmin(totals))])


@dataclass(frozen=True)
class JointResiduals:
    """A joint's errors without any effect, small faults of the simulator itself fitted.

    Attributes:
        z: Errors over the noise, `(E,)`.
        faults: Responses to the simulator's own numbers, `(P, E)`.
        loss: Loss of each entry.
        price: Of the faults: how unlikely their sizes are, and of having fitted them.
    """

    z: np.ndarray
    faults: np.ndarray
    loss: np.ndarray
    price: float


def fit_faults(z: np.ndarray, faults: Sequence[np.ndarray] | np.ndarray) -> JointResiduals:
    """Return a joint's errors with the simulator's faults, `(P, E)`, fitted."""
    lines = np.reshape(np.asarray(faults, dtype=float), (-1, len(z)))
    whole = fit_sizes(z, [], faults=lines)
    left = z - whole @ lines
    return JointResiduals(
        z, lines, compute_loss(left[:, None], axis=1), _compute_penalty(left, [], lines, whole)
    )


def score_responses(
    joint: JointResiduals, shapes: Sequence[Response], start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much shapes make the errors more likely, entry by entry `(E,)`, and their best sizes.

    Prices of sizes and faults are spread over the entries.
    """
    whole = fit_sizes(joint.z, shapes, start, joint.faults)
    count = len(shapes)
    left = (
        joint.z
        - whole[count:] @ joint.faults
        - (sum_responses(shapes, whole[:count]) if shapes else 0.0)
    )
    saved = joint.price - _compute_penalty(left, shapes, joint.faults, whole)
    return joint.loss - compute_loss(left[:, None], axis=1) + saved / len(left), whole[:count]


def _compute_penalty(
    left: np.ndarray, shapes: Sequence[Response], lines: np.ndarray, size: np.ndarray
) -> float:
    """Return the loss of sizes and faults under their priors, and Occam's factor: how much narrower the recordings make them."""
    slope = _stack_slopes(shapes, lines, size)
    precision = np.concatenate([np.full(len(shapes), SIZE_PRIOR**-2.0), np.ones(len(lines))])
    told = (slope * weigh_residuals(left)) @ slope.T / precision + np.eye(len(size))
    return 0.5 * float(precision @ np.square(size)) + 0.5 * float(np.linalg.slogdet(told)[1])


# Chosen by hand. SHAPE_FACTORS was (0.4, 2.0) before; no comparison is recorded.
SHAPE_FACTORS = (0.35, 0.5, 0.7, 1.4, 2.0)
"""Values of a number that only shapes an effect that are tried beside the typical one, over it."""
FINE_GRID = tuple(np.geomspace(SIZE_GRID[0], 7.0, 24).round(3).tolist())
"""Sizes at which an effect is simulated that rings: between those of `SIZE_GRID` it would be out of
step, and only a dull one fits. The largest is a period of 2 s, the bound of `compliance`."""
REFERENCE_GRID = SIZE_GRID[:4]
"""Sizes at which effects are simulated on the reference: small ones of the field's, as many effects
begin at a threshold."""
MIN_RESPONSE = 1e-3
"""An effect that changes errors over the noise by less does nothing to a joint."""


def choose_rays(kind: EffectType, grid: Sequence[float] = SIZE_GRID) -> list[ParameterRay]:
    """Return the ways in which an effect can grow, at sizes as close as it has to be simulated; none beyond those of `grid`."""
    # effects that ring slowly have no upper end in the field; on the reference only small ones count
    fine = [size for size in FINE_GRID if grid is SIZE_GRID or size <= grid[-1]]
    return build_rays(kind, fine if kind.shaping and not list_shared_effects([kind]) else grid)


def list_shape_trials(kind: EffectType) -> list[dict[str, float]]:
    """Return values of the numbers that only shape an effect, over the typical ones.

    The first is empty: all are typical. Each other changes one number, to one of its `trials`, else
    to a multiple of the typical value.
    """
    found: list[dict[str, float]] = [{}]
    for name in kind.shaping:
        number = kind.numbers[name]
        values = getattr(number, "trials", ())
        parts = [one / number.typical for one in values if one != number.typical]
        found += [{name: part} for part in (parts if values else SHAPE_FACTORS)]
    return found


def add_responses(
    shapes: Sequence[dict[str, list[Response]]],
    name: str,
    ways: Sequence[ParameterRay],
    residuals: Residuals,
) -> list[ParameterRay]:
    """Add the shapes of an effect to the joints that it does something to.

    Numbers that only shape the effect are tried at several values; each joint keeps the best, and
    the rays remember them.
    """
    kind = ways[0].kind
    trials = [{}] if ways[0].shape else list_shape_trials(kind)
    shaped = []
    for trial in trials:
        shape = _repeat_per_joint(trial, len(shapes))
        shaped += [replace(ray, shape=shape) for ray in ways] if trial else ways
    every = residuals.list_responses(shaped)
    responses = [every[t * len(ways) : (t + 1) * len(ways)] for t in range(len(trials))]
    made: list[list[list[Response]]] = []  # by trial and joint, one a ray
    losses = np.zeros((len(trials), len(shapes)))
    for t, response in enumerate(responses):
        made.append([])
        for j in range(len(shapes)):
            pairs = zip(ways, response, strict=True)
            made[t].append([Response(ray.sizes, change[j]) for ray, change in pairs])
            if len(trials) > 1:
                z, own = residuals.z[j], made[t][j]
                losses[t, j] = compute_loss(z - sum_responses(own, fit_sizes(z, own)))
    if list_shared_effects([kind]):  # one cause: its form is the same on all joints
        losses[:] = losses.sum(1, keepdims=True)
    best = losses.argmin(0)
    for j, mine in enumerate(shapes):
        if max(np.abs(response[j]).max() for response in responses[0]) >= MIN_RESPONSE:
            mine[name] = made[best[j]][j]
    if len(trials) == 1:
        return list(ways)
    shape = {
        number: np.array([trials[b].get(number, 1.0) for b in best]) for number in kind.shaping
    }
    return [replace(ray, shape=shape) for ray in ways]


def scale_responses(
    responses: Mapping[str, list[Response]], by: float
) -> dict[str, list[Response]]:
    """Return responses `by` times as large."""
    scaled = {}
    for name, own in responses.items():
        scaled[name] = [Response(one.sizes, one.change * by) for one in own]
    return scaled


def simulate_effect(
    ways: Sequence[ParameterRay], residuals: Residuals
) -> tuple[Mapping[str, np.ndarray], list[dict[str, list[Response]]]]:
    """Return the shape of an effect that suits each joint best, and its responses by joint and name."""
    own: list[dict[str, list[Response]]] = [{} for _ in range(residuals.increments.shape[2])]
    found = add_responses(own, ways[0].kind.name, ways, residuals)
    return found[0].shape, own


def simulate_trials(
    parts: Sequence[Residuals], ways: Mapping[str, Sequence[ParameterRay]]
) -> dict[str, list[list[np.ndarray]]]:
    """Return the responses of each part to each ray, by trial; those of one effect are simulated together."""
    by_kind: dict[str, list[str]] = {}
    for key, way in ways.items():
        by_kind.setdefault(way[0].kind.name, []).append(key)
    rays = {name: [ray for key in keys for ray in ways[key]] for name, keys in by_kind.items()}
    for part in parts:
        part.z  # noqa: B018  # made once, before other processes need it
    todo = list(product(by_kind, range(len(parts))))
    every = map_parallel(lambda one: parts[one[1]].list_responses(rays[one[0]]), todo)
    known = dict(zip(todo, every, strict=True))
    found: dict[str, list[list[np.ndarray]]] = {}
    for name, keys in by_kind.items():
        place = 0
        for key in keys:
            found[key] = []
            for _ in ways[key]:
                found[key].append([known[name, p][place] for p in range(len(parts))])
                place += 1
    return found


def fit_joint_faults(
    residuals: Residuals, scatter: np.ndarray | None = None, z: np.ndarray | None = None
) -> list[JointResiduals]:
    """Return the errors of each joint with small faults of the simulator, in units of `scatter` times the noise.

    Args:
        residuals: Residuals of the simulator.
        scatter: Mean square of the whitened residuals, `(J,)`.
        z: Whitened residuals to explain in place of those of `residuals`, `(J, E)`.
    """
    by = np.ones(len(residuals.z)) if scatter is None else 1.0 / np.sqrt(scatter)
    z = residuals.z if z is None else z
    rows = zip(z, residuals.faults, by, strict=True)
    return [fit_faults(one * part, lines * part) for one, lines, part in rows]


def _repeat_per_joint(trial: Mapping[str, float], joints: int) -> dict[str, np.ndarray]:
    return {name: np.full(joints, part) for name, part in trial.items()}


def rewhiten_responses(
    shapes: Sequence[Mapping[str, Sequence[Response]]], before: Residuals, after: Residuals
) -> list[dict[str, list[Response]]]:
    """Return the responses of each joint over the noise of `after`, by effect; they are over that of `before`."""
    found: list[dict[str, list[Response]]] = []
    for j, mine in enumerate(shapes):
        found.append({})
        for name, own in mine.items():
            changes = [after.rewhiten(before, one.change, j) for one in own]
            pairs = zip(own, changes, strict=True)
            found[j][name] = [replace(one, change=change) for one, change in pairs]
    return found
