"""Motifs: short single-joint programs that separate effects which look alike otherwise."""

from itertools import product
from typing import Annotated

import numpy as np
from annotated_types import MinLen
from numpy.random import Generator
from numpy.typing import ArrayLike

from actuators.excite.poses import Program, draw_start_poses, move_joint
from brokk_rl.contracts.actuator import Segment
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Positive, spec


@spec
class Motif:
    """Base of the motifs: each program once per pose, in random order, while time is left.

    Attributes:
        share: Part of the time, relative to the others of the plan.
        stop_margin: As in `levels`.
    """

    share: Positive
    stop_margin: float

    def programs(self, machine: Machine, generator: Generator) -> list[Program]:
        """Return all that is played in one pose."""
        raise NotImplementedError

    def segments(self, machine: Machine, duration_s: float, generator: Generator) -> list[Segment]:
        """Return as many segments as fit into `duration_s`.

        Raises:
            ConfigError: the first one does not fit.
        """
        found, left = [], int(duration_s / machine.period_s + 1e-6)
        starts = draw_start_poses(machine, self.stop_margin, generator)
        while True:
            start, programs = next(starts), self.programs(machine, generator)
            for i in generator.permutation(len(programs)):
                name, u = programs[i]
                left -= len(u)
                if left >= 0:
                    name = f"{name}_{len(found):02d}"
                    found.append(Segment(name, start, u, "inward", self.stop_margin))
                elif found:
                    return found
                else:
                    raise ConfigError(
                        f"excitation={type(self).__name__.lower()}: its part of a run, {duration_s:.0f} s, does not hold its first "
                        "segment; raise collect.run_minutes (or its share), or leave it out"
                    )


def hold_levels(levels: ArrayLike, holds_s: ArrayLike, period_s: float) -> np.ndarray:
    """Return each level held for its time, `(T,)`."""
    counts = np.maximum(1, np.round(np.asarray(holds_s) / period_s).astype(int))
    return np.repeat(np.asarray(levels, dtype=float), counts)


@spec
class Ramps(Motif):
    """Slow ramps of one joint through zero: separates dead band, friction and hysteresis.

    Attributes:
        share: Part of the time, relative to the others of the plan.
        slopes_per_s: Change of the command per second.
        highest: Highest command.
        reach: Largest way to either side, as a part of the joint's travel, at the machine's nominal
            speed; lowers the peaks.
        stop_margin: As in `levels`.
    """

    slopes_per_s: Annotated[tuple[Positive, ...], MinLen(1)]
    highest: float
    reach: float

    def programs(self, machine: Machine, generator: Generator) -> list[Program]:
        """Return a ramp to one side, to the other and back, per joint and slope.

        The first side is random.
        """
        way = self.reach * (machine.upper - machine.lower) / machine.max_speed
        found = []
        for slope_per_s, joint in product(self.slopes_per_s, range(machine.num_joints)):
            # a triangle of height h and slope s takes the joint h^2 / s of its full speed further
            height = min(self.highest, np.sqrt(slope_per_s * way[joint]))
            rise = max(1, round(height / slope_per_s / machine.period_s))
            up = np.linspace(0.0, height, rise + 1)
            down = np.linspace(height, -height, 2 * rise + 1)
            ramp = np.concatenate([up, down[1:], -up[::-1][1:]])
            found.append(move_joint("ramps", machine, joint, generator.choice([-1.0, 1.0]) * ramp))
        return found


@spec
class Holds(Motif):
    """Zero command under different loads: shows leaks, sensor drift, noise and quantisation.

    Attributes:
        share: Part of the time, relative to the others of the plan.
        hold_s: Length of a hold; 20 s or more show a leak.
        stop_margin: As in `levels`.
    """

    hold_s: float

    def programs(self, machine: Machine, generator: Generator) -> list[Program]:
        """Return one hold: the way to each pose does the rest."""
        steps = max(1, round(self.hold_s / machine.period_s))
        return [("holds", np.zeros((steps, machine.num_joints)))]


@spec
class Reversals(Motif):
    """Small reversals of one joint at several speeds and lengths: shows play as missing motion.

    Attributes:
        share: Part of the time, relative to the others of the plan.
        levels: Commands to and fro.
        holds_s: Times for which they are held.
        num_cycles: Reversals of each kind.
        pause_s: Rest after each kind.
        stop_margin: As in `levels`.
    """

    levels: tuple[float, ...]
    holds_s: tuple[float, ...]
    num_cycles: int
    pause_s: float

    def programs(self, machine: Machine, generator: Generator) -> list[Program]:
        """Return all reversals of a joint in one program."""
        parts = []
        pause = hold_levels([0.0], [self.pause_s], machine.period_s)
        for level, hold_s in product(self.levels, self.holds_s):
            cycle = hold_levels([level, -level], [hold_s, hold_s], machine.period_s)
            parts += [np.tile(cycle, self.num_cycles), pause]
        commands = np.concatenate(parts)
        joints = range(machine.num_joints)
        return [move_joint("reversals", machine, joint, commands) for joint in joints]
