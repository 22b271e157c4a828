"""The predictive controller: its samples, its answers, and the cost that it follows."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from composed import option
from training import CPU, plant

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.rl.loop import ControlLoop
from tasks.predictive import PredictivePlanner, PredictivePolicy, _make_hat_functions
from tasks.settings import AdviceConfig

NUM = 4


def mpc(**changes: Any) -> PredictivePolicy:
    small = {"num_samples": 24, "iterations": 1, "horizon_s": 0.5, "num_knots": 3}
    return dataclasses.replace(
        option("policy", "mpc"), **({"actuator": option("actuator", "lag")} | small | changes)
    )


def build(machine: Machine, **changes: Any) -> tuple[ControlLoop, PredictivePlanner]:
    torch.manual_seed(3)
    loop = plant(machine).build(CPU, NUM, 16, 0)
    planner = mpc(**changes).build(loop, 0)
    assert isinstance(planner, PredictivePlanner)
    return loop, planner


def test_noise_is_linear_between_its_knots() -> None:
    weights = _make_hat_functions(3, 5).numpy()
    np.testing.assert_allclose(
        weights, [[1, 0.5, 0, 0, 0], [0, 0.5, 1, 0.5, 0], [0, 0, 0, 0.5, 1]], atol=1e-6
    )


def test_tool_noise_moves_the_tool_as_drawn(machine: Machine) -> None:
    loop, planner = build(machine)
    q = torch.tensor(machine.home).float().repeat(NUM, 1)
    joint = planner._map_tool_speed(q) * torch.tensor(machine.max_speed).float()[:, None]
    jacobian = loop.task.control.controller.kinematics.jacobian(q)  # type: ignore[attr-defined]
    rows = torch.cat((jacobian.tip, jacobian.pitch[:, None]), 1)
    # damped least squares: a little less than asked for, in the direction asked for
    moved = (rows @ joint)[0].numpy()
    np.testing.assert_allclose(moved, np.eye(4), atol=0.35)
    assert (np.diag(moved) > 0.6).all()
    assert not joint[:, machine.is_exclusive].any()


def test_the_task_gives_the_planned_command(machine: Machine) -> None:
    loop, planner = build(machine)
    groups = dict(loop.get_observations().items())
    action = planner.act(groups)  # type: ignore[arg-type]
    wanted = loop.task.control.controller.valve(planner.plan[:, 0])  # type: ignore[attr-defined]
    given = loop.task.command(action)
    state = loop.task.state
    bounded = wanted.minimum(state["highest"]).maximum(state["lowest"])
    torch.testing.assert_close(given, bounded, atol=1e-5, rtol=0)


def test_a_new_episode_forgets_the_plan(machine: Machine) -> None:
    loop, planner = build(machine)
    groups: Any = dict(loop.get_observations().items())
    first = planner.act(groups).clone()
    planner.plan.fill_(0.7)
    planner._generator.manual_seed(0)
    torch.testing.assert_close(planner.act(groups), first)


def test_predictions_are_those_of_the_actuator_model(machine: Machine) -> None:
    """Free runs of the loop's own model under the sampled commands."""
    _, planner = build(machine)
    q = torch.tensor(machine.home).float().repeat(NUM, 1)
    size = machine.num_history
    u = torch.zeros(NUM, size, machine.num_joints)
    u[:, :, 2] = 0.4
    samples = torch.zeros(NUM, 24, planner.plan.shape[1], machine.num_joints)
    samples[:, 1:, :, 3] = -0.6
    history = planner._predict_dead_time(q[:, None].repeat(1, size, 1), u)
    path = planner._predict(history, samples)
    model = option("actuator", "lag").build(machine, NUM, CPU)
    run = History(q=q[:, None].repeat(1, size, 1).clone(), u=u.clone())
    steps = planner._dead_steps + planner.plan.shape[1]
    given = torch.zeros(NUM, machine.num_joints)
    given[:, 3] = -0.6
    for _ in range(steps):
        run.push_u(given)
        run.push_q(model.step(run))
    torch.testing.assert_close(path[-1][:, 5], run.q[:, -1], atol=2e-3, rtol=0)
    assert (path[-1][:, 5, 3] < path[-1][:, 0, 3] - 0.05).all()


@pytest.mark.slow
def test_it_inserts_where_the_model_is_right(machine: Machine) -> None:
    torch.manual_seed(0)
    loop = plant(machine).build(CPU, 8, 8, 0)
    planner: Any = mpc(num_samples=64, horizon_s=1.2, num_knots=6).build(loop, 0)
    groups = loop.get_observations()
    ended = torch.zeros(8)
    for _ in range(loop.task.max_episode_steps):
        groups, _, done, _ = loop.step(planner.act(dict(groups.items())))
        ended = torch.maximum(ended, done * loop.finished["success_strict"])
    assert ended.sum() >= 5


def test_tasks_for_a_person_are_refused(machine: Machine) -> None:
    advice = AdviceConfig(
        delay_s=0.3, lag_s=0.1, dead_zone=0.0, joints_at_once=None, hold_s=0.5, settle_s=0.5
    )
    task = dataclasses.replace(option("task", "borehole_insertion"), advice=advice)
    loop = plant(machine, task=task).build(CPU, 2, 4, 0)
    with pytest.raises(ConfigError, match="policy=mpc"):
        mpc().build(loop, 0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_samples": 3}, "num_samples"),
        ({"spread": 0.0}, "spread"),
        ({"horizon_s": float("nan")}, "horizon_s"),
        ({"temperature": -1.0}, "temperature"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        mpc(**changes)
