"""Random levels on several joints at once: the only excitation that shows a shared pump."""

import numpy as np

from actuators.excite.poses import PoseProgram
from actuators.excite.schedule import check_order
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.spec import Positive, Share, spec


@spec
class Levels(PoseProgram):
    """Random levels for random times on several joints at once, from poses of opposite load.

    Attributes:
        share: Part of the time, relative to the others of the plan.
        pose_s: Time after which another start pose is taken, about.
        turn_s: Time after which it is drawn anew whether the exclusive joints move or all the
            others.
        exclusive_share: Part of the turns in which the exclusive joints move and the others rest.
        shortest_s: Shortest time a level is held; times are drawn log-uniformly.
        longest_s: Longest time.
        zero_share: Part of the levels that are zero, so that the number of moving joints varies.
        small_share: Part of the levels drawn from below `small_level`, where the dead band is.
        small_level: Largest small level.
        stop_margin: A joint that would come to rest this close to its stop, as a part of its
            travel, is driven the other way.
    """

    turn_s: Positive
    exclusive_share: float
    shortest_s: Positive
    longest_s: float
    zero_share: Share
    small_share: Share
    small_level: float

    def check(self) -> None:
        if self.zero_share + self.small_share > 1.0:
            raise ConfigError("zero_share, small_share: expected 1 or less together, got more")
        check_order(self, "shortest_s", "longest_s")
        check_order(self, "turn_s", "pose_s")

    def program(self, machine: Machine, steps: int, generator: np.random.Generator) -> np.ndarray:
        """Return the commands of so many control periods, `(T, J)`."""
        u = np.stack([self._joint(steps, machine.period_s, generator) for _ in machine.joints], 1)
        if not machine.is_exclusive.any() or machine.is_exclusive.all():
            return u
        turn = max(1, round(self.turn_s / machine.period_s))
        # spread evenly from a random beginning, so that a short program has its part too
        turns = self.exclusive_share * np.arange(-(-steps // turn) + 1) + generator.random()
        alone = np.diff(np.floor(turns)) > 0
        return u * mask_exclusive_joints(machine.is_exclusive, np.repeat(alone, turn)[:steps])

    def _joint(self, steps: int, period_s: float, generator: np.random.Generator) -> np.ndarray:
        """Return the levels of one joint, `(T,)`."""
        most = -(-steps // max(1, int(self.shortest_s / period_s)))
        held_s = np.exp(generator.uniform(np.log(self.shortest_s), np.log(self.longest_s), most))
        kind = generator.random(most)
        is_small = kind < self.zero_share + self.small_share
        reach = np.where(is_small, self.small_level, 1.0) * (kind >= self.zero_share)
        level = reach * generator.uniform(-1.0, 1.0, most)
        return np.repeat(level, np.maximum(1, np.round(held_s / period_s).astype(int)))[:steps]
