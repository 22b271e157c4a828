# Kernels are written in Warp's own subset of Python, whose types a type checker does not know.
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportReturnType=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
"""Worlds on a GPU: kinematics, collisions and constraint rows of `mujoco_warp`, the rest our kernels.

`brokk_rl.sim.simulator.WarpSimulator` is the spec that builds them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp

from brokk_rl.machine import Machine
from brokk_rl.sim.events import Event
from brokk_rl.sim.model import check_simulated, compile_model
from brokk_rl.sim.properties import StoredWorld, list_fields
from brokk_rl.sim.warp_dynamics import ArmDynamics
from brokk_rl.sim.warp_solver import ContactSolver


def make_substep(
    compiled: mujoco.MjModel, model: mjw.Model, data: mjw.Data, peak: wp.array
) -> Callable[[], None]:
    """Return a substep for an arm of a few joints driven by servos, in 18 launches.

    `mujoco_warp` alone takes some 60, and ten an iteration of the solver. The GPU waits for
    launches, not for arithmetic.

    Args:
        compiled: The model as MuJoCo has it.
        model: The model.
        data: All worlds.
        peak: Raised to the contact force of each world, `(N,)`, N.
    """
    dynamics, solve = ArmDynamics(compiled, model, data), ContactSolver(model, data, peak)

    def step() -> None:
        mjw.kinematics(model, data)
        dynamics.before_contacts()
        mjw.collision(model, data)
        mjw.make_constraint(model, data)
        solve()
        dynamics.after_contacts()

    return step


# Too few iterations leave a slightly soft contact; what is lost to a full buffer is lost, and that
# is a fault.
_LOST = int(mjw.OverflowType.ALL & ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS))


BUFFERS = {
    mjw.OverflowType.NEFC: "the buffer of constraint rows is full (sim.num_constraints)",
    mjw.OverflowType.NJMAX_NNZ: "the buffer of the sparse constraint matrix is full",
    mjw.OverflowType.BROADPHASE: "the buffer of geom pairs is full (sim.num_contacts)",
    mjw.OverflowType.NARROWPHASE: "the contact buffer is full (sim.num_contacts)",
}
"""Buffers of `mujoco_warp` whose names need words."""


class WarpWorld(StoredWorld):
    """Fulfils `brokk_rl.contracts.world.World` on a GPU (or, for tests, on the CPU).

    All tensors are views of Warp's arrays. `step` and `reset` use torch's current stream and keep
    every address, so that the caller may capture them together with its own torch operations inside
    `torch.cuda.graph`.

    Args:
        machine: The machine.
        device: A CUDA device or the CPU.
        num_worlds: `N`.
        simulator: Their spec, a `brokk_rl.sim.simulator.WarpSimulator`, which imports this module.
        events: Changes of the machine from world to world.
        site: MJCF of what stands beside the block.
    """

    def __init__(
        self,
        machine: Machine,
        device: torch.device,
        num_worlds: int,
        simulator: Any,
        events: tuple[Event, ...] = (),
        site: Path | None = None,
    ) -> None:
        compiled = compile_model(machine, machine.period_s / simulator.substeps, site=site)
        check_simulated(compiled, machine.name, is_warp=True)
        alarm_names = {}
        for kind in mjw.OverflowType:
            if kind & _LOST and kind != mjw.OverflowType.ALL:
                alarm_names[int(kind)] = BUFFERS.get(kind, f"the buffer {kind.name} is full")
        super().__init__(machine, num_worlds, compiled, device, torch.float32, alarm_names)
        self.supports_graphs = device.type == "cuda"
        self.substeps = simulator.substeps
        wp.config.log_level = wp.LOG_WARNING
        wp.init()
        self._warp_device = wp.device_from_torch(device)
        with wp.ScopedDevice(self._warp_device):
            self._model = mjw.put_model(
                self.model,
                batch_sizes=dict.fromkeys(
                    ("geom_size", "geom_pos", *list_fields(events)), num_worlds
                ),
            )
            sizes = {"nconmax": simulator.num_contacts, "njmax": simulator.num_constraints}
            self._data = mjw.make_data(self.model, num_worlds, **sizes)
        self._write_options(simulator)
        data, model = self._data, self._model
        resting = ("qvel", "ctrl", "time", "qacc_warmstart", "overflow")
        views = {}
        for name in ("qpos", "act", "mocap_pos", "mocap_quat", *resting):
            views[name] = wp.to_torch(getattr(data, name))
        for name in ("geom_size", "geom_pos"):
            views[name] = wp.to_torch(getattr(model, name))
        peak = wp.from_torch(self.contact_force_n)
        self._substep = make_substep(self.model, model, data, peak)
        fields = {name: wp.to_torch(getattr(model, name)) for name in list_fields(events)}
        at_rest = {name: torch.zeros_like(views[name][0]) for name in resting}
        self._begin(views, at_rest, tuple(views), fields, events)

    def step(self, increment: torch.Tensor) -> None:
        """Advance one control period; see `brokk_rl.contracts.world.World`."""
        view = self._views
        self._drive.step(view["qpos"], increment, view["act"], view["ctrl"])
        self.contact_force_n.zero_()
        with self._on_torch_stream():
            for _ in range(self.substeps):
                self._substep()
        self.q.copy_(view["qpos"])
        speeds, alarms = self._drive.measure_speeds(view["qvel"]), view["overflow"] & _LOST
        self.faults.logical_or_(self._drive.diverged(speeds)).logical_or_(alarms != 0)
        self._note_faults(speeds, alarms)

    def _write_options(self, simulator: Any) -> None:
        option = self._model.opt
        option.iterations = simulator.iterations
        option.ls_iterations = simulator.linesearch_iterations
        option.tolerance.fill_(simulator.tolerance)
        # `check_simulated` has made sure that no joint has friction
        option.disableflags |= int(mjw.DisableBit.FRICTIONLOSS)
        # overflows are read on the device into `faults`, not printed
        option.warn_overflow = 0

    @contextlib.contextmanager
    def _on_torch_stream(self) -> Iterator[None]:
        """Make Warp use torch's current stream, and tell it when torch is capturing it."""
        if not self.supports_graphs:
            with wp.ScopedDevice(self._warp_device):
                yield
            return
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        capturing = torch.cuda.is_current_stream_capturing()
        # a captured stream must not wait for work outside the capture
        with wp.ScopedStream(stream, sync_enter=not capturing):
            if not capturing:
                yield
                return
            with wp.ScopedCapture(stream=stream, external=True):
                yield
