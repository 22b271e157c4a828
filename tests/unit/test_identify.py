"""From excitation to a fitted model: each step on cases small enough to know the answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from axis import PLANT, driven, make_axis
from composed import MACHINE
from motion import make_recording

from actuators import open_loop
from actuators.contracts import FitTask
from actuators.identify import dead_time
from actuators.models.linear import ArxFit, Hold


def test_the_dead_time_is_found_to_the_hundredth_where_a_joint_is_commanded() -> None:
    axis = make_axis(MACHINE)
    plant = replace(PLANT, dead_time_s=0.43, time_constant_s=0.0)
    runs = driven(axis, 8, 60.0, 0, plant)
    delay = dead_time.estimate_dead_times(runs, axis, np.random.default_rng(0))["q3"]
    assert delay.value_s == pytest.approx(0.43, abs=0.011)
    assert delay.ci95_s[0] - 0.011 <= 0.43 <= delay.ci95_s[1] + 0.011
    assert delay.explained > 0.98
    still = [replace(run, u=np.zeros_like(run.u)) for run in runs]
    assert dead_time.estimate_dead_times(still, axis, np.random.default_rng(0)) == {"q3": None}


def test_a_linear_machine_is_learned_by_the_linear_model(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    u = generator.uniform(-1.0, 1.0, (400, 5)).astype(np.float32)
    q = np.zeros((400, 5), dtype=np.float32)
    q[:, 1] = -0.7
    for k in range(12, 399):
        q[k + 1] = q[k] + 0.002 * u[k - 11] + 0.3 * (q[k] - q[k - 1])
    run = make_recording(MACHINE, u, q)
    actuator = ArxFit(name="arx", ridge=1e-8).fit(FitTask(MACHINE, [run], [run], tmp_path))
    cut = open_loop.cut_windows([run], MACHINE, 5.0, 1.0)
    error, still = (
        np.abs(open_loop.roll_out(model, MACHINE, cut, torch.device("cpu")) - cut.measured).max()
        for model in (actuator, Hold())
    )
    assert error < 0.02 * still
