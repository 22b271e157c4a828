"""Start poses of opposite load: each command meets helping and resisting weight.

Under a weight of one sign the unequal speed of the two directions, load dependence, leaks and an
uneven dead band look alike.
"""

from collections.abc import Iterator

import numpy as np

from brokk_rl.machine import Machine

GRAVITY_M_S2 = 9.81
"""Gravity, m/s²: standard gravity (9.80665), rounded."""
NUM_CANDIDATES = 128
"""Random poses among which the next one is chosen."""


def draw_start_poses(
    machine: Machine, margin: float, generator: np.random.Generator
) -> Iterator[np.ndarray]:
    """Yield start poses `(J,)` without end, each opposing the load of those before.

    So the weight on each joint takes both signs, in turn, where it can. Where masses are not known
    the poses are random.

    Args:
        machine: Limits, masses and geometry.
        margin: Distance kept from the stops, as a part of each joint's travel.
        generator: Draws the candidates.
    """
    travel = machine.upper - machine.lower
    total = np.zeros(machine.num_joints)
    while True:
        candidates = generator.uniform(
            machine.lower + margin * travel,
            machine.upper - margin * travel,
            (NUM_CANDIDATES, len(travel)),
        )
        if not machine.has_bodies:
            yield candidates[0]
            continue
        pull = compute_load(machine, candidates)
        pull /= np.maximum(np.abs(pull).max(0), 1e-9)
        heavy = np.abs(pull).sum(1)
        best = (
            int(np.argmin(((total + pull) ** 2).sum(1) - heavy))
            if total.any()
            else int(np.argmax(heavy))
        )
        total += pull[best]
        yield candidates[best]


def compute_load(machine: Machine, q: np.ndarray) -> np.ndarray:
    """Return the gravity load in the positive direction at `q`, `(N, J)`, Nm or N.

    The slope of the potential energy of a machine that stands level, by central differences.

    Raises:
        ConfigError: masses or geometry are not known.
    """
    step = 1e-5
    shifts = step * np.eye(machine.num_joints)
    down, up = (
        _compute_potential_j(machine, (q[:, None] + side * shifts).reshape(-1, machine.num_joints))
        for side in (-1.0, 1.0)
    )
    return ((down - up) / (2.0 * step)).reshape(q.shape)


def _compute_potential_j(machine: Machine, q: np.ndarray) -> np.ndarray:
    """Return the potential energy at `q`, `(N, J)`: J, `(N,)`."""
    rotation, origin_m, energy_j = (
        np.broadcast_to(np.eye(3), (len(q), 3, 3)),
        np.zeros((len(q), 3)),
        np.zeros(len(q)),
    )
    for j, (joint, body) in enumerate(zip(machine.joints, machine.bodies, strict=True)):
        axis = np.array(body.axis)
        place = np.array([d.value for d in body.origin_m]) + (
            q[:, j, None] * axis if joint.kind == "slide" else 0.0
        )
        origin_m = origin_m + (rotation @ np.broadcast_to(place, (len(q), 3))[..., None])[..., 0]
        if joint.kind == "hinge":
            x, y, z = axis
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            angle = q[:, j, None, None]
            # Rodrigues' rotation formula.
            rotation = rotation @ (
                np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
            )
        height_m = (origin_m + rotation @ np.array(body.com_m))[:, 2]
        energy_j = energy_j + body.mass_kg.value * GRAVITY_M_S2 * height_m
    return energy_j
