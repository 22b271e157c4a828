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

WARNINGS = {
    mujoco.mjtWarning.mjWARN_INERTIA: "inertia near zero",
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "the contact buffer is full",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "the buffer of constraint rows is full",
    mujoco.mjtWarning.mjWARN_BADQPOS: "bad position",
    mujoco.mjtWarning.mjWARN_BADQVEL: "bad speed",
    mujoco.mjtWarning.mjWARN_BADQACC: "bad acceleration",
    mujoco.mjtWarning.mjWARN_BADCTRL: "bad command of a drive",
}
"""MuJoCo's warnings, in words."""
ALARMS = {1 << int(kind): text for kind, text in WARNINGS.items()}
"""The same by the bits of an alarm."""


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
        self._state, self._warning = (
            torch.from_numpy(self._batch.state),
            torch.from_numpy(self._batch.warning),
        )
        bound = {}
        for name in ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat"):
            bound[name] = torch.from_numpy(self._batch.bind(name))
        self._qpos, self._qvel, self._act, self._ctrl, self._mocap_pos, self._mocap_quat = (
            bound.values()
        )
        self._geom_size, self._geom_pos = (
            torch.from_numpy(self._batch.expand(name)) for name in ("geom_size", "geom_pos")
        )
        self.joint_load = torch.from_numpy(self._batch.bind("qfrc_applied"))
        # zeros would switch the equalities of the MJCF off
        self._first_state = self._state[0].clone()
        # contacts are felt in every substep; recording them all catches a peak between two control
        # steps
        self._recorded = self._batch.rollout(substeps, record=("sensordata",))
        self._sensors = torch.from_numpy(self._recorded["sensordata"])
        self._is_normal = torch.from_numpy(mask_normal_forces(self.model))
        fields = {}
        for name in list_fields(events):
            fields[name] = torch.from_numpy(self._batch.expand(name))
        self._begin(fields, events)

    def step(self, increment: torch.Tensor) -> None:
        """Advance one control period; see `brokk_rl.contracts.world.World`."""
        self._drive.step(self._qpos, increment, self._act, self._ctrl)
        try:
            self._batch.rollout(self.substeps, record=("sensordata",), out=self._recorded)
        except SimulationError as error:  # those worlds keep the state they had, all others went on
            self.faults[torch.from_numpy(error.ids)] = True
        self.contact_force_n.copy_((self._sensors @ self._is_normal).amax(1))
        self.q.copy_(self._qpos)
        speeds = self._drive.measure_speeds(self._qvel)
        self.faults.logical_or_(self._drive.diverged(speeds)).logical_or_(
            self._warning.flatten(1).any(1)
        )
        if self.faults.any():
            bits = torch.tensor(list(ALARMS))
            self._note_faults(speeds, (self._warning[:, :, 1] > 0).long() @ bits)

    def reset(self, mask: torch.Tensor, q: torch.Tensor, scene: torch.Tensor) -> None:
        """Begin anew in the worlds of `mask`; see `brokk_rl.contracts.world.World`."""
        rows = mask.nonzero()[:, 0]
        if not len(rows):
            return
        if self._properties:
            self._properties.begin(mask)
        start, placed = q[rows], scene[rows]
        self._state[rows] = self._first_state
        self._qpos[rows] = self._act[rows] = start.double()
        self._drive.reset(mask, q)
        self._place(rows, placed)
        self._warning[rows] = 0
        self.q[rows], self.contact_force_n[rows], self.faults[rows] = start, 0.0, False

    def place(self, mask: torch.Tensor, scene: torch.Tensor) -> None:
        """Put blocks elsewhere; see `brokk_rl.contracts.world.World`."""
        rows = mask.nonzero()[:, 0]
        if len(rows):
            self._place(rows, scene[rows])

    def _place(self, rows: torch.Tensor, scene: torch.Tensor) -> None:
        """Write the scenes, `(R, S)`, of the worlds `rows`, `(R,)`."""
        position, turn = self._placement.pose(scene)
        self._mocap_pos[rows, 0], self._mocap_quat[rows, 0] = position, turn
        size, pos = self._placement.geoms(scene)
        index = (rows[:, None], self._placement.geom_ids)
        self._geom_size[index], self._geom_pos[index] = size, pos

    def _stored(self) -> dict[str, torch.Tensor]:
        return {
            "state": self._state,
            "warning": self._warning,
            "geom_size": self._geom_size,
            "geom_pos": self._geom_pos,
        }
