"""Policies command speeds; joints that are commanded by position take their integral as a target."""

import torch

from brokk_rl.contracts.actuator import ActuatorModel
from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine


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
    """A model of position commands, with its commands as speeds.

    A target begins where the joint is, moves on with the speed that is asked for, and stays within
    the travel; `brokk_rl.commands.SpeedProgram` does the same for one machine.

    Args:
        inner: The model, whose commands are targets: -1 and 1 are the ends of the travel.
        machine: The machine.
        num_envs: Number of environments, `N`.
        device: Where the tensors live.
    """

    def __init__(
        self, inner: ActuatorModel, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        def tensor(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        self.inner = inner
        self._middle = tensor((machine.upper + machine.lower) / 2)
        self._half = tensor((machine.upper - machine.lower) / 2)
        self._step = tensor(machine.max_speed * machine.period_s) / self._half
        shape = (num_envs, machine.num_history, machine.num_joints)
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
        fresh = self._fresh[:, None, None]
        targets = torch.where(fresh, at[:, None].expand_as(self._targets), self._targets)
        newest = (targets[:, -1] + history.u[:, -1] * self._step).clamp(-1.0, 1.0)
        self._targets.copy_(torch.cat((targets[:, 1:], newest[:, None]), 1))
        self._fresh.fill_(False)
        return self.inner.step(History(q=history.q, u=self._targets))

    def __getattr__(self, name: str) -> object:
        """Return sensors and geometry of the model inside; see `contracts.actuator.SensingModel`."""
        if name in ("sides", "measure", "truth", "misplacement"):
            return getattr(self.inner, name)
        raise AttributeError(name)
