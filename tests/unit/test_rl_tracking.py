"""Where figures go beside `progress.csv`."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import wandb
from conftest import Brokk
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from brokk_rl.errors import ConfigError
from brokk_rl.rl.logger import TensorBoardTracking, WandbTracking, _find_sweep


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in which wandb keeps its own files."""
    for name in ("WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "home"))


def test_a_run_that_goes_on_has_each_step_once(tmp_path: Path) -> None:
    for process, (first, last) in enumerate([(0, 8), (5, 10)]):
        tracker = TensorBoardTracking().open(tmp_path, {}, first)
        for step in range(first, last):
            tracker.log({"loss/value": float(process)}, step)
        tracker.close()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload().Scalars("loss/value")
    wanted = [(step, float(step >= 5)) for step in range(10)]
    assert [(one.step, one.value) for one in events] == wanted


@pytest.mark.slow
def test_every_job_of_a_process_gets_a_wandb_run_of_its_own(tmp_path: Path) -> None:
    tracking = WandbTracking(project="tests", group=None, tags=("a", "b"), mode="offline")
    folders = [tmp_path / name for name in ("job_0", "job_1")]
    for folder in folders:
        folder.mkdir()
        tracker = tracking.open(folder, {"seed": 0}, 0)
        tracker.log({"loss/value": 1.0}, 0)
        tracker.close()
    found = [list((folder / "wandb").glob("offline-run-*")) for folder in folders]
    assert [len(runs) for runs in found] == [1, 1], "one run a job, in its own run folder"
    assert found[0][0].name != found[1][0].name
    assert all(list(runs[0].glob("run-*.wandb")) for runs in found)
    tracking.open(folders[0], {"seed": 0}, 1).close()
    again = {path.name.rpartition("-")[2] for path in (folders[0] / "wandb").glob("offline-run-*")}
    assert again == {found[0][0].name.rpartition("-")[2]}, "a job that goes on keeps its id"


@pytest.mark.parametrize("mode", ["", "sideways"])
def test_an_environment_that_wandb_refuses_is_explained(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb.teardown()  # it reads the environment once a process
    monkeypatch.setenv("WANDB_MODE", mode)
    tracking = WandbTracking(project="tests", group=None, tags=(), mode="disabled")
    if mode:
        with pytest.raises(ConfigError, match="WANDB_MODE"):
            tracking.open(tmp_path, {}, 0)
    else:
        tracking.open(tmp_path, {}, 0).close()


SMALL = (
    "sim=native", "session.device=cpu", "rl.num_envs=8", "rl.num_starts=32", "rl.budget.max_env_steps=512",
    "evaluation.episodes=4", "evaluation.num_recorded=1", "evaluation.video=false", "session.out=run",
    "task.episode_s=1.0",
)  # fmt: skip


FIELDS = {
    "episodes", "success_strict", "success_paper", "time_to_insert_s", "lateral_error_m", "peak_force_n", "valve_travel",
    "terminations", "seed", "actuator", "policy",
}  # fmt: skip
"""Fields of `evaluation.json` that tools outside the project read."""


@pytest.fixture
def run(brokk: Brokk, tmp_path: Path) -> Callable:
    def train(*words: str) -> Path:
        brokk("mode=train", "effect=[backlash]", *SMALL, *words)
        return tmp_path / "run"

    return train


def test_tensorboard_gets_parts_reward_terms_and_the_evaluation(run: Callable[..., Path]) -> None:
    folder = run("tracking=tensorboard")
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    evaluation = json.loads((folder / "evaluation.json").read_text())
    assert evaluation.keys() >= FIELDS and list(evaluation["policies"]) == ["trained", "classical"]
    (last,) = events.Scalars("evaluation/classical/valve_travel")
    assert last.value == pytest.approx(evaluation["policies"]["classical"]["valve_travel"])
    assert {"config/text_summary", "commit/text_summary"} <= set(events.Tags()["tensors"])
    (text,) = events.Tensors("choices/text_summary")
    assert b"backlash" in text.tensor_proto.string_val[0]
    assert "learning_curves" in events.Tags()["images"]
    tags = events.Tags()["scalars"]
    for name in ("progress", "success", "failure", "command_change", "peak_contact"):
        assert f"episode/reward/{name}" in tags
    # the terms of a reward add up to the return
    with (folder / "progress.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    checked = 0
    for row in rows:
        terms = [value for key, value in row.items() if key.startswith("episode/reward/")]
        assert len(terms) == 5
        assert sum(terms) == pytest.approx(row["episode/return"], abs=1e-4)
        checked += row["episodes"] > 0
    assert checked
    assert "reward/progress" not in (folder / "evaluation.json").read_text()


@pytest.mark.slow
def test_wandb_gets_the_evaluation_before_the_run_closes(
    run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    summaries: list[dict[str, Any]] = []
    configs: list[dict[str, Any]] = []
    kind = wandb.sdk.wandb_run.Run
    finish, init = kind.finish, wandb.init

    def note_summary(run: Any, *rest: Any) -> None:
        summaries.append(dict(run.summary))
        finish(run, *rest)

    def note_config(**given: Any) -> Any:
        configs.append(given)
        return init(**given)

    monkeypatch.setattr(kind, "finish", note_summary)
    monkeypatch.setattr(wandb, "init", note_config)
    folder = run("tracking=wandb")
    evaluation = json.loads((folder / "evaluation.json").read_text())
    (summary,), (given,) = summaries, configs
    assert summary["evaluation/trained/valve_travel"] == pytest.approx(evaluation["valve_travel"])
    assert given["config"]["choices"]["effect"] == "[backlash]"
    assert given["config"]["config"]["rl"]["num_envs"] == 8
    stored = next((folder / "wandb").glob("offline-run-*/run-*.wandb")).read_bytes()
    assert b"policy.onnx" in stored and b"learning_curves" in stored


def test_the_group_of_a_job_is_its_sweep(tmp_path: Path) -> None:
    job = tmp_path / "seeds" / "0_seed-1"
    job.mkdir(parents=True)
    assert _find_sweep(job) is None
    (job.parent / "multirun.yaml").touch()
    assert _find_sweep(job) == "seeds"
