"""Training: budgets, checkpoints, and what is said when one cannot be written or used."""

from __future__ import annotations

import errno
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import training as runs
from composed import MACHINE, option
from rsl_rl.models import RNNModel

from brokk_rl.errors import (
    CheckpointError,
    ConfigError,
    SimulationError,
    StorageError,
    TrainingError,
)
from brokk_rl.policy_folder import (
    describe_policy,
    find_checkpoint,
    list_checkpoints,
    read_checkpoint,
    write_policy,
)
from brokk_rl.rl.policy import load_initial_weights, make_actor
from brokk_rl.rl.settings import TrainingBudget

ITERATION = 16 * runs.STEPS
"""Control steps of one iteration."""


def test_the_budget_of_steps_ends_training_with_a_whole_iteration(tmp_path: Path) -> None:
    runner = runs.train(tmp_path, runs.small(max_env_steps=4 * ITERATION + 1))
    rows = runs.progress(tmp_path)
    assert [int(float(row["env_steps"])) for row in rows] == [ITERATION * (i + 1) for i in range(5)]
    assert [int(row["iteration"]) for row in rows] == list(range(5))
    assert runner.current_learning_iteration == 5


class Remembering(RNNModel):
    """A recurrent network under a name of its own."""


def test_a_network_with_a_memory_is_refused_before_the_first_step_whatever_its_name(
    tmp_path: Path,
) -> None:
    training = runs.small(max_env_steps=ITERATION)
    actor = training.runner["actor"] | {"class_name": f"{__name__}:Remembering"}
    training = replace(training, runner=training.runner | {"actor": actor})
    with pytest.raises(ConfigError, match="a network with memory"):
        runs.make(tmp_path, training)


def test_the_budget_of_seconds_ends_training(tmp_path: Path) -> None:
    runner = runs.make(tmp_path, runs.small(max_seconds=0.4, save_interval=1000))
    runner.run()
    assert 0.4 <= runner.logger.seconds < 2.0


def test_the_first_budget_that_is_spent_counts() -> None:
    budget = TrainingBudget(max_env_steps=100, max_seconds=10.0)
    spent = [budget.share_spent(*now) for now in ((50, 2.0), (20, 9.0), (100, 0.0))]
    assert spent == [0.5, 0.9, 1.0]
    assert TrainingBudget(max_env_steps=None, max_seconds=10.0).share_spent(10**9, 5.0) == 0.5


def test_training_without_an_end_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_env_steps: expected a bound"):
        TrainingBudget(max_env_steps=None, max_seconds=None)


def test_a_checkpoint_every_save_interval_and_only_the_newest_kept(tmp_path: Path) -> None:
    often = {"save_interval": 2, "keep_checkpoints": 2}
    runs.train(tmp_path, runs.small(max_env_steps=7 * ITERATION, **often))
    assert [path.name for path in list_checkpoints(tmp_path)] == ["model_6.pt", "model_7.pt"]
    assert not list(tmp_path.glob("*.part"))


def test_checkpoints_are_sorted_by_iteration_not_by_name(tmp_path: Path) -> None:
    for iteration in (100, 9, 20):
        zipfile.ZipFile(tmp_path / f"model_{iteration}.pt", "w").close()
    found = [path.name for path in list_checkpoints(tmp_path)]
    assert found == ["model_9.pt", "model_20.pt", "model_100.pt"]
    assert find_checkpoint(str(tmp_path)).name == "model_100.pt"


def test_a_full_disk_leaves_the_older_checkpoint_and_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = runs.train(tmp_path, runs.small(max_env_steps=ITERATION))
    before = (tmp_path / "model_1.pt").read_bytes()

    def fill_disk(path: Path, data: bytes) -> None:
        with path.open("wb") as file:
            file.write(data[:9])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_disk)
    runner.current_learning_iteration += 1
    with pytest.raises(StorageError, match="nothing was left behind"):
        runner.checkpoint()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model_1.pt", "progress.csv"]
    assert (tmp_path / "model_1.pt").read_bytes() == before
    read_checkpoint(tmp_path / "model_1.pt", "cpu")


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    runs.train(tmp_path / "run", runs.small(max_env_steps=ITERATION))
    return tmp_path / "run" / "model_1.pt"


def loading(checkpoint: Path, **changes: Any) -> None:
    runner = runs.make(checkpoint.parent, runs.small(max_env_steps=ITERATION, **changes))
    runner.load(str(checkpoint))


def test_bytes_that_are_no_checkpoint_are_named_corrupt_and_change_nothing(
    checkpoint: Path,
) -> None:
    progress = checkpoint.with_name("progress.csv")
    before = progress.read_text()
    for content in (checkpoint.read_bytes()[:2000], b"", b"hello", b"\x80\x04]q\x00."):
        checkpoint.write_bytes(content)
        with pytest.raises(CheckpointError, match=r"model_1\.pt is missing or corrupt"):
            loading(checkpoint)
    assert progress.read_text() == before


