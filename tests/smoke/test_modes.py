"""The bench by its command, end to end and small."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Brokk

pytestmark = pytest.mark.slow


def test_bench_measures_physics_control_step_and_training(brokk: Brokk, tmp_path: Path) -> None:
    sizes = ("bench.num_envs=[8,16]", "bench.seconds=0.05", "bench.iterations=1")
    few = ("actuator=lag", "session.device=cpu", "rl.num_starts=32")
    brokk("mode=bench", "session.out=bench", *few, *sizes)
    found = json.loads((tmp_path / "bench" / "benchmark.json").read_text())
    rates = [found[f"{name}env_steps_per_s"] for name in ("physics_", "", "train_")]
    assert rates == sorted(rates, reverse=True) and rates[-1] > 0
    assert [row["num_envs"] for row in found["rows"]] == [8, 16]
    assert found["num_envs"] == 16 and found["device"].startswith("cpu")
