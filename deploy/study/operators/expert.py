"""An operator who knows the machine: several joints at once, by where the arm is going to be rather than where it is."""

from __future__ import annotations

import numpy as np

from brokk_rl.contracts import OperatorModel
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from deploy.study.operators.crossover import Crossover
from deploy.study.operators.hands import Hands
from deploy.study.operators.sight import Sight
from deploy.study.operators.traits import Range


@spec
class Expert:
    """Simulated, unguided: reckons with everything that is on its way, and so works faster than the delay lets others.

    Attributes:
        hands: How the levers are moved.
        sight: What is seen.
        gain_1_s: Speed of approach per way left.
        band: Command up to which valves stay shut, as the person knows it.
        creep: Smallest share of full speed that is asked for.
        good_rad: Error with which a joint is left alone, rad or m.
    """

    hands: Hands
    sight: Sight
    gain_1_s: Range
    band: float
    creep: float
    good_rad: float

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> OperatorModel:
        """See `brokk_rl.contracts.Operator`."""
        law = Crossover(
            hands=self.hands,
            sight=self.sight,
            crossover_rad_s=self.gain_1_s,
            anticipation=1.0,
            band=self.band,
            creep=self.creep,
            good_rad=self.good_rad,
        )
        return law.build(machine, persons, seed)
