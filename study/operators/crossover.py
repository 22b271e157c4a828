"""Operators without guidance who steer several joints at once: as fast as the delay lets them, or looking ahead of it."""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from study.operators.hands import Hands
from study.operators.sight import Sight
from study.operators.traits import Range, Traits
from study.trial_contract import OperatorModel, OperatorView


@spec
class Crossover:
    """Simulated, unguided: on each joint McRuer's crossover model, stable only as slow as the delay wants.

    With 0.55 s of the machine and 0.3 s of the person a phase margin of 45 degrees leaves about 0.9
    rad/s (McRuer and Jex, IEEE Trans. Hum. Factors Electron. 8, 1967).

    Attributes:
        hands: How the levers are moved.
        sight: Model of the operator's sight.
        crossover_rad_s: Crossover frequency.
        anticipation: Share of the motion on its way that is reckoned with: 0 for who sees only
            the present motion, 1 for who knows the machine.
        band: Command up to which valves stay shut, as the person knows it.
        creep: Smallest share of full speed that is asked for.
        good_rad: Error with which a joint is left alone, rad or m.
    """

    hands: Hands
    sight: Sight
    crossover_rad_s: Range
    anticipation: Range
    band: float
    creep: float
    good_rad: float

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> OperatorModel:
        """See `study.trial_contract.Operator`."""
        return CrossoverModel(self, machine, persons, seed)


class CrossoverModel:
    """Such operators at work."""

    def __init__(
        self, operator: Crossover, machine: Machine, persons: np.ndarray, seed: int
    ) -> None:
        traits = Traits(persons, seed)
        self._config, self._speed = operator, machine.max_speed
        self._hands, self._sight = (
            operator.hands.build(machine, persons, seed),
            operator.sight.build(machine, persons, seed),
        )
        self._crossover = traits.draw("crossover_rad_s", operator.crossover_rad_s)
        self._anticipation = traits.draw("anticipation", operator.anticipation)
        self._period_s = machine.period_s
        self._sent = np.zeros(
            (len(persons), round(machine.dead_time_s / machine.period_s), machine.num_joints)
        )
        self._since = np.zeros((len(persons), machine.num_joints))

    def step(self, view: OperatorView) -> np.ndarray:
        """See `study.trial_contract.OperatorModel`."""
        coming = self._sent.sum(1) * self._period_s * self._speed
        ahead = view.q + self._anticipation * coming
        if self._sight.look(view, ahead):
            self._since = ahead.copy()
        # between two pictures the hands' own motion is felt
        away = self._sight.way - (ahead - self._since)
        share = np.clip(self._crossover * away / self._speed, -1.0, 1.0)
        size = np.where(
            np.abs(away) > self._config.good_rad, np.maximum(np.abs(share), self._config.creep), 0.0
        )
        given = self._hands.step(
            np.sign(share)
            * np.where(size > 0, self._config.band + (1.0 - self._config.band) * size, 0.0)
        )
        opened = (
            np.sign(given)
            * np.maximum(np.abs(given) - self._config.band, 0.0)
            / (1.0 - self._config.band)
        )
        self._sent = np.concatenate((self._sent[:, 1:], opened[:, None]), 1)
        return given
