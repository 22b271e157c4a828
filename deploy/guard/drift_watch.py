"""Drift watch: does the machine still behave as when its model was made? Pure: numpy, no clock.

Every `BLOCK_S` of a joint's motion gives one score: its residual over the predicted way. A
conformal test compares it with the joint's scores in recordings that the model was not fitted to,
and with all before it in this run. The p-values are independent and uniform as long as these
scores are exchangeable (Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2005,
theorem 8.2). A martingale for each joint bets against that. By Ville's inequality the chance that
one of J martingales ever reaches J/alpha is at most alpha, however long the run. RAPT 2026 allows
false alarms in 0.5 % of its episodes.

The guarantee is for each run of the loop, and for a machine whose work is as varied as in the
recordings. Blocks on end are alike, so that on a machine it is not exact.

The probable effect is the one whose form explains most of the residuals since the run began.
"""

from __future__ import annotations

import math
import random
from bisect import bisect_left, bisect_right, insort
from collections.abc import Sequence
from enum import Enum

import numpy as np

from brokk_rl.machine import Machine

BLOCK_S = 10.0
"""Motion of a joint that gives one score. Chosen by hand: long enough that the dead time between
command and motion hardly counts, short enough that a minute of work tells a large change."""
STEP_S = 0.5
"""Time over which residuals are summed for the score. Chosen by hand: noise of the sensor cancels,
errors of dead time and speed do not."""
POWERS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Powers of the bets, mixed with equal weight (Vovk, Nouretdinov and Gammerman, ICML 2003)."""
MOVES = 0.1
"""Part of full speed above which a joint counts as moving."""

NUM_FORMS = 6
"""Forms of residuals that are told apart."""


class Misfit(Enum):
    """Probable effect, in the words of the diagnosis."""

    NONE = "none"
    FLOW_GAIN = "flow_gain"
    ASYMMETRY = "asymmetry"
    DEAD_TIME = "dead_time"
    CREEP = "creep"
    DEAD_BAND = "dead_band"


class ConformalMartingale:
    """Bets that scores are larger than those before; see the module.

    Args:
        scores: Of the recordings.
        seed: Of the draws between equal scores.

    Attributes:
        log_wealth: Logarithm of the martingale, 0 at the beginning.
    """

    def __init__(self, scores: Sequence[float], seed: int) -> None:
        self._scores, self._chance = sorted(scores), random.Random(seed)
        self._log_bets = [0.0] * len(POWERS)
        self.log_wealth = 0.0

    def update(self, score: float) -> float:
        """Take in a score; return its p-value."""
        smaller, up_to = bisect_left(self._scores, score), bisect_right(self._scores, score)
        larger, equal = len(self._scores) - up_to, up_to - smaller + 1
        # In (0, 1]: a p-value of 0 would win without end.
        p = (larger + (1.0 - self._chance.random()) * equal) / (len(self._scores) + 1)
        insort(self._scores, score)
        for number, power in enumerate(POWERS):
            self._log_bets[number] += math.log(power) + (power - 1.0) * math.log(p)
        most = max(self._log_bets)
        total = sum(math.exp(one - most) for one in self._log_bets)
        self.log_wealth = most + math.log(total / len(POWERS))
        return p


class DriftWatch:
    """Conformal test martingale of each joint, fed with one score every `BLOCK_S` of its motion.

    Args:
        scores: Of the recordings that the model was not fitted to, of each joint; a joint without
            any is not watched.
        false_alarms: Largest chance of a false alarm in a run.
        machine: Speeds and period.
        seed: Of the draws between equal scores.

    Attributes:
        misfit: The probable effect once the alarm is given.
        joint: Its joint; -1 without an alarm.
    """

    def __init__(
        self, scores: Sequence[Sequence[float]], false_alarms: float, machine: Machine, seed: int
    ) -> None:
        self._martingales = [ConformalMartingale(own, seed + j) for j, own in enumerate(scores)]
        self._is_watched = [bool(own) for own in scores]
        self._limit = math.log(len(scores) / false_alarms)
        self._meters = [BlockMeter(machine, joint) for joint in range(machine.num_joints)]
        self._moves = MOVES * machine.max_speed * machine.period_s
        self.misfit, self.joint = Misfit.NONE, -1

    def interrupt(self) -> None:
        """Begin the blocks anew, after a gap."""
        for meter in self._meters:
            meter.begin()

    def update(
        self, measured: np.ndarray, predicted: np.ndarray, slack: np.ndarray
    ) -> list[float | None]:
        """Take in one control period; return the score of each joint whose block is full.

        Args:
            measured: Measured motions, `(J,)`.
            predicted: Predicted motions.
            slack: Sizes of a motion that noise may make.
        """
        scores = []
        for joint, meter in enumerate(self._meters):
            moves = bool(abs(predicted[joint]) > self._moves[joint])
            motion = (float(measured[joint]), float(predicted[joint]), float(slack[joint]))
            score = meter.add(*motion, moves)
            scores.append(score)
            if score is not None and self._is_watched[joint]:
                self._bet(joint, score)
        return scores

    def _bet(self, joint: int, score: float) -> None:
        martingale = self._martingales[joint]
        martingale.update(score)
        # The first alarm stays: later ones would follow from the same change.
        if self.joint < 0 and martingale.log_wealth >= self._limit:
            self.joint, self.misfit = joint, self._meters[joint].name_effect()


class BlockMeter:
    """Scores of the motion of one joint, and what its residuals look like.

    Args:
        machine: Speeds and period.
        joint: Its number.
    """

    def __init__(self, machine: Machine, joint: int) -> None:
        self._full = float(machine.max_speed[joint]) * machine.period_s
        self._steps = max(1, round(STEP_S / machine.period_s))
        self._num_moving = round(BLOCK_S / machine.period_s)
        self._sums = np.zeros((NUM_FORMS, 2))
        self._before = 0.0
        self.begin()

    def begin(self) -> None:
        """Begin a block."""
        self._moving = self._count = 0
        self._piece = self._residual = self._way = 0.0

    def add(self, measured: float, predicted: float, slack: float, moves: bool) -> float | None:
        """Take in one period; return the score where a block is full."""
        self._note_forms(measured - predicted, predicted)
        self._piece += measured - predicted
        self._way += abs(predicted)
        self._moving += moves
        self._count += 1
        if self._count % self._steps == 0:
            self._residual += abs(self._piece)
            self._piece = 0.0
        if self._moving < self._num_moving:
            return None
        score = self._residual / (slack + self._way)
        self.begin()
        return score

    def _note_forms(self, residual: float, predicted: float) -> None:
        """Add up how well each effect's form explains the residuals."""
        is_slow = 0.0 < abs(predicted) < self._full / 2
        forms = (
            predicted,  # flow_gain
            max(predicted, 0.0),  # asymmetry, positive direction
            min(predicted, 0.0),  # asymmetry, negative direction
            self._before - predicted,  # dead_time: a motion that comes later
            self._full if predicted == 0.0 else 0.0,  # creep
            math.copysign(self._full, predicted) if is_slow else 0.0,  # dead_band
        )
        self._before = predicted
        for number, form in enumerate(forms):
            self._sums[number] += residual * form, form * form

    def explain(self) -> dict[Misfit, float]:
        """Return the sum of squared residuals that each effect's form explains."""
        cross, square = self._sums.T
        explained = np.divide(cross**2, square, out=np.zeros(NUM_FORMS), where=square > 0)
        gain, extend, retract, dead_time, creep, dead_band = explained.tolist()
        return {
            Misfit.FLOW_GAIN: gain,
            # Both directions together have one number more to fit; a shared gain is simpler.
            Misfit.ASYMMETRY: max(extend, retract),
            Misfit.DEAD_TIME: dead_time,
            Misfit.CREEP: creep,
            Misfit.DEAD_BAND: dead_band,
        }

    def name_effect(self) -> Misfit:
        """Return the effect whose form explains most of the residuals."""
        explained = self.explain()
        return max(explained, key=lambda effect: explained[effect])
