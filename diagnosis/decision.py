"""From detected effects to an answer: rivals, probabilities, numbers with intervals, a verdict.

The weights of the choice are recorded as plain JSON, enough to choose again at other penalties
without a simulation.
Axes: `J` joints, `E` entries, `B` blocks of entries that hang together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from brokk_rl.machine import Machine
from diagnosis import calibration
from diagnosis.answer import Estimate, Ranked, Selected
from diagnosis.calibration import Certainty
from diagnosis.detection import Findings, Prices
from diagnosis.effect_library import Found, Kind, shared
from diagnosis.refine import without
from diagnosis.residuals import Evidence
from diagnosis.responses import plain
from diagnosis.search import Chosen, Scored, Subset, Table, choose, promising


def record_weights(findings: Findings, prices: Prices) -> dict[str, Any]:
    """Returns what was weighed."""
    joints, common = [], shared(ways[0].kind for ways in findings.rays.values() if ways)
    for j, table in enumerate(findings.tables):
        priced = {*promising(table, prices.joint, prices.share, common)}
        rows = []
        for subset in sorted(table.scored, key=sorted):
            if subset in priced:
                null = findings.price(j, subset) - prices.joint * len(subset - common)
                rows.append(
                    _row(table, subset) | {"null": round(null / max(prices.reference, 1e-9), 2)}
                )
            elif subset and (len(subset) < 3 or any(subset < larger for larger in priced)):
                rows.append(_row(table, subset) | {"gain": round(table.scored[subset].total, 2)})
        joints.append({"felt": sorted(table.shapes), "subsets": rows})
    return {
        "joints": joints,
        "others": [{"effect": one.kind.name, "joints": one.joints.tolist(), "worth": one.worth, "gain": one.gain,
                    "rivals": dict(one.rivals)} for one in findings.others],
        "left": findings.left.tolist(), "left_null": findings.left_null.tolist(), "scatter": findings.scatter.tolist(),
        "strays": findings.strays.tolist(), "tool_left": findings.tool_left, "entries": findings.evidence.z.shape[1],
        "blocks": int(findings.evidence.block.max()) + 1,
        "prices": {"joint": prices.joint, "name": prices.name},
    }  # fmt: skip


def _row(table: Table, subset: Subset) -> dict[str, Any]:
    scored = table.scored[subset]
    sizes = {name: [round(float(v), 3) for v in size] for name, size in scored.sizes.items()}
    gain = np.bincount(table.block, scored.gain)
    return {"effects": sorted(subset), "gain": [round(float(v), 2) for v in gain], "sizes": sizes}


def restore_result(told: Mapping[str, Any], prices: Prices, kinds: Sequence[Kind]) -> Findings:
    """Returns the findings at other prices; evidence, repair and rays are those that choosing and saying need, no more."""
    tables, nulls, count = [], [], told["blocks"]
    for joint in told["joints"]:
        table = Table(
            plain(np.zeros(count), []), {name: [] for name in joint["felt"]}, np.arange(count)
        )
        for row in joint["subsets"]:
            sizes = {name: np.array(size) for name, size in row["sizes"].items()}
            gain = np.array(row["gain"]) if "null" in row else np.full(count, row["gain"] / count)
            table.scored[frozenset(row["effects"])] = Scored(gain, sizes)
        tables.append(table)
        nulls.append(
            {frozenset(row["effects"]): row["null"] for row in joint["subsets"] if "null" in row}
        )

    def price(j: int, subset: Subset) -> float:
        return prices.joint * len(subset - shared(kinds)) + prices.reference * nulls[j].get(
            subset, 0.0
        )

    chosen = chosen_of(tables, price, prices, kinds)
    by_name = {kind.name: kind for kind in kinds}
    others = []
    for one in told["others"]:
        mask, was = np.array(one["joints"]), told["prices"]
        more = (was["joint"] - prices.joint) * (
            1 if by_name[one["effect"]].target.stochastic else mask.sum()
        )
        worth = one["worth"] + more + was["name"] - prices.name
        if worth > 0:
            others.append(
                Found(by_name[one["effect"]], mask, {}, worth, one["gain"], 0.0, one["rivals"])
            )
    evidence = cast(Evidence, SimpleNamespace(z=np.zeros((len(tables), told["entries"]))))
    left, left_null, scatter, strays = (
        np.array(told[name]) for name in ("left", "left_null", "scatter", "strays")
    )
    rays = {name: [] for joint in told["joints"] for name in joint["felt"]}
    return Findings(
        evidence,
        tables,
        rays,
        price,
        chosen,
        None,
        others,
        left,
        left_null,
        scatter,
        strays,
        told["tool_left"],
    )


def chosen_of(tables: Sequence[Table], price: Any, prices: Prices, kinds: Sequence[Kind]) -> Chosen:
    """Returns the set that is worth most at these prices."""
    return choose(
        tables, price, prices.name, prices.share, shared(kinds), prices.partial, prices.joint
    )


SAME = 0.9
"""An effect that earns so much of what another earns in its place cannot be told from it."""
AS_GOOD = 3.0
"""Difference in log likelihood that says nothing."""
LISTED = 8
NAMED = 0.5
"""Probability from which a further effect is named: one that is missed costs what a wrong one
does."""
SAID = 0.27
"""Probability from which an unknown cause is told in the place of effects. Causes outside the
library are about a fifth of all,
effects more than half: at this, a share of the one kind that is missed costs as much as the same
share of the other."""
STANDS = 0.9
"""Probability from which what sensors, frames or tool points show is told, however probable an
unknown cause is beside it."""
LEFT = 15.0
"""Evidence of a clue, beyond that on the reference, from which the report says that something is
left on a joint."""
TOLD = 0.9
"""Probability of an unknown cause where tool points are off and no effect moves them so."""
SCATTERED = 1.6
"""Mean square error over that of the reference from which it says the same."""


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
        if other in findings.chosen.names or not all(
            other in findings.tables[j].shapes for j in places
        ):
            continue
        earned = sum(
            findings.tables[j].score(subsets[j] - {name} | {other}).total - without[j]
            for j in places
        )
        found.append(Swap(other, earned, earned / max(own, 1e-9)))
    return sorted(found, key=lambda swap: -swap.earned)


def same_as(swaps: Sequence[Swap], own: float) -> tuple[str, ...]:
    """Returns the effects that cannot be told from one that earns `own`, at most three."""
    return tuple(swap.name for swap in swaps if swap.share > SAME or own - swap.earned < AS_GOOD)[
        :3
    ]


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
    subsets = [
        (t, s) for t, s in zip(findings.tables, findings.chosen.subsets, strict=True) if name in s
    ]
    return sum(
        table.score(subset).total - table.score(subset - {name}).total for table, subset in subsets
    )


def margin(
    findings: Findings, prices: Prices, name: str, swaps: Sequence[Swap], like: Sequence[str]
) -> float:
    """Returns by how much a chosen effect is worth more than nothing in its place, and than what is not like it."""
    own, subsets = own_gain(findings, name), findings.chosen.subsets
    saved = sum(
        findings.price(j, s) - findings.price(j, s - {name})
        for j, s in enumerate(subsets)
        if name in s
    )
    others = [own - swap.earned for swap in swaps if swap.name not in like]
    return min([own - saved - prices.name, *others])


def named_signs(
    findings: Findings,
    prices: Prices,
    weights: Certainty,
    name: str,
    swaps: Sequence[Swap],
    like: Sequence[str],
) -> dict[str, float]:
    """Returns the signs that a chosen effect is rightly named."""
    places = [
        (t, s) for t, s in zip(findings.tables, findings.chosen.subsets, strict=True) if name in s
    ]
    whole = sum(table.score(subset).total for table, subset in places)
    size = max(float(np.abs(table.score(subset).sizes[name]).max()) for table, subset in places)
    adds = own_gain(findings, name) / max(whole, 1e-9)
    outside = calibration.odds(weights.outside, calibration.outside(findings))
    return calibration.right(
        margin(findings, prices, name, swaps, like), adds, size, len(findings.names), outside
    )


def other_signs(findings: Findings, weights: Certainty, found: Found) -> dict[str, float]:
    """Returns the same of an effect that sensors, frames or tool points show."""
    outside = calibration.odds(weights.outside, calibration.outside(findings))
    return calibration.right(found.worth, 1.0, 1.0, len(findings.names), outside)


def none_signs(findings: Findings, prices: Prices, weights: Certainty) -> dict[str, float]:
    """Returns the signs that there is nothing to find."""
    nearest = max(
        (_alone(findings, prices, name)[0] for name in findings.rays), default=-prices.name
    )
    return calibration.none(
        nearest, calibration.odds(weights.outside, calibration.outside(findings))
    )


def numbers(
    findings: Findings, kind: Kind, machine: Machine, form: float
) -> dict[str, dict[str, Estimate]]:
    """Returns the numbers of a selected effect by joint; `form`: what its real forms add to the error, over its size."""
    repair = findings.repair
    assert repair is not None, "a selected effect has been simulated"
    found: dict[str, dict[str, Estimate]] = {}
    for ray, mask, size, deviation in zip(
        repair.rays, repair.mask, repair.sizes, repair.deviation, strict=True
    ):
        if ray.kind.name != kind.name:
            continue
        for name in (ray.name,) if ray.name else kind.fitted:
            number, unit = kind.numbers[name], kind.size(name)
            for j in np.flatnonzero(mask):
                ends = number.none + unit * calibration.widened(
                    size[j] + np.array([-1.96, 0.0, 1.96]) * deviation[j], form
                )
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
    return [
        kinds[name]
        for name in sorted(findings.chosen.names, key=lambda name: -own_gain(findings, name))
    ]


def unexplained(findings: Findings) -> np.ndarray:
    """Returns which joints have something left, `(J,)` bool: predicted by a flexible model, or scattered too much."""
    late = any(one.kind.stage == "timing" for one in findings.others)
    return (calibration.predicted(findings).max(0) > LEFT) | (
        (findings.scatter > SCATTERED) & (not late)
    )


def unknown_chance(findings: Findings, prices: Prices, weights: Certainty) -> float:
    """Returns the probability that the cause lies outside the library."""
    found = calibration.chance(weights.outside, calibration.outside(findings))
    seen = any(one.kind.stage in ("kinematics", "sensing") for one in findings.others)
    return max(found, TOLD) if findings.tool_left > prices.tool and not seen else found


def named_chances(findings: Findings, prices: Prices, weights: Certainty) -> dict[str, float]:
    """Returns the probability of each effect that was found."""
    found = {
        one.kind.name: calibration.chance(weights.right, other_signs(findings, weights, one))
        for one in findings.others
    }
    for name in findings.chosen.names:
        swaps = rivals(findings, name)
        signs = named_signs(
            findings, prices, weights, name, swaps, same_as(swaps, own_gain(findings, name))
        )
        found[name] = calibration.chance(weights.right, signs)
    return found


def is_unknown(findings: Findings, prices: Prices, weights: Certainty) -> bool:
    """Says whether an unknown cause is told: where effects were found from `SAID` on, else where it is more probable than none.

    What sensors, frames or tool points show for sure is there whatever moves a joint besides: that
    is then a remainder.
    """
    named = named_chances(findings, prices, weights)
    if any(named[one.kind.name] >= STANDS for one in findings.others):
        return False
    chances, least = list(named.values()), SAID
    if not chances:
        chances, least = (
            [calibration.chance(weights.none, none_signs(findings, prices, weights))],
            0.5,
        )
    return unknown_chance(findings, prices, weights) > min(least, max(chances))


def likely(findings: Findings, prices: Prices, weights: Certainty) -> Findings:
    """Returns the findings without effects that are more probably not there, dropped one by one; the most probable one stays.

    What is left is judged anew each time: an effect may have been named only for what it was worth
    beside another.
    """
    kept = findings
    while len(chances := named_chances(kept, prices, weights)) > 1:
        least = min(chances, key=chances.__getitem__)
        if chances[least] >= NAMED:
            break
        chosen = Chosen(
            tuple(subset - {least} for subset in kept.chosen.subsets), kept.chosen.worth
        )
        kept = replace(
            kept, chosen=chosen, others=[one for one in kept.others if one.kind.name != least]
        )
    subsets, repaired = kept.chosen.subsets, findings.repair
    if repaired and subsets != findings.chosen.subsets:
        ways = {
            name: [ray for ray in repaired.rays if ray.kind.name == name]
            for name in findings.chosen.names
        }
        kept = replace(
            kept,
            repair=without(findings.evidence, ways, repaired, subsets) if any(subsets) else None,
        )
    return kept


def other(findings: Findings, found: Found, weights: Certainty, machine: Machine) -> Selected:
    """Returns what is said of an effect that sensors, frames or tool points show."""
    near = sorted(found.rivals, key=lambda name: -found.rivals[name])
    like = tuple(
        name for name in near if found.rivals[name] > max(SAME * found.gain, found.gain - AS_GOOD)
    )[:3]
    form = weights.form[found.kind.stage]
    parameters = {
        name: {
            joint: _widened(one, found.kind.numbers[name].none or 0.0, form)
            for joint, one in estimates.items()
        }
        for name, estimates in found.parameters.items()
    }
    return Selected(
        effect=found.kind.name,
        joints=tuple(
            name for name, has in zip(machine.joint_names, found.joints, strict=True) if has
        ),
        probability=calibration.chance(weights.right, other_signs(findings, weights, found)),
        parameters=parameters,
        gap_closed=Estimate(found.closed, (found.closed, found.closed)),
        same_as=like,
    )


def _widened(one: Estimate, none: float, form: float) -> Estimate:
    low, value, high = (
        calibration.widened(np.array([one.ci95[0], one.mean, one.ci95[1]]) - none, form) + none
    )
    return Estimate(float(value), (float(low), float(high)))


def ranking(
    findings: Findings,
    selected: Sequence[Selected],
    prices: Prices,
    weights: Certainty,
    machine: Machine,
    unknown: float,
) -> list[Ranked]:
    """Returns all rivals worth naming, most probable first; `none` and `unknown` among them, none above an unknown that is told."""
    named = {one.effect: Ranked(one.effect, one.joints, one.probability) for one in selected}
    is_told = is_unknown(findings, prices, weights)
    most = min(unknown, 1.0 - unknown) if is_told else 1.0 - unknown
    over = max(findings.chosen.worth, 0.0)
    for name in findings.rays:
        worth, places = _alone(findings, prices, name)
        if name not in named and places:
            odds = float(np.clip((worth - over) / weights.temperature, -30.0, 30.0))
            joints = tuple(machine.joint_names[j] for j in places)
            named[name] = Ranked(name, joints, min(float(1.0 / (1.0 + np.exp(-odds))), most))
    chances = [one.probability for one in selected]
    nothing = calibration.chance(weights.none, none_signs(findings, prices, weights))
    least = 1.0 - max([*chances, unknown if unknown > 0.5 else 0.0])
    none = min(nothing, least, most if is_told else 1.0)
    rows = [*named.values(), Ranked("none", (), none), Ranked("unknown", (), unknown)]
    return sorted(rows, key=lambda one: -one.probability)[:LISTED]


def _alone(findings: Findings, prices: Prices, name: str) -> tuple[float, list[int]]:
    """Returns what an effect by itself is worth, and the joints on which it is worth something."""
    only, worth, places = frozenset({name}), -prices.name, []
    for j, table in enumerate(findings.tables):
        if only in table.scored and table.scored[only].total > prices.joint:
            more = table.scored[only].total - findings.price(j, only)
            worth, places = worth + max(more, 0.0), [*places, *([j] if more > 0 else [])]
    return worth, places
