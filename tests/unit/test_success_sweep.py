"""Time to success: when a level counts as passed, and a sweep that goes on after a stop."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import training as runs

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.rl.benchmark_sizes import SuccessSweep
from brokk_rl.rl.logger import find_passing
from brokk_rl.rl.runner import TrainingGroup
from brokk_rl.rl.success_sweep import TABLE, report_sweep, run_sweep, summarise
from brokk_rl.session import Session

SWEEP = SuccessSweep(
    num_envs=(8, 16), epochs=(1, 2), mini_batches=(2,), seeds=(3,), max_seconds=0.2
)


def rows(*pairs: tuple[int, float]) -> list[dict[str, float]]:
    return [
        {"episodes": count, "episode/success_strict": success, "seconds": float(index)}
        for index, (count, success) in enumerate(pairs)
    ]


def test_a_level_is_passed_by_the_newest_episodes_and_not_by_few_of_them() -> None:
    # newest 20 episodes: 0.5, then 0.75 twice, then 1
    found = rows((10, 0.0), (10, 1.0), (10, 0.5), (10, 1.0), (10, 1.0))
    assert find_passing(found, 0.7, window=20)["seconds"] == 2.0
    assert find_passing(found, 0.95, window=20)["seconds"] == 4.0
    assert find_passing(found[:4], 0.95, window=20) is None
    assert find_passing(rows((19, 1.0)), 0.95, window=20) is None
    # the first episodes to end are the short ones, and those succeed
    early = rows((20, 1.0), (10, 0.5), (10, 0.5), (20, 1.0))
    for number, row in enumerate(early, 1):
        row["env_steps"] = 100.0 * number
    assert find_passing(early, 0.95, window=20)["seconds"] == 0.0
    assert find_passing(early, 0.95, after=100, window=20)["seconds"] == 3.0
    # an iteration without an episode repeats older figures, which count for nothing
    assert find_passing(rows((10, 0.0), (0, 1.0), (10, 0.0)), 0.5, window=20) is None


def test_a_sweep_trains_each_point_once_and_goes_on(machine: Machine, tmp_path: Path) -> None:
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    training = runs.small(max_env_steps=1)
    built: list[int] = []

    def build(num_envs: int) -> Any:
        built.append(num_envs)
        return runs.plant(machine).build(runs.CPU, num_envs, 64, 0)

    with TrainingGroup(runs.CPU) as group:
        found = run_sweep(SWEEP, training, session, group, build)
        assert built == [8, 16]
        points = [(row["num_envs"], row["epochs"], row["seed"]) for row in found]
        assert points == [(8, 1, 3), (8, 2, 3), (16, 1, 3), (16, 2, 3)]
        assert all(row["seconds"] >= 0.2 and row["env_steps"] > 0 for row in found)
        assert all(row["seconds_to_0.95"] is None for row in found)
        lines = (tmp_path / TABLE).read_text().splitlines()
        (tmp_path / TABLE).write_text("\n".join(lines[:3]) + "\n")
        again = run_sweep(SWEEP, training, session, group, build)
        assert built == [8, 16, 16] and again[:3] == found[:3]
        with pytest.raises(ConfigError, match=r"max_seconds: expected 0\.2"):
            run_sweep(replace(SWEEP, max_seconds=9.0), training, session, group, build)
    assert not list(tmp_path.glob("*/model_*.pt"))


def test_the_report_holds_medians_of_the_seeds_that_passed(tmp_path: Path) -> None:
    point = {"num_envs": 8, "epochs": 1, "mini_batches": 2, "seconds": 20.0, "env_steps": 4000}
    found = [
        point | {"seed": 0, "seconds_to_0.95": 4.0, "seconds_to_0.99": None},
        point | {"seed": 1, "seconds_to_0.95": 6.0, "seconds_to_0.99": 18.0},
        point | {"seed": 2, "seconds_to_0.95": 5.0, "seconds_to_0.99": None},
    ]
    (line,) = summarise(found)
    assert line["seconds_to_0.95"] == 5.0 and line["passed_0.99"] == 1
    assert line["seconds_to_0.99"] is None and line["env_steps_per_s"] == 200
    report_sweep(found, tmp_path, {"device": "test"})
    assert json.loads((tmp_path / "success_sweep.json").read_text())["sizes"] == [line]
    assert (tmp_path / "success_sweep.png").stat().st_size > 5000


@pytest.mark.parametrize("change", [{"epochs": ()}, {"num_envs": (0,)}, {"seeds": ()}])
def test_sizes_that_train_nothing_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=rf"bench\.success\.{next(iter(change))}"):
        replace(SWEEP, **change)
