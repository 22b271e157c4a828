"""The world on a GPU: `mujoco_warp`, a whole control step in one CUDA graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from brokk_rl.errors import ConfigError, DeviceError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

if TYPE_CHECKING:
    from brokk_rl.sim.warp_world import WarpWorld


@spec
class Warp:
    """MuJoCo Warp: thousands of worlds on one GPU.

    Attributes:
        num_worlds: Worlds, unless the caller of `build` asks for another number.
        substeps: Physics steps per control period.
        num_contacts: Contacts for which there is room, in each world on average; more are a fault
            of the worlds that lose them.
        num_constraints: Rows for contacts and joint limits for which there is room in each world;
            more are a fault.
        iterations: Bound on the solver's iterations in a substep.
        linesearch_iterations: Bound on the line search's iterations in each of them.
        tolerance: At which the solver stops.
        fused: Dynamics, contacts' solver and integration by launches of our own (`warp_dynamics`,
            `warp_solver`): 18 a substep instead of 60 and ten an iteration. The same physics; held
            against MuJoCo C on a CPU, not yet run on a GPU.
    """

    num_worlds: int
    substeps: int
    num_contacts: int
    num_constraints: int
    iterations: int
    linesearch_iterations: int
    tolerance: float
    fused: bool

    def check(self) -> None:
        counts = (
            self.num_worlds,
            self.substeps,
            self.num_contacts,
            self.num_constraints,
            self.iterations,
            self.linesearch_iterations,
        )
        if min(counts) < 1 or self.tolerance <= 0.0:
            raise ConfigError(
                f"sim: expected counts of 1 or more and a positive tolerance, got {counts} and {self.tolerance}"
            )

    def build(
        self, machine: Machine, device: torch.device | str, num_worlds: int | None = None
    ) -> WarpWorld:
        """Returns the worlds; `num_worlds` overrides the number in the config. On a CPU this is slow and meant for tests.

        Raises:
            DeviceError: A GPU was asked for and there is none.
        """
        device = torch.device(device)
        if device.type == "cuda" and not torch.cuda.is_available():
            raise DeviceError(
                f"device '{device}' was asked for, but torch finds no CUDA GPU here; choose sim=native (or sim=auto) and the CPU"
            )
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
        from brokk_rl.sim.warp_world import (
            WarpWorld,
        )  # takes seconds to import, so only where it is needed

        return WarpWorld(self, machine, num_worlds or self.num_worlds, device)
