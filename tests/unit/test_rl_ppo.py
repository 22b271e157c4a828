"""PPO on the device against rsl-rl's own."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from composed import option
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from training import make, small, train

from brokk_rl.errors import ConfigError
from brokk_rl.rl.ppo import CappedGaussian, DevicePPO
from brokk_rl.rl.rollout import CapturedRollout
from brokk_rl.rl.settings import CAPPED, Exploration, Teacher, TrainingConfig

NUM_ENVS, STEPS, GROUPS = 16, 6, {"actor": ["policy"], "critic": ["policy"]}
GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 0.3, "std_type": "log"}


def _algorithm(kind: type[PPO], device: str = "cpu", **changes: object) -> PPO:
    torch.manual_seed(0)
    obs = TensorDict({"policy": torch.randn(NUM_ENVS, 7, device=device)}, batch_size=[NUM_ENVS])
    shape = {"hidden_dims": (16, 16), "obs_normalization": True}
    noise = copy.deepcopy(GAUSSIAN)
    actor = MLPModel(obs, GROUPS, "actor", 3, distribution_cfg=noise, **shape)
    critic = MLPModel(obs, GROUPS, "critic", 1, (16, 16))
    storage = RolloutStorage("rl", NUM_ENVS, STEPS, obs, [3], device)
    settings = {"num_learning_epochs": 3, "num_mini_batches": 4, "desired_kl": 0.01}
    settings |= {"device": device, "entropy_coef": 0.01}
    return kind(actor, critic, storage, **(settings | changes))


def _roll_out(algorithm: PPO, seed: int) -> TensorDict:
    """Fills the storage with made-up steps of the algorithm's own policy; returns what is seen at the end."""
    device = algorithm.device
    torch.manual_seed(seed)
    draws = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draws).to(device)

    def seen() -> TensorDict:
        return TensorDict({"policy": random(NUM_ENVS, 7)}, batch_size=[NUM_ENVS])

    with torch.inference_mode():
        for _ in range(STEPS):
            algorithm.act(seen())
            now, reward = seen(), random(NUM_ENVS)
            done = random(NUM_ENVS) > 1.5
            algorithm.process_env_step(now, reward, done, {"time_outs": random(NUM_ENVS) > 2.0})
    return seen()


def _learn(algorithm: PPO, seed: int, last: TensorDict) -> dict[str, float]:
    with torch.inference_mode():
        algorithm.compute_returns(last)
    torch.manual_seed(seed)  # the order of mini-batches
    return algorithm.update()


def _iteration(algorithm: PPO, seed: int) -> dict[str, float]:
    return _learn(algorithm, seed, _roll_out(algorithm, seed))


