"""Start poses of opposite load: each command meets helping and resisting weight.

Under a weight of one sign the unequal speed of the two directions, load dependence, leaks and an
uneven dead band look alike.
"""

from collections.abc import Iterator

import numpy as np
from numpy.random import Generator

from brokk_rl.contracts.actuator import Segment
from brokk_rl.kinematics import Gravity
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec

Program = tuple[str, np.ndarray]
"""Name and commands, `(T, J)`."""
NUM_CANDIDATES = 128
"""Random poses among which the next one is chosen."""


def draw_start_poses(machine: Machine, margin: float, generator: Generator) -> Iterator[np.ndarray]:
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


def move_joint(name: str, machine: Machine, joint: int, commands: np.ndarray) -> Program:
    """Return name and commands, `(T, J)`, of a program of one joint, `(T,)`, with the others at rest."""
    u = np.zeros((len(commands), machine.num_joints))
    u[:, joint] = commands
    return f"{name}_{machine.joint_names[joint]}", u


@spec
class PoseProgram:
    """Base of excitations that fill the time from poses of opposite load.

    Attributes:
        share: Part of the time, relative to the others of the plan.
        pose_s: Time after which another start pose is taken, about.
        stop_margin: Distance kept from the stops, as a part of each joint's travel.
    """

    share: Positive
    pose_s: Positive
    stop_margin: float

    def program(self, machine: Machine, steps: int, generator: Generator) -> np.ndarray:
        """Return the commands of so many control periods, `(T, J)`."""
        raise NotImplementedError

    def segments(self, machine: Machine, duration_s: float, generator: Generator) -> list[Segment]:
        """Return segments of about `pose_s` each, which fill the time."""
        total = max(1, int(duration_s / machine.period_s))
        count = min(max(1, round(duration_s / self.pose_s)), total)
        starts = draw_start_poses(machine, self.stop_margin, generator)
        name, found = type(self).__name__.lower(), []
        for i in range(count):
            start, u = next(starts), self.program(machine, total // count, generator)
            found.append(Segment(f"{name}_{i:02d}", start, u, "inward", self.stop_margin))
        return found
