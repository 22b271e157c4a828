"""PPO in CUDA graphs, compiled and not, learns on a real GPU what rsl-rl's own learns."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from brokk_rl.rl.ppo import DevicePPO

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.filterwarnings("ignore::DeprecationWarning:torch"),
    pytest.mark.filterwarnings(
        "ignore:TensorFloat32:UserWarning"
    ),  # wanted: see brokk_rl.rl.runner
]

CUDA = torch.device("cuda")
NUM = 64
GROUPS = {"actor": ["policy"], "critic": ["policy"]}


def make_learner(kind: type[PPO], fuse: bool = False, **changes: Any) -> PPO:
    torch.manual_seed(0)
    seen = TensorDict({"policy": torch.randn(NUM, 7, device=CUDA)}, batch_size=[NUM])
    noise = {"class_name": "GaussianDistribution", "init_std": 0.3, "std_type": "log"}
    actor = MLPModel(
        seen, GROUPS, "actor", 3, (32, 16), obs_normalization=True, distribution_cfg=noise
    )
    critic = MLPModel(seen, GROUPS, "critic", 1, (32, 16))
    storage = RolloutStorage("rl", NUM, 8, seen, [3], "cuda")
    learner = kind(
        actor, critic, storage, num_learning_epochs=3, num_mini_batches=4, desired_kl=0.01,
        entropy_coef=0.01, device="cuda", **changes,
    )  # fmt: skip
    if isinstance(learner, DevicePPO):
        learner.fuse = fuse
    return learner


def roll_out(learner: PPO, seed: int) -> TensorDict:
    draws = torch.Generator().manual_seed(seed)

    def see() -> TensorDict:
        return TensorDict({"policy": torch.randn(NUM, 7, generator=draws).cuda()}, batch_size=[NUM])

    with torch.inference_mode():
        for _ in range(8):
            learner.act(see())
            reward, done = torch.randn(2, NUM, generator=draws).cuda()
            learner.process_env_step(see(), reward, done > 1.5, {"time_outs": done > 2.0})
    return see()


def learn(learner: PPO, seed: int, last: TensorDict) -> dict[str, float]:
    with torch.inference_mode():
        learner.compute_returns(last)
    torch.manual_seed(seed)  # the order of mini-batches
    return learner.update()


@pytest.mark.parametrize("fuse", [False, True], ids=["eager", "fused"])
def test_captured_ppo_learns_what_rsl_rls_own_learns(fuse: bool) -> None:
    """In float32: storage is that of the captured rollout, returns and update are compared.

    The learning rate is fixed. rsl-rl raises it when the divergence is above 0 and small, and at the
    first mini-batch of an update only rounding decides that. The adaptive rate is compared on a CPU,
    in `tests/unit/test_rl_ppo.py`.
    """
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    ours = make_learner(DevicePPO, fuse, schedule="fixed")
    theirs = make_learner(PPO, schedule="fixed")
    for seed in range(4):
        last = roll_out(ours, seed)
        theirs.storage = copy.deepcopy(ours.storage)
        figures = learn(theirs, seed, last)
        found = learn(ours, seed, last)
        assert found == pytest.approx(figures, rel=1e-3, abs=1e-5)
        torch.testing.assert_close(
            ours.storage.returns, theirs.storage.returns, rtol=1e-4, atol=1e-5
        )
    assert ours._epoch is not None and len(ours._epoch) == 1  # type: ignore[attr-defined]
    torch.set_float32_matmul_precision(precision)
    for mine, other in zip(
        (*ours.actor.parameters(), *ours.critic.parameters()),
        (*theirs.actor.parameters(), *theirs.critic.parameters()),
        strict=True,
    ):
        torch.testing.assert_close(mine, other, rtol=2e-3, atol=2e-5)
