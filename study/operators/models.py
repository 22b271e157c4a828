"""Kinds of simulated operators: who follows the advice, who moves one joint and waits, who steers several at once."""

from __future__ import annotations

import numpy as np

from actuators.person import HumanFollower
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from study.operators.person import Hands, OperatorModel, Person, Range
from study.operators.sight import Sight

LONGER, SHORTER, LEAST, MOST = 1.25, 0.6, 0.05, 2.5
"""Factors on short moves of a joint after one that was not enough, and after one that was too much;
bounds of their product."""


@spec
class AdviceFollower:
    """Simulated: follows the advice shown, late and imprecisely, a few levers at once; without advice does nothing.

    Attributes:
        hands: How the levers are moved.
    """

    hands: HumanFollower

    def build(self, machine: Machine, person: Person) -> OperatorModel:
        """See `study.operators.person.Operator`."""
        hands = Hands(self.hands, machine, person)
        return lambda q, rim_in_base_m, advice: hands.step(np.nan_to_num(advice))


@spec
class Novice:
    """Simulated, unguided: one joint at a time: deflects, lets go, waits until nothing moves, looks again.

    People under delays move and wait (Ferrell, IEEE Trans. Hum. Factors Electron. 6,
    1965).

    Attributes:
        hands: How the levers are moved.
        sight: Model of the operator's sight.
        deflection: Deflection of a long move.
        fine_deflection: Deflection of a short one.
        fine_s: Time below which a move is short.
        band: Command up to which valves stay shut, as the person knows it.
        lost_s: Time for which a lever must be held before anything moves at all, as the person
            knows it.
        judgement: Length of a move over the right one; for short ones joint by joint corrected by
            the effect of the last one.
        scatter: Standard deviation of its logarithm, from move to move.
        wait_s: Pause after a move, beyond the time in which the machine comes to rest.
        good_rad: Error with which a joint is left alone, rad or m.
    """

    hands: HumanFollower
    sight: Sight
    deflection: Range
    fine_deflection: float
    fine_s: float
    band: float
    lost_s: Range
    judgement: Range
    scatter: float
    wait_s: Range
    good_rad: float

    def build(self, machine: Machine, person: Person) -> OperatorModel:
        """See `study.operators.person.Operator`."""
        return NoviceModel(self, machine, person).step


class NoviceModel:
    """A novice at work."""

    def __init__(self, novice: Novice, machine: Machine, person: Person) -> None:
        self._config, self._machine, self._chance = novice, machine, person.chance
        self._hands = Hands(novice.hands, machine, person)
        self._sight = novice.sight.build(machine, person)
        self._deflection = person.draw("deflection", novice.deflection)
        self._judgement = person.draw("judgement", novice.judgement)
        self._pause_s = person.draw("wait_s", novice.wait_s) + machine.dead_time_s
        self._lost_s = person.draw("lost_s", novice.lost_s)
        self._learnt = np.ones(machine.num_joints)
        self._last = np.zeros(machine.num_joints)
        self._move = np.zeros(machine.num_joints)
        self._left_s = self._rest_s = 0.0

    def step(self, q: np.ndarray, rim_in_base_m: np.ndarray, advice: np.ndarray) -> np.ndarray:
        """See `study.operators.person.OperatorModel`."""
        period_s = self._machine.period_s
        self._left_s -= period_s
        self._rest_s = self._pause_s if self._left_s > 0 else self._rest_s - period_s
        if self._sight.look(q, rim_in_base_m) and self._left_s <= 0 and self._rest_s <= 0:
            self._decide()
        # The last moment of a move is a part of a period.
        return self._hands.step(self._move * min(max(self._left_s / period_s, 0.0), 1.0))

    def _decide(self) -> None:
        """Choose the joint that needs longest, and how long to move it."""
        config, speed = self._config, self._machine.max_speed
        joint = int((np.abs(self._sight.way) / speed).argmax())
        away = self._sight.way[joint]
        if abs(away) <= config.good_rad:
            return
        level, factor = self._deflection, 1.0
        if abs(away) / (speed[joint] * self._rate(level)) < config.fine_s:
            level, factor = config.fine_deflection, self._learnt[joint]
            # The same side again: the last move was not enough; the other side: too much.
            if self._last[joint] * away > 0:
                factor *= LONGER
            elif self._last[joint] * away < 0:
                factor *= SHORTER
            factor = self._learnt[joint] = min(max(factor, LEAST), MOST)
        scatter = np.exp(config.scatter * self._chance.standard_normal())
        full_s = abs(away) / (speed[joint] * self._rate(level))
        self._left_s = (full_s * self._judgement * scatter + self._lost_s) * factor
        self._last[joint] = away
        self._move = np.zeros_like(self._move)
        self._move[joint] = np.sign(away) * level

    def _rate(self, level: float) -> float:
        """Return the share of full speed at a deflection."""
        return (level - self._config.band) / (1.0 - self._config.band)


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

    def build(self, machine: Machine, person: Person) -> OperatorModel:
        """See `study.operators.person.Operator`."""
        return CrossoverModel(self, machine, person).step


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
