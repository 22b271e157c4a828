"""Comparing runs: what differs, over seeds, with intervals."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from brokk_rl.errors import ConfigError
from brokk_rl.modes.compare import (
    average_seeds,
    compare_to_baseline,
    find_differences,
    find_runs,
    list_figures,
    load_run,
    tabulate_runs,
)
from brokk_rl.statistics import compute_student_interval, compute_wilson_interval


def write_run(folder: Path, actuator: str, seed: int, strict: float, **more: Any) -> None:
    folder.mkdir(parents=True)
    figures = {
        "episodes": 100, "success_strict": {"mean": strict, "ci95": [0, 1]},
        "success_paper": {"mean": strict / 2, "ci95": [0, 1]}, "time_to_insert_s": {"median": 8.0, "p95": 12.0},
        "lateral_error_m": {"mean": 0.004}, "peak_force_n": 1500.0, "valve_travel": 0.7, "seed": seed,
        "actuator": actuator, "policy": "trained",
    }  # fmt: skip
    record = {
        "seed": seed, "outcome": "finished",
        "choices": {"mode": "train", "actuator": actuator, "session": "default"},
        "overrides": [f"actuator={actuator}", f"session.seed={seed}"],
    }  # fmt: skip
    (folder / "evaluation.json").write_text(json.dumps(figures | more))
    (folder / "session.json").write_text(json.dumps(record))


def average(*folders: Path, columns: list[str] | None = None) -> list[dict[str, Any]]:
    table = tabulate_runs([load_run(folder) for folder in folders], columns or [])
    return average_seeds(table, columns or []).to_dict("records")


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    for index, (actuator, seed, strict) in enumerate(
        (("ideal", 0, 0.2), ("ideal", 1, 0.4), ("mlp", 0, 0.9), ("mlp", 1, 0.9))
    ):
        write_run(tmp_path / "sweep" / f"{index}_{actuator}", actuator, seed, strict)
    return tmp_path / "sweep"


@pytest.mark.parametrize(
    ("successes", "trials"), [(8, 10), (0, 10), (10, 10), (1010, 1024), (1, 1)]
)
def test_wilson_is_that_of_the_books(successes: int, trials: int) -> None:
    # (p + z²/2n ± z √(p (1 - p)/n + z²/4n²)) / (1 + z²/n)
    z, rate = stats.norm.ppf(0.975), successes / trials
    middle = rate + z**2 / (2 * trials)
    half = z * np.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    expected = ((middle - half) / (1 + z**2 / trials), (middle + half) / (1 + z**2 / trials))
    assert compute_wilson_interval(successes, trials) == pytest.approx(expected, abs=1e-12)
    assert compute_wilson_interval(0, 0) == (0.0, 1.0)


def test_student_is_that_of_the_books() -> None:
    # two values 0.2 and 0.4: mean 0.3, standard error 0.1, t(0.975, 1) = 12.706
    expected = (0.3 - 1.2706, 0.3 + 1.2706)
    assert compute_student_interval([0.2, 0.4]) == pytest.approx(expected, abs=1e-4)
    assert compute_student_interval([0.9, 0.9]) == pytest.approx((0.9, 0.9))
    assert compute_student_interval([0.2]) is None


def test_a_task_without_the_figures_of_an_insertion_has_its_own(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    write_run(folder, "ideal", 0, 0.5)
    hover = {"episodes": 10, "success_strict": {"mean": 0.5}, "height_m": 0.2, "actuator": "ideal"}
    (folder / "evaluation.json").write_text(json.dumps(hover))
    assert list_figures(tabulate_runs([load_run(folder)], [])) == ["success_strict", "height_m"]


def test_seeds_become_one_row_with_the_interval_over_them(sweep: Path) -> None:
    ideal, mlp = average(*find_runs([str(sweep)]), columns=["actuator"])
    assert (ideal["actuator"], ideal["seeds"]) == ("ideal", [0, 1])
    assert ideal["success_strict"] == pytest.approx(0.3)
    # a rate: cut off at 0 and 1
    assert (ideal["success_strict_low"], ideal["success_strict_high"]) == (0.0, 1.0)
    assert (mlp["success_strict_low"], mlp["success_strict_high"]) == pytest.approx((0.9, 0.9))
    # two values 1500: mean 1500, no spread
    assert (ideal["peak_force_n"], ideal["peak_force_n_high"]) == (1500.0, 1500.0)


def test_a_single_run_has_the_interval_of_its_episodes(sweep: Path) -> None:
    path = sweep / "2_mlp" / "evaluation.json"
    content = json.loads(path.read_text())
    content["success_strict"]["ci95"] = [0.83, 0.94]
    path.write_text(json.dumps(content))
    (single,) = average(sweep / "2_mlp")
    assert (single["success_strict_low"], single["success_strict_high"]) == (0.83, 0.94)
    assert np.isnan(single["peak_force_n_low"])


def test_every_policy_of_an_evaluation_gets_its_row(tmp_path: Path) -> None:
    figures = {"episodes": 10, "success_strict": {"mean": 0.5}, "success_paper": {"mean": None}}
    figures["time_to_insert_s"] = {"median": None}
    write_run(tmp_path / "run", "mlp", 0, 0.9, policies={"trained": figures, "classical": figures})
    rows = average(tmp_path / "run")
    assert [row["policy"] for row in rows] == ["trained", "classical"]
    assert np.isnan(rows[0]["success_paper"])


def test_an_evaluation_elsewhere_belongs_to_the_run_that_trained(tmp_path: Path) -> None:
    for seed, actuator in ((0, "ideal"), (1, "ideal"), (0, "mlp"), (1, "mlp")):
        trained = tmp_path / f"{actuator}_{seed}"
        write_run(trained, actuator, seed, 0.9)
        (trained / "resolved.yaml").write_text("task: {memory: 13}\n")
        elsewhere = tmp_path / f"{actuator}_{seed}_there"
        write_run(elsewhere, "hydraulic", 0, 0.5 if actuator == "ideal" else 0.7)
        # it was written on another machine; both folders were moved together
        (elsewhere / "resolved.yaml").write_text(f"policy: {{path: /gone/{trained.name}}}\n")
    runs = [load_run(folder) for folder in find_runs([str(tmp_path / "*_there")])]
    columns = find_differences(runs)
    assert columns == ["actuator", "evaluated on"]
    ideal, mlp = average_seeds(tabulate_runs(runs, columns), columns).to_dict("records")
    assert (ideal["actuator"], ideal["evaluated on"]) == ("ideal", "hydraulic")
    assert ideal["seeds"] == [0, 1]
    assert (ideal["success_strict"], mlp["success_strict"]) == (0.5, 0.7)


def test_differences_are_those_of_the_same_seed_and_condition() -> None:
    columns, rows = ["actuator", "evaluated on"], []
    scores = {
        ("lag", "ideal"): {0: 0.5, 1: 0.9},
        ("lag", "mlp"): {0: 0.3},
        ("mlp", "ideal"): {1: 1.0, 0: 0.7, 2: 0.0},
        ("mlp", "mlp"): {0: 0.7},
    }
    for setting, rates in scores.items():
        for seed, rate in rates.items():
            rows.append(["trained", seed, *setting, 100, rate, rate, rate])
    names = ["policy", "seed", *columns, "episodes", "success_strict"]
    table = pd.DataFrame(rows, columns=[*names, "success_strict_low", "success_strict_high"])
    groups = average_seeds(table, columns)
    compared = compare_to_baseline(groups, table, columns, None)
    base, other_base, other, single = compared.to_dict("records")
    assert np.isnan(base["difference"]) and np.isnan(other_base["difference"])
    assert other["by_seed"] == pytest.approx({0: 0.2, 1: 0.1})
    # mean 0.15, standard error 0.05, t(0.975, 1) = 12.706
    bounds = (other["difference_low"], other["difference_high"])
    assert bounds == pytest.approx((0.15 - 0.6353, 0.15 + 0.6353), abs=1e-4)
    assert single["difference"] == pytest.approx(0.4) and np.isnan(single["difference_low"])
    with pytest.raises(ConfigError, match=r"0 rows have them.*'actuator': 'lag'"):
        compare_to_baseline(groups, table, columns, {"actuator": "lagg"})


def test_the_command_compares_with_a_baseline_and_writes_all_figures(
    sweep: Path, brokk: Callable[..., Any], tmp_path: Path
) -> None:
    words = ("mode=compare", f"compare.runs={sweep}", "session.out=compared")
    done = brokk(*words, "compare.baseline={actuator: mlp}")
    assert done.code == 0
    for part in ("ideal", "mlp", "0.3", "strict", "travel", "difference by seed", "-0.600"):
        assert part in done.out
    folder = tmp_path / "compared"
    groups = json.loads((folder / "comparison.json").read_text())["groups"]
    assert [group["runs"] for group in groups] == [2, 2]
    assert groups[0]["by_seed"] == pytest.approx({"0": -0.7, "1": -0.5})
    rows = list(csv.DictReader((folder / "comparison.csv").read_text().splitlines()))
    assert [row["success_strict"] for row in rows] == ["0.2", "0.4", "0.9", "0.9"]
    assert rows[2]["peak_force_n"] == "1500.0"
