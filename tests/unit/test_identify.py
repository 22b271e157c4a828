"""From excitation to a fitted model: each step on cases small enough to know the answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from axis import PLANT, driven, make_axis
from motion import make_recording

from actuators import open_loop
from actuators.contracts import FitTask
from actuators.identify import dead_time
from actuators.models.linear import ArxFit, Hold
from brokk_rl.machine import Machine

CPU = torch.device("cpu")


def test_the_dead_time_is_found_to_the_hundredth_where_a_joint_is_commanded(
    machine: Machine,
) -> None:
    axis = make_axis(machine)
    plant = replace(PLANT, dead_time_s=0.43, time_constant_s=0.0)
    runs = driven(axis, 8, 60.0, 0, plant)
    delay = dead_time.estimate_dead_times(runs, axis, np.random.default_rng(0))["q3"]
    assert delay is not None
    assert delay.value_s == pytest.approx(0.43, abs=0.011)
    assert delay.ci95_s[0] - 0.011 <= 0.43 <= delay.ci95_s[1] + 0.011
    assert delay.explained > 0.98
    still = [replace(run, u=np.zeros_like(run.u)) for run in runs]
    assert dead_time.estimate_dead_times(still, axis, np.random.default_rng(0)) == {"q3": None}


def test_a_linear_machine_is_learned_by_the_linear_model(machine: Machine, tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    u = generator.uniform(-1.0, 1.0, (400, 5)).astype(np.float32)
    q = np.zeros((400, 5), dtype=np.float32)
    q[:, 1] = -0.7
    for k in range(12, 399):
        q[k + 1] = q[k] + 0.002 * u[k - 11] + 0.3 * (q[k] - q[k - 1])
    run = make_recording(machine, u, q)
    actuator = ArxFit(name="arx", ridge=1e-8).fit(FitTask(machine, [run], [run], tmp_path))
    cut = open_loop.cut_windows([run], machine, 5.0, 1.0)
    error, still = (
        np.abs(open_loop.roll_out(model, machine, cut, CPU) - cut.measured).max()
        for model in (actuator, Hold())
    )
    assert error < 0.02 * still


TINY = (
    "identify.hold_out=3", "fit.one_step_updates=120", "fit.one_step_batch=256", "fit.updates=40", "fit.horizons_s=[0.5]",
    "fit.batch=64", "fit.validate_every=40",
)  # fmt: skip


@pytest.mark.slow
def test_collect_and_identify_from_the_command(
    brokk: Callable[..., Any], tmp_path: Path, machine: Machine
) -> None:
    small = ("collect.run_minutes=1.0", "collect.file_minutes=0.5", "actuator=lag")
    sine = ("session.out=sine", "collect.num_runs=10")
    levels = ("session.out=levels", "excitation=levels", "collect.num_runs=3", "session.seed=1")
    for words in (sine, levels):
        assert brokk("mode=collect", *words, *small).code == 0
    done = brokk(
        "mode=identify", "session.out=fit", "session.device=cpu", "identify.recordings=sine/recordings/*",
        "identify.test=levels/recordings/*", *TINY,
    )  # fmt: skip
    assert done.code == 0, done.err
    result = json.loads(Path("fit/identification.json").read_text())
    for rows in result["joints"].values():
        assert rows["mlp"]["5"]["rmse"] < rows["hold"]["5"]["rmse"]
        assert set(rows["arx"]) == {"1", "2", "5", "10"}
    # With the lag of 0.1 s.
    assert result["delay_s"]["q1"]["value"] == pytest.approx(0.55 + 0.1, abs=0.06)
    assert Path("fit/prediction.png").stat().st_size > 1000
