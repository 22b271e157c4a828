"""Contracts of fits and of models that plan a run; a package from elsewhere may bring either.

Axes: `N` environments, `J` joints, `T` control periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import torch

from brokk_rl.contracts.actuator import Actuator, ActuatorModel
from brokk_rl.machine import Machine
from brokk_rl.record import Recording


class PlannedRun(Protocol):
    """A run of a model whose commands are all known beforehand."""

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """Return positions `k`, `(N, J)`, from those before in `q`, `(T + 1, N, J)`.

        It is called once for each `k`, rising from `first` of `PlannedModel.plan_run` on.
        """
        ...


class PlannedModel(ActuatorModel, Protocol):
    """An actuator model that computes what depends on commands alone for a whole run at once.

    It looks at the newest position only, and at the two newest in its first step.
    """

    @property
    def delay_s(self) -> torch.Tensor:
        """Time until a command begins to act, `(N, J)`, s."""
        ...

    def plan_run(
        self, u: torch.Tensor, first: int, q: torch.Tensor | None = None
    ) -> PlannedRun | None:
        """Return the run that begins after a `reset` of all environments; `None`: `step` through it.

        The positions are those of `step`. The state stays as it was.

        Args:
            u: Commands of the run, `(T, N, J)`; position `k` follows command `k - 1`.
            first: Number of the first position that is asked for: the length of the history.
            q: Positions up to there, `(first, N, J)` or more, for effects that begin where a joint is;
                `None`: a model with such an effect has to be stepped.
        """
        ...


class ActuatorFit(Protocol):
    """A spec in `conf/fit`: learns an actuator model from recordings."""

    name: str
    """Name of the model in tables and files."""

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> Actuator:
        """Fit to `train`, choose by `validation`, write results into `folder`.

        Returns the fitted actuator.
        """
        ...
