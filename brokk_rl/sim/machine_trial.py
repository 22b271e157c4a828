"""A simulated second of a machine, so that a machine that passes its check can be trained."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import torch

from brokk_rl.contracts.actuator import ActuatorModel
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.sim.model import FASTEST_MODE, find_fastest_mode
from brokk_rl.sim.scene import make_empty_scenes

TRIAL_S = 1.0
"""Simulated time, s: commands of full size reach the ends of travel in it."""
MOST_FAULTS = 5e-4
"""Share of control steps that may end in a fault: half of what a training endures
(`rl.max_fault_rate`)."""


def try_machine(
    machine: Machine,
    world: Any,
    actuator: ActuatorModel | None,
    drawn: dict[str, torch.Tensor] | None,
) -> tuple[str | None, bool]:
    """Simulate a second; return what diverged and what to change, and whether a training endures it.

    Nothing diverged where the text is `None`.

    The worlds get new random commands in each period, as a policy at the start of a training gives
    them; where nothing can be touched, half of them get full commands that stay.

    Args:
        machine: The machine.
        world: Its world, as `sim=native` builds it.
        actuator: How speeds become motion; `None`: the joints move as they are asked to.
        drawn: Starts of the task; `None`: random poses with nothing to touch.
    """
    generator = torch.Generator().manual_seed(0)
    num_worlds = world.num_worlds
    everywhere = torch.ones(num_worlds, dtype=torch.bool)
    if drawn is None:
        lower, upper = (torch.tensor(end) for end in (machine.lower, machine.upper))
        share = torch.rand(num_worlds, machine.num_joints, generator=generator)
        q, scene = (lower + (upper - lower) * share).float(), make_empty_scenes(num_worlds)
    else:
        q, scene = drawn["q"], drawn["scene"]
    history = History(
        q=torch.zeros(num_worlds, machine.num_history, machine.num_joints),
        u=torch.zeros(num_worlds, machine.num_history, machine.num_joints),
    )
    world.reset(everywhere, q, scene)
    history.reset(everywhere, q)
    if actuator is not None:
        actuator.reset(everywhere)
    cause = ""
    stride = torch.tensor(machine.max_speed * machine.period_s, dtype=torch.float32)
    is_touching = torch.zeros(num_worlds, dtype=torch.bool)
    held = torch.randn(q.shape, generator=generator).sign()
    with torch.inference_mode():
        for step in range(math.ceil(TRIAL_S / machine.period_s)):
            u = torch.rand(q.shape, generator=generator) * 2.0 - 1.0
            if drawn is None:  # a task would end such episodes before they hit the ground
                u[::2] = held[::2]
            history.push_u(u)
            increment = u * stride
            if actuator is not None:
                increment = actuator.step(history) - history.q[:, -1]
            world.step(increment)
            if step == 0:
                is_touching = world.contact_force_n > 0.0
            if not cause and world.faults.any():
                cause = world.explain_faults()
            history.push_q(world.q)
    if not cause:
        return None, True
    num_faults, is_inside = int(world.faults.sum()), is_touching[world.faults]
    is_endured = num_faults <= MOST_FAULTS * num_worlds * math.ceil(TRIAL_S / machine.period_s)
    said = f"{num_faults} of {num_worlds} worlds diverged in a simulated second: {cause}. "
    if is_inside[0]:
        said += (
            "It began in contact with the block, the ground or itself: let the task draw other starts, "
            "or take block and ground away (scene: brokk_rl.sim.scene.make_empty_scenes)"
        )
    else:
        said += _suggest_stiffness(machine, world.model, q.numpy())
    return said, is_endured


def _suggest_stiffness(machine: Machine, model: mujoco.MjModel, poses: np.ndarray) -> str:
    """Return what to change so that the drives are as calm as those of a new machine."""
    stiffness = np.array([body.stiffness.value for body in machine.bodies])
    mode_rad_s, joint = find_fastest_mode(model, stiffness, poses)
    phase = mode_rad_s * model.opt.timestep
    name = machine.joint_names[joint]
    if phase <= FASTEST_MODE:
        return f"Look at max_speed, stiffness and mass of {name}, or give more sim.substeps"
    calm = float(stiffness[joint]) * (FASTEST_MODE / phase) ** 2
    return (
        f"The drives are too stiff for substeps of {1000.0 * model.opt.timestep:.3g} ms; {name} swings fastest, "
        f"at {mode_rad_s / (2.0 * math.pi):.3g} Hz: lower its body.stiffness from {stiffness[joint]:.4g} to "
        f"{calm:.3g}, or raise sim.substeps by a factor of {math.ceil(phase / FASTEST_MODE)}"
    )
