"""An operator who follows the advice, as well as hands can."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from actuators.person import HumanFollower
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from study.operators.person import Hands, Person


@spec
class AdviceFollower:
    """Simulated: follows the advice shown, late and imprecisely, a few levers at once; without advice does nothing.

    Attributes:
        hands: How the levers are moved.
    """

    hands: HumanFollower

    label: ClassVar[str] = "follower"

    def build(self, machine: Machine, person: Person) -> AdviceFollowerModel:
        """See `study.operators.person.Operator`."""
        return AdviceFollowerModel(Hands(self.hands, machine, person))


class AdviceFollowerModel:
    """A follower at work."""

    def __init__(self, hands: Hands) -> None:
        self._hands = hands

    def step(self, q: np.ndarray, rim_in_base_m: np.ndarray, advice: np.ndarray) -> np.ndarray:
        """See `study.operators.person.OperatorModel`."""
        return self._hands.step(np.nan_to_num(advice))
