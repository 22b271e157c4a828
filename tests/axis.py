"""A single axis that follows speeds, and recordings of it, for tests of what is read off recordings."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from motion import make_recording, rest

from actuators.models.lag import FirstOrderLag
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

CPU = torch.device("cpu")
PLANT = FirstOrderLag(
    dead_time_s=0.31, dead_band_extend=0.07, dead_band_retract=0.1, gain=0.9, time_constant_s=0.08
)


def make_axis(machine: Machine) -> Machine:
    """A single servo axis, known by nothing but its limits."""
    joint = dataclasses.replace(machine.joints[2], body=None)
    return dataclasses.replace(
        machine, name="axis", mjcf=None, tool_m=None, joints=(joint,), exclusive=(), levers=()
    )


def driven(
    machine: Machine,
    count: int,
    seconds: float,
    seed: int,
    plant: FirstOrderLag = PLANT,
    wandering: float = 0.003,
) -> list[Recording]:
    """Returns recordings of a plant under levels and rests, its speed wandering by a percent or two."""
    random, steps = np.random.default_rng(seed), round(seconds / machine.period_s)
    model = plant.build(machine, count, CPU)
    history = rest(machine, num=count)
    level, left, wander = np.zeros((3, count, machine.num_joints))
    commands, positions, margin = [], [], 0.2 * (machine.upper - machine.lower)
    for _ in range(steps):
        q = history.q[:, -1].numpy()
        fresh = random.uniform(-0.9, 0.9, level.shape) * (random.random(level.shape) > 0.2)
        level = np.where(left <= 0, fresh, level)
        left = np.where(left <= 0, random.uniform(0.4, 2.5, level.shape), left) - machine.period_s
        level = np.where((q > machine.upper - margin) & (level > 0), -0.6, level)
        level = np.where((q < machine.lower + margin) & (level < 0), 0.6, level)
        commands.append(level)
        positions.append(q + 2e-4 * random.standard_normal(q.shape))
        history.push_u(torch.as_tensor(level, dtype=torch.float32))
        wander = 0.99 * wander + wandering * random.standard_normal(wander.shape)
        before = history.q[:, -1].clone()
        moved = model.step(history) - before
        history.push_q(before + moved * torch.as_tensor(1.0 + wander, dtype=torch.float32))
    u, q = (np.stack(rows, 1).astype(np.float32) for rows in (commands, positions))
    return [make_recording(machine, u[n], q[n], f"{seed}.{n}") for n in range(count)]
