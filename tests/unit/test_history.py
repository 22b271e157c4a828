"""What is remembered, and in which order."""

from __future__ import annotations

import torch

from brokk_rl.history import History


def of_one_joint(num_envs: int = 1) -> History:
    return History(q=torch.zeros(num_envs, 3, 1), u=torch.zeros(num_envs, 3, 1))


def rows(history: History, env: int = 0) -> tuple[list[float], list[float]]:
    return history.q[env, :, 0].tolist(), history.u[env, :, 0].tolist()


def test_one_control_step_follows_the_trace_of_the_docstring() -> None:
    history = of_one_joint()
    history.q[0, :, 0] = torch.tensor([8.0, 9.0, 10.0])  # q(t-2), q(t-1), q(t) at t = 10
    history.u[0, :, 0] = torch.tensor([7.0, 8.0, 9.0])  # u(t-3), u(t-2), u(t-1)
    history.push_u(torch.tensor([[10.0]]))
    # the actuator model sees position and command of the same moment in one row
    assert rows(history) == ([8, 9, 10], [8, 9, 10])
    history.push_q(torch.tensor([[11.0]]))
    # the next observation knows one position more than commands
    assert rows(history) == ([9, 10, 11], [8, 9, 10])


def test_a_reset_backfills_its_environments_and_leaves_the_others() -> None:
    history = of_one_joint(2)
    history.q += 1.0
    history.u += 0.5
    history.reset(torch.tensor([False, True]), torch.tensor([[7.0], [8.0]]))
    assert rows(history, 0) == ([1, 1, 1], [0.5, 0.5, 0.5])
    assert rows(history, 1) == ([8, 8, 8], [0, 0, 0])


def test_every_update_keeps_the_addresses() -> None:
    history = of_one_joint()
    before = history.q.data_ptr(), history.u.data_ptr()
    history.push_u(torch.ones(1, 1))
    history.push_q(torch.ones(1, 1))
    history.reset(torch.tensor([True]), torch.zeros(1, 1))
    assert (history.q.data_ptr(), history.u.data_ptr()) == before
