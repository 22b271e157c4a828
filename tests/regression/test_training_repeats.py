"""Training on a CPU repeats bit for bit, also across an interruption."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import training as runs

from brokk_rl.rl.settings import Teacher

ITERATION = 16 * runs.STEPS


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(value, b[name]) for name, value in a.items())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nine iterations that nothing interrupted, a checkpoint after each."""
    folder = tmp_path_factory.mktemp("whole")
    training = runs.small(max_env_steps=9 * ITERATION, keep_checkpoints=9)
    runs.train(folder, training)
    return folder


def read_end(folder: Path) -> dict[str, Any]:
    return torch.load(folder / "model_9.pt", weights_only=True)


def check_same_end(folder: Path, whole: Path) -> None:
    """Checks weights, optimizer, environments, random streams and progress."""
    ends = [read_end(one) for one in (folder, whole)]
    for part in ("actor_state_dict", "critic_state_dict", "random"):
        assert same(ends[0][part], ends[1][part]), part
    assert same(ends[0]["env"]["tensors"], ends[1]["env"]["tensors"])
    state = [end["optimizer_state_dict"]["state"] for end in ends]
    assert all(same(state[0][key], state[1][key]) for key in state[0])
    assert runs.progress(folder) == runs.progress(whole) and len(runs.progress(whole)) == 9


def test_the_same_seed_trains_the_same_weights_however_often_it_is_saved(
    whole: Path, tmp_path: Path
) -> None:
    training = runs.small(max_env_steps=9 * ITERATION, save_interval=50)
    runs.train(tmp_path / "once", training)
    check_same_end(tmp_path / "once", whole)


def test_a_resumed_run_is_the_run_that_was_never_interrupted(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "parts"
    runs.train(folder, runs.small(max_env_steps=3 * ITERATION, save_interval=3))
    training = runs.small(max_env_steps=9 * ITERATION, save_interval=3)
    resumed = runs.train(folder, training, folder / "model_3.pt")
    check_same_end(folder, whole)
    rates = [group["lr"] for group in read_end(whole)["optimizer_state_dict"]["param_groups"]]
    assert rates == [resumed.alg.learning_rate] * len(rates)


def test_going_back_to_an_older_checkpoint_drops_the_progress_after_it(
    whole: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    training = runs.small(max_env_steps=9 * ITERATION)
    runs.train(folder, training, folder / "model_4.pt")
    check_same_end(folder, whole)


def test_a_resumed_run_settles_as_the_run_that_was_never_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brokk_rl.rl.runner.ITERATIONS_PER_ROUND", 2)
    teacher = Teacher(weight=4.0, until=(1.0, 0.5))
    training = runs.small(max_env_steps=8 * ITERATION, settling=0.8, teacher=teacher)
    whole = runs.train(tmp_path / "run", replace(training, keep_checkpoints=9))
    again = runs.train(tmp_path / "run", training, tmp_path / "run" / "model_5.pt")
    assert same(runs.weights(whole), runs.weights(again))
    desired_kl = pytest.approx(0.01 * (1 - 0.9 * (6 / 8 - 0.2) / 0.8))
    assert whole.alg.desired_kl == again.alg.desired_kl == desired_kl


def test_another_start_of_the_pool_is_not_another_run(tmp_path: Path) -> None:
    """The pool of starts comes from the session's seed, not from what was drawn before it."""
    torch.manual_seed(1)
    first = runs.plant().build(torch.device("cpu"), 4, 32, 5).starts
    torch.manual_seed(2)
    second = runs.plant().build(torch.device("cpu"), 4, 32, 5).starts
    assert same(first, second)
