"""The command, end to end and small: train and bench."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import onnx
import pytest

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
    assert found.keys() >= FIELDS
    assert (found["policy"], found["actuator"], found["episodes"]) == ("trained", "lag", 8)
    for name in ("success_strict", "success_paper"):
        low, high = found[name]["ci95"]
        assert 0 <= low <= found[name]["mean"] <= high <= 1
    assert sum(found["terminations"].values()) == 8
    assert list(found["policies"]) == ["trained", "classical"]
    assert found["policies"]["classical"]["success_strict"]["mean"] >= 0.5
    record = read(run / "session.json")
    assert record["outcome"] == "finished" and record["seed"] == 0
    assert record["objective"] == found["success_strict"]["mean"]


def test_bench_measures_physics_control_step_and_training(tmp_path: Path) -> None:
    sizes = ("bench.num_envs=[8,16]", "bench.seconds=0.05", "bench.iterations=1")
    few = ("actuator=lag", "session.device=cpu", "rl.num_starts=32")
    command(tmp_path, "mode=bench", "session.out=bench", *few, *sizes)
    found = read(tmp_path / "bench" / "benchmark.json")
    rates = [found[f"{name}env_steps_per_s"] for name in ("physics_", "", "train_")]
    assert rates == sorted(rates, reverse=True) and rates[-1] > 0
    assert [row["num_envs"] for row in found["rows"]] == [8, 16]
    assert found["num_envs"] == 16 and found["device"].startswith("cpu")
