"""The search around sets of effects whose responses do not add up.

The search adds up the responses of single effects. A saturation does nothing to a simulator without
dead band, and a dead band of a third of the command changes the responses of all other effects.
Where the sum is far off, each effect is simulated again beside the others of the set, and all sizes
of a set with one more effect are fitted together from many starts.
Axes: `J` joints, `R` growth paths, `E` entries (whitened increments).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from brokk_rl.parallel import map_parallel
from diagnosis.error_covariance import compute_loss
from diagnosis.refine import (
    FittedSet,
    drop_windows,
    list_subsets,
    look_up_sizes,
    refit_from,
    search_sizes,
    simulate_sizes,
)
from diagnosis.residuals import SIZE_GRID, ParameterRay, Residuals, build_rays, to_increments
from diagnosis.responses import MIN_RESPONSE, Response
from diagnosis.search import EffectSet, PenaltyFunction, SubsetTable

# Chosen by hand; not searched.
WIDE_GRID = tuple(sorted({*SIZE_GRID, 4.0, 5.5, 7.5, 10.0, 14.0}))
"""Sizes, over the typical one, at which effects are simulated; numbers keep their bounds."""

MIN_ADDITIVE_SHARE = 0.7
"""A set that earns less than so much of what adding up promised does not add up."""

LARGE_SIZE = 2.6
"""Sizes over the typical one from which adding up is not trusted."""

MAX_ADDITIONS = 6
"""Effects that are tried beside a set by fitting all sizes together."""

ADDITION_WINDOWS = 4
"""They are tried on one of so many parts of the recordings."""

Shapes = list[dict[str, list[Response]]]


class WideResponses(NamedTuple):
    """Responses of effects beside a fitted set.

    Attributes:
        z: Residuals that are to be explained, over the noise, `(J, E)`.
        rays: Rays of each effect.
        shapes: Responses of each joint to each effect, one a ray.
    """

    z: np.ndarray
    rays: dict[str, list[ParameterRay]]
    shapes: Shapes


def is_needed(residuals: Residuals, fitted: FittedSet, promised: float) -> bool:
    """Return True where the responses of the set do not add up.

    Sizes are then far beyond the typical ones, and an effect hides others or gains far less than
    `promised`.
    An effect on the command hides all others: nothing shows within a dead band. A large error of
    speed hides nothing. Mass and friction of a drive are in one differential equation.
    """
    if any(ray.kind.target.side == "drive" for ray in fitted.rays):
        return True
    far: list[ParameterRay] = []
    for ray, sizes in zip(fitted.rays, fitted.sizes, strict=True):
        if np.abs(sizes).max() > LARGE_SIZE:
            far.append(ray)
    if any(ray.kind.target.side == "command" for ray in far):
        return True
    gain = float(compute_loss(residuals.z) - compute_loss(fitted.z))
    return bool(far) and gain < MIN_ADDITIVE_SHARE * promised


def simulate_beside(
    residuals: Residuals, grown: Mapping[str, Sequence[ParameterRay]], fitted: FittedSet
) -> WideResponses:
    """Return the responses to effects beside a fitted set."""
    joints = residuals.increments.shape[2]
    shapes: Shapes = [{} for _ in range(joints)]
    paths = simulate_sizes(residuals.simulator, fitted.rays, fitted.sizes[None])
    left = residuals.whiten(residuals.compute_error(paths))[:, 0]
    wide: dict[str, list[ParameterRay]] = {}
    mine = {(ray.kind.name, ray.name): place for place, ray in enumerate(fitted.rays)}
    for name, ways in grown.items():
        # As close as before: an effect that rings is out of step on a coarser grid.
        grid = sorted({*WIDE_GRID, *ways[0].sizes[ways[0].sizes > 0.0].tolist()})
        wide[name] = [replace(ray, shape=ways[0].shape) for ray in build_rays(ways[0].kind, grid)]
    every = map_parallel(
        lambda name: _simulate_responses(residuals, wide[name], fitted), list(wide)
    )
    for name, responses in zip(wide, every, strict=True):
        for j in range(joints):
            if max(np.abs(response[j]).max() for response in responses) >= MIN_RESPONSE:
                pairs = zip(wide[name], responses, strict=True)
                shapes[j][name] = [Response(ray.sizes, response[j]) for ray, response in pairs]
        # Effects of the set are to be chosen again, so their own responses are added back.
        for ray, response in zip(wide[name], responses, strict=True):
            place = mine.get((name, ray.name))
            for j in range(joints) if place is not None else ():
                left[j] += Response(ray.sizes, response[j]).at(float(fitted.sizes[place, j]))[0]
    return WideResponses(left, wide, shapes)


def _simulate_responses(
    residuals: Residuals, ways: Sequence[ParameterRay], fitted: FittedSet
) -> list[np.ndarray]:
    """Return the whitened response at each size of the rays of an effect, beside the fitted set, each `(J, C, E)`."""
    has = any(one.kind.name == ways[0].kind.name for one in fitted.rays)
    company = [*fitted.rays, *([] if has else ways)]
    places = [(one.kind.name, one.name) for one in company]
    trials = []
    for ray in ways:
        sizes = np.zeros((len(ray.sizes), len(company), fitted.sizes.shape[1]))
        sizes[:, : len(fitted.rays)] = fitted.sizes
        sizes[:, places.index((ray.kind.name, ray.name))] = ray.sizes[:, None]
        trials.append(sizes)
    paths = simulate_sizes(residuals.simulator, company, np.concatenate(trials))
    ends, found, first = to_increments(paths, residuals.start), [], 0
    for ray in ways:
        own = ends[first : first + len(ray.sizes)]
        found.append(residuals.whiten(own - own[np.flatnonzero(ray.sizes == 0.0)[0]]))
        first += len(ray.sizes)
    return found


def add_effect(
    residuals: Residuals,
    ways: Mapping[str, Sequence[ParameterRay]],
    tables: Sequence[SubsetTable],
    chosen: EffectSet,
    fitted: FittedSet,
    price: float,
) -> FittedSet | None:
    """Return the set with one more effect, on the joints where it pays, all sizes fitted together; `None` where none pays.

    A saturation pays only when dead band and speed move along with it: adding up does not show
    that, a joint fit does. `price` is that of a joint with an effect, in the part of the recordings
    on which this is tried.
    """
    part = drop_windows(residuals, ADDITION_WINDOWS)
    least = _compute_losses(part, fitted.rays, fitted.sizes)
    found, most = None, 0.0
    for name in _rank_additions(tables, chosen, ways):
        # A joint without any effect has no set to which the effect could belong.
        pairs = zip(tables, chosen.subsets, strict=True)
        new = np.array([bool(s) and name in t.shapes and name not in s for t, s in pairs])
        subsets = _add_name(chosen.subsets, new, name)
        rays_: list[ParameterRay] = []
        for one in sorted(frozenset().union(*subsets)):
            rays_ += ways[one]
        mask = np.array([[ray.kind.name in subset for subset in subsets] for ray in rays_])
        known = look_up_sizes(rays_, fitted)
        # The same draws for each effect, so that chance does not decide between them.
        sizes = search_sizes(part, rays_, mask, known, np.random.default_rng(0))
        gain = least - _compute_losses(part, rays_, sizes)
        pays = new & (gain > price)
        if (worth := float((gain - price)[pays].sum())) > most:
            kept = _add_name(chosen.subsets, pays, name)
            found, most = (kept, rays_, np.where(pays, sizes, known)), worth
    return refit_from(residuals, ways, *found) if found else None


def _add_name(
    subsets: Sequence[frozenset[str]], joints: np.ndarray, name: str
) -> list[frozenset[str]]:
    """Return the subsets, with `name` on the `joints` `(J,)` bool."""
    return [s | {name} if has else s for s, has in zip(subsets, joints, strict=True)]


def combine_best(
    residuals: Residuals,
    ways: Mapping[str, Sequence[ParameterRay]],
    tried: Sequence[FittedSet],
    price: PenaltyFunction,
) -> FittedSet | None:
    """Return the repair that takes for each joint the best of those `tried`, none where errors of free runs only grow by it.

    `price` is the penalty of a set on a joint. `None` where no joint is left.
    """
    measured = residuals.simulator.cut.measured
    squares = [np.square(residuals.base - measured).mean((0, 1))]
    by_name: dict[tuple[str, str], ParameterRay] = {}
    for one in tried:
        squares.append(np.square(one.after - measured).mean((0, 1)))
        for ray in one.rays:
            by_name[ray.kind.name, ray.name] = ray
    subsets, rays_ = [], list(by_name.values())
    start = np.zeros((len(rays_), residuals.increments.shape[2]))
    for j in range(residuals.increments.shape[2]):
        own = [list_subsets(one)[j] for one in tried]
        cost = []
        for one, subset in zip(tried, own, strict=True):
            cost.append(float(compute_loss(one.z[j])) + (price(j, subset) if subset else 0.0))
        # Increments may fit better while errors of whole free runs grow.
        closing = [k for k in np.argsort(cost) if squares[k + 1][j] < squares[0][j]]
        subsets.append(own[closing[0]] if closing else frozenset())
        if closing:
            start[:, j] = look_up_sizes(rays_, tried[closing[0]])[:, j]
    return refit_from(residuals, ways, subsets, rays_, start) if any(subsets) else None


def drop_unneeded(
    tables: Sequence[SubsetTable],
    subsets: Sequence[frozenset[str]],
    price: PenaltyFunction,
    name_price: float,
) -> tuple[frozenset[str], ...]:
    """Return the sets without effects that add less than they cost, dropped one by one: of two that are alike one stays."""
    while names := frozenset().union(*subsets):
        own = dict.fromkeys(names, -name_price)
        for j, (table, subset) in enumerate(zip(tables, subsets, strict=True)):
            for name in subset:
                gain = table.score(subset).total - table.score(subset - {name}).total
                own[name] += gain - (price(j, subset) - price(j, subset - {name}))
        least = min(own, key=own.__getitem__)
        if own[least] > 0.0:
            break
        subsets = tuple(subset - {least} for subset in subsets)
    return tuple(subsets)


def _compute_losses(
    residuals: Residuals, rays_: Sequence[ParameterRay], sizes: np.ndarray
) -> np.ndarray:
    """Return the loss of each joint at sizes `(R, J)`, `(J,)`."""
    paths = simulate_sizes(residuals.simulator, rays_, sizes[None])
    return compute_loss(residuals.whiten(residuals.compute_error(paths))[:, 0], 1)


def _rank_additions(
    tables: Sequence[SubsetTable], chosen: EffectSet, ways: Mapping[str, Sequence[ParameterRay]]
) -> list[str]:
    """Return effects that some joint with a set lacks: first those on the command, which hide each other, then by gain."""
    found: dict[str, float] = {}
    for table, subset in zip(tables, chosen.subsets, strict=True):
        own = table.score(subset).total
        for name in table.shapes.keys() - subset if subset else ():
            found[name] = found.get(name, 0.0) + max(0.0, table.score(subset | {name}).total - own)

    def rank(name: str) -> tuple[bool, float]:
        return ways[name][0].kind.target.side != "command", -found[name]

    return sorted(found, key=rank)[:MAX_ADDITIONS]