def test_a_checkpoint_cannot_run_code(checkpoint: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (checkpoint.with_name("trapped"),))

    torch.save({"actor_state_dict": Trap()}, checkpoint)
    with pytest.raises(CheckpointError, match="corrupt: no checkpoint of ours"):
        loading(checkpoint)
    assert not checkpoint.with_name("trapped").exists()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda made: made["actor_state_dict"]["mlp.0.weight"].fill_(torch.inf), r"NaN or infinite weights in mlp\.0\.weight"),
        (lambda made: made.pop("fingerprint"), "another machine: name, joints, limits"),
        (lambda made: made.pop("env"), "does not fit this configuration"),
        (lambda made: made.pop("optimizer_state_dict"), "does not fit this configuration"),
        (lambda made: made.pop("iter"), "does not fit this configuration"),
    ],
)  # fmt: skip
def test_a_checkpoint_with_a_part_spoiled_or_missing_is_refused(
    change: Callable[[dict[str, Any]], Any], told: str, checkpoint: Path
) -> None:
    content = torch.load(checkpoint, weights_only=True)
    change(content)
    torch.save(content, checkpoint)
    with pytest.raises(CheckpointError, match=told):
        loading(checkpoint)


def test_a_checkpoint_of_another_network_or_number_of_environments_is_refused(
    checkpoint: Path,
) -> None:
    wider = runs.small(max_env_steps=1).runner
    wider["actor"]["hidden_dims"] = [32]
    for changes in ({"runner": wider}, {"num_envs": 8}):
        with pytest.raises(CheckpointError, match="does not fit this configuration"):
            loading(checkpoint, **changes)


def test_resuming_where_there_is_no_checkpoint_says_so(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="holds no policy"):
        find_checkpoint(str(tmp_path))
    with pytest.raises(CheckpointError, match="there is no such path"):
        find_checkpoint(str(tmp_path / "model_3.pt"))


def test_too_many_faults_stop_the_run_with_an_error(tmp_path: Path) -> None:
    training = runs.small(max_env_steps=100 * ITERATION, max_fault_rate=0.001)
    runner = runs.make(tmp_path, training)
    step = runner.env.world.step

    def diverges(increment: torch.Tensor) -> None:
        step(increment)
        runner.env.world.q[3] = torch.nan
        runner.env.world.contact_force_n[3] = torch.nan
        runner.env.world.faults[3] = True

    runner.env.world.step = diverges  # type: ignore[method-assign]
    # one of 16 environments in each step: 6.25 %
    with pytest.raises(SimulationError, match=r"6\.25% .* of iteration 0 .*limit 0\.10%"):
        runner.run()


@pytest.mark.parametrize("number", [float("nan"), 1e30])
def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_last_checkpoint(
    number: float, tmp_path: Path
) -> None:
    runner = runs.make(tmp_path, runs.small(max_env_steps=3 * ITERATION))
    step, calls = runner.env.step, [0]

    def spoils(actions: torch.Tensor) -> Any:
        calls[0] += 1
        groups, reward, *rest = step(actions)
        is_spoiled = calls[0] == 2 * runs.STEPS + 1
        return groups, reward + number if is_spoiled else reward, *rest

    runner.env.step = spoils  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match=r"iteration 2: .* for value.*model_2\.pt"):
        runner.run()
    assert [path.name for path in list_checkpoints(tmp_path)] == ["model_1.pt", "model_2.pt"]
    assert len(runs.progress(tmp_path)) == 2


@pytest.mark.parametrize("part", ["actor", "critic"])
def test_a_weight_that_the_last_update_spoils_is_named_and_not_written(
    part: str, tmp_path: Path
) -> None:
    runner = runs.make(tmp_path, runs.small(max_env_steps=ITERATION))
    finish = runner.alg.critic.update_normalization

    def spoils(observations: Any) -> None:
        finish(observations)
        next(getattr(runner.alg, part).parameters()).data.view(-1)[0] = torch.inf

    runner.alg.critic.update_normalization = spoils  # type: ignore[method-assign]
    with pytest.raises(TrainingError, match="weights; there is no checkpoint"):
        runner.run()
    assert not list_checkpoints(tmp_path)


def test_the_divergence_of_updates_falls_to_a_tenth_while_the_policy_settles() -> None:
    training = runs.small(max_env_steps=100, settling=0.5)
    found = [training.divergence(share) for share in (0.0, 0.5, 0.75, 1.0, 1.2)]
    assert found == pytest.approx([0.01, 0.01, 0.0055, 0.001, 0.001])
    assert runs.small(max_env_steps=100, settling=0.0).divergence(0.99) == 0.01
    with pytest.raises(ConfigError, match=r"settling: expected .* 1, got 1.5"):
        runs.small(max_env_steps=100, settling=1.5)


def spread(actor: Any) -> torch.Tensor:
    return actor.distribution.log_std_param


def test_training_that_begins_with_a_policy_has_its_network_and_its_own_exploration(
    tmp_path: Path,
) -> None:
    training = runs.small(max_env_steps=64)
    runner = runs.train(tmp_path / "old", training)
    old = runner.alg.actor
    with torch.no_grad():
        spread(old).fill_(-3.0)  # as one that has settled
    env = runner.env
    network = training.describe_network()
    contract = describe_policy(network, env.task, env.description, MACHINE)
    write_policy(tmp_path / "old", contract, old.state_dict())
    loop = runs.plant().build(runs.CPU, 16, 64, 0)
    actor = make_actor(network, loop.get_observations(), loop.num_actions)
    load_initial_weights(actor, str(tmp_path / "old"), MACHINE)
    groups = loop.get_observations()
    np.testing.assert_array_equal(actor(groups).detach(), old(groups).detach())
    shipped = option("rl", "ppo").runner["actor"]["distribution_cfg"]["init_std"]
    torch.testing.assert_close(spread(actor).exp(), torch.full((5,), shipped))

    network["actor"]["hidden_dims"] = [8]
    other = make_actor(network, loop.get_observations(), loop.num_actions)
    with pytest.raises(CheckpointError, match="policy="):
        load_initial_weights(other, str(tmp_path / "old"), MACHINE)