def _compare_weights(ours: PPO, theirs: PPO, **tolerance: float) -> None:
    for who in ("actor", "critic"):
        mine, other = (dict(getattr(one, who).named_parameters()) for one in (ours, theirs))
        torch.testing.assert_close(mine, other, **tolerance)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"schedule": "fixed"},
        {"normalize_advantage_per_mini_batch": True, "use_clipped_value_loss": False},
    ],
)
def test_it_learns_the_same_as_rsl_rls_own(changes: dict) -> None:
    ours, theirs = _algorithm(DevicePPO, **changes), _algorithm(PPO, **changes)
    for seed in range(4):
        assert _iteration(ours, seed) == pytest.approx(_iteration(theirs, seed), rel=1e-4, abs=1e-6)
        assert ours.learning_rate == pytest.approx(theirs.learning_rate, rel=1e-5)
    _compare_weights(ours, theirs, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(ours.actor.obs_normalizer.mean, theirs.actor.obs_normalizer.mean)


@pytest.mark.parametrize(
    ("device", "fuse"),
    [
        pytest.param("cpu", True, marks=pytest.mark.slow),  # the compiler takes half a minute
        pytest.param("cuda", False, marks=pytest.mark.gpu),
        pytest.param("cuda", True, marks=pytest.mark.gpu),
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.filterwarnings("ignore:TensorFloat32:UserWarning")  # wanted: see brokk_rl.rl.runner
def test_captured_and_compiled_parts_learn_the_same_as_rsl_rls_own(
    device: str, fuse: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a fixed rate: in the first mini-batch rounding alone decides whether rsl-rl raises it."""
    monkeypatch.setattr(DevicePPO, "fuse", fuse)
    ours, theirs = (_algorithm(kind, device, schedule="fixed") for kind in (DevicePPO, PPO))
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    for seed in range(4):
        last = _roll_out(ours, seed)
        theirs.storage = copy.deepcopy(ours.storage)
        found = _learn(ours, seed, last)
        assert found == pytest.approx(_learn(theirs, seed, last), rel=1e-3, abs=1e-5)
        one, other = ours.storage.returns, theirs.storage.returns
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    torch.set_float32_matmul_precision(precision)
    if device == "cuda":
        assert len(ours._epoch) == 1, "a pass over all mini-batches is one graph"
    _compare_weights(ours, theirs, rtol=2e-3, atol=2e-5)


def _teacher() -> MLPModel:
    torch.manual_seed(7)
    seen = TensorDict({"policy": torch.zeros(1, 7)}, batch_size=[1])
    noise = {"class_name": "GaussianDistribution"}
    return MLPModel(seen, GROUPS, "actor", 3, (16,), distribution_cfg=noise)


def test_a_teacher_is_followed_where_its_action_has_weight() -> None:
    """Its outputs are clamped: beyond a full stroke there is nothing to imitate."""
    algorithm, teacher = _algorithm(DevicePPO, schedule="fixed"), _teacher()
    with torch.no_grad():
        teacher.mlp[-1].bias.copy_(torch.tensor([0.3, -0.3, 40.0]))

    def show(seen: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
        is_along, shown = seen["policy"][:, 0] > 0.0, teacher(seen)
        return torch.where(is_along[:, None], shown, -shown), is_along

    algorithm.follow(show)
    algorithm.imitation = (1000.0, 0.0)
    for seed in range(60):
        _iteration(algorithm, seed)
    seen = TensorDict({"policy": torch.randn(64, 7).abs()}, batch_size=[64])
    wanted = teacher(seen).clamp(-1.0, 1.0)
    assert (wanted[:, 2] == 1.0).all()
    away = (algorithm.actor(seen) - wanted).square().mean().sqrt()
    assert away < 0.15 and (0.0 - wanted).square().mean().sqrt() > 0.5


def test_the_learning_rate_moves_both_ways() -> None:
    """Otherwise the comparison above would not see the rule."""
    rates = []
    for kl in (1e-6, 10.0):
        algorithm = _algorithm(DevicePPO, desired_kl=kl)
        _iteration(algorithm, 0)
        rates.append(algorithm.learning_rate)
    assert rates[0] < 0.001 < rates[1]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_rollout_stores_what_rsl_rl_would_store(device: str) -> None:
    """Against rsl-rl's own functions; on a GPU the rollout is captured."""
    algorithm = _algorithm(PPO, device)
    rollout = CapturedRollout(algorithm)
    seen = torch.randn(STEPS, NUM_ENVS, 7, device=device)
    rewards = torch.randn(STEPS, NUM_ENVS, device=device)
    ends = torch.rand(2, STEPS, NUM_ENVS, device=device) > 0.7
    for t in range(STEPS):
        rollout.act({"policy": seen[t]})
        rollout.store(rewards[t], ends[0, t] | ends[1, t], ends[1, t])
    storage, actor = algorithm.storage, algorithm.actor
    obs = TensorDict({"policy": seen}, batch_size=[STEPS, NUM_ENVS])
    with torch.no_grad():
        values = algorithm.critic(obs)
        actor(obs, stochastic_output=True)
        expected = actor.get_output_log_prob(storage.actions)
        torch.testing.assert_close(storage.actions_log_prob[..., 0], expected)
        for stored, wanted in zip(
            storage.distribution_params, actor.output_distribution_params, strict=True
        ):
            torch.testing.assert_close(stored, wanted)
    torch.testing.assert_close(storage.observations["policy"], seen)
    torch.testing.assert_close(storage.values, values)
    expected = rewards + algorithm.gamma * values[..., 0] * ends[1]
    torch.testing.assert_close(storage.rewards[..., 0], expected)
    assert torch.equal(storage.dones[..., 0].bool(), ends[0] | ends[1])
    drawn = (storage.actions - storage.distribution_params[0]) / storage.distribution_params[1]
    assert abs(float(drawn.mean())) < 0.2 and 0.85 < float(drawn.std()) < 1.15  # 288 draws
    assert len(drawn.unique()) == drawn.numel()
    with pytest.raises(OverflowError, match="full"):
        rollout.store(rewards[0], ends[0, 0], ends[1, 0])


def capped(training: TrainingConfig, **schedule: Any) -> TrainingConfig:
    """Returns a training whose cap falls from 0.5 to 0.125 between shares 0.2 and 0.6 of its budget."""
    runner = copy.deepcopy(training.runner)
    runner["actor"]["distribution_cfg"] = {
        "class_name": CAPPED, "init_std": 0.6, "std_type": None, "std_range": [0.01, 0.5],
    }  # fmt: skip
    parts = {"cap": (0.5, 0.125), "over": (0.2, 0.6)} | schedule
    return replace(training, runner=runner, exploration=Exploration(**parts))


def test_the_cap_falls_in_equal_ratios() -> None:
    schedule = Exploration(cap=(0.5, 0.125), over=(0.2, 0.6))
    caps = [schedule.cap_at(share) for share in (0.0, 0.2, 0.4, 0.6, 1.0)]
    assert caps == pytest.approx([0.5, 0.5, 0.25, 0.125, 0.125])


def test_below_the_cap_it_is_the_gaussian_of_rsl_rl() -> None:
    ours = CappedGaussian(3, 0.4, (0.1, 1.0))
    theirs = GaussianDistribution(3, 0.4, (0.1, 1.0), std_type="log")
    mean, action = torch.randn(5, 3), torch.randn(5, 3)
    for one in (ours, theirs):
        one.update(mean)
    assert torch.equal(ours.log_prob(action), theirs.log_prob(action))
    assert torch.equal(ours.entropy, theirs.entropy)


@pytest.mark.parametrize(
    ("std", "cap", "expected"), [(0.05, 0.2, 0.1), (0.15, 0.2, 0.15), (3.0, 0.2, 0.2), (0.5, 0.05, 0.1)]
)  # fmt: skip
def test_the_noise_lies_between_bound_and_cap(std: float, cap: float, expected: float) -> None:
    noise = CappedGaussian(2, std, (0.1, 1.0))
    noise.set_cap(cap)
    noise.update(torch.zeros(1, 2))
    assert noise.std[0].tolist() == pytest.approx([expected] * 2)


def test_training_moves_the_cap_and_a_checkpoint_keeps_it(tmp_path: Path) -> None:
    training = capped(small(max_env_steps=16 * 4 * 40, save_interval=10))
    runner = train(tmp_path, training)
    cap = runner.alg.actor.distribution.log_cap
    # moved at the start of every tenth iteration, the last time when 30 of 40 were done
    assert cap.item() == pytest.approx(math.log(0.125))
    again = make(tmp_path / "again", training)
    assert again.alg.actor.distribution.log_cap.item() == pytest.approx(math.log(0.5))
    again.load(str(tmp_path / "model_40.pt"))
    assert again.alg.actor.distribution.log_cap.item() == pytest.approx(math.log(0.125))


def test_a_schedule_for_another_distribution_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"expected the distribution .*CappedGaussian.*, got Gau"):
        replace(option("rl", "ppo"), exploration=Exploration(cap=(0.5, 0.1), over=(0.0, 1.0)))


def test_the_weights_of_a_teacher_fall_to_nothing() -> None:
    teacher = Teacher(weight=4.0, until=(1.0, 0.5))
    found = [teacher.weights_at(share) for share in (0.0, 0.25, 0.5, 1.0, 1.1)]
    assert found == [[4.0, 4.0], [3.0, 2.0], [2.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
