"""What effects do around a set that was found, where adding up what each does by itself is far off.

A saturation does nothing to a simulator whose dead band is missing, and a dead band of a third of
the command changes what all
others do. There the search goes on from the set: each effect is simulated in the company of the
others, from none to far beyond its typical size, and what all of them together change is put down
as the sum of what each adds to the rest. Sets that differ from the one found by one effect are then
as right as their simulation. What pays only together with another is found by fitting all sizes of
a set with one effect more, from many starts.
Axes: `J` joints, `R` rays, `E` entries (increments of all windows, over the simulator's noise).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diagnosis.evidence import GRID, Evidence, Ray, rays
from diagnosis.noise import increments, loss
from diagnosis.repair import Repair, repair, searched, simulate
from diagnosis.search import Chosen, Price, Table
from diagnosis.shapes import FELT
from diagnosis.sizes import Shape

WIDE = tuple(sorted({*GRID, 4.0, 5.5, 7.5, 10.0, 14.0}))
"""Sizes, over the typical one, at which effects are simulated; numbers keep their bounds."""
ROUGH = 0.7
"""A set that earns less than so much of what adding up promised does not add up."""
LARGE = 2.6
"""Sizes over the typical one from which adding up is not trusted."""

TRIED = 6
"""Effects that are tried beside a set by fitting all sizes together."""
EACH = 4
"""They are tried on one of so many parts of the recordings."""

Shapes = list[dict[str, list[Shape]]]
Around = tuple[np.ndarray, dict[str, list[Ray]], Shapes]
"""The errors that are to be explained `(J, E)`, the rays of each effect, and what they do to each
joint."""


def is_needed(evidence: Evidence, repaired: Repair, promised: float) -> bool:
    """Says whether effects hardly add up: sizes are far beyond the typical, and some hide others, or earn far less than `promised`.

    What acts on the command hides what else does: nothing shows within a dead band. A speed that is
    far off hides nothing.
    """
    far = [
        ray
        for ray, sizes in zip(repaired.rays, repaired.sizes, strict=True)
        if np.abs(sizes).max() > LARGE
    ]
    hides = any(ray.kind.target.side == "command" for ray in far)
    return hides or (bool(far) and float(loss(evidence.z) - loss(repaired.z)) < ROUGH * promised)


def simulated(evidence: Evidence, grown: Mapping[str, Sequence[Ray]], repaired: Repair) -> Around:
    """Returns what effects do in the company of a set."""
    joints = evidence.way.shape[2]
    shapes: Shapes = [{} for _ in range(joints)]
    left = evidence.whitened(
        evidence.error_of(simulate(evidence.candidates, repaired.rays, repaired.sizes[None]))
    )[:, 0]
    wide: dict[str, list[Ray]] = {}
    mine = {(ray.kind.name, ray.name): place for place, ray in enumerate(repaired.rays)}
    for name, ways in grown.items():
        grid = sorted(
            {*WIDE, *ways[0].sizes[ways[0].sizes > 0.0].tolist()}
        )  # as close as they were before
        wide[name] = [replace(ray, shape=ways[0].shape) for ray in rays(ways[0].kind, grid)]
        responses = [_response(evidence, ray, wide[name], repaired) for ray in wide[name]]
        for j in range(joints):
            if max(np.abs(response[j]).max() for response in responses) >= FELT:
                shapes[j][name] = [
                    Shape(ray.sizes, response[j])
                    for ray, response in zip(wide[name], responses, strict=True)
                ]
        for ray, response in zip(wide[name], responses, strict=True):
            place = mine.get((name, ray.name))
            for j in range(joints) if place is not None else ():
                left[j] += Shape(ray.sizes, response[j]).at(float(repaired.sizes[place, j]))[0]
    return left, wide, shapes


def _response(evidence: Evidence, ray: Ray, ways: Sequence[Ray], repaired: Repair) -> np.ndarray:
    """Returns what a ray changes at each of its sizes, in the company of the set, over the noise, `(J, C, E)`."""
    has = any(one.kind.name == ray.kind.name for one in repaired.rays)
    company = [*repaired.rays, *([] if has else ways)]
    place = next(
        k
        for k, one in enumerate(company)
        if one.kind.name == ray.kind.name and one.name == ray.name
    )
    sizes = np.zeros((len(ray.sizes), len(company), repaired.sizes.shape[1]))
    sizes[:, : len(repaired.rays)] = repaired.sizes
    sizes[:, place] = ray.sizes[:, None]
    ends = increments(simulate(evidence.candidates, company, sizes), evidence.start)
    return evidence.whitened(ends - ends[np.flatnonzero(ray.sizes == 0.0)[0]])


def grown(
    evidence: Evidence,
    ways: Mapping[str, Sequence[Ray]],
    tables: Sequence[Table],
    chosen: Chosen,
    repaired: Repair,
    price: float,
) -> Repair | None:
    """Returns the set with one more effect, on the joints where it pays, all sizes fitted together; `None` where none pays.

    A saturation pays only when dead band and speed move along with it: adding up does not show
    that, a joint fit does. `price` is that of a joint with an effect, in the part of the recordings
    on which this is tried.
    """
    part = thinned(evidence, EACH)
    least = _losses(part, repaired.rays, repaired.sizes)
    found, most = None, 0.0
    for name in _promising(tables, chosen, ways):
        subsets = [
            s | {name} if s and name in t.shapes else s
            for t, s in zip(tables, chosen.subsets, strict=True)
        ]
        rays_ = [ray for one in sorted(frozenset().union(*subsets)) for ray in ways[one]]
        mask = np.array([[ray.kind.name in subset for subset in subsets] for ray in rays_])
        sizes = searched(part, rays_, mask, _known(rays_, repaired), np.random.default_rng(0))
        gain = least - _losses(part, rays_, sizes)
        new = np.array(
            [name in s and name not in old for s, old in zip(subsets, chosen.subsets, strict=True)]
        )
        pays = new & (gain > price)
        if (worth := float((gain - price)[pays].sum())) > most:
            kept = [
                s if p else old for s, p, old in zip(subsets, pays, chosen.subsets, strict=True)
            ]
            start = np.where(pays, sizes, _known(rays_, repaired))
            found, most = (kept, rays_, start), worth
    return _repaired(evidence, ways, *found) if found else None


def best(
    evidence: Evidence, ways: Mapping[str, Sequence[Ray]], tried: Sequence[Repair], price: Price
) -> Repair | None:
    """Returns the repair that takes for each joint the best of those `tried`, none where errors of free runs only grow by it.

    `price` is what a set costs on a joint. `None` where no joint is left.
    """
    measured = evidence.candidates.cut.measured
    squares = [
        np.square(paths - measured).mean((0, 1))
        for paths in (evidence.base, *(one.after for one in tried))
    ]
    subsets, rays_ = (
        [],
        list({(ray.kind.name, ray.name): ray for one in tried for ray in one.rays}.values()),
    )
    start = np.zeros((len(rays_), evidence.way.shape[2]))
    for j in range(evidence.way.shape[2]):
        own = [subsets_of(one)[j] for one in tried]
        cost = [
            float(loss(one.z[j])) + (price(j, s) if s else 0.0)
            for one, s in zip(tried, own, strict=True)
        ]
        closing = [k for k in np.argsort(cost) if squares[k + 1][j] < squares[0][j]]
        subsets.append(own[closing[0]] if closing else frozenset())
        if closing:
            start[:, j] = _known(rays_, tried[closing[0]])[:, j]
    return _repaired(evidence, ways, subsets, rays_, start) if any(subsets) else None


def paying(
    tables: Sequence[Table], subsets: Sequence[frozenset[str]], price: Price, name_price: float
) -> tuple[frozenset[str], ...]:
    """Returns the sets without effects that add less than they cost, dropped one by one: of two that are alike one stays."""
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


def without(
    evidence: Evidence,
    ways: Mapping[str, Sequence[Ray]],
    repaired: Repair,
    subsets: Sequence[frozenset[str]],
) -> Repair:
    """Returns the repair with fewer effects, fitted anew from its sizes."""
    return _repaired(evidence, ways, subsets, repaired.rays, repaired.sizes)


def subsets_of(repaired: Repair) -> tuple[frozenset[str], ...]:
    """Returns the effects of each joint."""
    return tuple(
        frozenset(ray.kind.name for ray, has in zip(repaired.rays, mask, strict=True) if has)
        for mask in repaired.mask.T
    )


def _repaired(
    evidence: Evidence,
    ways: Mapping[str, Sequence[Ray]],
    subsets: Sequence[frozenset[str]],
    rays_: Sequence[Ray],
    sizes: np.ndarray,
) -> Repair:
    """Returns the repair with `subsets` whose fit begins at `sizes` `(R, J)` of `rays_`."""
    place = {(ray.kind.name, ray.name): k for k, ray in enumerate(rays_)}
    start = [
        {n: np.array([sizes[place[n, ray.name], j] for ray in ways[n]]) for n in s}
        for j, s in enumerate(subsets)
    ]
    return repair(evidence, subsets, ways, start)


def thinned(evidence: Evidence, each: int) -> Evidence:
    """Returns the simulator held against one of `each` parts of the recordings."""
    rows = np.concatenate(evidence.groups[::each])
    candidates = evidence.candidates
    cut = replace(
        candidates.cut, **{name: getattr(candidates.cut, name)[rows] for name in ("u", "q", "run")}
    )
    some = {
        name: value[rows]
        for name in ("claims", "mean", "bias", "late")
        if (value := getattr(evidence, name, None)) is not None
    }
    return replace(
        evidence,
        candidates=replace(candidates, cut=cut, running_s=candidates.running_s[rows]),
        **some,
    )


def _known(rays_: Sequence[Ray], repaired: Repair) -> np.ndarray:
    """Returns the sizes that are known already, 0 where none is, `(R, J)`."""
    sizes = {(ray.kind.name, ray.name): repaired.sizes[k] for k, ray in enumerate(repaired.rays)}
    return np.stack(
        [sizes.get((ray.kind.name, ray.name), np.zeros(repaired.sizes.shape[1])) for ray in rays_]
    )


def _losses(evidence: Evidence, rays_: Sequence[Ray], sizes: np.ndarray) -> np.ndarray:
    """Returns the loss of each joint at sizes `(R, J)`, `(J,)`."""
    paths = simulate(evidence.candidates, rays_, sizes[None])
    return loss(evidence.whitened(evidence.error_of(paths))[:, 0], 1)


def _promising(
    tables: Sequence[Table], chosen: Chosen, ways: Mapping[str, Sequence[Ray]]
) -> list[str]:
    """Returns effects that some joint with a set lacks: those on the command, which hide behind each other, then what adds most."""
    found: dict[str, float] = {}
    for table, subset in zip(tables, chosen.subsets, strict=True):
        own = table.score(subset).total
        for name in table.shapes.keys() - subset if subset else ():
            found[name] = found.get(name, 0.0) + max(0.0, table.score(subset | {name}).total - own)
    return sorted(
        found, key=lambda name: (ways[name][0].kind.target.side != "command", -found[name])
    )[:TRIED]
