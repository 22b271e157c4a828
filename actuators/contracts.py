"""Contracts of fits and of planned runs; a package from elsewhere may bring either.

Axes: `N` environments, `J` joints, `T` control periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import torch

from brokk_rl.contracts.actuator import Actuator
from brokk_rl.machine import Machine
from brokk_rl.record import Recording


class PlannedRun(Protocol):
    """A run of a model whose commands are all known beforehand."""

    def step(self, k: int, q: torch.Tensor) -> torch.Tensor:
        """Return positions `k`, `(N, J)`, from those before in `q`, `(T + 1, N, J)`.

        It is called once for each `k`, rising from `first` of `PlannableModel.plan_run` on.
        """
        ...


@dataclass(frozen=True)
class FitTask:
    """Recordings that a model is fitted to, and where the results go.

    Attributes:
        machine: The machine.
        train: Recordings to fit to.
        validation: Recordings to stop the fit by.
        folder: Where the fit writes.
        seed: Of its random numbers.
        device: Where it computes.
    """

    machine: Machine
    train: Sequence[Recording]
    validation: Sequence[Recording]
    folder: Path
    seed: int = 0
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def recordings(self) -> list[Recording]:
        """All recordings, for a fit that nothing stops."""
        return [*self.train, *self.validation]


class ActuatorFit(Protocol):
    """A spec in `conf/fit`: learns an actuator model from recordings."""

    name: str
    """Name of the model in tables and files."""

    def fit(self, task: FitTask) -> Actuator:
        """Return the fitted actuator; results lie in the folder of the task."""
        ...
