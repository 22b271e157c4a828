"""Effects that the reference shows already: a valve that overshoots, a pin that rubs.

They are put around the simulator. The field shows them too, so they are no change of the machine.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.baseline import Baseline, SimulatorComparison, set_covariances
from diagnosis.effect_library import EffectType, EffectValues
from diagnosis.error_covariance import compute_loss
from diagnosis.refine import drop_windows
from diagnosis.residuals import ParameterRay, Residuals, build_rays
from diagnosis.responses import (
    MIN_RESPONSE,
    Response,
    fit_faults,
    list_shape_trials,
    simulate_trials,
    sum_responses,
)
from diagnosis.search import SubsetTable

log = logging.getLogger(__name__)

# Chosen by hand. SURE_GAIN was 8 before; no comparison is recorded.
REFERENCE_SIZES = (0.12, 0.3, 0.45, 0.6, 1.0)
"""Sizes over the typical one."""
SURE_GAIN = 6.0
"""Log Bayes factor, all parts together, from which an effect is there."""
AGREEING_SHARE = 0.75
"""Share of the parts in which its gain must be positive."""
REFERENCE_WINDOWS = 3
"""One of so many stretches of each part is searched, which saves time."""

RaysByTrial = Mapping[str, Sequence[ParameterRay]]


def add_reference_effects(
    base: Baseline, kinds: Sequence[EffectType], machine: Machine
) -> Baseline:
    """Return the simulator with the effects around it that the reference shows.

    Args:
        base: A simulator, and fits that left out parts of the reference, their noise known, before
            any discrepancy is learned.
        kinds: The library.
        machine: The machine.
    """
    ways: dict[str, list[ParameterRay]] = {}
    for kind in kinds:
        if _is_one_sided(kind):
            ways |= _list_trials(kind)
    if len(base.left_out) < 2 or base.is_flexible:
        return base
    parts = [drop_windows(one.residuals, REFERENCE_WINDOWS) for one in base.left_out]
    found = _find_effects(parts, ways, machine.joint_names)
    return _wrap_simulator(base, found, machine) if found else base


def _is_one_sided(kind: EffectType) -> bool:
    """Return True where free runs show the effect on a joint alone, and sizes have one sign only.

    Sizes of both signs have been settled by the fit of the simulator.
    """
    if kind.target.stochastic or kind.target.side not in ("speed", "command"):
        return False
    rays = build_rays(kind, REFERENCE_SIZES)
    return bool(rays) and all(ray.sizes.min() >= 0.0 for ray in rays)


def _list_trials(kind: EffectType) -> dict[str, list[ParameterRay]]:
    """Return the ways in which an effect can grow, by a name for each of its shapes."""
    found = {}
    for place, trial in enumerate(list_shape_trials(kind)):
        shape = {name: np.full(kind.num_joints, part) for name, part in trial.items()}
        rays = build_rays(kind, REFERENCE_SIZES)
        found[f"{kind.name} {place}"] = [replace(ray, shape=shape) for ray in rays]
    return found


def _find_effects(
    parts: Sequence[Residuals], ways: RaysByTrial, joint_names: Sequence[str]
) -> list[tuple[EffectType, EffectValues]]:
    """Return the effect that each joint shows most surely in all parts together, with its numbers, each `(1, J)`."""
    responses = simulate_trials(parts, ways)
    of_part = np.repeat(np.arange(len(parts)), [part.z.shape[1] for part in parts])
    found: dict[str, tuple[EffectType, dict[str, np.ndarray]]] = {}
    for j in range(parts[0].z.shape[0]):
        joint = fit_faults(
            np.concatenate([part.z[j] for part in parts]),
            np.concatenate([part.faults[j] for part in parts], 1),
        )
        shapes: dict[str, list[Response]] = {}
        for key, way in ways.items():
            changes = [np.concatenate([one[j] for one in own], 1) for own in responses[key]]
            if max(np.abs(change).max() for change in changes) >= MIN_RESPONSE:
                pairs = zip(way, changes, strict=True)
                shapes[key] = [Response(ray.sizes, change) for ray, change in pairs]
        table = SubsetTable(joint, shapes, of_part)
        scored = {key: table.score(frozenset({key})) for key in shapes}
        best = max(scored, key=lambda key: scored[key].total, default=None)
        if best is None or scored[best].total < SURE_GAIN:
            continue
        # A fault of one recording is no property of the machine.
        if np.mean(np.bincount(of_part, scored[best].gain) > 0) < AGREEING_SHARE:
            continue
        # Beside errors of the simulator's own numbers a lag may stand for a response that is too
        # short. The simulator keeps its numbers, so the effect must reduce the error without them.
        left = joint.z - sum_responses(shapes[best], scored[best].sizes[best])
        if compute_loss(left) >= compute_loss(joint.z):
            continue
        kind = ways[best][0].kind
        log.info("the reference shows %s on %s already", kind.name, joint_names[j])
        _, values = found.setdefault(
            kind.name, (kind, _expand_values(kind, ways[best], np.zeros(len(ways[best]))))
        )
        for name, value in _expand_values(kind, ways[best], scored[best].sizes[best]).items():
            values[name][:, j] = value[:, j]
    return list(found.values())


def _expand_values(
    kind: EffectType, ways: Sequence[ParameterRay], sizes: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the numbers of an effect at sizes along its rays, the same on all joints, each `(1, J)`."""
    found = {
        name: np.broadcast_to(kind.typical(name), (1, kind.num_joints)) for name in kind.shaping
    }
    for ray, size in zip(ways, sizes, strict=True):
        found |= ray.values(np.full((1, kind.num_joints), size))
    shape = (1, kind.num_joints)
    return {name: np.broadcast_to(value, shape).copy() for name, value in found.items()}


def _wrap_simulator(
    base: Baseline, effects: Sequence[tuple[EffectType, EffectValues]], machine: Machine
) -> Baseline:
    """Return the simulator with effects around it, and the noise of its residuals with them."""

    def around(one: SimulatorComparison) -> SimulatorComparison:
        simulator = one.residuals.simulator
        fixed = replace(simulator, fixed=[*simulator.fixed, *effects])
        return replace(
            one, residuals=Residuals(fixed, one.residuals.noise, one.residuals.valid_mask)
        )

    left_out = [around(one) for one in base.left_out]
    left_out = set_covariances(left_out, machine)
    return replace(base, field=around(base.field), left_out=left_out)
