"""An arm of two position servos in MJCF, and recordings of it with a fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import torch
from composed import option

from brokk_rl.commands import read_targets
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, make_motion

ARM = """
<mujoco model="two_links">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body pos="0 0 0.3">
      <joint name="shoulder" axis="0 1 0" range="-1.6 1.6" damping="0.2" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1.0" contype="0"/>
      <body pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" range="-1.6 1.6" damping="0.1" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.025" mass="0.5" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="shoulder" kp="60" kv="4"/>
    <position joint="elbow" kp="30" kv="1.5"/>
  </actuator>
</mujoco>
"""
NOISE_RAD = 2e-4


def make_machine(*names: str) -> Machine:
    """Returns a machine of position servos at 50 Hz, known by its joints."""
    servos = option("machine", "so101")
    joint = servos.joints[0]
    ends = {"lower": replace(joint.lower, value=-1.5), "upper": replace(joint.upper, value=1.5)}
    joint = replace(joint, **ends, home=0.0, max_speed=replace(joint.max_speed, value=3.0))
    joints = tuple(replace(joint, name=name) for name in names)
    timing = {"period_s": 0.02, "dead_time_s": 0.0, "num_history": 26}
    return replace(servos, name="two_links", title="two links", joints=joints, **timing)


def draw_targets(generator: np.random.Generator, count: int, joints: int) -> np.ndarray:
    """Returns targets that step and ramp, `(T, J)`."""
    found = np.zeros((count, joints))
    for j in range(joints):
        at, k = 0.0, 0
        while k < count:
            goal, speed = generator.uniform(-0.9, 0.9), generator.choice([0.6, 1.5, 1e3])
            for _ in range(int(generator.integers(15, 80))):
                at += float(np.clip(goal - at, -speed * 0.02, speed * 0.02))
                if k < count:
                    found[k, j] = at
                k += 1
    return found


def record_arm(
    machine: Machine,
    change: Callable[[Any], None],
    delay: int,
    seed: int,
    seconds: float = 16.0,
    play_rad: float = 0.0,
) -> Recording:
    """Returns a recording of the arm with a fault, stepped by MuJoCo in a loop of its own.

    The delay is in control periods; the elbow holds its target within the play.
    """
    generator = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_string(ARM)
    change(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    count = round(seconds / machine.period_s)
    targets, q, held = draw_targets(generator, count, 2), np.zeros((count, 2)), 0.0
    for k in range(count):
        q[k] = data.qpos
        target = targets[max(0, k - delay)]
        held = min(max(held, target[1] - play_rad / 2), target[1] + play_rad / 2)
        data.ctrl[:] = target[0], held
        for _ in range(10):
            mujoco.mj_step(model, data)
    t_s = np.arange(count) * machine.period_s
    q += generator.normal(0.0, NOISE_RAD, q.shape)
    return make_motion(machine, f"run {seed}", t_s, (targets / 1.5).astype(np.float32), q)


def keep(spec: Any) -> None:
    """The arm as in the file."""


def rub(spec: Any) -> None:
    """Adds friction of 0.5 Nm at the elbow."""
    spec.joint("elbow").frictionloss = 0.5


def weaken(spec: Any) -> None:
    """Takes 40 % of the stiffness of the shoulder's drive."""
    drive = spec.actuators[0]
    gain, bias = drive.gainprm.copy(), drive.biasprm.copy()
    gain[0], bias[1] = 0.6 * gain[0], 0.6 * bias[1]
    drive.gainprm, drive.biasprm = gain, bias


def damp(spec: Any) -> None:
    """Takes a fifth of the damping of the shoulder's drive, 4 Nms/rad."""
    drive = spec.actuators[0]
    bias = drive.biasprm.copy()
    bias[2] = 0.8 * bias[2]
    drive.biasprm = bias


def limit_force(spec: Any) -> None:
    """Limits the drive of the shoulder to 5 Nm; the arm weighs 3.6 Nm stretched out."""
    drive = spec.actuators[0]
    drive.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    drive.forcerange = np.array([-5.0, 5.0])


def run_servo(model: Any, machine: Machine, u: np.ndarray) -> np.ndarray:
    """Returns positions after each command `(T, J)`, from rest at the first one."""
    start = torch.as_tensor(read_targets(u[0], machine), dtype=torch.float32)
    rows = torch.as_tensor(u, dtype=torch.float32)
    shape = (1, machine.num_history, 1)
    history = History(q=start.repeat(*shape), u=rows[0].repeat(*shape))
    found = []
    for command in rows:
        history.push_u(command[None])
        history.push_q(model.step(history))
        found.append(history.q[0, -1].numpy().copy())
    return np.array(found)
