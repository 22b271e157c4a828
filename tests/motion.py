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


def build_nominal_tables(machine: Machine, dead_time_s: float) -> dict[str, Any]:
    """Returns the tables of a valve that is the nominal machine: a dead time, then speed times command."""
    none, line = [0.0] * machine.num_joints, [[0.0, 1.0]] * machine.num_joints
    tables = {"dead_time_s": [dead_time_s] * machine.num_joints}
    tables |= dict.fromkeys(("demand", "play", "spool_s", "speed_s"), none)
    return tables | {"knots": [0.0, 1.0], "curve_extend": line, "curve_retract": line, "pose": None}


def step_through(model: Any, u: torch.Tensor, q: torch.Tensor, size: int) -> torch.Tensor:
    """Returns positions `(T, N, J)` like `q`, from `size` on those of a model that is stepped."""
    q = q.clone()
    for k in range(size, len(q)):
        past = slice(k - size, k)
        q[k] = model.step(History(q=q[past].transpose(0, 1), u=u[past].transpose(0, 1)))
    return q


def run_planned(model: Any, u: torch.Tensor, q: torch.Tensor, size: int) -> torch.Tensor:
    """Returns the same of a planned run."""
    q, run = q.clone(), model.plan_run(u, size)
    assert run is not None, "it was to be planned"
    for k in range(size, len(q)):
        q[k] = run.step(k, q)
    return q


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
