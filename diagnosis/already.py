"""What the reference shows already belongs to the simulator, not to the gap.

A fit has the structure that it has: held against the reference it may lack an effect of the library
plainly (a valve that overshoots a little, a pin that rubs), and in the field it lacks it again:
that is no change of the machine. Effects that the reference shows for sure are put around the
simulator, joint by joint, before anything is held against the field.
Axes: `P` parts of the reference, `J` joints, `E` entries (increments of all windows, over the
simulator's noise).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from brokk_rl.machine import Machine
from diagnosis import simulator
from diagnosis.around import thinned
from diagnosis.candidates import Values
from diagnosis.evidence import Evidence, Ray, rays
from diagnosis.library import Kind
from diagnosis.search import Table
from diagnosis.shapes import FELT, SHAPES
from diagnosis.simulator import Base, Held
from diagnosis.sizes import Shape, plain

log = logging.getLogger(__name__)

SIZES = (0.12, 0.3, 0.45, 0.6, 1.0)
SURE = 6.0
"""Log of a Bayes factor, all parts together, from which an effect is there."""
AGREEING = 0.75
"""Share of the parts in which it must pay."""
EACH = 3
"""This is looked for on one of so many stretches of each part."""

Ways = Mapping[str, Sequence[Ray]]


def refined(base: Base, kinds: Sequence[Kind], machine: Machine) -> Base:
    """Returns the simulator with the effects around it that the reference shows.

    Args:
        base: A simulator, and fits that left out parts of the reference, their noise known, before
            any discrepancy is learned.
        kinds: The library.
        machine: The machine.
    """
    ways = {key: way for kind in kinds if _can_be_there(kind) for key, way in _ways(kind).items()}
    if len(base.nulls) < 2 or base.is_flexible:
        return base
    found = _there([thinned(one.evidence, EACH) for one in base.nulls], ways, machine.joint_names)
    return _around(base, found, machine) if found else base


def _can_be_there(kind: Kind) -> bool:
    """Says whether free runs show the effect on a joint by itself, and only one way: what goes both ways a fit has settled."""
    ways = (
        []
        if kind.target.stochastic or kind.target.side not in ("speed", "command")
        else rays(kind, SIZES)
    )
    return bool(ways) and all(ray.sizes.min() >= 0.0 for ray in ways)


def _ways(kind: Kind) -> dict[str, list[Ray]]:
    """Returns the ways in which an effect can grow, by a name for each of its shapes."""
    trials: list[dict[str, float]] = [
        {},
        *({number: part} for number in kind.shaping for part in SHAPES),
    ]
    found = {}
    for place, trial in enumerate(trials):
        shape = {name: np.full(kind.num_joints, part) for name, part in trial.items()}
        found[f"{kind.name} {place}"] = [replace(ray, shape=shape) for ray in rays(kind, SIZES)]
    return found


def _there(
    parts: Sequence[Evidence], ways: Ways, joint_names: Sequence[str]
) -> list[tuple[Kind, Values]]:
    """Returns the effect that each joint shows most surely in all parts together, with its numbers, each `(1, J)`."""
    responses = {
        key: [[part.response(ray) for ray in way] for part in parts] for key, way in ways.items()
    }
    of_part = np.repeat(np.arange(len(parts)), [part.z.shape[1] for part in parts])
    found: dict[str, tuple[Kind, dict[str, np.ndarray]]] = {}
    for j in range(parts[0].z.shape[0]):
        joint = plain(
            np.concatenate([part.z[j] for part in parts]),
            np.concatenate([part.faults[j] for part in parts], 1),
        )
        shapes: dict[str, list[Shape]] = {}
        for key, way in ways.items():
            changes = [
                np.concatenate([one[k][j] for one in responses[key]], 1) for k in range(len(way))
            ]
            if max(np.abs(change).max() for change in changes) >= FELT:
                shapes[key] = [
                    Shape(ray.sizes, change) for ray, change in zip(way, changes, strict=True)
                ]
        table = Table(joint, shapes, of_part)
        scored = {key: table.score(frozenset({key})) for key in shapes}
        best = max(scored, key=lambda key: scored[key].total, default=None)
        if (
            best is None
            or scored[best].total < SURE
            or np.mean(np.bincount(of_part, scored[best].gain) > 0) < AGREEING
        ):
            continue
        kind = ways[best][0].kind
        log.info("the reference shows %s on %s already", kind.name, joint_names[j])
        _, values = found.setdefault(
            kind.name, (kind, _values(kind, ways[best], np.zeros(len(ways[best]))))
        )
        for name, value in _values(kind, ways[best], scored[best].sizes[best]).items():
            values[name][:, j] = value[:, j]
    return list(found.values())


def _values(kind: Kind, ways: Sequence[Ray], sizes: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the numbers of an effect at sizes along its rays, the same on all joints, each `(1, J)`."""
    found = {
        name: np.full((1, kind.num_joints), kind.numbers[name].typical) for name in kind.shaping
    }
    for ray, size in zip(ways, sizes, strict=True):
        found |= ray.values(np.full((1, kind.num_joints), size))
    return {
        name: np.broadcast_to(value, (1, kind.num_joints)).copy() for name, value in found.items()
    }


def _around(base: Base, effects: Sequence[tuple[Kind, Values]], machine: Machine) -> Base:
    """Returns the simulator with effects around it, and the noise of what it errs by then."""

    def around(one: Held) -> Held:
        candidates = one.evidence.candidates
        fixed = replace(candidates, fixed=[*candidates.fixed, *effects])
        return replace(one, evidence=Evidence(fixed, one.evidence.noise, one.evidence.claims))

    nulls = [around(one) for one in base.nulls]
    known = simulator.noises(nulls, machine)
    nulls = [replace(one, evidence=replace(one.evidence, noise=known)) for one in nulls]
    return replace(base, field=around(base.field), nulls=nulls)
