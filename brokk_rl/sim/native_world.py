"""Worlds stepped by MuJoCo C on CPU threads (`mujoco.batch.Batch`)."""

from __future__ import annotations

from pathlib import Path

import mujoco
import torch
from mujoco.batch import Batch, SimulationError

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim.events import Event
from brokk_rl.sim.model import check_simulated, compile_model, mask_normal_forces
from brokk_rl.sim.properties import StoredWorld, list_fields

ALARMS: dict[int, str] = {}
"""MuJoCo's warnings in its words, by the bits of an alarm."""
for _warning in range(int(mujoco.mjtWarning.mjNWARNING)):
    # the place that follows is that of the last warning, which is not kept
    ALARMS[1 << _warning] = mujoco.mju_warningText(_warning, 0).partition(" at ")[0]


class NativeWorld(StoredWorld):
    """World on a thread pool; fulfils `brokk_rl.contracts.world.World`.

    Results are the same at any number of threads.

    Args:
        machine: The machine.
        num_worlds: `N`.
        substeps: Physics steps per control period.
        num_threads: Threads; 0 takes all cores.
        events: Changes of the machine from world to world.
        site: MJCF of what stands beside the block.
    """

    supports_graphs = False

    def __init__(
        self,
        machine: Machine,
        num_worlds: int,
        substeps: int,
        num_threads: int,
        events: tuple[Event, ...] = (),
        site: Path | None = None,
    ) -> None:
        model = compile_model(machine, machine.period_s / substeps, site=site)
        check_simulated(model, machine.name, is_warp=False)
        try:
            self._batch = Batch(model, num_worlds, num_threads)
        except ValueError as error:
            if "bad_alloc" not in str(error):
                raise
            raise ConfigError(
                f"{num_worlds} worlds do not fit into the memory of this computer; take fewer: "
                "rl.num_envs, evaluation.episodes, play.worlds or sim.num_worlds"
            ) from error
        super().__init__(machine, num_worlds, model, torch.device("cpu"), torch.float64, ALARMS)
        self.substeps = substeps
        views = {"state": self._batch.state, "warning": self._batch.warning}
        for name in ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat"):
            views[name] = self._batch.bind(name)
        for name in ("geom_size", "geom_pos"):
            views[name] = self._batch.expand(name)
        tensors = {name: torch.from_numpy(view) for name, view in views.items()}
        # zeros would switch the equalities of the MJCF off
        at_rest = {name: tensors[name][0].clone() for name in ("state", "warning")}
        self.joint_load = torch.from_numpy(self._batch.bind("qfrc_applied"))
        # contacts are felt in every substep; recording them all catches a peak between two control
        # steps
        self._recorded = self._batch.rollout(substeps, record=("sensordata",))
        self._sensors = torch.from_numpy(self._recorded["sensordata"])
        self._is_normal = torch.from_numpy(mask_normal_forces(self.model))
        fields = {}
        for name in list_fields(events):
            fields[name] = torch.from_numpy(self._batch.expand(name))
        stored = ("state", "warning", "geom_size", "geom_pos")
        self._begin(tensors, at_rest, stored, fields, events)

    def step(self, increment: torch.Tensor) -> None:
        """Advance one control period; see `brokk_rl.contracts.world.World`."""
        view = self._views
        self._drive.step(view["qpos"], increment, view["act"], view["ctrl"])
        try:
            self._batch.rollout(self.substeps, record=("sensordata",), out=self._recorded)
        except SimulationError as error:  # those worlds keep the state they had, all others went on
            self.faults[torch.from_numpy(error.ids)] = True
        self.contact_force_n.copy_((self._sensors @ self._is_normal).amax(1))
        self.q.copy_(view["qpos"])
        speeds = self._drive.measure_speeds(view["qvel"])
        self.faults.logical_or_(self._drive.diverged(speeds)).logical_or_(
            view["warning"].flatten(1).any(1)
        )
        if self.faults.any():
            bits = torch.tensor(list(ALARMS))
            self._note_faults(speeds, (view["warning"][:, :, 1] > 0).long() @ bits)
