"""From detected effects to an answer: rivals, probabilities, numbers with intervals, a verdict.

Axes: `J` joints, `E` entries, `B` blocks of entries that hang together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from brokk_rl.machine import Machine
from diagnosis import calibration
from diagnosis.answer import Estimate, Selected
from diagnosis.detection import DetectionResult
from diagnosis.effect_library import DetectedEffect, EffectType
from diagnosis.refine import drop_effects
from diagnosis.request import Penalties, ProbabilityModel
from diagnosis.residuals import ParameterRay
from diagnosis.search import EffectSet, Subset, SubsetTable

SAME_SHARE = 0.9
"""An effect that earns so much of what another earns in its place cannot be told from it."""
SAME_NATS = 3.0
"""Difference in log likelihood that says nothing."""
MAX_EQUIVALENTS = 3
"""Longest list of equivalent effects. Chosen by hand; not searched."""
MIN_NAMED = 0.5
"""Probability from which a further effect is named: one that is missed costs what a wrong one
does."""
MIN_CERTAIN = 0.9
"""Probability from which what sensors, frames or tool points show is told, however probable an
unknown cause is beside it."""
MIN_CLUE_NATS = 15.0
"""Evidence of a clue, beyond that on the reference, from which the report says that something is
left on a joint."""
MAX_SCATTER = 1.6
"""Mean square error over that of the reference from which it says the same."""


@dataclass(frozen=True)
class Substitution:
    """An effect in the place of a chosen one, its gain, and that over the gain of the chosen one."""

    name: str
    earned: float
    share: float


def rank_substitutions(result: DetectionResult, name: str) -> list[Substitution]:
    """Return the gain of each other effect in the place of `name`, the best first."""
    found, subsets, own = [], result.chosen.subsets, 0.0
    places = [j for j, subset in enumerate(subsets) if name in subset]
    without = {j: result.tables[j].score(subsets[j] - {name}).total for j in places}
    own = sum(result.tables[j].score(subsets[j]).total - without[j] for j in places)
    for other in result.rays:
        # An effect that does nothing to one of the joints cannot take the place there.
        felt = all(other in result.tables[j].shapes for j in places)
        if other in result.chosen.names or not felt:
            continue
        gains = []
        for j in places:
            swapped = result.tables[j].score(subsets[j] - {name} | {other})
            gains.append(swapped.total - without[j])
        earned = sum(gains)
        found.append(Substitution(other, earned, earned / max(own, 1e-9)))
    return sorted(found, key=lambda swap: -swap.earned)


def list_equivalents(swaps: Sequence[Substitution], own: float) -> tuple[str, ...]:
    """Return the effects that cannot be told from one that earns `own`, at most three."""
    found = []
    for swap in swaps:
        if swap.share > SAME_SHARE or own - swap.earned < SAME_NATS:
            found.append(swap.name)
    return tuple(found[:MAX_EQUIVALENTS])


def look_up_values(result: DetectionResult, name: str, other: str) -> dict[str, np.ndarray]:
    """Return the numbers of `other` in the place of the chosen effect `name`, each `(1, J)` or `(1, 1)`."""
    ways = result.rays[other]
    sizes = np.zeros((len(ways), len(result.tables)))
    for j, subset in enumerate(result.chosen.subsets):
        if name in subset:
            sizes[:, j] = result.tables[j].score(subset - {name} | {other}).sizes[other]
    found: dict[str, np.ndarray] = {}
    for ray, size in zip(ways, sizes, strict=True):
        found |= ray.values(size[None])
    return found


def compute_own_gain(result: DetectionResult, name: str) -> float:
    """Return the gain of a chosen effect over the rest of the set, on all joints that have it."""
    gains = []
    for table, subset in _list_places(result, name):
        gains.append(table.score(subset).total - table.score(subset - {name}).total)
    return sum(gains)


def _list_places(result: DetectionResult, name: str) -> list[tuple[SubsetTable, Subset]]:
    """Return table and subset of each joint that has an effect."""
    pairs = zip(result.tables, result.chosen.subsets, strict=True)
    return [(table, subset) for table, subset in pairs if name in subset]


def compute_margin(
    result: DetectionResult,
    penalties: Penalties,
    name: str,
    swaps: Sequence[Substitution],
    like: Sequence[str],
) -> float:
    """Return the net gain of a chosen effect over the best alternative: no effect, or one that is not like it."""
    own, subsets = compute_own_gain(result, name), result.chosen.subsets
    prices = []
    for j, subset in enumerate(subsets):
        if name in subset:
            prices.append(result.price(j, subset) - result.price(j, subset - {name}))
    saved = sum(prices)
    others = [own - swap.earned for swap in swaps if swap.name not in like]
    return min([own - saved - penalties.name, *others])


def read_chosen_signs(
    result: DetectionResult,
    penalties: Penalties,
    weights: ProbabilityModel,
    name: str,
    swaps: Sequence[Substitution],
    like: Sequence[str],
) -> dict[str, float]:
    """Return the signs that a chosen effect is rightly named."""
    places = _list_places(result, name)
    whole = sum(table.score(subset).total for table, subset in places)
    size = max(float(np.abs(table.score(subset).sizes[name]).max()) for table, subset in places)
    adds = compute_own_gain(result, name) / max(whole, 1e-9)
    outside = calibration.compute_log_odds(
        weights.outside, calibration.collect_outside_signs(result)
    )
    return calibration.collect_effect_signs(
        compute_margin(result, penalties, name, swaps, like), adds, size, len(result.names), outside
    )


def read_detected_signs(
    result: DetectionResult, weights: ProbabilityModel, found: DetectedEffect
) -> dict[str, float]:
    """Return the same of an effect that sensors, frames or tool points show."""
    outside = calibration.compute_log_odds(
        weights.outside, calibration.collect_outside_signs(result)
    )
    return calibration.collect_effect_signs(found.net_gain, 1.0, 1.0, len(result.names), outside)


def estimate_numbers(
    result: DetectionResult, kind: EffectType, machine: Machine, form: float
) -> dict[str, dict[str, Estimate]]:
    """Return the numbers of a selected effect by joint; `form`: relative model-form error of its size, 1 sigma."""
    fitted = result.fitted
    assert fitted is not None, "a selected effect has been simulated"
    found: dict[str, dict[str, Estimate]] = {}
    for ray, mask, size, deviation in zip(
        fitted.rays, fitted.mask, fitted.sizes, fitted.deviation, strict=True
    ):
        if ray.kind.name != kind.name:
            continue
        for name in (ray.name,) if ray.name else kind.fitted:
            number, unit, (least, most) = kind.numbers[name], kind.size(name), kind.limits(name)
            for j in np.flatnonzero(mask):
                place = j if number.per_joint else 0
                interval = size[j] + np.array([-1.96, 0.0, 1.96]) * deviation[j]
                ends = number.none + unit[place] * calibration.widen_interval(interval, form)
                # A unit below 0 turns the ends around.
                low, mean, high = np.sort(np.clip(ends, least[place], most[place])).tolist()
                joint = machine.joint_names[j] if number.per_joint else "machine"
                found.setdefault(name, {})[joint] = Estimate(mean, (low, high))
    for ray in fitted.rays:
        for name, part in ray.shape.items() if ray.kind.name == kind.name else ():
            values = kind.clipped(name, part * kind.typical(name))
            places = np.flatnonzero(fitted.joints_of(kind))
            given = {machine.joint_names[j]: float(values[j]) for j in places}
            found[name] = {joint: Estimate(value, (value, value)) for joint, value in given.items()}
    return found


def rank_chosen_effects(
    result: DetectionResult, kinds: Mapping[str, EffectType]
) -> list[EffectType]:
    """Return the chosen effects, the ones that earn most first."""
    names = sorted(result.chosen.names, key=lambda name: -compute_own_gain(result, name))
    return [kinds[name] for name in names]


def find_unexplained_joints(result: DetectionResult) -> np.ndarray:
    """Return which joints have something left, `(J,)` bool: predicted by a flexible model, or scattered too much."""
    late = any(one.kind.stage == "timing" for one in result.detected)
    return (calibration.subtract_reference_clues(result).max(0) > MIN_CLUE_NATS) | (
        (result.scatter > MAX_SCATTER) & (not late)
    )


def compute_effect_probabilities(
    result: DetectionResult, penalties: Penalties, weights: ProbabilityModel
) -> dict[str, float]:
    """Return the probability of each effect that was found."""
    found: dict[str, float] = {}
    for one in result.detected:
        signs = read_detected_signs(result, weights, one)
        found[one.kind.name] = calibration.compute_probability(weights.right, signs)
    for name in result.chosen.names:
        swaps = rank_substitutions(result, name)
        like = list_equivalents(swaps, compute_own_gain(result, name))
        signs = read_chosen_signs(result, penalties, weights, name, swaps, like)
        found[name] = calibration.compute_probability(weights.right, signs)
    return found


def drop_unlikely_effects(
    result: DetectionResult, penalties: Penalties, weights: ProbabilityModel
) -> DetectionResult:
    """Return the findings without effects that are more probably not there, dropped one by one; the most probable one stays.

    The rest is judged again each time: an effect may gain only beside another.
    """
    kept = result
    held = result.fitted.held if result.fitted else ()
    # Sizes that carry further than the likelihood's say more than its gain.
    shown = frozenset[str]().union(*(result.chosen.subsets[j] for j in held))
    while len(chances := compute_effect_probabilities(kept, penalties, weights)) > 1:
        rest = chances.keys() - shown
        if not rest:
            break
        least = min(rest, key=chances.__getitem__)
        if chances[least] >= MIN_NAMED:
            break
        chosen = EffectSet(
            tuple(subset - {least} for subset in kept.chosen.subsets), kept.chosen.net_gain
        )
        kept = replace(
            kept, chosen=chosen, detected=[one for one in kept.detected if one.kind.name != least]
        )
    subsets, fitted = kept.chosen.subsets, result.fitted
    if fitted and subsets != result.chosen.subsets:
        ways: dict[str, list[ParameterRay]] = {name: [] for name in result.chosen.names}
        for ray in fitted.rays:
            ways[ray.kind.name].append(ray)
        # The sizes of the others have grown beside the dropped effect, so they are fitted anew.
        kept = replace(kept, fitted=None)
        if any(subsets):
            kept.fitted = drop_effects(result.residuals, ways, fitted, subsets)
    return kept


def describe_detected_effect(
    result: DetectionResult, found: DetectedEffect, weights: ProbabilityModel, machine: Machine
) -> Selected:
    """Return the answer about an effect that sensors, frames or tool points show."""
    near = sorted(found.rivals, key=lambda name: -found.rivals[name])
    least = max(SAME_SHARE * found.gain, found.gain - SAME_NATS)
    like = tuple([name for name in near if found.rivals[name] > least][:MAX_EQUIVALENTS])
    form = weights.get_form_error(found.kind.name, found.kind.stage)
    parameters: dict[str, dict[str, Estimate]] = {}
    for name, estimates in found.parameters.items():
        none = found.kind.numbers[name].none or 0.0
        parameters[name] = {
            joint: _widen_estimate(one, none, form) for joint, one in estimates.items()
        }
    return Selected(
        effect=found.kind.name,
        joints=tuple(
            name for name, has in zip(machine.joint_names, found.joints, strict=True) if has
        ),
        probability=calibration.compute_probability(
            weights.right, read_detected_signs(result, weights, found)
        ),
        parameters=parameters,
        gap_closed=Estimate(found.closed, (found.closed, found.closed)),
        same_as=like,
    )


def _widen_estimate(one: Estimate, none: float, form: float) -> Estimate:
    low, value, high = (
        calibration.widen_interval(np.array([one.ci95[0], one.mean, one.ci95[1]]) - none, form)
        + none
    )
    return Estimate(float(value), (float(low), float(high)))
