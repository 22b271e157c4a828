"""The command, end to end and small: train, evaluate, export, bench, resume, and the same again from `resolved.yaml`."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch

from brokk_rl import cli

pytestmark = pytest.mark.slow

SMALL = (
    "sim.native.num_worlds=16", "actuator=lag", "session.device=cpu", "rl.num_starts=64", "rl.save_interval=2",
    "rl.budget.max_env_steps=1152",
)  # fmt: skip
"""Three iterations of 16 environments."""
FEW = ("evaluation.episodes=8", "evaluation.num_recorded=2", "evaluation.video=false")
FIELDS = {
    "episodes", "success_strict", "success_paper", "time_to_insert_s", "lateral_error_m", "peak_force_n", "valve_travel",
    "terminations", "seed", "actuator", "policy",
}  # fmt: skip
"""Fields of `evaluation.json` that tools outside the project read."""


def command(folder: Path, *arguments: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("sys.argv", ["brokk", *arguments])
        assert cli.main() == 0


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def check_evaluation(found: dict[str, Any], policy: str, episodes: int) -> None:
    assert (
        found.keys() >= FIELDS
        and found["policy"] == policy
        and found["actuator"] == "lag"
        and found["episodes"] == episodes
    )
    for name in ("success_strict", "success_paper"):
        low, high = found[name]["ci95"]
        assert 0 <= low <= found[name]["mean"] <= high <= 1
    assert (
        found["time_to_insert_s"].keys() == {"median", "p95"}
        and sum(found["terminations"].values()) == episodes
    )
    assert all(
        isinstance(found[name], float)
        for name in ("lateral_error_m", "peak_force_n", "valve_travel")
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("train")
    command(folder, "mode=train", "session.out=run", "tracking=tensorboard", *SMALL, *FEW)
    return folder / "run"


def test_training_leaves_all_that_is_needed_to_judge_and_use_the_policy(run: Path) -> None:
    names = {path.name for path in run.iterdir()}
    assert names == {
        "evaluation.json", "golden.json", "learning_curves.png", "model_2.pt", "model_3.pt", "policy.json", "policy.onnx",
        "policy.safetensors", "progress.csv", "resolved.yaml", "session.json", "tensorboard",
    }  # fmt: skip
    assert (run / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
    onnx.checker.check_model(onnx.load(run / "policy.onnx"))
    with (run / "progress.csv").open(newline="") as file:
        assert [float(row["env_steps"]) for row in csv.DictReader(file)] == [384, 768, 1152]


def test_the_trained_policy_is_evaluated_beside_the_classical_one(run: Path) -> None:
    found = read(run / "evaluation.json")
    check_evaluation(found, "trained", 8)
    assert list(found["policies"]) == ["trained", "classical"]
    assert found["policies"]["classical"]["success_strict"]["mean"] >= 0.5
    record = read(run / "session.json")
    assert (
        record["outcome"] == "finished"
        and record["objective"] == found["success_strict"]["mean"]
        and record["seed"] == 0
    )
    assert record["machine"] == "brokk170" and record["choices"]["actuator"] == "lag"


def test_the_resolved_config_runs_again_to_the_same_result(run: Path) -> None:
    command(run.parent, "--config-dir", str(run), "--config-name", "resolved", "session.out=again")
    first, again = (read(folder / "evaluation.json") for folder in (run, run.parent / "again"))
    assert first == again
    weights = [
        torch.load(folder / "model_3.pt", weights_only=True)["actor_state_dict"]
        for folder in (run, run.parent / "again")
    ]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_a_resumed_command_ends_where_an_uninterrupted_one_does(run: Path) -> None:
    arguments = ("mode=train", "session.out=parts", *SMALL, *FEW)
    command(run.parent, *arguments, "rl.budget.max_env_steps=768")
    command(run.parent, *arguments, "policy=parts")
    parts = run.parent / "parts"
    weights = [
        torch.load(folder / "model_3.pt", weights_only=True)["actor_state_dict"]
        for folder in (run, parts)
    ]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
    assert (
        read(parts / "evaluation.json") == read(run / "evaluation.json")
        and len(read(parts / "session.json")["resumed"]) == 1
    )


def test_evaluating_the_policy_again_gives_the_same_figures(run: Path) -> None:
    command(
        run.parent,
        "mode=evaluate",
        f"policy={run}",
        "session.out=evaluation",
        "actuator=lag",
        "session.device=cpu",
        *FEW,
    )
    found = read(run.parent / "evaluation" / "evaluation.json")
    check_evaluation(found, "trained", 8)
    first = read(run / "evaluation.json")["policies"]
    assert found["policies"] == {name: first[name] for name in ("trained", "classical")}


def test_exporting_a_checkpoint_makes_the_same_policy(run: Path) -> None:
    command(run.parent, "mode=export", f"policy={run}", "session.out=export")
    made = run.parent / "export"
    assert {path.name for path in made.iterdir()} == {
        "golden.json", "policy.json", "policy.onnx", "policy.safetensors", "resolved.yaml",
        "session.json", "shapes.json",
    }  # fmt: skip
    assert (made / "policy.safetensors").read_bytes() == (run / "policy.safetensors").read_bytes()
    assert read(made / "policy.json")["observation"] == read(run / "policy.json")["observation"]
    assert read(made / "policy.json")["parity"]["largest_difference"] < 1e-3


def test_bench_measures_physics_control_step_and_training(run: Path) -> None:
    sizes = ("bench.num_envs=[8,16]", "bench.seconds=0.05", "bench.iterations=1")
    command(
        run.parent,
        "mode=bench",
        "session.out=bench",
        "actuator=lag",
        "session.device=cpu",
        "rl.num_starts=32",
        *sizes,
    )
    found = read(run.parent / "bench" / "benchmark.json")
    rates = ("physics_env_steps_per_s", "env_steps_per_s", "train_env_steps_per_s")
    assert (
        found["num_envs"] == 16
        and found["graph"] is False
        and found["device"].startswith("cpu")
        and "torch" in found["versions"]
    )
    assert [row["num_envs"] for row in found["rows"]] == [8, 16]
    assert all(row[name] > 0 for row in found["rows"] for name in rates) and all(
        found[name] == found["rows"][-1][name] for name in rates
    )
    assert (
        found["physics_env_steps_per_s"] > found["env_steps_per_s"] > found["train_env_steps_per_s"]
    )
