"""Simulated operators at the levers, and the ground of their trials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np

    from brokk_rl.machine import Machine
    from brokk_rl.record import Recording
    from brokk_rl.session import Session


@dataclass(frozen=True)
class TrialBatch:
    """Trials of a study, to be done side by side in numpy.

    Attributes:
        q: Joint positions from which each begins, `(N, J)`.
        rim_in_base_m: Centre of the rim of its hole, `(N, 3)`.
        radius_m: Radius of its hole, `(N,)`.
        guided: Whether advice is shown, `(N,)` bool.
        limit_s: Time after which each ends at the latest.
        depth_m: Depth of the tip below the rim at which the tool is in.
        clearance_m: Distance of the tip from the hole's axis within which it is.
    """

    q: np.ndarray
    rim_in_base_m: np.ndarray
    radius_m: np.ndarray
    guided: np.ndarray
    limit_s: float
    depth_m: float
    clearance_m: float


@dataclass(frozen=True)
class OperatorView:
    """View of simulated operators at the start of a control period, numpy.

    Attributes:
        q: Joint positions, `(N, J)`.
        rim_in_base_m: Centre of the hole's rim, `(N, 3)`; the operator model adds its errors of
            vision.
        advice: Commands that are advised, `(N, J)`; NaN where none is shown.
    """

    q: np.ndarray
    rim_in_base_m: np.ndarray
    advice: np.ndarray


class OperatorModel(Protocol):
    """Simulated operators at the levers of `N` machines, in numpy; one control period a call."""

    def step(self, view: OperatorView) -> np.ndarray:
        """Return the commands of the coming period, `(N, J)` in [-1, 1].

        Exclusive joints never move together with others.
        """
        ...


class Operator(Protocol):
    """A spec in `conf/operator`: a kind of simulated operator."""

    def build(self, machine: Machine, persons: np.ndarray, seed: int) -> OperatorModel:
        """Return a model of the operators `persons`, `(N,)`.

        The same number and seed is the same person.
        """
        ...


class TrialGround(Protocol):
    """A spec in `conf/ground`: where simulated operators do trials."""

    def run(
        self, machine: Machine, session: Session, trials: TrialBatch, operators: OperatorModel
    ) -> list[Recording]:
        """Do the trials; return a recording of each, in order, with advice where it was shown."""
        ...
