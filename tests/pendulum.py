"""A pendulum behind a motor with BAM's friction in MuJoCo C, tracked by a controller: logs of joints commanded by torque."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import torch
from composed import option
from motion import roll

from brokk_rl import record
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

STEP_S = 0.001
INERTIA, WEIGHT_NM, MAX_NM = 0.05, 1.5, 8.0
XML = """
<mujoco><option timestep="{step}" integrator="implicitfast"/><worldbody><body>
<joint name="arm" type="hinge" axis="0 -1 0" damping="{damping}" frictionloss="0.01" armature="{armature}"/>
<inertial pos="{length} 0 0" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
<actuator>{drive}</actuator></mujoco>
"""
"""Positive is up; the mass of 1 kg bears `WEIGHT_NM` where the arm is level."""

Friction = Callable[[float, float, float], float]
"""Largest dry friction at the motor's torque, the torque from outside, and the speed."""


def make_pendulum(max_nm: float = MAX_NM) -> Machine:
    """Returns a machine of one hinge that is commanded by torque, at 200 Hz."""
    drive = option("machine", "emps")
    joint = drive.joints[0]
    joint = replace(
        joint,
        name="arm",
        kind="hinge",
        lower=replace(joint.lower, value=-1.5),
        upper=replace(joint.upper, value=1.5),
        home=0.0,
        max_speed=replace(joint.max_speed, value=6.0),
        max_force=replace(joint.max_force, value=max_nm),
    )
    return replace(drive, joints=(joint,))


def build_model(damping: float, drive: str = '<motor joint="arm"/>') -> mujoco.MjModel:
    """Returns the pendulum with viscous friction and an actuator of its own."""
    length = WEIGHT_NM / 9.81
    armature = INERTIA - length**2
    text = XML.format(step=STEP_S, damping=damping, armature=armature, length=length, drive=drive)
    return mujoco.MjModel.from_xml_string(text)


def compute_bam_friction(numbers: Mapping[str, float]) -> Friction:
    """Returns the budget of Duclusaud et al. (2025), by the names of its parameter files."""
    n = numbers

    def budget(motor: float, external: float, speed: float) -> float:
        rest = np.exp(-(abs(speed / n["dtheta_stribeck"]) ** n["alpha"]))
        gear = abs(external * n["load_friction_external"] - motor * n["load_friction_motor"])
        return n["friction_base"] + gear + rest * n["friction_stribeck"]

    return budget


def log_pendulum(
    machine: Machine,
    friction: Friction,
    damping: float,
    seed: int,
    seconds: float,
    drive: str = '<motor joint="arm"/>',
) -> Recording:
    """Returns a log of a controller of its own on the pendulum; the torque is held over each period.

    `drive`: actuator of the file, whose control is the torque that the controller asks for.
    """
    model, rng = build_model(damping, drive), np.random.default_rng(seed)
    data, steps = mujoco.MjData(model), round(seconds / machine.period_s)
    rate, phase = rng.uniform(0.7, 7.0, 4), rng.uniform(0.0, 6.0, 4)
    amplitude = rng.uniform(0.5, 1.2) * np.array([0.55, 0.35, 0.2, 0.1])
    rate.sort()
    found, commands = np.empty(steps), np.empty(steps)
    data.qpos[0] = float(amplitude @ np.sin(phase))
    for k in range(steps):
        angle = rate * k * machine.period_s + phase
        target, speed = float(amplitude @ np.sin(angle)), float((amplitude * rate) @ np.cos(angle))
        q, v = float(data.qpos[0]), float(data.qvel[0])
        found[k] = q
        torque = float(np.clip(40.0 * (target - q) + 2.0 * (speed - v), -MAX_NM, MAX_NM))
        commands[k] = torque / machine.max_force[0]
        data.ctrl[0] = torque
        for _ in range(round(machine.period_s / STEP_S)):
            external = -WEIGHT_NM * float(np.cos(data.qpos[0]))
            model.dof_frictionloss[0] = friction(torque, external, float(data.qvel[0]))
            mujoco.mj_step(model, data)
    noise = 1e-5 * rng.standard_normal(steps)
    t_s = machine.period_s * np.arange(steps)
    return record.make_motion(machine, f"{seed}", t_s, commands[:, None], (found + noise)[:, None])


def run_drive(model: Any, machine: Machine, u: np.ndarray, start: float) -> np.ndarray:
    """Returns positions after each command `(T,)`, from rest."""
    commands = torch.as_tensor(u, dtype=torch.float32)[:, None, None]
    return roll(model, machine, commands, [start])[1:, 0, 0].numpy().astype(float)
