"""Motion of a model under commands, for tests of actuators and effects."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, make_motion


def make_recording(
    machine: Machine, u: np.ndarray, q: np.ndarray, run: str = "run", **changes: Any
) -> Recording:
    """Returns commands and positions `(T, J)` of each control period as a recording."""
    t_s = machine.period_s * np.arange(len(u))
    return replace(make_motion(machine, run, t_s, u, q), **changes)


def draw_commands(machine: Machine, steps: int, num: int, seed: int = 0) -> torch.Tensor:
    """Returns random commands that hold for five periods, `(T, N, J)`, some of them zero and some full."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(math.ceil(steps / 5), num, machine.num_joints, generator=generator)
    u = drawn * 3.0 - 1.5
    return (u.clamp(-1.0, 1.0) * (u.abs() > 0.2)).repeat_interleave(5, 0)[:steps]


def rest(machine: Machine, at: Any = None, num: int = 1) -> History:
    """Returns the history of `num` machines at rest at `at`, `(J,)` or `(N, J)`; home if none."""
    q = torch.as_tensor(machine.home if at is None else at, dtype=torch.float32)
    shape = (num, machine.num_history, machine.num_joints)
    history = History(q=torch.zeros(shape), u=torch.zeros(shape))
    history.reset(torch.ones(num, dtype=torch.bool), q.expand(num, -1))
    return history


@torch.no_grad()
def roll(
    model: Any, machine: Machine, u: torch.Tensor, at: Any = None, moving: bool = False
) -> torch.Tensor:
    """Returns the positions `(T + 1, N, J)` under commands `(T, N, J)`, from rest at `at`, home if none, or while moving."""
    history = rest(machine, at, u.shape[1])
    if moving:
        history.q += 0.01 * torch.arange(1 - machine.num_history, 1)[None, :, None]
        history.u.fill_(0.5)
    path = [history.q[:, -1].clone()]
    for command in u:
        history.push_u(command)
        history.push_q(model.step(history))
        path.append(history.q[:, -1].clone())
    return torch.stack(path)
