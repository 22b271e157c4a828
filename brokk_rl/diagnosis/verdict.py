"""From what the search found to what is said: classes that cannot be told apart, probabilities, numbers, a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.diagnosis.answer import Estimate, Ranked, Selected
from brokk_rl.diagnosis.engine import Findings, Prices
from brokk_rl.diagnosis.found import Found
from brokk_rl.diagnosis.library import Kind
from brokk_rl.machine import Machine

SAME = 0.9
"""An effect that earns so much of what another earns in its place cannot be told from it."""
AS_GOOD = 3.0
"""Difference in log likelihood that says nothing."""
LISTED = 8


@dataclass(frozen=True)
class Swap:
    """An effect in the place of a chosen one, and what it earns of what that one earns."""

    name: str
    earned: float
    share: float


def rivals(findings: Findings, name: str) -> list[Swap]:
    """Returns what each other effect would earn in the place of `name`, the best first."""
    found, subsets, own = [], findings.chosen.subsets, 0.0
    places = [j for j, subset in enumerate(subsets) if name in subset]
    without = {j: findings.tables[j].score(subsets[j] - {name}).total for j in places}
    own = sum(findings.tables[j].score(subsets[j]).total - without[j] for j in places)
    for other in findings.rays:
        if other in findings.chosen.names or not all(other in findings.tables[j].shapes for j in places):
            continue
        earned = sum(findings.tables[j].score(subsets[j] - {name} | {other}).total - without[j] for j in places)
        found.append(Swap(other, earned, earned / max(own, 1e-9)))
    return sorted(found, key=lambda swap: -swap.earned)


def same_as(swaps: Sequence[Swap], own: float) -> tuple[str, ...]:
    """Returns the effects that cannot be told from one that earns `own`, at most three."""
    return tuple(swap.name for swap in swaps if swap.share > SAME or own - swap.earned < AS_GOOD)[:3]


def values(findings: Findings, name: str, other: str) -> dict[str, np.ndarray]:
    """Returns the numbers of `other` in the place of the chosen effect `name`, each `(1, J)` or `(1, 1)`."""
    ways = findings.rays[other]
    sizes = np.zeros((len(ways), len(findings.tables)))
    for j, subset in enumerate(findings.chosen.subsets):
        if name in subset:
            sizes[:, j] = findings.tables[j].score(subset - {name} | {other}).sizes[other]
    found: dict[str, np.ndarray] = {}
    for ray, size in zip(ways, sizes, strict=True):
        found |= ray.values(size[None])
    return found


def own_gain(findings: Findings, name: str) -> float:
    """Returns what a chosen effect adds to the rest of the set, on all joints that have it."""
    subsets = [(t, s) for t, s in zip(findings.tables, findings.chosen.subsets, strict=True) if name in s]
    return sum(table.score(subset).total - table.score(subset - {name}).total for table, subset in subsets)


def margin(findings: Findings, prices: Prices, name: str, swaps: Sequence[Swap], like: Sequence[str]) -> float:
    """Returns by how much a chosen effect is worth more than nothing in its place, and than what is not like it."""
    own, subsets = own_gain(findings, name), findings.chosen.subsets
    saved = sum(findings.price(j, s) - findings.price(j, s - {name}) for j, s in enumerate(subsets) if name in s)
    others = [own - swap.earned for swap in swaps if swap.name not in like]
    return min([own - saved - prices.name, *others])


def probability(margin: float, prices: Prices) -> float:
    """Returns the probability that goes with a margin of worth."""
    return float(1.0 / (1.0 + np.exp(-np.clip(margin / prices.temperature, -30.0, 30.0))))


def numbers(findings: Findings, kind: Kind, machine: Machine) -> dict[str, dict[str, Estimate]]:
    """Returns the numbers of a selected effect by joint."""
    repair = findings.repair
    assert repair is not None, "a selected effect has been simulated"
    found: dict[str, dict[str, Estimate]] = {}
    for ray, mask, size, deviation in zip(repair.rays, repair.mask, repair.sizes, repair.deviation, strict=True):
        if ray.kind.name != kind.name:
            continue
        for name in (ray.name,) if ray.name else kind.fitted:
            number, unit = kind.numbers[name], kind.size(name)
            for j in np.flatnonzero(mask):
                ends = number.none + unit * (size[j] + np.array([-1.96, 0.0, 1.96]) * deviation[j])
                low, mean, high = (float(v) for v in np.sort(np.clip(ends, *number.bounds)))
                joint = machine.joint_names[j] if number.per_joint else "machine"
                found.setdefault(name, {})[joint] = Estimate(mean, (low, high))
    for ray in repair.rays:
        for name, part in ray.shape.items() if ray.kind.name == kind.name else ():
            values = kind.clipped(name, part * kind.numbers[name].typical)
            places = np.flatnonzero(repair.joints_of(kind))
            given = {machine.joint_names[j]: float(values[j]) for j in places}
            found[name] = {joint: Estimate(value, (value, value)) for joint, value in given.items()}
    return found


def chosen_kinds(findings: Findings, kinds: Mapping[str, Kind]) -> list[Kind]:
    """Returns the chosen effects, the ones that earn most first."""
    return [kinds[name] for name in sorted(findings.chosen.names, key=lambda name: -own_gain(findings, name))]


def unexplained(findings: Findings, prices: Prices) -> np.ndarray:
    """Returns what shows that something is left, by joint, `(J,)`: predicted by a flexible model, or scattered too much."""
    predicted = np.maximum(findings.left - 1.5 * findings.left_null - prices.remainder, 0.0)
    entries = findings.evidence.z.shape[1]
    noisy = {one.kind.stage for one in findings.others} & {"timing"}
    scattered = np.zeros(len(predicted)) if noisy else 0.5 * entries * np.log(np.maximum(findings.scatter / prices.scatter, 1.0))
    return np.maximum(predicted, scattered)


def is_unknown(findings: Findings, prices: Prices) -> bool:
    """Says whether something is there that the library does not explain."""
    left = unexplained(findings, prices)
    subsets = zip(findings.tables, findings.chosen.subsets, strict=True)
    gained = sum(table.score(s).total if s else 0.0 for table, s in subsets) + sum(one.gain for one in findings.others)
    if findings.tool_left > prices.tool and not any(one.kind.stage in ("kinematics", "sensing") for one in findings.others):
        return True
    return bool(left.sum() > 0 and gained < prices.explained * (gained + left.sum()))


def unknown_chance(findings: Findings, prices: Prices) -> float:
    """Returns the probability that the cause lies outside the library."""
    left = unexplained(findings, prices).sum()
    if is_unknown(findings, prices):
        return max(0.5, probability(left, prices))
    return min(0.5, probability(left - 4.0 * prices.temperature, prices))


def other(found: Found, prices: Prices, machine: Machine) -> Selected:
    """Returns what is said of an effect that sensors, frames or tool points show."""
    near = sorted(found.rivals, key=lambda name: -found.rivals[name])
    like = tuple(name for name in near if found.rivals[name] > max(SAME * found.gain, found.gain - AS_GOOD))[:3]
    return Selected(
        effect=found.kind.name,
        joints=tuple(name for name, has in zip(machine.joint_names, found.joints, strict=True) if has),
        probability=probability(found.worth, prices),
        parameters=found.parameters,
        gap_closed=Estimate(found.closed, (found.closed, found.closed)),
        same_as=like,
    )


def ranking(findings: Findings, selected: Sequence[Selected], prices: Prices, machine: Machine, unknown: float) -> list[Ranked]:
    """Returns all rivals worth naming, most probable first; `none` and `unknown` among them."""
    named = {one.effect: Ranked(one.effect, one.joints, one.probability) for one in selected}
    for name in findings.rays:
        if name in named:
            continue
        worth = [
            (table.scored[frozenset({name})].total - findings.price(j, frozenset({name})), j)
            for j, table in enumerate(findings.tables)
            if frozenset({name}) in table.scored and table.scored[frozenset({name})].total > prices.joint
        ]
        alone = sum(max(value, 0.0) for value, _ in worth) - prices.name
        chance = probability(alone - max(findings.chosen.worth, 0.0), prices)
        joints = tuple(machine.joint_names[j] for value, j in worth if value > 0)
        if joints:
            named[name] = Ranked(name, joints, chance)
    chances = [one.probability for one in selected]
    none = 1.0 - max(chances) if chances else max(0.0, 1.0 - unknown)
    rows = [*named.values(), Ranked("none", (), none), Ranked("unknown", (), unknown)]
    return sorted(rows, key=lambda one: -one.probability)[:LISTED]
