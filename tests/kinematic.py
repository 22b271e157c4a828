"""A world without physics for tests of tasks and control loops: joints go where the actuator model says and touch nothing."""

from __future__ import annotations

import torch

from brokk_rl.machine import Machine


class Kinematic:
    """A simulator spec that builds `KinematicWorld`."""

    def __init__(self, num_worlds: int = 8) -> None:
        self.num_worlds = num_worlds

    def build(
        self, machine: Machine, device: torch.device, num_worlds: int | None = None
    ) -> KinematicWorld:
        return KinematicWorld(machine, num_worlds or self.num_worlds, device)


class KinematicWorld:
    """Fulfils `brokk_rl.contracts.world.World`; forces and faults are whatever a test writes into them."""

    supports_graphs = False

    def __init__(
        self, machine: Machine, num_worlds: int, device: torch.device | str = "cpu"
    ) -> None:
        self.num_worlds, self.device = num_worlds, torch.device(device)
        self.q = torch.zeros(num_worlds, machine.num_joints)
        self.contact_force_n = torch.zeros(num_worlds)
        self.faults = torch.zeros(num_worlds, dtype=torch.bool)

    def step(self, increment: torch.Tensor) -> None:
        self.q += increment

    def reset(self, mask: torch.Tensor, q: torch.Tensor, scene: torch.Tensor) -> None:
        self.q.copy_(torch.where(mask[:, None], q, self.q))
        self.contact_force_n.masked_fill_(mask, 0.0)
        self.faults.masked_fill_(mask, False)

    def place(self, mask: torch.Tensor, scene: torch.Tensor) -> None:
        self.placed = (mask.clone(), scene.clone())

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {
            "q": self.q.clone(),
            "contact_force_n": self.contact_force_n.clone(),
            "faults": self.faults.clone(),
        }

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        for name, value in state.items():
            getattr(self, name).copy_(value)
