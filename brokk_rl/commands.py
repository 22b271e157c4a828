"""From a policy's proposal to the commands of a machine: who gives them, and in which interface.

On the machine a person reads the proposed lever positions and moves the levers, late and
imperfectly; such a follower is one of `conf/follower`. The neutral one, of which every other is a
departure, is here.

A program of a policy, an excitation or an inspection thinks in speeds: at 0 a joint rests. Joints
commanded by position take the integral of such a program as their target, which begins where the
joint is and stays within the travel. Torques are left as they are: no speed belongs to them.
Axes: `N` environments, `T` samples, `H` samples of history (oldest first), `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import spec

if TYPE_CHECKING:
    import torch

    from brokk_rl.contracts.actuator import ActuatorModel


@spec
class NoFollower:
    """No person in between: the policy's command is given unchanged and at once."""

    label: ClassVar = "nobody"
    state: ClassVar[dict[str, Any]] = {}

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> NoFollower:
        """Return the follower that changes nothing; see `brokk_rl.contracts.actuator.Follower`."""
        return self

    def reset(self, mask: torch.Tensor) -> None:
        """Have no memory."""

    def step(self, proposed: torch.Tensor) -> torch.Tensor:
        """Return `proposed`, `(N, J)`."""
        return proposed


def select_levers(priority: torch.Tensor, most: torch.Tensor | int) -> torch.Tensor:
    """Return the levers that are moved, `(N, J)` bool: the `most` of highest `priority`.

    Args:
        priority: Priority of each lever, `(N, J)`; of equal ones the first counts.
        most: Number of levers, one for all environments or `(N, 1)`.
    """
    import torch  # this module is read by programs that need none

    mine, others = priority[:, :, None], priority[:, None, :]
    order = torch.arange(priority.shape[1], device=priority.device)
    before = (others > mine) | ((others == mine) & (order < order[:, None]))
    return before.sum(2) < most


def read_targets(u: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the target positions of commands `(…, J)`, rad or m: -1 and 1 are the ends of the travel."""
    middle, half = _measure_travel(machine)
    return middle + u * half


def scale_targets(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the commands of target positions `(…, J)`, rad or m, cut at the ends of the travel."""
    middle, half = _measure_travel(machine)
    return np.clip((q - middle) / half, -1.0, 1.0)


def _measure_travel(machine: Machine) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half width of the travel, `(J,)` each."""
    return (machine.upper + machine.lower) / 2, (machine.upper - machine.lower) / 2


def find_rest(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the commands `(…, J)` under which joints rest at `q`: the position itself as a target, else 0."""
    return scale_targets(q, machine) if machine.interface == "position" else np.zeros_like(q)


def view_speeds(u: np.ndarray, machine: Machine) -> np.ndarray:
    """Return commands `(…, T, J)` as parts of full speed.

    Those of valves and drives are speeds already. A target changes from one sample to the next, so
    its speed acts from the sample at which the new target is given.
    """
    if machine.interface != "position":
        return u
    step = np.diff(read_targets(u, machine), axis=-2, prepend=read_targets(u[..., :1, :], machine))
    return np.clip(step / (machine.max_speed * machine.period_s), -1.0, 1.0)


def view_recordings(recordings: Sequence[Recording], machine: Machine) -> list[Recording]:
    """Return recordings with their commands as speeds; see `view_speeds`."""
    if machine.interface != "position":
        return list(recordings)
    return [replace(one, u=view_speeds(one.u, machine)) for one in recordings]


class SpeedProgram:
    """Commands of one machine that carry out a program of speeds, step by step.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._target: np.ndarray | None = None

    def command(self, speeds: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the commands of the coming control period, and the speeds that they carry out.

        Args:
            speeds: Speeds that are asked for, of full speed, `(…, J)` in [-1, 1].
            q: Measured positions, `(…, J)`.
        """
        machine = self._machine
        if machine.interface != "position":
            return speeds, speeds
        before = q if self._target is None else self._target
        step = machine.max_speed * machine.period_s
        self._target = np.clip(before + speeds * step, machine.lower, machine.upper)
        return scale_targets(self._target, machine), (self._target - before) / step


def accept_speeds(
    model: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
) -> ActuatorModel:
    """Return a model that takes speeds, whatever the joints of the machine are commanded by.

    Raises:
        ConfigError: They are commanded by torque, which needs a controller of its own.
    """
    if machine.interface == "torque":
        raise ConfigError(
            f"machine '{machine.name}' is commanded by torque, and a policy commands speeds; simulate it with the controller of "
            "its joints, as a machine with command: velocity or position"
        )
    if machine.interface == "speed":
        return model
    return TargetIntegrator(model, machine, num_envs, device)


class TargetIntegrator:
    """A model of position commands, with its commands as speeds; `SpeedProgram` for all environments.

    Args:
        inner: The model, whose commands are targets: -1 and 1 are the ends of the travel.
        machine: The machine.
        num_envs: Number of environments, `N`.
        device: Where the tensors live.
    """

    def __init__(
        self, inner: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        import torch

        middle, half = _measure_travel(machine)
        rows = np.stack((middle, half, machine.max_speed * machine.period_s))
        self._middle, self._half, way = torch.as_tensor(rows, dtype=torch.float32, device=device)
        self._step = way / self._half
        shape = (num_envs, machine.num_history, machine.num_joints)
        self.inner = inner
        self._targets = torch.zeros(shape, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`targets` as commands, `(N, H, J)`, `fresh`, and the state of the model as `inner.…`."""
        inner = {f"inner.{name}": value for name, value in self.inner.state.items()}
        return {"targets": self._targets, "fresh": self._fresh} | inner

    def reset(self, mask: torch.Tensor) -> None:
        """Let the environments of `mask`, `(N,)` bool, begin where they are."""
        self._targets.masked_fill_(mask[:, None, None], 0.0)
        self._fresh.logical_or_(mask)
        self.inner.reset(mask)

    def step(self, history: History) -> torch.Tensor:
        """Return the joint positions one control period later, shape `(N, J)`."""
        at = ((history.q[:, -1] - self._middle) / self._half).clamp(-1.0, 1.0)
        targets = self._targets.where(~self._fresh[:, None, None], at[:, None])
        newest = (targets[:, -1] + history.u[:, -1] * self._step).clamp(-1.0, 1.0)
        self._targets.copy_(targets.roll(-1, 1))
        self._targets[:, -1] = newest
        self._fresh.fill_(False)
        return self.inner.step(History(q=history.q, u=self._targets))

    def __getattr__(self, name: str) -> object:
        """Return sensors and geometry of the model inside; see `contracts.actuator.SensingModel`."""
        if name in ("sides", "measure", "truth", "misplacement"):
            return getattr(self.inner, name)
        raise AttributeError(name)
