"""Simulator specs of `conf/sim`: MuJoCo C on CPU threads, MuJoCo Warp on a GPU, or by device.

Worlds and torch are imported where they are needed: `mujoco_warp` alone takes seconds to import,
and a bad number is refused before.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from brokk_rl.errors import ConfigError, DeviceError
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from brokk_rl.sim.events import Event
from brokk_rl.spec import Count, Index, Positive, WorldCount, name_spec, spec

if TYPE_CHECKING:
    import torch

    from brokk_rl.contracts.world import Simulator, World
    from brokk_rl.sim.native_world import NativeWorld
    from brokk_rl.sim.parity import ParityResult
    from brokk_rl.sim.warp_world import WarpWorld


@spec
class NativeSimulator:
    """MuJoCo C on threads: many worlds on the cores of this computer.

    Attributes:
        num_worlds: Worlds, unless the caller of `build` asks for another number.
        substeps: Physics steps per control period.
        num_threads: Threads; 0 takes all cores.
    """

    num_worlds: WorldCount
    substeps: Count
    num_threads: Index

    def build(
        self,
        machine: Machine,
        device: torch.device | str,
        num_worlds: int | None = None,
        events: tuple[Event, ...] = (),
        site: Path | None = None,
    ) -> NativeWorld:
        """Return the worlds; see `brokk_rl.contracts.world.Simulator`.

        Raises:
            DeviceError: `device` is not the CPU.
        """
        from brokk_rl.sim.native_world import NativeWorld

        if not _is_cpu(device):
            raise DeviceError(
                f"sim=native runs on the CPU, but device '{device}' was asked for; "
                "choose sim=warp, or the CPU"
            )
        num = self.num_worlds if num_worlds is None else num_worlds
        return NativeWorld(machine, num, self.substeps, self.num_threads, events, site)


@spec
class WarpSimulator:
    """MuJoCo Warp: thousands of worlds on one GPU.

    Attributes:
        num_worlds: Worlds, unless the caller of `build` asks for another number.
        substeps: Physics steps per control period.
        num_contacts: Size of the contact buffer, per world on average. A world that loses a
            contact to a full buffer is a fault.
        num_constraints: Size of each world's buffer of rows for contacts and joint limits. A world
            that needs more rows is a fault.
        iterations: Bound on the solver's iterations in a substep.
        linesearch_iterations: Bound on the line search's iterations in each of them.
        tolerance: At which the solver stops.
        parity_worlds: Worlds in which each machine is compared with MuJoCo C before it is used
            (`brokk_rl.sim.parity`); 0 for no comparison.
    """

    num_worlds: WorldCount
    substeps: Count
    num_contacts: Count
    num_constraints: Count
    iterations: Count
    linesearch_iterations: Count
    tolerance: Positive
    parity_worlds: Index

    def build(
        self,
        machine: Machine,
        device: torch.device | str,
        num_worlds: int | None = None,
        events: tuple[Event, ...] = (),
        site: Path | None = None,
    ) -> WarpWorld:
        """Return the worlds; see `brokk_rl.contracts.world.Simulator`.

        On a CPU this is slow and meant for tests.

        Raises:
            DeviceError: A GPU was asked for and there is none.
            ConfigError: The machine's MJCF has parts that are not simulated, or the simulator
                differs from MuJoCo C on this machine.
        """
        import torch

        from brokk_rl.sim.warp_world import WarpWorld

        device = torch.device(device)
        if device.type == "cuda" and not torch.cuda.is_available():
            raise DeviceError(
                f"device '{device}' was asked for, but torch finds no CUDA GPU here; "
                "choose sim=native (or sim=auto) and the CPU"
            )
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
        if self.parity_worlds:
            _check_parity(self, machine, device, site)
        num = self.num_worlds if num_worlds is None else num_worlds
        return WarpWorld(machine, device, num, self, events, site)


@spec
class AutoSimulator:
    """MuJoCo Warp on a GPU, MuJoCo C on threads without one.

    Attributes:
        native: Used on a CPU; on two cores it steps 13 times faster than Warp on a CPU.
        warp: Used on a CUDA device.
    """

    native: NativeSimulator
    warp: WarpSimulator

    def build(
        self,
        machine: Machine,
        device: torch.device | str,
        num_worlds: int | None = None,
        events: tuple[Event, ...] = (),
        site: Path | None = None,
    ) -> World:
        """Return the worlds on `device`; see `brokk_rl.contracts.world.Simulator`."""
        chosen = self.native if _is_cpu(device) else self.warp
        return chosen.build(machine, device, num_worlds, events, site)


def find_site(scene: str | None, sim: Simulator) -> Path | None:
    """Return the MJCF file that a task names as its `scene`.

    Args:
        scene: A path, or `package:path`; `None` for nothing beside the block.
        sim: Simulator that is to build it.

    Raises:
        ConfigError: There is no such file, or the simulator takes none.
    """
    if scene is None:
        return None
    path = resolve_package_path(scene)
    if not path.is_file():
        raise ConfigError(f"task.scene: expected an MJCF file, got {scene}; there is none")
    if "site" not in inspect.signature(sim.build).parameters:
        raise ConfigError(
            f"task.scene: sim={name_spec(sim)} builds no scene; choose sim=native or sim=warp, or "
            "task.scene=null"
        )
    return path


def list_events(events: Mapping[str, Event], sim: Simulator) -> tuple[Event, ...]:
    """Return events for the worlds of a simulator.

    Raises:
        ConfigError: The simulator cannot vary the machine, or two events change the same property.
    """
    names = [event.property for event in events.values()]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"event: two of {', '.join(events)} change {name}; leave one out")
    if events and "events" not in inspect.signature(sim.build).parameters:
        raise ConfigError(
            f"event={','.join(events)}: sim={name_spec(sim)} cannot vary the machine; choose "
            "sim=native or sim=warp, or event=[]"
        )
    return tuple(events.values())


@functools.lru_cache(maxsize=8)
def _check_parity(
    simulator: WarpSimulator, machine: Machine, device: torch.device, site: Path | None
) -> ParityResult:
    """Compare a simulator with MuJoCo C on a machine, once in a process."""
    from brokk_rl.sim.parity import check_parity
    from brokk_rl.sim.warp_world import WarpWorld

    world = WarpWorld(machine, device, simulator.parity_worlds, simulator, site=site)
    return check_parity(world, machine, simulator.substeps, site)


def _is_cpu(device: torch.device | str) -> bool:
    return str(device).partition(":")[0] == "cpu"
