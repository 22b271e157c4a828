"""An actuator: joints that move in proportion to the command."""

import torch

from brokk_rl.spec import Positive, spec


@spec
class Rubber:
    """Move in proportion to the command, without delay.

    Attributes:
        stretch: Share of the full speed that a full command gives.
    """

    stretch: Positive

    def build(self, machine, num_envs, device):
        """Return the model for `num_envs` environments on `device`."""
        return RubberModel(self.stretch, machine, device)


class RubberModel:
    """A model without memory; see `brokk_rl.contracts.actuator.ActuatorModel`."""

    def __init__(self, stretch, machine, device):
        step = stretch * machine.max_speed * machine.period_s
        self._step = torch.as_tensor(step, dtype=torch.float32, device=device)
        self.state = {}

    def reset(self, mask):
        """Forget nothing: there is no memory."""

    def step(self, history):
        """Return the joint positions one control period later, (N, J)."""
        return history.q[:, -1] + self._step * history.u[:, -1]
