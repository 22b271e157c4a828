"""Parity of a simulator with MuJoCo C, measured on the machine at hand.

Half of the worlds begin at random positions in the air, the other half with the tool at a block.
Both simulators get the same random motion. MuJoCo C is the reference: it is written apart from
MuJoCo Warp and from our kernels, and computes in double precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import Kinematics
from brokk_rl.sim.native_world import NativeWorld
from brokk_rl.sim.scene import COLUMNS, HOLE_RADIUS_BOUNDS_M, SCALE_BOUNDS, make_nominal_scenes

if TYPE_CHECKING:
    from brokk_rl.contracts.world import World
    from brokk_rl.machine import Machine

NUM_PERIODS = 4
"""Control periods that are compared. The first gives the worlds their speeds; over more, contact
amplifies rounding."""
POSITION_TOLERANCE = 5e-3
"""Of the way that a joint goes at full speed in the periods compared. The shipped machine stays
below 4e-4 in all 64 worlds; with `impratio="20"` single precision costs 3.5e-3
(`tests/unit/test_sim_parity.py`)."""
FORCE_TOLERANCE = 0.02
"""Of the force of MuJoCo C, and of the median force of all worlds that touch something."""
EXCEPTIONS = 2
"""Worlds of 64 that may differ: at an edge both simulators may choose another pair of faces."""
FAR_M = 30.0
"""Distance of a block that nothing reaches."""
NEAR_M, DEPTH_M = 0.06, 0.02
"""Spread of the block's place around the tool, and its height above it at most. Chosen by hand: about
half of these worlds touch the block at once."""
MAX_LEAN_RAD = 0.3
"""Tilt of the holes, more than any task has."""


@dataclass(frozen=True)
class ParityResult:
    """Differences between a simulator and MuJoCo C after the same motion from the same states.

    Attributes:
        num_worlds: Worlds compared.
        num_touching: Those in which MuJoCo C found a contact.
        position_error: Greatest difference of a joint's position in each world, `(N,)`, as a part
            of the way at full speed.
        force_error: Greatest difference of the contact force in each world, `(N,)`, as a part of
            the force.
        fault_worlds: Worlds that are a fault in one of the two alone.
    """

    num_worlds: int
    num_touching: int
    position_error: np.ndarray
    force_error: np.ndarray
    fault_worlds: tuple[int, ...]

    @property
    def num_different(self) -> int:
        """Number of worlds beyond one of the tolerances."""
        beyond = (self.position_error > POSITION_TOLERANCE) | (self.force_error > FORCE_TOLERANCE)
        beyond[list(self.fault_worlds)] = True
        return int(beyond.sum())

    @property
    def is_alike(self) -> bool:
        """True where the simulator may be used for this machine."""
        return self.num_different <= EXCEPTIONS * self.num_worlds / 64

    def describe(self) -> str:
        """Return one sentence with the figures."""
        return (
            f"{self.num_worlds} random states against MuJoCo C: positions within "
            f"{self.position_error.max():.1e} of the way at full speed, forces within "
            f"{100.0 * self.force_error.max():.2g} % ({self.num_touching} touching), "
            f"{self.num_different} beyond the tolerance"
        )


def measure_parity(
    world: World, machine: Machine, substeps: int, seed: int = 0, site: Path | None = None
) -> ParityResult:
    """Return how far a simulator is from MuJoCo C; its worlds are reset and stepped.

    Args:
        world: Worlds of the simulator.
        machine: Their machine.
        substeps: Physics steps per control period of these worlds.
        seed: For the random states and motion.
        site: MJCF of what stands beside the block in these worlds.
    """
    reference = NativeWorld(machine, world.num_worlds, substeps, num_threads=0, site=site)
    generator = torch.Generator().manual_seed(seed)
    q, scene = _draw_states(machine, world.num_worlds, generator)
    everywhere = torch.ones(world.num_worlds, dtype=torch.bool)
    reference.reset(everywhere, q, scene)
    world.reset(everywhere.to(world.device), q.to(world.device), scene.to(world.device))
    stride = torch.tensor(machine.max_speed, dtype=torch.float32) * machine.period_s
    position, force = torch.zeros(2, world.num_worlds)
    touched = torch.zeros(world.num_worlds, dtype=torch.bool)
    for _ in range(NUM_PERIODS):
        increment = stride * (2.0 * torch.rand(q.shape, generator=generator) - 1.0)
        reference.step(increment)
        world.step(increment.to(world.device))
        apart = (world.q.cpu() - reference.q).abs() / (NUM_PERIODS * stride)
        expected, found = reference.contact_force_n, world.contact_force_n.cpu()
        is_pressed = (expected > 0.0) | (found > 0.0)
        scale = expected.clone()
        if is_pressed.any():
            scale += torch.maximum(expected, found)[is_pressed].median()
        position = torch.maximum(position, apart.amax(1))
        force = torch.maximum(force, (found - expected).abs() / scale.clamp(min=1e-9))
        touched |= expected > 0.0
    sound = ~reference.faults
    other = (world.faults.cpu() != reference.faults).nonzero()[:, 0].tolist()
    return ParityResult(
        num_worlds=world.num_worlds,
        num_touching=int((touched & sound).sum()),
        position_error=torch.where(sound, position, 0.0).nan_to_num(nan=torch.inf).numpy(),
        force_error=torch.where(sound, force, 0.0).nan_to_num(nan=torch.inf).numpy(),
        fault_worlds=tuple(other),
    )


def check_parity(
    world: World, machine: Machine, substeps: int, site: Path | None = None
) -> ParityResult:
    """Return how far a simulator is from MuJoCo C; its worlds are reset and stepped.

    Raises:
        ConfigError: It is too far.
    """
    result = measure_parity(world, machine, substeps, site=site)
    if not result.is_alike:
        raise ConfigError(
            f"machine {machine.name}: sim=warp does not simulate it as MuJoCo C does: "
            f"{result.describe()}; choose sim=native"
        )
    return result


def _draw_states(
    machine: Machine, num_worlds: int, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return joint positions, `(N, J)`, and scenes, `(N, S)`; the second half has the block at the tool."""
    lower, upper = (
        torch.tensor(np.array(x), dtype=torch.float32) for x in (machine.lower, machine.upper)
    )

    def draw(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    q = lower + (upper - lower) * torch.rand(num_worlds, len(lower), generator=generator)
    scene, half = make_nominal_scenes(num_worlds), num_worlds // 2
    tip = Kinematics(machine).pose(q).tip_in_base_m[half:]
    column = {name: scene[half:, i] for i, name in enumerate(COLUMNS)}
    column["hole_x_m"][:] = tip[:, 0] + draw(-NEAR_M, NEAR_M, num_worlds - half)
    column["hole_y_m"][:] = tip[:, 1] + draw(-NEAR_M, NEAR_M, num_worlds - half)
    column["rim_z_m"][:] = tip[:, 2] + draw(-DEPTH_M, DEPTH_M, num_worlds - half)
    column["yaw_rad"][:] = draw(-np.pi, np.pi, num_worlds - half)
    column["block_scale"][:] = draw(*SCALE_BOUNDS, num_worlds - half)
    column["hole_radius_m"][:] = draw(*HOLE_RADIUS_BOUNDS_M, num_worlds - half)
    # every other block leans, and one that leans stands on no ground
    column["lean_rad"][::2] = draw(-MAX_LEAN_RAD, MAX_LEAN_RAD, len(column["lean_rad"][::2]))
    scene[:half, COLUMNS.index("hole_x_m")] = FAR_M
    return q, scene
