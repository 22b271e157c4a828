"""The actuator without any imperfection: what a simulator assumes that knows nothing of hydraulics."""

import torch

from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.spec import spec


@spec
class Ideal:
    """Moves at once at the machine's full speed times the command.

    Attributes:
        speed_scale: Speed at full command over the machine's `max_speed`.
    """

    speed_scale: float

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> "IdealModel":
        """Returns a model for `num_envs` environments on `device`."""
        return IdealModel(self, machine, device)


class IdealModel:
    """`q' = q + period * speed_scale * max_speed * u`, held at the ends of travel. Has no memory."""

    def __init__(self, config: Ideal, machine: Machine, device: torch.device) -> None:
        self._step_at_full = torch.as_tensor(
            machine.max_speed * machine.period_s * config.speed_scale,
            dtype=torch.float32,
            device=device,
        )
        self._lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        self._upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def reset(self, mask: torch.Tensor) -> None:
        """Does nothing."""

    def step(self, history: History) -> torch.Tensor:
        """Returns the joint positions one control period later, shape `(N, J)`."""
        return (history.q[:, -1] + history.u[:, -1] * self._step_at_full).clamp(
            self._lower, self._upper
        )
