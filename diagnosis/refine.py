"""Sizes of a set of effects fitted by simulation, the residuals that it leaves, and standard errors.

Axes: `C` candidates, `R` growth paths, `J` joints, `E` entries (whitened increments), `W` windows,
`K` steps, `F` fits side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.effect_library import EffectSimulator, EffectType
from diagnosis.error_covariance import compute_loss, weigh_residuals
from diagnosis.residuals import ParameterRay, Residuals
from diagnosis.responses import SIZE_PRIOR, fit_joint_faults
from diagnosis.search import MIN_SIZE, EffectSet, PenaltyFunction, Subset

# Chosen by hand; not searched.
MAX_FIT_STEPS = 6
"""Steps of a fit at most. It was 4 before; no comparison is recorded."""

DRIVE_FIT_STEPS = 30
"""The same for mass and friction of a drive: they trade against each other, so the way is long."""

REFIT_STEPS = 2
"""The same for the residuals without some effects, which needs no exact sizes."""

SIZE_STEP = 0.05
"""Finite difference, of the typical size."""

START_FACTORS = (1.0, 0.5, 1.6)
"""Multiples of the first guess at which a fit may begin: what adding up the effects said is far off
where they are large."""

DAMPING_FACTORS = (0.03, 1.0, 30.0)
"""Factors on the damping that are tried at each step."""

DAMPING_BOUNDS = (1e-4, 1e4)
"""Damping, over the diagonal of the normal matrix."""

MIN_FIT_GAIN = 0.02
"""Gain in log likelihood below which a fit ends."""

DRAWN, FOLLOWED, SPREAD = 40, 3, 0.5
"""Starts of a search, those of a joint that are followed, and their scatter (of the logarithm)."""

MAX_EXTRAPOLATION = 2.5
"""Sizes may grow to so many times the largest that was simulated before."""


@dataclass(frozen=True, eq=False)
class FittedSet:
    """Effects with their sizes.

    Attributes:
        rays: Ways in which the effects grow.
        mask: Which joints have each, `(R, J)` bool.
        sizes: Fitted to all entries, `(R, J)`.
        halves: Fitted to the entries outside of each half, `(2, R, J)`.
        after: Positions of free runs with the sizes that were not fitted to their window, `(W, K,
            J)`.
        own: The same with the sizes fitted to their own half: the prediction of `after`.
        z: Errors of `after` over the noise, `(J, E)`.
        deviation: Standard errors of the sizes, `(R, J)`.
        held: Joints whose sizes are given, not fitted here.
    """

    rays: Sequence[ParameterRay]
    mask: np.ndarray
    sizes: np.ndarray
    halves: np.ndarray
    after: np.ndarray
    own: np.ndarray
    z: np.ndarray
    deviation: np.ndarray
    held: frozenset[int] = frozenset()

    @property
    def kinds(self) -> list[EffectType]:
        """Effects of the set, each once."""
        return list({ray.kind.name: ray.kind for ray in self.rays}.values())

    def effects(self) -> list[tuple[EffectType, dict[str, np.ndarray]]]:
        """Return the effects with their numbers, each `(1, J)` or `(1, 1)`."""
        return _collect_effects(self.rays, self.sizes[None])

    def joints_of(self, kind: EffectType) -> np.ndarray:
        """Return which joints have an effect, `(J,)` bool."""
        return np.any(
            [mask for ray, mask in zip(self.rays, self.mask, strict=True) if ray.kind is kind], 0
        )

    def size(self, name: str, joint: int) -> float:
        """Return the largest size of an effect on a joint, along any of its rays."""
        found = []
        for ray, row in zip(self.rays, self.sizes, strict=True):
            if ray.kind.name == name:
                found.append(abs(float(row[joint])))
        return max(found, default=0.0)


def simulate_sizes(
    simulator: EffectSimulator, rays: Sequence[ParameterRay], sizes: np.ndarray
) -> np.ndarray:
    """Return free runs `(C, W, K, J)` with the effects at sizes `(C, R, J)`."""
    return simulator.simulate(_collect_effects(rays, sizes), len(sizes))


def _collect_effects(
    rays: Sequence[ParameterRay], sizes: np.ndarray
) -> list[tuple[EffectType, dict[str, np.ndarray]]]:
    values: dict[str, tuple[EffectType, dict[str, np.ndarray]]] = {}
    for r, ray in enumerate(rays):
        values.setdefault(ray.kind.name, (ray.kind, {}))[1].update(ray.values(sizes[:, r]))
    return list(values.values())


def fit_set(
    residuals: Residuals,
    subsets: Sequence[frozenset[str]],
    rays: Mapping[str, Sequence[ParameterRay]],
    start: Sequence[Mapping[str, np.ndarray]],
    steps: int = MAX_FIT_STEPS,
) -> FittedSet:
    """Fit a set of effects by simulation, all sizes of a joint at once.

    The fit to all entries begins at the best of several multiples of `start`; those to all but one
    half begin where it ended, and stay there where their half says nothing: a pump shows its limit
    only in those parts where many joints move at once.

    Args:
        residuals: Residuals of the simulator without them.
        subsets: Effects of each joint.
        rays: Ways in which each effect can grow.
        start: Sizes of each effect along its rays, by joint and name.
        steps: Steps of each fit at most.
    """
    found, mask, sizes = _lay_out(subsets, rays, start)
    every = np.ones((1, len(residuals.fold)))
    halves = np.stack([residuals.fold != 0, residuals.fold != 1]).astype(float)
    fit = _Fit(residuals, found, mask)
    steps = DRIVE_FIT_STEPS if any(r.kind.target.side == "drive" for r in found) else steps
    whole = fit.descended(fit.nearest(sizes)[None], every, steps)
    # Fits to a half begin and are centred at the whole: a half may say nothing about a size.
    apart = fit.descended(np.repeat(whole, 2, 0), halves, max(1, steps // 2), whole)
    z, slopes, _ = _linearise(residuals, found, whole)
    z_apart, paths = fit.simulated(apart)
    half = residuals.fold.reshape(len(residuals.increments), -1)[:, 0]
    first = (half == 0)[:, None, None]
    # The simulator leaves the mean response of stochastic effects out.
    mean = 0.0 if residuals.mean is None else residuals.mean
    after = np.where(first, paths[0], paths[1]) + mean
    own = np.where(first, paths[1], paths[0]) + mean
    held = np.where(residuals.fold == 0, z_apart[0], z_apart[1])
    return FittedSet(
        found,
        mask,
        whole[0],
        apart,
        after,
        own,
        held,
        _estimate_deviations(z[0], slopes[0], residuals, mask),
    )


def build_held_set(
    residuals: Residuals,
    rays: Mapping[str, Sequence[ParameterRay]],
    sizes_by_joint: Sequence[Mapping[str, np.ndarray]],
    known: FittedSet | None = None,
    held: frozenset[int] = frozenset(),
) -> FittedSet:
    """Return a set with given sizes, nothing fitted; joints with the sizes of `known` keep its halves.

    Args:
        residuals: Residuals of the simulator without them.
        rays: Ways in which each effect can grow.
        sizes_by_joint: Sizes of each effect along its rays, by joint and name.
        known: A fitted set.
        held: Joints whose sizes later fits must keep.
    """
    subsets = [frozenset(sizes) for sizes in sizes_by_joint]
    found, mask, sizes = _lay_out(subsets, rays, sizes_by_joint)
    sizes = np.clip(sizes, *_Fit(residuals, found, mask).bounds) * mask
    z, slopes, paths = _linearise(residuals, found, sizes[None])
    z_held = z[0]
    after = paths[0] + (0.0 if residuals.mean is None else residuals.mean)
    own, halves = after.copy(), np.stack([sizes, sizes])
    if known is not None:
        before = look_up_sizes(found, known)
        for j in np.flatnonzero((np.abs(before - sizes) < 1e-9).all(0) & mask.any(0)):
            after[..., j], own[..., j] = known.after[..., j], known.own[..., j]
            z_held[j] = known.z[j]
            for k, half in enumerate(known.halves):
                one = replace(known, sizes=half)
                halves[k, :, j] = look_up_sizes(found, one)[:, j]
    deviation = _estimate_deviations(z[0], slopes[0], residuals, mask)
    return FittedSet(found, mask, sizes, halves, after, own, z_held, deviation, held)


def simulate_refit(
    residuals: Residuals,
    subsets: Sequence[frozenset[str]],
    rays: Mapping[str, Sequence[ParameterRay]],
    start: Sequence[Mapping[str, np.ndarray]],
) -> np.ndarray:
    """Return free runs `(W, K, J)` with a set of effects, sizes fitted to all entries in a few steps from `start`."""
    found, mask, sizes = _lay_out(subsets, rays, start)
    fit = _Fit(residuals, found, mask)
    sizes = fit.descended(fit.nearest(sizes)[None], np.ones((1, len(residuals.fold))), REFIT_STEPS)
    return fit.simulated(sizes)[1][0] + (0.0 if residuals.mean is None else residuals.mean)


def _lay_out(
    subsets: Sequence[frozenset[str]],
    rays: Mapping[str, Sequence[ParameterRay]],
    start: Sequence[Mapping[str, np.ndarray]],
) -> tuple[list[ParameterRay], np.ndarray, np.ndarray]:
    """Return the rays of a set, which joints have them `(R, J)`, and sizes to begin at `(R, J)`."""
    chosen: list[ParameterRay] = []
    mask, sizes = [], []
    for name in sorted(frozenset().union(*subsets)):
        for place, ray in enumerate(rays[name]):
            chosen.append(ray)
            has = [ray.kind.name in subset for subset in subsets]
            mask.append(has)
            sizes.append([start[j][name][place] if one else 0.0 for j, one in enumerate(has)])
    return chosen, np.array(mask), np.array(sizes)


def search_sizes(
    residuals: Residuals,
    rays: Sequence[ParameterRay],
    mask: np.ndarray,
    known: np.ndarray,
    generator: np.random.Generator,
) -> np.ndarray:
    """Return sizes `(R, J)` fitted from many starts about those `known`; where these are 0, about the typical one."""
    drawn = np.exp(SPREAD * generator.standard_normal((DRAWN, *known.shape)))
    starts = np.where(known == 0.0, drawn**2, known * drawn) * mask
    fit = _Fit(residuals, rays, mask)
    starts = np.clip(starts, *fit.bounds)
    order = _compute_totals(fit.simulated(starts)[0], starts, 1.0).argsort(0)[:FOLLOWED]  # (F, J)
    best = np.take_along_axis(starts, order[:, None], 0)
    found = fit.descended(best, np.ones((FOLLOWED, len(residuals.fold))), MAX_FIT_STEPS)
    last = _compute_totals(fit.simulated(found)[0], found, 1.0).argmin(0)
    return np.take_along_axis(found, last[None, None], 0)[0]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Levenberg and Marquardt's descent of the sizes of all joints at once, `F` fits side by side."""

    residuals: Residuals
    rays: Sequence[ParameterRay]
    mask: np.ndarray

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest sizes, `(R, 1)`: beyond the simulated sizes, within the bounds of the numbers."""
        low = np.array([ray.sizes[0] for ray in self.rays])[:, None]
        high = np.array([ray.sizes[-1] for ray in self.rays])[:, None]
        by = np.array([1.0 if ray.is_tied else MAX_EXTRAPOLATION for ray in self.rays])[:, None]
        return np.where(low < 0, by * low, low), by * high

    def simulated(self, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors over the noise `(F, J, E)` and free runs `(F, W, K, J)` at sizes `(F, R, J)`."""
        paths = simulate_sizes(self.residuals.simulator, self.rays, sizes)
        return self.residuals.whiten(self.residuals.compute_error(paths)).swapaxes(0, 1), paths

    def nearest(self, sizes: np.ndarray) -> np.ndarray:
        """Return, joint by joint, the best of several multiples of sizes `(R, J)`."""
        trials = np.clip(np.stack([sizes * by for by in START_FACTORS]), *self.bounds)
        best = _compute_totals(self.simulated(trials)[0], trials, 1.0).argmin(0)
        return np.where(self.mask, np.take_along_axis(trials, best[None, None], 0)[0], 0.0)

    def descended(
        self, now: np.ndarray, used: np.ndarray, steps: int, about: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Return the best sizes from `now` `(F, R, J)` on, entries weighed by `used` `(F, E)`, sizes a priori `about` so large."""
        damping, weights = np.full((len(now), now.shape[2]), 1e-2), used[:, None]
        for _ in range(steps):
            z, slopes, _ = _linearise(self.residuals, self.rays, now)
            least = _compute_totals(z, now - about, weights)
            # All dampings are simulated at once: a step costs one call of the simulator.
            steps_by_damping = []
            for by in DAMPING_FACTORS:
                steps_by_damping.append(self._step(z, slopes, now - about, used, by * damping))
            trials = np.clip(now + np.stack(steps_by_damping), *self.bounds) * self.mask
            tried = self.simulated(trials.reshape(-1, *now.shape[1:]))[0]
            tried = tried.reshape(len(DAMPING_FACTORS), *z.shape)
            pairs = zip(tried, trials, strict=True)
            totals = np.stack(
                [_compute_totals(one, sizes - about, weights) for one, sizes in pairs]
            )  # (D, F, J)
            best = totals.argmin(0)
            gained = least - totals.min(0)
            better = gained > 0.0
            # Where no damping helps, the linearisation fails beyond a much smaller step.
            factor = np.where(better, np.array(DAMPING_FACTORS)[best], DAMPING_FACTORS[-1] ** 2)
            damping = np.clip(damping * factor, *DAMPING_BOUNDS)
            now = np.where(
                better[:, None], np.take_along_axis(trials, best[None, :, None], 0)[0], now
            )
            if gained.max() < MIN_FIT_GAIN:
                break
        return now

    def _step(
        self,
        z: np.ndarray,
        slopes: np.ndarray,
        off: np.ndarray,
        used: np.ndarray,
        damping: np.ndarray,
    ) -> np.ndarray:
        """Return the step of the sizes, `(F, R, J)`; `off`: their difference from the prior mean."""
        step = np.zeros_like(off)
        for f, j in np.ndindex(damping.shape):
            rows = self.mask[:, j]
            weighted = slopes[f, j][rows] * (weigh_residuals(z[f, j]) * used[f])
            normal = weighted @ slopes[f, j][rows].T + np.eye(rows.sum()) / SIZE_PRIOR**2
            damped = normal + damping[f, j] * np.diag(np.diag(normal))
            step[f, rows, j] = np.linalg.solve(
                damped, weighted @ z[f, j] - off[f, rows, j] / SIZE_PRIOR**2
            )
        return step


def _compute_totals(z: np.ndarray, sizes: np.ndarray, used: np.ndarray | float) -> np.ndarray:
    """Return the loss of errors `(F, J, E)` and sizes `(F, R, J)`, `(F, J)`."""
    return (compute_loss(z[..., None], -1) * used).sum(-1) + 0.5 * np.square(
        sizes / SIZE_PRIOR
    ).sum(1)


def _linearise(
    residuals: Residuals, rays: Sequence[ParameterRay], sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors `(F, J, E)`, their slopes over the sizes `(F, J, R, E)`, and free runs `(F, W, K, J)` at sizes `(F, R, J)`."""
    fits, count, joints = sizes.shape
    # Large sizes step backward, away from their bounds.
    last = np.array([ray.sizes[-1] for ray in rays])
    fits_in = (sizes + SIZE_STEP <= last[:, None] * 2).all(2)
    sign = np.where(fits_in, 1.0, -1.0)
    varied = np.repeat(sizes[:, None], count + 1, 1)
    for r in range(count):
        varied[:, r + 1, r] += SIZE_STEP * sign[:, r, None]
    paths = simulate_sizes(residuals.simulator, rays, varied.reshape(-1, count, joints))
    z = residuals.whiten(residuals.compute_error(paths)).reshape(joints, fits, count + 1, -1)
    slopes = (z[:, :, :1] - z[:, :, 1:]) / (SIZE_STEP * sign)[None, :, :, None]
    return (
        z[:, :, 0].swapaxes(0, 1),
        slopes.swapaxes(0, 1),
        paths.reshape(fits, count + 1, *paths.shape[1:])[:, 0],
    )


def _estimate_deviations(
    z: np.ndarray, slopes: np.ndarray, residuals: Residuals, mask: np.ndarray
) -> np.ndarray:
    """Return standard errors of the sizes, `(R, J)`.

    The variance is the larger of that by the likelihood and that between blocks. Small faults of
    the simulator add to it: a constant fault shows in no spread between blocks.
    """
    found = np.zeros(mask.shape)
    for j in np.flatnonzero(mask.any(0)):
        rows = mask[:, j]
        weighted = slopes[j][rows] * weigh_residuals(z[j])
        inverse = np.linalg.inv(weighted @ slopes[j][rows].T + np.eye(rows.sum()) / SIZE_PRIOR**2)
        # The sandwich estimator over blocks holds where entries of a block depend on each other.
        score = weighted * z[j]
        blocks = np.unique(residuals.block)
        scores = np.stack([score[:, residuals.block == one].sum(1) for one in blocks])
        factor = len(scores) / max(1, len(scores) - 1)
        spread = inverse @ (factor * scores.T @ scores) @ inverse
        of_faults = np.square(inverse @ weighted @ residuals.faults[j].T).sum(1)
        found[rows, j] = np.sqrt(np.maximum(np.diag(spread), np.diag(inverse)) + of_faults)
    return found


def compute_gain(before: np.ndarray, after: np.ndarray) -> float:
    """Return by how much the loss of errors over the noise fell."""
    return float(compute_loss(before) - compute_loss(after))


def prune_set(
    residuals: Residuals,
    chosen: EffectSet,
    fitted: FittedSet,
    price: PenaltyFunction,
    scatter: np.ndarray,
    shared: Subset,
) -> tuple[Subset, ...]:
    """Return the set without effects of no size worth naming, and without joints where it does not pay when it is simulated.

    Args:
        residuals: Residuals of the simulator.
        chosen: The set.
        fitted: The set fitted by simulation, its residuals cross-validated between halves.
        price: Penalty of a subset on a joint.
        scatter: Mean square of the whitened residuals, `(J,)`.
        shared: Effects with one cause for all joints: they stay on all of them.
    """
    found = []
    joints = zip(
        fit_joint_faults(residuals, scatter),
        fit_joint_faults(residuals, scatter, fitted.z),
        strict=True,
    )
    for j, (subset, (before, after)) in enumerate(zip(chosen.subsets, joints, strict=True)):
        earned = float(before.loss.sum() - after.loss.sum()) + before.price - after.price
        pays = earned > price(j, subset)
        kept = []
        for name in subset:
            if name in shared or (pays and fitted.size(name, j) >= MIN_SIZE):
                kept.append(name)
        found.append(frozenset(kept))
    return tuple(found)


def drop_effects(
    residuals: Residuals,
    ways: Mapping[str, Sequence[ParameterRay]],
    fitted: FittedSet,
    subsets: Sequence[frozenset[str]],
) -> FittedSet:
    """Return the repair with fewer effects, fitted anew from its sizes; held joints keep theirs."""
    found = refit_from(residuals, ways, subsets, fitted.rays, fitted.sizes)
    if not fitted.held:
        return found
    sizes = list_sizes(found)
    for j in fitted.held:
        sizes[j] = {
            name: size for name, size in list_sizes(fitted)[j].items() if name in subsets[j]
        }
    return build_held_set(residuals, ways, sizes, found, fitted.held)


def list_sizes(fitted: FittedSet) -> list[dict[str, np.ndarray]]:
    """Return the sizes of each effect along its rays, by joint and name."""
    found: list[dict[str, np.ndarray]] = [{} for _ in fitted.sizes.T]
    for ray, sizes, mask in zip(fitted.rays, fitted.sizes, fitted.mask, strict=True):
        for j in np.flatnonzero(mask).tolist():
            own = found[j].get(ray.kind.name, np.zeros(0))
            found[j][ray.kind.name] = np.append(own, sizes[j])
    return found


def list_subsets(fitted: FittedSet) -> tuple[frozenset[str], ...]:
    """Return the effects of each joint."""
    return tuple(frozenset(sizes) for sizes in list_sizes(fitted))


def refit_from(
    residuals: Residuals,
    ways: Mapping[str, Sequence[ParameterRay]],
    subsets: Sequence[frozenset[str]],
    rays_: Sequence[ParameterRay],
    sizes: np.ndarray,
) -> FittedSet:
    """Return the repair with `subsets` whose fit begins at `sizes` `(R, J)` of `rays_`."""
    place = {(ray.kind.name, ray.name): k for k, ray in enumerate(rays_)}
    start: list[dict[str, np.ndarray]] = []
    for j, subset in enumerate(subsets):
        start.append({})
        for name in subset:
            rows = [place[name, ray.name] for ray in ways[name]]
            start[j][name] = sizes[rows, j]
    return fit_set(residuals, subsets, ways, start)


def drop_windows(residuals: Residuals, each: int) -> Residuals:
    """Return the simulator held against one of `each` parts of the recordings."""
    rows = np.concatenate(residuals.groups[::each])
    simulator = residuals.simulator
    cut = replace(
        simulator.cut, **{name: getattr(simulator.cut, name)[rows] for name in ("u", "q", "run")}
    )
    some = {}
    for name in ("valid_mask", "mean", "bias", "late"):
        value = getattr(residuals, name, None)
        if value is not None:
            some[name] = value[rows]
    return replace(
        residuals,
        simulator=replace(simulator, cut=cut, running_s=simulator.running_s[rows]),
        **some,
    )


def look_up_sizes(rays_: Sequence[ParameterRay], fitted: FittedSet) -> np.ndarray:
    """Return the sizes that are known already, 0 where none is, `(R, J)`."""
    sizes = {(ray.kind.name, ray.name): fitted.sizes[k] for k, ray in enumerate(fitted.rays)}
    none = np.zeros(fitted.sizes.shape[1])
    return np.stack([sizes.get((ray.kind.name, ray.name), none) for ray in rays_])
