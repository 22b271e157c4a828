"""Motion of a model under commands, for tests of actuators and effects."""

from __future__ import annotations

import math
from typing import Any

import torch

from brokk_rl.history import History
from brokk_rl.machine import Machine


def draw_commands(machine: Machine, steps: int, num: int, seed: int = 0) -> torch.Tensor:
    """Returns random commands that hold for five periods, `(T, N, J)`, some of them zero and some full."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(math.ceil(steps / 5), num, machine.num_joints, generator=generator)
    u = drawn * 3.0 - 1.5
    return (u.clamp(-1.0, 1.0) * (u.abs() > 0.2)).repeat_interleave(5, 0)[:steps]


@torch.no_grad()
def roll(
    model: Any, machine: Machine, u: torch.Tensor, at: Any = None, moving: bool = False
) -> torch.Tensor:
    """Returns the positions `(T + 1, N, J)` under commands `(T, N, J)`, from rest at `at`, home if none, or while moving."""
    q = torch.as_tensor(machine.home if at is None else at, dtype=torch.float32).expand(u.shape[1:])
    shape = (u.shape[1], machine.num_history, machine.num_joints)
    history = History(q=torch.zeros(shape), u=torch.zeros(shape))
    history.reset(torch.ones(u.shape[1], dtype=torch.bool), q)
    if moving:
        history.q += 0.01 * torch.arange(-shape[1] + 1, 1)[None, :, None]
        history.u.fill_(0.5)
    path = [q]
    for command in u:
        history.push_u(command)
        history.push_q(model.step(history))
        path.append(history.q[:, -1].clone())
    return torch.stack(path)
