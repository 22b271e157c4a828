"""Worlds stepped by `mujoco_warp`; see `brokk_rl.sim.warp` for the spec."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco_warp as mjw
import torch
import warp as wp

from brokk_rl.machine import Machine
from brokk_rl.sim.drive import Drive
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.scene import Placement, nominal
from brokk_rl.sim.warp_substep import check, fused, staged

if TYPE_CHECKING:
    from brokk_rl.sim.warp import Warp


# Too few iterations leave a slightly soft contact; what is lost to a full buffer is lost, and that
# is a fault.
_LOST = int(mjw.OverflowType.ALL & ~(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS))


class WarpWorld:
    """Fulfils `brokk_rl.contracts.world.World` on a GPU (or, for tests, on the CPU).

    All tensors are views of Warp's arrays. `step` and `reset` use torch's current stream and keep
    every address, so that the caller may capture them together with its own torch operations inside
    `torch.cuda.graph`. Outside a capture the solver's loop (`fused: false`) asks the host after
    each iteration, which is slow.

    Args:
        spec: Sizes and solver settings.
        machine: The machine.
        num_worlds: `N`.
        device: A CUDA device or the CPU.
    """

    def __init__(self, spec: Warp, machine: Machine, num_worlds: int, device: torch.device) -> None:
        self.num_worlds, self.device = num_worlds, device
        self.supports_graphs = device.type == "cuda"
        self._substeps = spec.substeps
        self.model = compile_model(machine, machine.period_s / spec.substeps)
        check(self.model, machine, spec.fused)
        wp.config.log_level = wp.LOG_WARNING
        wp.init()
        self._warp_device = wp.device_from_torch(device)
        with wp.ScopedDevice(self._warp_device):
            self._model = mjw.put_model(
                self.model, batch_sizes={"geom_size": num_worlds, "geom_pos": num_worlds}
            )
            self._data = mjw.make_data(
                self.model, num_worlds, nconmax=spec.num_contacts, njmax=spec.num_constraints
            )
        self._write_options(spec)
        data, model = self._data, self._model
        names = (
            "qpos",
            "qvel",
            "act",
            "ctrl",
            "time",
            "qacc_warmstart",
            "mocap_pos",
            "mocap_quat",
            "overflow",
        )
        self._views = {name: wp.to_torch(getattr(data, name)) for name in names}
        self._views |= {
            name: wp.to_torch(getattr(model, name)) for name in ("geom_size", "geom_pos")
        }
        self._placement = Placement(self.model, device, torch.float32)
        self._drive = Drive(self.model, machine, num_worlds, device, torch.float32)
        self.q = torch.zeros(num_worlds, machine.num_joints, device=device)
        self.contact_force_n = torch.zeros(num_worlds, device=device)
        self.faults = torch.zeros(num_worlds, dtype=torch.bool, device=device)
        peak = wp.from_torch(self.contact_force_n)
        self._substep = (
            fused(self.model, model, data, peak) if spec.fused else staged(model, data, peak)
        )
        home = torch.tensor(machine.home, dtype=torch.float32, device=device).expand(num_worlds, -1)
        self.reset(torch.ones_like(self.faults), home, nominal(num_worlds, device))

    def step(self, increment: torch.Tensor) -> None:
        """Advances one control period; see `brokk_rl.contracts.world.World`."""
        view = self._views
        self._drive.step(view["qpos"], increment, view["act"], view["ctrl"])
        self.contact_force_n.zero_()
        with self._on_torch_stream():
            for _ in range(self._substeps):
                self._substep()
        self.q.copy_(view["qpos"])
        self.faults.logical_or_(self._drive.diverged(view["qvel"])).logical_or_(
            (view["overflow"] & _LOST) != 0
        )

    def reset(self, mask: torch.Tensor, q: torch.Tensor, scene: torch.Tensor) -> None:
        """Begins anew in the worlds of `mask`; see `brokk_rl.contracts.world.World`."""
        view = self._views
        position, turn = self._placement.pose(scene)
        size, pos = self._placement.geoms(scene)
        rows, zero = mask[:, None], q.new_zeros(())
        for name in ("qpos", "act"):
            torch.where(rows, q, view[name], out=view[name])
        for name in ("qvel", "ctrl", "qacc_warmstart"):
            torch.where(rows, zero, view[name], out=view[name])
        view["time"].masked_fill_(mask, 0.0)
        view["overflow"].masked_fill_(mask, 0)
        for name, value in (("mocap_pos", position), ("mocap_quat", turn)):
            torch.where(rows, value, view[name][:, 0], out=view[name][:, 0])
        for name, value in (("geom_size", size), ("geom_pos", pos)):
            ids = self._placement.geom_ids
            view[name].index_copy_(1, ids, torch.where(rows[..., None], value, view[name][:, ids]))
        self._drive.reset(mask, q)
        torch.where(rows, q, self.q, out=self.q)
        self.contact_force_n.masked_fill_(mask, 0.0)
        self.faults.masked_fill_(mask, False)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Returns copies of everything that must be stored to go on."""
        return {name: tensor.clone() for name, tensor in self._stored().items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Restores what `state_dict` returned."""
        for name, tensor in self._stored().items():
            tensor.copy_(state[name])

    def _stored(self) -> dict[str, torch.Tensor]:
        own = {"q": self.q, "contact_force_n": self.contact_force_n, "faults": self.faults}
        return self._views | {"reference": self._drive.reference} | own

    def _write_options(self, spec: Warp) -> None:
        option = self._model.opt
        option.iterations, option.ls_iterations = spec.iterations, spec.linesearch_iterations
        option.tolerance.fill_(spec.tolerance)
        option.disableflags |= int(mjw.DisableBit.FRICTIONLOSS)  # there is none, see `check`
        option.warn_overflow = 0  # read on the device into `faults`, not printed from it

    @contextlib.contextmanager
    def _on_torch_stream(self) -> Iterator[None]:
        """Makes Warp use torch's current stream, and know when torch is capturing it."""
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
