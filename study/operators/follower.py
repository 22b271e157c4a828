"""An operator who follows the advice, as well as hands can."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from study.operators.hands import Hands, HandsModel
from study.trial_contract import OperatorModel, OperatorView


@spec
class AdviceFollower:
    """Simulated: follows the advice shown, late and imprecisely, a few levers at once; without advice does nothing.

    Attributes:
        hands: How the levers are moved.
    """

    hands: Hands

    # Recordings and reports of earlier versions hold this name.
    label: ClassVar[str] = "follower"

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> OperatorModel:
        """See `study.trial_contract.Operator`."""
        return AdviceFollowerModel(self.hands.build(machine, persons, seed))


class AdviceFollowerModel:
    """Followers at work."""

    def __init__(self, hands: HandsModel) -> None:
        self._hands = hands

    def step(self, view: OperatorView) -> np.ndarray:
        """See `study.trial_contract.OperatorModel`."""
        return self._hands.step(np.nan_to_num(view.advice))
