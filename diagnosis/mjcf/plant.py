"""An MJCF file as a plant: joint motion under commands, simulated by MuJoCo C.

Numbers of joints and drives (friction, damping, armature, gain, limit) can differ from row to row, so that
candidates are simulated side by side. Axes: `N` rows, `T` control periods, `J` joints, `S` numbers of a
state.
"""

from __future__ import annotations

import copy
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from diagnosis.plant import NO_CHANGES, ModelChanges, Plant

STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
MAX_STATES = 4_000_000
"""Numbers of states kept at once: 32 MB."""
REFERENCE_TRAVEL = 0.05
"""Error of position, over the travel, at which a position drive gives its reference torque. Chosen by
hand: a drive that holds an arm errs by a few percent."""
MAX_DAMPING_LOSS = 0.95
"""Largest share of the damping of joint and drive that an effect takes away: a rest keeps joints stable."""


class MjcfPlant(Plant):
    """Joints and drives of an MJCF file, named as those of a machine.

    Args:
        path: MJCF file.
        machine: The machine: its joint names are those of the file.

    Raises:
        ConfigError: The file cannot be compiled, a joint or its drive is missing, or the control period
            is no multiple of the time step.
    """

    def __init__(self, path: Path, machine: Machine) -> None:
        try:
            self.model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise ConfigError(f"simulator={path}: MuJoCo cannot compile it: {error}") from error
        self.machine = machine
        joints, drives = [], []
        for name in machine.joint_names:
            joints.append(_find_joint(self.model, path, name))
            drives.append(_find_drive(self.model, path, name, joints[-1]))
        self.drives = np.array(drives)
        self.dofs = self.model.jnt_dofadr[joints]
        self.substeps = round(machine.period_s / self.model.opt.timestep)
        apart_s = self.substeps * self.model.opt.timestep - machine.period_s
        if abs(apart_s) > 1e-6 * machine.period_s:
            raise ConfigError(
                f"simulator={path}: the control period {machine.period_s:g} s of machine '{machine.name}' is no multiple of the "
                f"time step {self.model.opt.timestep:g} s; change <option timestep> or the machine's period_s"
            )
        self._data = mujoco.MjData(self.model)
        # MuJoCo's order of a full state: time, qpos, qvel, act, …
        q_at, speed_at = 1 + self.model.jnt_qposadr[joints], 1 + self.model.nq + self.dofs
        beyond = mujoco.mj_stateSize(self.model, STATE) - 1 - self.model.nq - self.model.nv
        # such as activations or delayed commands
        super().__init__(q_at, speed_at, has_memory=beyond > 0)
        gear = self.model.actuator_gear[self.drives, 0]
        self._per_command = 1.0 / gear if machine.interface == "torque" else gear
        # Candidates of a search seldom come back later.
        self._remember = lru_cache(maxsize=512)(self._build)

    def start(self, q: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return states at positions and speeds `(N, J)`, `(N, S)`; other joints are where the file has them."""
        mujoco.mj_resetData(self.model, self._data)
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self._data, state, STATE)
        return self.place(np.repeat(state[None], len(q), 0), q, speed)

    def run(
        self, state: np.ndarray, commands: np.ndarray, changes: ModelChanges = NO_CHANGES
    ) -> np.ndarray:
        """Return the states after each control period; changes as in `change_model`, see `Plant.run`."""
        count, periods = commands.shape[:2]
        models = self._list_models(count, changes)
        found = np.empty((count, periods, state.shape[1]))
        if not count or not periods:
            return found
        at_once = max(1, MAX_STATES // (periods * self.substeps * state.shape[1]))
        for first in range(0, count, at_once):
            rows = slice(first, first + at_once)
            control = np.zeros((len(found[rows]), periods, self.model.nu))
            control[..., self.drives] = commands[rows] * self._per_command
            states, _ = rollout.rollout(
                models[rows], self._data, state[rows], np.repeat(control, self.substeps, 1)
            )
            found[rows] = np.asarray(states)[:, self.substeps - 1 :: self.substeps]
        return found

    def read_references(self) -> dict[str, np.ndarray]:
        """Return the unit of each number that a row may change, on each joint, `(J,)`.

        Friction is counted in the torque that a drive gives for an error of 5 % of the travel
        (position), at full speed (velocity), or at full command (torque), Nm or N. Damping is counted
        in that torque over the full speed, armature in the inertia of the joint, gain in itself. A limit
        is counted in the same force of the drive, as if its force had no range.
        """
        model, machine = self.model, self.machine
        gain = np.abs(model.actuator_gainprm[self.drives, 0] * model.actuator_gear[self.drives, 0])
        gain = np.where(gain > 0.0, gain, 1.0)
        full = {
            "position": gain * REFERENCE_TRAVEL * (machine.upper - machine.lower),
            "speed": gain * machine.max_speed,
            "torque": machine.max_force,
        }[machine.interface]
        is_torque = machine.interface == "torque"
        unlimited = full / np.abs(model.actuator_gear[self.drives, 0]) if is_torque else full
        limited = model.actuator_forcelimited[self.drives].astype(bool)
        limit = np.abs(model.actuator_forcerange[self.drives]).max(1)
        full = np.where(limited, np.minimum(full, limit), full)
        return {
            "friction": full,
            "damping": full / machine.max_speed,
            "armature": model.dof_M0[self.dofs],
            "gain": np.ones(machine.num_joints),
            "limit": unlimited,
        }

    def change_model(self, changes: ModelChanges) -> mujoco.MjModel:
        """Return the model with numbers of its joints changed, each `(J,)`.

        Args:
            changes: `friction`, `damping` and `armature` are added, in the units of `read_references`;
                `gain` multiplies the drive's. `limit` is the unit of a limit over the largest force of the
                drive, 0 for none; a lower limit of the file stays.
        """
        model, unit = copy.copy(self.model), self.read_references()
        dofs, drives = self.dofs, self.drives
        if "friction" in changes:
            model.dof_frictionloss[dofs] += changes["friction"] * unit["friction"]
        if "damping" in changes:
            damping = model.dof_damping.reshape(model.nv, -1)[:, 0]  # MuJoCo 4 has higher orders
            square = np.square(model.actuator_gear[drives, 0])
            held = damping[dofs] - model.actuator_biasprm[drives, 2] * square
            least = -MAX_DAMPING_LOSS * np.maximum(held, 0.0)
            total = damping[dofs] + np.maximum(changes["damping"] * unit["damping"], least)
            damping[dofs] = np.maximum(total, 0.0)
            # A joint has no damping below 0: the drive loses the rest of it.
            model.actuator_biasprm[drives, 2] -= np.minimum(total, 0.0) / square
        if "armature" in changes:
            model.dof_armature[dofs] += changes["armature"] * unit["armature"]
        if "gain" in changes:
            # Both terms of a position drive: the force is gain (target - position) - damping speed.
            model.actuator_gainprm[drives, 0] *= changes["gain"]
            model.actuator_biasprm[drives, 1] *= changes["gain"]
            if self.machine.interface == "speed":
                model.actuator_biasprm[drives, 2] *= changes["gain"]
        if "limit" in changes:
            for place in np.flatnonzero(changes["limit"] > 0.0):
                drive = drives[place]
                most = unit["limit"][place] / changes["limit"][place]
                limits = np.array([-most, most])
                if model.actuator_forcelimited[drive]:
                    limits = np.clip(limits, *model.actuator_forcerange[drive])
                model.actuator_forcerange[drive] = limits
                model.actuator_forcelimited[drive] = True
        mujoco.mj_setConst(model, mujoco.MjData(model))  # inertias that constraints are scaled by
        return model

    def _list_models(self, count: int, changes: ModelChanges) -> list[mujoco.MjModel]:
        if not changes:
            return [self.model] * count
        names = tuple(sorted(changes))
        rows = np.stack([changes[name] for name in names], 1).astype(np.float64)  # (N, Q, J)
        return [self._remember(names, row.tobytes()) for row in rows]

    def _build(self, names: tuple[str, ...], row: bytes) -> mujoco.MjModel:
        values = np.frombuffer(row).reshape(len(names), -1)
        return self.change_model(dict(zip(names, values, strict=True)))


def _find_joint(model: mujoco.MjModel, path: Path, name: str) -> int:
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if found < 0:
        known = [model.joint(number).name for number in range(model.njnt)]
        raise ConfigError(
            f"simulator={path}: it has no joint '{name}'; it has {', '.join(known)}. Name the joints of the machine file as "
            "those of the MJCF"
        )
    return found


def _find_drive(model: mujoco.MjModel, path: Path, name: str, joint: int) -> int:
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    found = np.flatnonzero(on_joint & (model.actuator_trnid[:, 0] == joint))
    if len(found) != 1:
        raise ConfigError(
            f"simulator={path}: expected one actuator on joint '{name}', found {len(found)}; "
            f'add <position joint="{name}" kp=…/>, <velocity …/> or <motor …/>'
        )
    return int(found[0])
