"""A person's hands on the levers: they follow the wanted positions late, sluggishly and imprecisely, a few levers at a time.

The law is that of `follower=person` (reaction delay, first-order lag integrated exactly over the
period, amplitude, tremor, dead zone, a choice of levers that holds for a while), in numpy, for the
machine's own computer; the names of the numbers are the same.
Axes: `N` trials, `J` joints.
"""

from __future__ import annotations

import math

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.spec import spec
from study.operators.traits import Range, Traits


@spec
class Hands:
    """Motor properties of a person at the levers; ranges are drawn per person.

    Attributes:
        delay_s: Reaction delay, from eye to hand.
        lag_s: Time constant of the hand.
        gain: Deflection over the one wanted.
        tremor: Standard deviation of the deflection, as a part of it.
        dead_zone: Deflection below which a lever commands nothing.
        joints_at_once: Levers moved at the same time.
        grip_s: Time for which a lever once taken is kept, as long as it is wanted.
    """

    delay_s: Range
    lag_s: Range
    gain: Range
    tremor: Range
    dead_zone: Range
    joints_at_once: int | tuple[int, int]
    grip_s: Range

    def check(self) -> None:
        most = (
            self.joints_at_once[0]
            if isinstance(self.joints_at_once, tuple)
            else self.joints_at_once
        )
        if most < 1:
            raise ConfigError(
                f"operator.hands.joints_at_once: expected 1 or more, got {self.joints_at_once}"
            )

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> HandsModel:
        """Return the hands of the persons `(N,)`."""
        return HandsModel(self, machine, persons, seed)


class HandsModel:
    """Hands at work."""

    def __init__(self, hands: Hands, machine: Machine, persons: np.ndarray, seed: int) -> None:
        traits, self._period_s = Traits(persons, seed), machine.period_s
        self._exclusive = machine.is_exclusive
        self._delay = traits.draw("delay_s", hands.delay_s) / machine.period_s
        self._lag = np.maximum(traits.draw("lag_s", hands.lag_s) / machine.period_s, 1e-9)
        self._gain, self._tremor = (
            traits.draw("gain", hands.gain),
            traits.draw("tremor", hands.tremor),
        )
        self._dead_zone, self._grip_s = (
            traits.draw("dead_zone", hands.dead_zone),
            traits.draw("grip_s", hands.grip_s),
        )
        most = (
            hands.joints_at_once
            if isinstance(hands.joints_at_once, tuple)
            else (hands.joints_at_once, hands.joints_at_once)
        )
        self._most = traits.draw(
            "joints_at_once", (most[0] - 0.5 + 1e-9, most[1] + 0.5 - 1e-9)
        ).round()
        shape = (len(persons), machine.num_joints)
        self._wanted = np.zeros(
            (
                len(persons),
                math.ceil(float(self._delay.max(initial=0.0)) - 1e-6) + 2,
                machine.num_joints,
            )
        )
        self._hand, self._held_s = np.zeros(shape), np.zeros(shape)
        self._generator = np.random.default_rng((seed, 1))

    @property
    def hand(self) -> np.ndarray:
        """Where the levers are, `(N, J)`."""
        return self._hand

    def step(self, wanted: np.ndarray) -> np.ndarray:
        """Return the mean command of the coming period, `(N, J)`, where deflections `(N, J)` are wanted from now on."""
        self._wanted = np.concatenate((self._wanted[:, 1:], wanted[:, None]), 1)
        last = self._wanted.shape[1] - 1
        whole = np.floor(self._delay + 5e-7)
        part = np.clip(self._delay - whole, 0.0, 1.0)
        rows, newest = np.arange(len(wanted)), (last - whole[:, 0]).astype(int)
        later, earlier = self._wanted[rows, newest], self._wanted[rows, np.maximum(newest - 1, 0)]
        held = self._holds(later)
        after, first = self._reach(self._hand, earlier, part)
        hand, second = self._reach(after, later, 1.0 - part)
        self._hand = np.where(held, hand, 0.0)
        shaken = 1.0 + self._tremor * self._generator.standard_normal(wanted.shape)
        deflection = np.clip(np.where(held, first + second, 0.0) * self._gain * shaken, -1.0, 1.0)
        return (
            np.sign(deflection)
            * np.maximum(np.abs(deflection) - self._dead_zone, 0.0)
            / (1.0 - self._dead_zone)
        )

    def _holds(self, asked: np.ndarray) -> np.ndarray:
        """Return which levers are held, `(N, J)` bool: the exclusive or the others, the largest, those once taken for a while."""
        priority = np.abs(asked) + 1e-6 * np.abs(self._hand)
        alone = np.where(self._exclusive, priority, 0.0).max(1)
        among = np.where(self._exclusive, 0.0, priority).max(1)
        free = mask_exclusive_joints(self._exclusive, alone > among)
        taken = asked != 0
        kept = taken & (self._held_s > 0) & (self._held_s < self._grip_s - 1e-6)
        ranked = np.where(free, priority + 2.0 * kept, -1.0)
        rank = (-ranked).argsort(1, kind="stable").argsort(1)
        held = free & (rank < self._most)
        self._held_s = np.where(held & taken, self._held_s + self._period_s, 0.0)
        return held

    def _reach(
        self, hand: np.ndarray, target: np.ndarray, part: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the hand's position after `part` of a period on its way to `target`, and its share of the period's mean."""
        left = np.exp(-part / self._lag)
        return target + (hand - target) * left, target * part + (hand - target) * self._lag * (
            1.0 - left
        )
