"""The control loop: who is reset, what is seen, what is counted, and that evaluation is the same for everybody."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import training as runs
from composed import MACHINE, option
from torch._dynamo.exc import BackendCompilerFailed

from brokk_rl.contracts.target import TargetReading
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import Kinematics
from brokk_rl.rl.evaluation import evaluate_policy
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.policy import ClassicalPolicy
from brokk_rl.rl.settings import NearStarts

CPU = torch.device("cpu")


def make(num_envs: int = 8, **changes: Any) -> ControlLoop:
    torch.manual_seed(0)
    task = replace(option("task", "borehole_insertion"), **changes)
    return runs.plant(task).build(CPU, num_envs, 64, 5)


def test_only_finished_environments_begin_anew() -> None:
    loop = make()
    for _ in range(3):
        loop.step(torch.zeros(8, 5))
    last = loop.max_episode_length - 1
    loop.episode_length_buf = torch.where(torch.arange(8) < 2, last, loop.episode_length_buf)
    before = runs.take_state(loop)
    _, _, done, extras = loop.step(torch.zeros(8, 5))
    assert done.tolist() == [True, True, *[False] * 6]
    assert extras["time_outs"].tolist() == done.tolist()
    after = runs.take_state(loop)
    assert (after["task.steps"][:2] == 0).all() and (after["task.steps"][2:] == 4).all()
    assert (after["episode.length"][:2] == 0).all() and (after["episode.length"][2:] == 4).all()
    is_new = (after["task.start.target_m"] != before["task.start.target_m"]).any(1)
    assert is_new[:2].any() and not is_new[2:].any()
    assert (after["history.u"][:2] == 0).all() and (after["history.q"][:2].diff(dim=1) == 0).all()
    assert torch.equal(after["history.q"][:2, -1], after["world.q"][:2])
    assert torch.equal(after["world.q"][:2], after["task.start.q"][:2])
    assert torch.equal(after["history.q"][2:, :-1], before["history.q"][2:, 1:])


def test_a_failure_is_no_time_out() -> None:
    loop = make()
    loop.step(torch.zeros(8, 5))
    loop.world.q[3, 0] = float(MACHINE.upper[0])
    loop.episode_length_buf = torch.ones(8, dtype=torch.long) * (loop.max_episode_length - 1)
    _, _, done, extras = loop.step(torch.zeros(8, 5))
    assert done.all() and extras["time_outs"].tolist() == [index != 3 for index in range(8)]
    assert loop.task.reasons[int(loop.reason[3])] == "joint_limit"


def test_asking_twice_gives_the_same_observation() -> None:
    loop = make()
    loop.step(torch.randn(8, 5))
    state, random = runs.take_state(loop), torch.get_rng_state()
    assert (loop.get_observations() == loop.get_observations()).all()
    assert torch.equal(random, torch.get_rng_state())
    assert all(torch.equal(value, state[name]) for name, value in runs.take_state(loop).items())


def test_what_was_handed_out_does_not_change_later() -> None:
    loop = make()
    seen = loop.get_observations()
    kept = seen["policy"].clone()
    loop.step(torch.ones(8, 5))
    assert torch.equal(seen["policy"], kept)


def test_statistics_count_what_ended_since_they_were_last_asked() -> None:
    loop = make(episode_s=0.2)
    loop.statistics()
    for _ in range(4):
        loop.step(torch.zeros(8, 5))
    found = loop.statistics()
    assert found["episodes"] == 8 and found["end/time_limit"] == 1.0
    assert found["length"] == 4.0 and found["fault_rate"] == 0.0
    assert loop.statistics()["episodes"] == 0


def test_the_action_of_a_step_is_in_force_in_that_step() -> None:
    plain = option("task", "borehole_insertion").action
    loop = make(action=replace(plain, kind="direct", scale=1.0, limits=False))
    action = torch.linspace(-1, 1, 40).reshape(8, 5)
    positioning = loop.task.state["positioning"].bool()
    loop.step(action)
    exclusive = torch.as_tensor(MACHINE.is_exclusive)
    wanted = torch.where(exclusive == positioning[:, None], action, 0.0)
    assert torch.equal(loop.history.u[:, -1], wanted)


def results(loop: ControlLoop, policy: Any, seed: int = 7) -> dict[str, Any]:
    starts = {name: value[: loop.num_envs] for name, value in loop.starts.items()}
    return evaluate_policy(loop, policy.build(loop, 0), starts, seed, 2).summary


def test_evaluating_a_policy_twice_gives_the_same_figures() -> None:
    loop = make(32, episode_s=6.0)
    first = results(loop, ClassicalPolicy(task=None))
    torch.rand(100)
    assert results(loop, ClassicalPolicy(task=None)) == first and first["episodes"] == 32
    assert sum(first["terminations"].values()) == 32, "every episode ends in one way"
    other = make(32, episode_s=6.0)
    assert results(other, ClassicalPolicy(task=None)) == first


def test_every_policy_meets_the_same_holes_and_the_same_errors() -> None:
    loop = make(16, episode_s=1.0)
    met: list[dict[str, torch.Tensor]] = []

    names = ("start.target_m", "start.q", "start.scene", "bias_m", "q_scale", "u_scale")

    def look(groups: dict[str, torch.Tensor], scale: float) -> torch.Tensor:
        if loop.task.state["age"].eq(0).all():
            found = {name: loop.task.state[name].clone() for name in (*names, "estimate_sum_m")}
            met.append(found)
        return scale * torch.randn(16, 5)

    for scale in (0.0, 1.0):
        policy = SimpleNamespace(act=partial(look, scale=scale))
        results(loop, SimpleNamespace(build=lambda *_, policy=policy: policy))
    assert len(met) == 2 and all(torch.equal(met[0][name], met[1][name]) for name in met[0])


def test_recorded_episodes_begin_at_their_start_and_hold_no_sample_of_the_next() -> None:
    loop = make(4, episode_s=0.5)
    starts = {name: value[:4] for name, value in loop.starts.items()}
    found = evaluate_policy(loop, ClassicalPolicy(task=None).build(loop, 0), starts, 7, 2)
    episodes = found.episodes
    assert len(episodes) == 2
    for row, episode in enumerate(episodes):
        assert episode.q[0] == pytest.approx(starts["q"][row].numpy()) and (episode.u[0] == 0).all()
        assert len(episode.t_s) == len(episode.q) == len(episode.u) == len(episode.force_n) == 11
        # no jump: top speed is 0.45 rad/s
        assert abs(episode.q[1:] - episode.q[:-1]).max() <= 0.45 * 0.05 + 1e-6


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_a_control_step_leaves_the_cores_to_the_physics(
    monkeypatch: pytest.MonkeyPatch, two_threads: None
) -> None:
    loop, found = make(), []
    monkeypatch.setattr(loop.world, "step", lambda increment: found.append(torch.get_num_threads()))
    loop.step(torch.zeros(8, 5))
    assert found == [1] and torch.get_num_threads() == 2


def test_a_fused_control_step_is_compiled_once_and_does_what_the_plain_one_does(
    monkeypatch: pytest.MonkeyPatch, two_threads: None
) -> None:
    """Traced in full but not turned into C++, which takes a minute."""
    traced = []

    def backend(graph: torch.fx.GraphModule, _: object) -> Callable[..., Any]:
        traced.append(graph)
        return graph.forward

    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=backend))
    plain, fused = make(), make()
    fused.capture(fuse=True)
    ends = []
    for loop in (plain, fused):
        torch.manual_seed(1)
        loop.begin()
        for step in range(20):
            # rsl-rl rolls out in it, an evaluation does not.
            with torch.inference_mode(step % 2 == 0):
                obs, *_ = loop.step(torch.full((8, 5), 0.3))
        ends.append({name: value.clone() for name, value in obs.items()})
    assert all(torch.equal(ends[1][name], value) for name, value in ends[0].items())
    assert len(traced) == 3


def test_without_a_compiler_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise BackendCompilerFailed(fail, RuntimeError("No working C++ compiler found"), None)

    loop = make()
    monkeypatch.setattr(loop, "_advance", fail)
    with pytest.raises(ConfigError, match=r"(?s)rl.fuse.*g\+\+"):
        loop.capture(fuse=True)


def test_the_example_gets_there_where_the_controller_is_stuck() -> None:
    loop, reached = make(64), []
    task = loop.task
    for act in (task.classical_action, lambda groups: task.example_action(groups)[0]):
        found = evaluate_policy(loop, SimpleNamespace(act=act), loop.starts, 0, 1)
        reached.append(found.summary["success_reached"]["mean"])
    assert reached[0] < 0.95 <= reached[1]


NEAR = NearStarts(share=(0.5, 0.0), height_m=(0.05, 0.3), way=(0.0, 0.0))


def test_part_of_the_starts_of_a_training_lies_above_the_target() -> None:
    loop = make()
    before = {name: value.clone() for name, value in loop.starts.items()}
    loop.bring_near(NEAR, 1)
    start = loop.starts
    pose = Kinematics(MACHINE).pose(start["q"][:32])
    away = pose.tip_in_base_m - start["target_m"][:32]
    near = away[:, :2].norm(dim=1) < 0.01
    assert near.float().mean() > 0.9, "few arms cannot get there, and stay"
    height_m = away[near, 2]
    assert height_m.min() > 0.04 and height_m.max() < 0.31 and height_m.std() > 0.03
    assert (pose.pitch_rad[near] - torch.pi / 2).abs().max() < 0.03
    assert torch.equal(start["q"][32:], before["q"][32:])
    for name in ("target_m", "scene"):
        assert torch.equal(start[name], before[name])
    assert (start["closeness"][:32][near] > before["closeness"][:32][near]).all()
    assert (loop.world.q[:, None] == start["q"]).all(2).any(1).all(), "the episodes begin there"
    for share, most in ((NEAR.share_at(0.5), 0.25), (NEAR.share_at(1.0), 0.0)):
        loop.draw_near(share)
        found = []
        for _ in range(64):
            loop.begin()
            found.append((loop.world.q[:, None] == start["q"][:32]).all(2).any(1).float())
        assert torch.stack(found).mean().item() == pytest.approx(most, abs=0.08)


def test_a_task_that_cannot_bring_its_starts_near_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = make()
    monkeypatch.setattr(type(loop.task), "offers", frozenset())
    with pytest.raises(ConfigError, match=r"no starts near its target.*rl\.near_starts=null"):
        loop.bring_near(NEAR, 1)


class _Pointing:
    """A sensor of two machines: the first knows a place 0.3 m beside its hole, the second nothing."""

    def __init__(self) -> None:
        self.shift_m = np.array([0.0, 0.3, 0.0])
        self.target_m = np.zeros((2, 3))
        self.planned, self.num_reads = np.zeros(0), 0

    def reset(self, mask: np.ndarray, start: dict[str, np.ndarray]) -> None:
        self.target_m[mask] = start["target_m"][mask] + self.shift_m

    def begin(self) -> None: ...

    def attend(self, mask: np.ndarray) -> None: ...

    def read(self, q: np.ndarray, measured_q: np.ndarray, plan: Any) -> TargetReading:
        self.num_reads += 1
        if self.num_reads == 100:
            self.planned = plan(self.target_m, 13, 1.0)
            np.testing.assert_array_equal(self.planned[:, 0], measured_q)
        return TargetReading(self.target_m, np.array([True, False]))

    def summarize(self) -> dict[str, Any]:
        return {}


def test_a_policy_goes_where_a_sensor_sees_the_hole_and_rests_where_it_sees_none() -> None:
    sensor = _Pointing()
    spec: Any = SimpleNamespace(sense=lambda machine, num_envs, seed: sensor)
    task = replace(option("task", "borehole_insertion"), episode_s=60.0)
    torch.manual_seed(0)
    loop = runs.plant(task).build(CPU, 2, 2, 5, target=spec)
    policy, groups = ClassicalPolicy(task=None).build(loop, 0), loop.get_observations()
    begun = loop.history.q[:, -1].clone()
    for _ in range(150):
        groups, *_ = loop.step(policy.act(dict(groups.items())))  # type: ignore[arg-type]
    tip_m = Kinematics(MACHINE, CPU).pose(loop.history.q[:, -1]).tip_in_base_m.numpy()
    target_m = loop.task.state["start.target_m"].numpy()
    # the block does not lie where the sensor believes it: the tool stays over it
    np.testing.assert_allclose(tip_m[0, :2], target_m[0, :2] + sensor.shift_m[:2], atol=0.1)
    assert torch.equal(loop.history.u[1], torch.zeros_like(loop.history.u[1]))
    np.testing.assert_allclose(loop.history.q[1, -1], begun[1], atol=0.01)
    # the plan ends where the sensor believes the hole
    end_m = Kinematics(MACHINE, CPU).pose(torch.as_tensor(sensor.planned[:, -1])).tip_in_base_m
    np.testing.assert_allclose(end_m[:, :2], sensor.target_m[:, :2], atol=0.05)
