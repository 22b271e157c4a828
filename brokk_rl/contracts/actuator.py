"""Contracts of actuator models, excitations, effects and followers.

Axes: `N` environments, `J` joints, `H` samples of history (oldest first).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

if TYPE_CHECKING:
    import numpy as np
    import torch

    from brokk_rl.history import History
    from brokk_rl.machine import Machine


class ActuatorModel(Protocol):
    """Map from the last `H` positions and commands to the next position, for all environments.

    A model with a state of its own (spool position, pressure) keeps it in tensors of fixed shape
    listed by `state`. `step` works without a host synchronisation and without data-dependent
    shapes, so that it can be captured in a CUDA graph.
    """

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Internal state by name, each `(N, …)`; written in place. Empty without memory."""
        ...

    def reset(self, mask: torch.Tensor) -> None:
        """Put the environments of `mask`, `(N,)` bool, into the state of a machine at rest."""

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)` in rad or m.

        `history.u[:, -1]` is the command that has just come into force, `history.q[:, -1]` the
        position at this moment.
        """
        ...


class SensingModel(ActuatorModel, Protocol):
    """An actuator model with sensors and geometry: effects around a model fulfil this.

    A loop asks an actuator for `sides` (absent: none) and calls `measure` and `misplacement` only
    where they do something, once a control period, after `reset`. `step` is given true positions.
    """

    @property
    def sides(self) -> frozenset[str]:
        """`measurement` where `measure` matters, `kinematics` where `misplacement` does."""
        ...

    def measure(self, q: torch.Tensor) -> torch.Tensor:
        """Return the sensor readings at the true positions `q`, `(N, J)`."""
        ...

    def truth(self, q: torch.Tensor) -> torch.Tensor:
        """Return likely true positions for readings `q`, `(N, J)` or `(N, H, J)`."""
        ...

    def misplacement(self, q: torch.Tensor) -> torch.Tensor:
        """Return the controller's error in a target near the tool at `q`, `(N, 3)` in m."""
        ...


class Actuator(Protocol):
    """A spec in `conf/actuator`: builds an actuator model."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ActuatorModel:
        """Return a model for `num_envs` environments on `device`."""
        ...


@dataclass(frozen=True)
class Segment:
    """A pose and the commands that are played from it. Pure data for one machine.

    Attributes:
        name: Its name, unique in its plan, e.g. `ramps_q3_02`.
        start: Joint positions from which it is played, `(J,)`, rad or m.
        u: The program, `(T, J)` in [-1, 1]; row `k` is in force in control period `k`. Exclusive
            joints never together with others.
        stops: Reaction when a joint is about to come to rest closer to its stop than
            `stop_margin`. `home`: everything goes
            back to `start` and waits until the program, which runs on by the clock, next passes
                zero. `inward`: this joint is
            driven the other way until its program next passes zero.
        stop_margin: Distance from the stops, as a part of the joint's travel.
    """

    name: str
    start: np.ndarray
    u: np.ndarray
    stops: Literal["home", "inward"]
    stop_margin: float


class Excitation(Protocol):
    """A spec in `conf/excitation`: commands that reveal the behaviour of an actuator.

    Numpy only: it also runs on the machine's computer.
    """

    @property
    def share(self) -> float:
        """Part of the time, relative to the others of a plan; above 0."""
        ...

    def segments(
        self, machine: Machine, duration_s: float, generator: np.random.Generator
    ) -> list[Segment]:
        """Return segments of `duration_s` in all, or as much as whole segments fill.

        Args:
            machine: Gives limits, speeds, weights, and the joints that never move together with
                others.
            duration_s: Time for the programs, without the ways to their start poses.
            generator: The only source of chance.

        Raises:
            ConfigError: not a single segment fits into `duration_s`.
        """
        ...


class Effect(Protocol):
    """A spec in `conf/effect`: wraps an actuator model; the result is one again."""

    def wrap(
        self, model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> ActuatorModel:
        """Return `model` with the effect added; with the effect's neutral value nothing changes."""
        ...


class FollowerModel(Protocol):
    """Map from the proposed to the given command, as a person at the levers does it.

    `step` works without a host synchronisation and without data-dependent shapes, so that it can be
    captured in a CUDA graph.
    """

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Complete state by name, each `(N, …)`; written in place. Empty without memory."""
        ...

    def reset(self, mask: torch.Tensor) -> None:
        """Put a new person at the levers in the environments of `mask`, `(N,)` bool.

        This person has seen no proposal yet.
        """

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return the given command of the coming control period, `(N, J)` in [-1, 1].

        `proposed`, `(N, J)`, is the proposal from now on. Where no proposal moves an
        exclusive joint together with others, the given command does not either.
        """
        ...


class Follower(Protocol):
    """A spec in `conf/follower`: builds the model between policy and machine."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> FollowerModel:
        """Return followers for `num_envs` environments on `device`."""
        ...
