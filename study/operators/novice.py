"""An operator without guidance who handles dead time as a beginner: one joint, look, move, wait."""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from study.operators.hands import Hands
from study.operators.sight import Sight
from study.operators.traits import Range, Traits
from study.trial_contract import OperatorModel, OperatorView

LONGER, SHORTER, RANGE = 1.25, 0.6, (0.05, 2.5)
"""Factors on short moves of a joint after one that was not enough, and after one that was too much;
bounds of their product."""


@spec
class Novice:
    """Simulated, unguided: one joint at a time: deflects, lets go, waits until nothing moves, looks again.

    People under delays move and wait (Ferrell, IEEE Trans. Hum. Factors Electron. 6,
    1965).

    Attributes:
        hands: How the levers are moved.
        sight: Model of the operator's sight.
        deflection: Deflection of a long move.
        fine: Deflection of a short one, and the time below which a move is short, s.
        band: Command up to which valves stay shut, as the person knows it.
        lost_s: Time for which a lever must be held before anything moves at all, as the person
            knows it.
        judgement: Length of a move over the right one; for short ones joint by joint corrected by
            the effect of the last one.
        scatter: Standard deviation of its logarithm, from move to move.
        wait_s: Pause after a move, beyond the time in which the machine comes to rest.
        good_rad: Error with which a joint is left alone, rad or m.
    """

    hands: Hands
    sight: Sight
    deflection: Range
    fine: tuple[float, float]
    band: float
    lost_s: Range
    judgement: Range
    scatter: float
    wait_s: Range
    good_rad: float

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> OperatorModel:
        """See `study.trial_contract.Operator`."""
        return NoviceModel(self, machine, persons, seed)


class NoviceModel:
    """Novices at work."""

    def __init__(self, novice: Novice, machine: Machine, persons: np.ndarray, seed: int) -> None:
        traits = Traits(persons, seed)
        self._config, self._machine = novice, machine
        self._hands, self._sight = (
            novice.hands.build(machine, persons, seed),
            novice.sight.build(machine, persons, seed),
        )
        self._deflection = traits.draw("deflection", novice.deflection)[:, 0]
        self._judgement = traits.draw("judgement", novice.judgement)[:, 0]
        self._pause_s = traits.draw("wait_s", novice.wait_s)[:, 0] + machine.dead_time_s
        self._lost_s = traits.draw("lost_s", novice.lost_s)[:, 0]
        self._learnt = np.ones((len(persons), machine.num_joints))
        self._last = np.zeros((len(persons), machine.num_joints))
        self._left_s = np.zeros(len(persons))
        self._rest_s = np.zeros(len(persons))
        self._move = np.zeros((len(persons), machine.num_joints))
        self._generator = np.random.default_rng((seed, 3))

    def step(self, view: OperatorView) -> np.ndarray:
        """See `study.trial_contract.OperatorModel`."""
        period_s = self._machine.period_s
        self._left_s -= period_s
        self._rest_s = np.where(self._left_s > 0, self._pause_s, self._rest_s - period_s)
        if self._sight.look(view, view.q):
            self._decide((self._left_s <= 0) & (self._rest_s <= 0))
        # the last moment of a move is a part of a period
        part = np.clip(self._left_s / period_s, 0.0, 1.0)
        return self._hands.step(self._move * part[:, None])

    def _decide(self, idle: np.ndarray) -> None:
        """Let those who are idle, `(N,)` bool, choose a joint and how long to move it."""
        config, speed = self._config, self._machine.max_speed
        way, rows = self._sight.way, np.arange(len(idle))
        joint = (np.abs(way) / speed).argmax(1)
        away = way[rows, joint]
        moves = idle & (np.abs(away) > config.good_rad)
        scattered = np.exp(config.scatter * self._generator.standard_normal(len(idle)))
        full = self._rate(self._deflection)
        short = np.abs(away) / (speed[joint] * full) < config.fine[1]
        level = np.where(short, config.fine[0], self._deflection)
        turned = self._last[rows, joint] * away
        factor = self._learnt[rows, joint] * np.where(
            turned > 0, LONGER, np.where(turned < 0, SHORTER, 1.0)
        )
        factor = np.where(short, np.clip(factor, *RANGE), 1.0)
        time_s = (
            np.abs(away) / (speed[joint] * self._rate(level)) * self._judgement * scattered
            + self._lost_s
        ) * factor
        self._learnt[rows[moves & short], joint[moves & short]] = factor[moves & short]
        self._last[rows[moves], joint[moves]] = away[moves]
        chosen = np.zeros_like(self._move)
        chosen[rows, joint] = np.sign(away) * level
        self._move = np.where(moves[:, None], chosen, self._move)
        self._left_s = np.where(moves, time_s, self._left_s)

    def _rate(self, level: np.ndarray) -> np.ndarray:
        """Return the share of full speed at a deflection."""
        return (level - self._config.band) / (1.0 - self._config.band)
