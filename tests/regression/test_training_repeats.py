"""Training on a CPU repeats bit for bit, also across an interruption."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import training as runs
from composed import option

from brokk_rl.machine import Machine

ITERATION = 16 * runs.STEPS


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(value, b[name]) for name, value in a.items())


def test_the_same_seed_trains_the_same_weights(machine: Machine, tmp_path: Path) -> None:
    first, second = (
        runs.train(machine, tmp_path / name, runs.small(max_env_steps=6 * ITERATION))
        for name in "ab"
    )
    assert same(runs.weights(first), runs.weights(second))
    assert (
        runs.progress(tmp_path / "a") == runs.progress(tmp_path / "b")
        and len(runs.progress(tmp_path / "a")) == 6
    )


@pytest.mark.parametrize("save_interval", [1, 3])
def test_a_resumed_run_is_the_run_that_was_never_interrupted(
    save_interval: int, machine: Machine, tmp_path: Path
) -> None:
    whole = runs.train(
        machine,
        tmp_path / "whole",
        runs.small(max_env_steps=9 * ITERATION, save_interval=save_interval),
    )
    runs.train(
        machine,
        tmp_path / "parts",
        runs.small(max_env_steps=3 * ITERATION, save_interval=save_interval),
    )
    checkpoint = tmp_path / "parts" / "model_3.pt"
    resumed = runs.train(
        machine,
        tmp_path / "parts",
        runs.small(max_env_steps=9 * ITERATION, save_interval=save_interval),
        checkpoint,
    )
    assert same(runs.weights(whole), runs.weights(resumed))
    assert runs.progress(tmp_path / "whole") == runs.progress(tmp_path / "parts")
    assert whole.alg.learning_rate == resumed.alg.learning_rate
    ends = [
        torch.load(tmp_path / name / "model_9.pt", weights_only=True) for name in ("whole", "parts")
    ]
    assert same(ends[0]["env"]["tensors"], ends[1]["env"]["tensors"]) and same(
        ends[0]["random"], ends[1]["random"]
    )
    state = [end["optimizer_state_dict"]["state"] for end in ends]
    assert all(same(state[0][key], state[1][key]) for key in state[0])


def test_a_resumed_run_settles_as_the_run_that_was_never_interrupted(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brokk_rl.rl.runner.ITERATIONS_PER_ROUND", 2)
    training = runs.small(max_env_steps=8 * ITERATION, settling=0.8)
    whole = runs.train(machine, tmp_path / "run", replace(training, keep_checkpoints=9))
    again = runs.train(machine, tmp_path / "run", training, tmp_path / "run" / "model_5.pt")
    assert same(runs.weights(whole), runs.weights(again))
    assert (
        whole.alg.desired_kl
        == again.alg.desired_kl
        == pytest.approx(0.01 * (1 - 0.9 * (6 / 8 - 0.2) / 0.8))
    )


def test_how_often_a_checkpoint_is_written_does_not_change_training(
    machine: Machine, tmp_path: Path
) -> None:
    often, once = (
        runs.train(
            machine,
            tmp_path / str(interval),
            runs.small(max_env_steps=4 * ITERATION, save_interval=interval),
        )
        for interval in (1, 50)
    )
    assert same(runs.weights(often), runs.weights(once)) and runs.progress(
        tmp_path / "1"
    ) == runs.progress(tmp_path / "50")


def test_going_back_to_an_older_checkpoint_drops_the_progress_after_it(
    machine: Machine, tmp_path: Path
) -> None:
    whole = runs.train(machine, tmp_path / "run", runs.small(max_env_steps=6 * ITERATION))
    before = runs.progress(tmp_path / "run")
    again = runs.train(
        machine,
        tmp_path / "run",
        runs.small(max_env_steps=6 * ITERATION),
        tmp_path / "run" / "model_4.pt",
    )
    assert runs.progress(tmp_path / "run") == before and len(before) == 6
    assert same(runs.weights(whole), runs.weights(again))


def test_another_start_of_the_pool_is_not_another_run(machine: Machine, tmp_path: Path) -> None:
    """The pool of starts comes from the session's seed, not from what was drawn before it."""
    torch.manual_seed(1)
    first = runs.plant(machine).build(torch.device("cpu"), 4, 32, 5).starts
    torch.manual_seed(2)
    second = runs.plant(machine).build(torch.device("cpu"), 4, 32, 5).starts
    assert same(first, second)


@pytest.mark.slow
def test_with_physics_and_the_learned_actuator_too(machine: Machine, tmp_path: Path) -> None:
    native = replace(option("sim", "native"), num_threads=2)
    ends = {}
    for name, budgets in {"whole": (6,), "parts": (3, 6)}.items():
        for iterations in budgets:
            training = runs.small(max_env_steps=iterations * ITERATION)
            torch.manual_seed(0)
            plant = replace(runs.plant(machine, sim=native), actuator=option("actuator", "mlp"))
            loop = plant.build(torch.device("cpu"), 16, 64, 0)
            runner = runs.make(machine, tmp_path / name, training, loop)
            if iterations == 6 and len(budgets) == 2:
                runner.load(str(tmp_path / name / "model_3.pt"))
            runner.run()
            ends[name] = runs.weights(runner)
    assert same(ends["whole"], ends["parts"])
