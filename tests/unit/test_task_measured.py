"""`task/noise=measured` is what the benchmark measured, by distance; without it, what was assumed, said aloud."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import pytest
import torch
from composed import option
from hydra.utils import instantiate

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from tasks.noise import MeasuredNoise

AHEAD = torch.tensor([[0.3 + 2.0, 0.45, 1.9], [0.3, 0.45, 1.9 - 3.0]])
"""Targets 2 m and 3 m from the camera."""


def table(path: Path, **changes: Any) -> Path:
    """Writes a table in which 95 % of errors are below 0.5 + 0.3 z^2 mm, twice that in haze; returns its path."""
    rows = []
    for condition, factor in (("clean", 1.0), ("haze", 2.0), ("empty", None)):
        for distance_m in (1.0, 2.0, 3.0, 4.0):
            p95 = None if factor is None else factor * (0.5 + 0.3 * distance_m**2)
            std_m = None if p95 is None else p95 / 2000.0
            rows.append({"perception": "plane_conic", "condition": condition, "distance_m": distance_m, "position_mm_p95": p95,
                         "along_std_m": std_m, "across_std_m": std_m} | changes)  # fmt: skip
    path.write_text(json.dumps(rows))
    return path


def measured(**changes: Any) -> MeasuredNoise:
    return replace(option("task/noise", "measured"), calibration_m=0.0, **changes)


def test_errors_are_those_of_the_table_by_distance(tmp_path: Path) -> None:
    noise = measured(table=str(table(tmp_path / "a.json")), conditions=("clean",), frame_share=0.5)
    # 0.5 + 0.3 * 4 = 1.7 mm and 0.5 + 0.3 * 9 = 3.2 mm are 95 % of the longest
    np.testing.assert_allclose(noise.bias_m(AHEAD), np.array([[1.7], [3.2]]) / 950.0, rtol=1e-5)
    # half of the standard deviation of an axis, 0.85 and 1.6 mm, evenly spread over twice the
    # square root of three
    np.testing.assert_allclose(
        noise.sample_m(AHEAD), np.array([[0.85], [1.6]]) / 1000 * 0.5 * np.sqrt(3), rtol=1e-5
    )
    worst = replace(noise, conditions=("clean", "haze"))
    np.testing.assert_allclose(worst.bias_m(AHEAD), np.array([[3.4], [6.4]]) / 950.0, rtol=1e-5)


def test_the_calibration_of_the_camera_is_part_of_the_bias(tmp_path: Path) -> None:
    # 3 mm in each direction, 5.2 mm in space: 95 % of such errors are shorter than 2.795 * 3 mm
    noise = replace(
        measured(table=str(table(tmp_path / "a.json")), conditions=("clean",)),
        calibration_m=0.003 * np.sqrt(3),
    )
    expected = np.hypot(np.array([[1.7], [3.2]]), 2.795 * 3) / 950.0
    np.testing.assert_allclose(noise.bias_m(AHEAD), expected, rtol=1e-3)


def test_a_law_that_grows_faster_than_the_square_stays_above_zero(tmp_path: Path) -> None:
    path = table(tmp_path / "a.json")
    rows = json.loads(path.read_text())
    for row in rows:
        row["position_mm_p95"] = row["distance_m"] ** 4
    path.write_text(json.dumps(rows))
    noise = measured(table=str(path), conditions=("clean",))
    near = noise.bias_m(torch.tensor([[0.35, 0.45, 1.9]]))
    assert float(near) >= 0.0  # type: ignore[arg-type]


def test_without_a_table_what_was_assumed_is_used_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        noise = measured(table=str(tmp_path / "none.json"))
    assert "there is no file" in caplog.text and "benchmarks/perception/table.py" in caplog.text
    assert (noise.bias_m(AHEAD), noise.sample_m(AHEAD)) == (0.008, 0.005)


def test_tables_that_say_too_little_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="measured at 0 distances under empty"):
        measured(table=str(table(tmp_path / "a.json")), conditions=("empty",))
    with pytest.raises(ConfigError, match="perception=plane_conic was measured at 0 distances"):
        measured(table=str(table(tmp_path / "b.json", perception="paper")))
    (tmp_path / "c.json").write_text("{nothing")
    with pytest.raises(ConfigError, match=r"expected table\.json"):
        measured(table=str(tmp_path / "c.json"))


def test_an_episode_draws_its_bias_by_distance(tmp_path: Path, machine: Machine) -> None:
    noise = measured(
        table=str(table(tmp_path / "a.json")), conditions=("clean",), frame_share=0.0, filter="none"
    )
    torch.manual_seed(0)
    process = replace(option("task", "borehole_insertion"), noise=noise).build(
        machine, 256, torch.device("cpu")
    )
    process.reset(torch.ones(256, dtype=torch.bool), process.starts(256, 0))
    longest = noise.bias_m(process.state["start.target_m"])
    assert longest.max() > 1.1 * longest.min()  # type: ignore[union-attr]
    share = process.state["bias_m"].norm(dim=1, keepdim=True) / longest
    assert (
        share.max() <= 1.001
        and share.max() > 0.95
        and share.min() < 0.05
        and 0.4 < share.mean() < 0.6
    )


def test_the_option_is_chosen_by_name() -> None:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose(
            "config", ["mode=train", "task/noise=measured", "task.noise.table=nowhere.json"]
        )
    assert isinstance(instantiate(cfg.task.noise, _convert_="all"), MeasuredNoise)
