"""Start poses of opposite load: each command meets helping and resisting weight.

Under a weight of one sign the unequal speed of the two directions, load dependence, leaks and an
uneven dead band look alike.
"""

from collections.abc import Callable, Iterator

import numpy as np

from brokk_rl.contracts.actuator import Segment
from brokk_rl.kinematics import Gravity
from brokk_rl.machine import Machine

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
    lower, upper = machine.lower + margin * travel, machine.upper - margin * travel
    while True:
        candidates = generator.uniform(lower, upper, (NUM_CANDIDATES, len(travel)))
        if not machine.has_bodies:
            yield candidates[0]
            continue
        pull = Gravity(machine).load(candidates)
        pull /= np.maximum(np.abs(pull).max(0), 1e-9)
        heavy = np.abs(pull).sum(1)
        # With nothing to oppose yet, the heaviest comes first.
        cost = ((total + pull) ** 2).sum(1) - heavy if total.any() else -heavy
        best = int(np.argmin(cost))
        total += pull[best]
        yield candidates[best]


def fill_from_poses(
    name: str,
    machine: Machine,
    duration_s: float,
    pose_s: float,
    margin: float,
    generator: np.random.Generator,
    program: Callable[[int], np.ndarray],
) -> list[Segment]:
    """Return segments of about `pose_s` each, from poses of opposite load, which fill the time.

    Args:
        name: Of the segments, before their numbers.
        machine: Limits, masses and geometry.
        duration_s: Time to fill.
        pose_s: Length of a segment, about.
        margin: Distance kept from the stops, as a part of each joint's travel.
        generator: Draws the poses.
        program: Commands of so many control periods, `(T, J)`.
    """
    total = max(1, int(duration_s / machine.period_s))
    count = min(max(1, round(duration_s / pose_s)), total)
    starts = draw_start_poses(machine, margin, generator)
    found = []
    for i in range(count):
        start, u = next(starts), program(total // count)
        found.append(Segment(f"{name}_{i:02d}", start, u, "inward", margin))
    return found
