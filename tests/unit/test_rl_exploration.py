"""The cap of the exploration noise: its schedule, its effect on the noise, and that a resumed training goes on with it."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from composed import option
from rsl_rl.modules.distribution import GaussianDistribution
from training import make, small, train

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.rl.ppo import CappedGaussian
from brokk_rl.rl.settings import CAPPED, Exploration, Teacher, TrainingConfig


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


def test_training_moves_the_cap_and_a_checkpoint_keeps_it(machine: Machine, tmp_path: Path) -> None:
    training = capped(small(max_env_steps=16 * 4 * 40, save_interval=10))
    runner = train(machine, tmp_path, training)
    cap = runner.alg.actor.distribution.log_cap
    # moved at the start of every tenth iteration, the last time when 30 of 40 were done
    assert cap.item() == pytest.approx(math.log(0.125))
    again = make(machine, tmp_path / "again", training)
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
