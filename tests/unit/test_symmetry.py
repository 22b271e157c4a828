"""The mirror of a machine, of its episodes in the simulator, and of what PPO learns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import training as runs
from composed import option
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.ppo import DevicePPO
from brokk_rl.sim.scene import COLUMNS
from brokk_rl.sim.simulator import NativeSimulator
from brokk_rl.symmetry import Mirror, compute_joint_signs

NUM = 6
NATIVE = NativeSimulator(num_worlds=NUM, substeps=5, num_threads=1)
SIGNS = torch.tensor([-1.0, 1.0, 1.0, 1.0, 1.0])


def make(machine: Machine, task: str) -> ControlLoop:
    """Returns a loop whose first observation error is drawn, and then stays."""
    torch.manual_seed(0)
    return runs.plant(machine, option("task", task), NATIVE).build(runs.CPU, NUM, 64, 5)


def mirror_start(start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    found = {name: value.clone() for name, value in start.items()}
    found["q"][:, 0] *= -1
    found["target_m"][:, 1] *= -1
    for column in ("hole_y_m", "yaw_rad"):
        found["scene"][:, COLUMNS.index(column)] *= -1
    return found


@pytest.mark.parametrize("task", ["borehole_insertion", "goal_pose"])
def test_a_mirrored_episode_is_the_mirror_of_the_episode(
    machine: Machine, task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = make(machine, task)
    mirror = loop.task.mirror()
    # errors of perception are drawn; without them both episodes see the same hole
    monkeypatch.setattr(torch, "rand", lambda *size, **kwargs: torch.full(size[:2], 0.5))
    monkeypatch.setattr(torch, "rand_like", lambda value, **kwargs: torch.full_like(value, 0.5))
    start = {name: value[:NUM].clone() for name, value in loop.starts.items()}
    generator = torch.Generator().manual_seed(1)
    actions = [0.6 * torch.randn(NUM, 5, generator=generator) for _ in range(40)]
    seen: list[list[dict[str, torch.Tensor]]] = []
    for side, first in ((torch.ones(5), start), (SIGNS, mirror_start(start))):
        loop.begin(first)
        loop.task.state["bias_m"].zero_()
        steps = []
        for action in actions:
            groups, reward, done, _ = loop.step(action * side)
            alive = ~done
            steps.append(
                dict(groups) | {"reward": reward.clone(), "alive": alive, "q": loop.end_q.clone()}
            )
        seen.append(steps)
    going, compared, bent = torch.ones(NUM, dtype=torch.bool), 0, 0.0
    for one, other in zip(*seen, strict=True):
        assert torch.equal(one["alive"][going], other["alive"][going])
        torch.testing.assert_close(other["q"][going], (one["q"] * SIGNS)[going], rtol=0, atol=2e-4)
        torch.testing.assert_close(other["reward"][going], one["reward"][going], rtol=0, atol=5e-3)
        going &= one["alive"]
        for group in ("policy", "guide", "privileged"):
            expected = mirror.apply(group, one[group])[going]
            torch.testing.assert_close(other[group][going], expected, rtol=0, atol=5e-3)
            compared += expected.numel()
        bent = max(bent, float(one["q"][going][:, 0].abs().max()))
    assert compared > 10_000 and bent > 0.3  # arms that stand to the side


def test_only_the_slew_changes_sides(machine: Machine) -> None:
    assert compute_joint_signs(machine).tolist() == [-1.0, 1.0, 1.0, 1.0, 1.0]


def test_a_machine_that_is_not_symmetric_is_refused(machine: Machine) -> None:
    slew = machine.joints[0]
    longer = replace(slew, upper=replace(slew.upper, value=2.0))
    with pytest.raises(ConfigError, match=r"travel of q1, \[-1\.6, 2\], differs"):
        compute_joint_signs(replace(machine, joints=(longer, *machine.joints[1:])))
    assert slew.body is not None
    aside = replace(slew, body=replace(slew.body, com_m=(0.0, 0.1, 0.0)))
    with pytest.raises(ConfigError, match=r"com_m of q1 lies 0\.1 m off the plane"):
        compute_joint_signs(replace(machine, joints=(aside, *machine.joints[1:])))


def algorithm(kind: type[PPO], **changes: object) -> PPO:
    torch.manual_seed(0)
    obs = TensorDict({"policy": torch.randn(16, 7)}, batch_size=[16])
    groups = {"actor": ["policy"], "critic": ["policy"]}
    noise = {"class_name": "GaussianDistribution", "init_std": 0.3, "std_type": "log"}
    actor = MLPModel(obs, groups, "actor", 3, (16,), distribution_cfg=noise)
    critic = MLPModel(obs, groups, "critic", 1, (16,))
    storage = RolloutStorage("rl", 16, 6, obs, [3], "cpu")
    return kind(
        actor, critic, storage, num_learning_epochs=2, num_mini_batches=2, desired_kl=0.01,
        entropy_coef=0.01, device="cpu", **changes,
    )  # fmt: skip


def test_it_learns_the_same_as_rsl_rls_own_augmentation() -> None:
    factor = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
    mirror = Mirror({"policy": (factor, 0.1 * (1 - factor))}, torch.tensor([-1.0, 1.0, 1.0]))
    settings = {
        "env": None, "data_augmentation_func": mirror.augment, "use_data_augmentation": True,
    }  # fmt: skip
    ours = algorithm(DevicePPO, symmetry_cfg=settings)
    theirs, alone = algorithm(PPO, symmetry_cfg=settings), algorithm(DevicePPO)
    for learner in (ours, theirs, alone):
        draws = torch.Generator().manual_seed(2)
        torch.manual_seed(3)
        with torch.inference_mode():
            for _ in range(6):
                seen = TensorDict({"policy": torch.randn(16, 7, generator=draws)}, batch_size=[16])
                learner.act(seen)
                reward, done = torch.randn(2, 16, generator=draws)
                learner.process_env_step(seen, reward, done > 1.5, {"time_outs": done > 2.0})
            learner.compute_returns(seen)
        torch.manual_seed(4)
        learner.update_on_device() if learner is ours else learner.update()
    weights = [
        torch.cat([p.flatten() for p in one.actor.parameters()]) for one in (ours, theirs, alone)
    ]
    torch.testing.assert_close(weights[0], weights[1], rtol=1e-4, atol=1e-6)
    assert (weights[0] - weights[2]).abs().max() > 1e-3
    assert np.isclose(ours.learning_rate, theirs.learning_rate)


def test_rsl_rls_own_symmetry_and_a_task_without_a_mirror_are_refused(
    machine: Machine, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = runs.small(max_env_steps=1)
    runner = dict(training.runner) | {
        "algorithm": {**training.runner["algorithm"], "symmetry_cfg": {}}
    }
    with pytest.raises(ConfigError, match=r"rl\.symmetry=true"):
        replace(training, runner=runner)
    loop = runs.plant(machine).build(runs.CPU, 16, 64, 0)
    monkeypatch.setattr(type(loop.task), "offers", frozenset())
    with pytest.raises(ConfigError, match=r"rl\.symmetry"):
        runs.make(machine, tmp_path, replace(training, symmetry=True), loop)


def test_a_training_with_symmetry_runs(machine: Machine, tmp_path) -> None:
    runner = runs.train(machine, tmp_path, runs.small(max_env_steps=256, symmetry=True))
    assert all(torch.isfinite(value).all() for value in runs.weights(runner).values())
