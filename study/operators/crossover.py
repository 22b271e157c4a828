"""Operators without guidance who steer several joints at once: as fast as the delay lets them, or looking ahead of it."""

from __future__ import annotations

import numpy as np

from actuators.person import HumanFollower
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from study.operators.person import Hands, Person, Range
from study.operators.sight import Sight


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

    hands: HumanFollower
    sight: Sight
    crossover_rad_s: Range
    anticipation: Range
    band: float
    creep: float
    good_rad: float

    def build(self, machine: Machine, person: Person) -> CrossoverModel:
        """See `study.operators.person.Operator`."""
        return CrossoverModel(self, machine, person)


@spec
class Expert(Crossover):
    """Simulated, unguided: reckons with all that is on its way, and so works faster than the delay lets others.

    Law and fields are those of `Crossover`.
    """


class CrossoverModel:
    """Such an operator at work."""

    def __init__(self, operator: Crossover, machine: Machine, person: Person) -> None:
        self._config, self._speed = operator, machine.max_speed
        self._hands = Hands(operator.hands, machine, person)
        self._sight = operator.sight.build(machine, person)
        self._crossover = person.draw("crossover_rad_s", operator.crossover_rad_s)
        self._anticipation = person.draw("anticipation", operator.anticipation)
        self._period_s = machine.period_s
        num_sent = round(machine.dead_time_s / machine.period_s)
        self._sent = np.zeros((num_sent, machine.num_joints))
        self._since = np.zeros(machine.num_joints)

    def step(self, q: np.ndarray, rim_in_base_m: np.ndarray, advice: np.ndarray) -> np.ndarray:
        """See `study.operators.person.OperatorModel`."""
        config = self._config
        coming = self._sent.sum(0) * self._period_s * self._speed
        ahead = q + self._anticipation * coming
        if self._sight.look(ahead, rim_in_base_m):
            self._since = ahead
        # Between two pictures the hands' own motion is felt.
        away = self._sight.way - (ahead - self._since)
        share = np.clip(self._crossover * away / self._speed, -1.0, 1.0)
        size = np.maximum(np.abs(share), config.creep)
        wanted = np.sign(share) * (config.band + (1.0 - config.band) * size)
        given = self._hands.step(np.where(np.abs(away) > config.good_rad, wanted, 0.0))
        opening = np.maximum(np.abs(given) - config.band, 0.0) / (1.0 - config.band)
        self._sent = np.concatenate((self._sent[1:], (np.sign(given) * opening)[None]))
        return given
