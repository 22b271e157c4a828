"""The set of effects that speed curves show, from which a search begins.

Responses that do not add up hide what a curve shows plainly: a dead band of half the command changes
the responses to all other effects, so that a search from nothing ends elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.effect_library import EffectType
from diagnosis.nonadditive_refit import combine_best
from diagnosis.refine import FittedSet, build_held_set, fit_set, list_sizes, list_subsets
from diagnosis.residuals import ParameterRay, Residuals
from diagnosis.responses import Response
from diagnosis.search import PenaltyFunction
from diagnosis.speed_curves import ADDED, CURVE_NUMBERS, MIN_SCORE, CurveDifference, SpeedCurves

LEAST_BETTER = 0.25
"""Part of the error that the numbers of the curves must remove beyond those of the search, on parts
that the latter were not fitted to. Chosen by hand: from a tenth on, practice machines with ordinary
gaps got up to three names too many; a speed that wanders by half costs the search half of the error."""

EffectNumbers = Mapping[str, Mapping[str, float]]
"""Numbers of effects, by effect and number."""


def fit_shown_effects(
    residuals: Residuals,
    proposed: Sequence[EffectNumbers],
    rays: Mapping[str, Sequence[ParameterRay]],
    shapes: Sequence[Mapping[str, Sequence[Response]]],
    found: FittedSet | None,
    price: PenaltyFunction,
) -> list[FittedSet]:
    """Return sets to continue from, the best first; none where the search already found the best.

    Args:
        residuals: Residuals of the simulator.
        proposed: Effects that the curves show, by joint.
        rays: Rays of each effect.
        shapes: Responses of each joint to each effect; others are not tried there.
        found: The set that the search found from nothing.
        price: Penalty of a subset on a joint.
    """
    start = _list_sizes(proposed, rays, shapes)
    subsets = [frozenset(sizes) for sizes in start]
    if not any(subsets):
        return []
    shown = fit_set(residuals, subsets, rays, start)
    tried = [shown, *([found] if found else [])]
    best = combine_best(residuals, rays, tried, price)
    known = list_subsets(found) if found else (frozenset(),) * len(subsets)
    return [best, *tried] if best and list_subsets(best) != known else []


def _list_sizes(
    proposed: Sequence[EffectNumbers],
    rays: Mapping[str, Sequence[ParameterRay]],
    shapes: Sequence[Mapping[str, Sequence[Response]]],
) -> list[dict[str, np.ndarray]]:
    """Return the sizes of the effects that the curves show, by joint and name."""
    start = []
    for joint, (mine, responses) in enumerate(zip(proposed, shapes, strict=True)):
        sizes = {}
        for name, numbers in mine.items():
            if name in responses:
                sizes[name] = compute_sizes(rays[name], numbers, joint)
        start.append(sizes)
    return start


def keep_shown_numbers(
    residuals: Residuals,
    proposed: Sequence[EffectNumbers],
    rays: Mapping[str, Sequence[ParameterRay]],
    shapes: Sequence[Mapping[str, Sequence[Response]]],
    found: FittedSet | None,
) -> FittedSet | None:
    """Return the set with the curves' own numbers on joints where these leave less error of free runs; `None` without any.

    Where a joint's speed wanders by half, the likelihood holds nearly any motion for possible, and
    its best sizes close nothing. A curve is the mean of all speeds at a command, which such
    wandering moves little.

    Args:
        residuals: Residuals of the simulator.
        proposed: Effects that the curves show, by joint.
        rays: Rays of each effect.
        shapes: Responses of each joint to each effect; others are not tried there.
        found: The set that the search found.
    """
    shown = _list_sizes(proposed, rays, shapes)
    if not any(shown):
        return None
    known = list_sizes(found) if found else [{} for _ in shown]
    measured = residuals.simulator.cut.measured
    fixed = build_held_set(residuals, rays, shown)
    paths = [residuals.base, found.after if found else residuals.base, fixed.after]
    errors = np.sqrt([np.square(one - measured).mean((0, 1)) for one in paths])
    better = errors[1] - errors[2] > LEAST_BETTER * errors[0]
    if not better.any():
        return None
    sizes = [shown[j] if has else known[j] for j, has in enumerate(better)]
    return build_held_set(residuals, rays, sizes, found, frozenset(np.flatnonzero(better).tolist()))


def compute_sizes(
    rays: Sequence[ParameterRay], numbers: Mapping[str, float], joint: int
) -> np.ndarray:
    """Return the size along each ray of an effect with these numbers on a joint, `(R,)`.

    A ray of all numbers at once takes the mean of their sizes.
    """
    found = []
    for ray in rays:
        names = [ray.name] if ray.name else [n for n in ray.kind.fitted if n in numbers]
        sizes = []
        for name in names:
            none = ray.kind.numbers[name].none or 0.0
            sizes.append((numbers[name] - none) / ray.kind.size_on(name, joint))
        found.append(float(np.mean(sizes)))
    return np.array(found)


def propose_effects(
    curves: SpeedCurves, kinds: Sequence[EffectType], machine: Machine
) -> list[EffectNumbers]:
    """Return the effects of the library that the curves show, with their numbers, by joint and name.

    Gains that do not differ between the sides are one of both. The play of a valve has no effect of
    its own in the library.
    """
    known = {kind.name for kind in kinds}
    found: list[EffectNumbers] = []
    for name in machine.joint_names:
        one = curves.joints.get(name)
        proposed = _read_effects(one) if one else {}
        found.append({effect: numbers for effect, numbers in proposed.items() if effect in known})
    return found


def _read_effects(one: CurveDifference) -> EffectNumbers:
    """Return the numbers of the effects that a difference shows, by effect."""
    names: list[str] = [*CURVE_NUMBERS, *ADDED]
    value = dict(zip(names, one.values.tolist(), strict=True))
    error = dict(zip(names, one.deviation.tolist(), strict=True))
    found: dict[str, Mapping[str, float]] = {}
    bands = {side: max(0.0, value[f"dead_band_{side}"]) for side in ("extend", "retract")}
    if max(bands.values()) > 0.0:
        found["dead_band"] = bands
    if value["saturation"] < 1.0:
        found["saturation"] = {"level": value["saturation"]}
    gains = {name: value[name] for name in ("extend_gain", "retract_gain")}
    if any(gain != 1.0 for gain in gains.values()):
        apart = abs(gains["extend_gain"] - gains["retract_gain"])
        if apart < MIN_SCORE * np.hypot(error["extend_gain"], error["retract_gain"]):
            found["flow_gain"] = {"gain": float(np.mean(list(gains.values())))}
        else:
            found["asymmetry"] = gains
    for effect, name, number in (
        ("dead_time", "dead_time_s", "dead_time_s"),
        ("lag", "lag_s", "time_constant_s"),
    ):
        if value[name] > MIN_SCORE * error[name]:
            found[effect] = {number: value[name]}
    return found
