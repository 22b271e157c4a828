"""An actuator with effects around it, sensors included: a machine that is not as its model has it."""

import torch

from brokk_rl.contracts.actuator import Actuator, ActuatorModel, Effect
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Affected:
    """Any actuator with effects around it, as recordings show it: positions are what the sensors say.

    For free runs and for collecting recordings. Not for a simulator, which keeps the true positions
    itself and takes the effects from `effect`.

    Attributes:
        actuator: The actuator.
        effects: Effects by name, the first nearest to the machine.
    """

    actuator: Actuator
    effects: dict[str, Effect]

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "AffectedModel":
        """Returns a model for `num_envs` environments on `device`."""
        return AffectedModel(
            self.actuator.build(machine, num_envs, device), self.effects, machine, num_envs, device
        )


class AffectedModel:
    """From measured positions to the next measured ones.

    In a simulator the world keeps the true positions; here nobody else does, so they are kept in
    the state, beginning at what the measured history lets one believe.

    Attributes:
        effects: The wrapped model of each effect by name; set their `parameters` to simulate
            candidates side by side.
    """

    def __init__(
        self,
        model: ActuatorModel,
        effects: dict[str, Effect],
        machine: Machine,
        num_envs: int,
        device: torch.device,
    ) -> None:
        self.effects: dict[str, ActuatorModel] = {}
        for name, effect in effects.items():
            model = self.effects[name] = effect.wrap(model, machine, num_envs, device)
        self._model = model
        self._truth, self._measure = (
            getattr(model, name, _keep_unchanged) for name in ("truth", "measure")
        )
        self._q = torch.zeros(num_envs, machine.num_history, machine.num_joints, device=device)
        self._fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """`q`, the true history `(N, H, J)`, and the model's as `inner.…`."""
        return {"q": self._q, "fresh": self._fresh} | {
            f"inner.{name}": value for name, value in self._model.state.items()
        }

    def reset(self, mask: torch.Tensor) -> None:
        """Forgets the true positions in the environments of `mask`, shape `(N,)` bool; cuts all gradients."""
        if self._q.requires_grad:
            self._q.detach_()
        self._fresh.logical_or_(mask)
        self._model.reset(mask)

    def step(self, history: History) -> torch.Tensor:
        """Returns the measured positions one control period later, shape `(N, J)`."""
        true = torch.where(self._fresh.clone()[:, None, None], self._truth(history.q), self._q)
        q = self._model.step(History(q=true, u=history.u))
        self._q.copy_(torch.cat((true[:, 1:], q[:, None]), 1))
        self._fresh.fill_(False)
        return self._measure(q)


def _keep_unchanged(q: torch.Tensor) -> torch.Tensor:
    return q
