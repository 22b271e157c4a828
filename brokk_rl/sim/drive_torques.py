"""Torques of the drives of an MJCF file once a physics step, and roll-outs of the file under such torques.

Joints keep their friction, damping and armature: these are numbers of the joint in every simulator.

Axes: `T` physics steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.sim.mjcf_plant import MjcfPlant

SHAKE = 0.1
"""Random torque while sampling, over the reference torque of the drive. Chosen by hand: a network sees
states beside those of its own path."""
SHAKE_STEPS = 20
"""Physics steps that a random torque lasts. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class DriveSamples:
    """Inputs and outputs of the drives, once a physics step.

    Attributes:
        error: Target less position, `(T, J)`, rad or m.
        speed: `(T, J)`, rad/s or m/s.
        torque: `(T, J)`, Nm or N.
        step_s: Physics time step.
        start: Number of the first step of each run.
    """

    error: np.ndarray
    speed: np.ndarray
    torque: np.ndarray
    step_s: float
    start: tuple[int, ...]


def sample_drives(
    path: Path, machine: Machine, targets: list[np.ndarray], seed: int
) -> DriveSamples:
    """Return inputs and torques of the drives under targets `(periods, J)` and a random torque.

    The torque is that of the inverse dynamics without drives: what an explicit torque has to be,
    although MuJoCo may integrate the damping of a drive implicitly.
    """
    plant, bare = MjcfPlant(path, machine), _load_bare(path, machine)
    generator = np.random.default_rng(seed)
    shake = SHAKE * plant.read_references()["friction"]
    model, inverse = plant.model, bare.model
    inverse.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    data, probe = mujoco.MjData(model), mujoco.MjData(inverse)
    at = model.jnt_qposadr[plant.joints]
    rows: dict[str, list[np.ndarray]] = {"error": [], "speed": [], "torque": []}
    start = []
    for run in targets:
        start.append(len(rows["error"]))
        mujoco.mj_resetData(model, data)
        data.qpos[at] = run[0]
        for k in range(len(run) * plant.substeps):
            target = run[k // plant.substeps]
            if k % SHAKE_STEPS == 0:
                data.qfrc_applied[plant.dofs] = shake * generator.uniform(-1.0, 1.0, len(target))
            data.ctrl[plant.drives] = target * model.actuator_gear[plant.drives, 0]
            probe.qpos[:], probe.qvel[:] = data.qpos, data.qvel
            rows["error"].append(target - data.qpos[at])
            rows["speed"].append(data.qvel[plant.dofs].copy())
            mujoco.mj_step(model, data)
            probe.qacc[:] = (data.qvel - probe.qvel) / model.opt.timestep
            mujoco.mj_inverse(inverse, probe)
            applied = data.qfrc_applied[plant.dofs]
            rows["torque"].append(probe.qfrc_inverse[plant.dofs] - applied)
    values = {name: np.array(value) for name, value in rows.items()}
    return DriveSamples(**values, step_s=float(model.opt.timestep), start=tuple(start))


def roll_out_torques(
    path: Path,
    machine: Machine,
    targets: np.ndarray,
    begin: np.ndarray,
    drive: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return the positions at each control period, `(periods, J)`, of a file under torques.

    Args:
        path: MJCF file; its drives are taken out.
        machine: The machine.
        targets: `(periods, J)`.
        begin: First positions, `(J,)`.
        drive: Returns torques `(J,)` from errors and speeds `(J,)`, once a physics step.
    """
    bare = _load_bare(path, machine)
    model, data = bare.model, mujoco.MjData(bare.model)
    at = model.jnt_qposadr[bare.joints]
    data.qpos[at] = begin
    found = np.empty_like(targets)
    for k in range(len(targets)):
        found[k] = data.qpos[at]
        for _ in range(bare.substeps):
            data.qfrc_applied[bare.dofs] = drive(targets[k] - data.qpos[at], data.qvel[bare.dofs])
            mujoco.mj_step(model, data)
    return found


def roll_out_targets(
    path: Path, machine: Machine, targets: np.ndarray, begin: np.ndarray
) -> np.ndarray:
    """Return the positions at each control period, `(periods, J)`, of a file under targets."""
    plant = MjcfPlant(path, machine)
    state = plant.start(begin[None], np.zeros((1, machine.num_joints)))
    q = plant.read(plant.run(state, targets[None]))[0][0]
    return np.concatenate([begin[None], q[:-1]])


def _load_bare(path: Path, machine: Machine) -> MjcfPlant:
    """Return the file with drives that do nothing."""
    bare = MjcfPlant(path, machine)
    bare.model.actuator_gainprm[bare.drives] = 0.0
    bare.model.actuator_biasprm[bare.drives] = 0.0
    return bare
