"""Dead time and lag of a joint from a frequency sweep, against responses that were integrated here."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

MEASURE = Path(__file__).resolve().parents[2] / "benchmarks/joints/measure.py"
PERIOD_S, STEPS = 0.02, 20
"""Control period, s, and steps of the integration in each."""


@pytest.fixture(scope="module")
def measure() -> Any:
    """The script, imported by its path: it is in no package."""
    spec = importlib.util.spec_from_file_location("joint_measurement", MEASURE)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def sweep(dead_time_s: float, lag_s: float, play_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Return targets and positions of a joint in a sweep from 0.1 to 2.5 Hz, by Euler's method."""
    t_s, dt_s = PERIOD_S * np.arange(6000), PERIOD_S / STEPS
    octaves = np.log(25.0) / t_s[-1]
    target = 0.1 * np.sin(2.0 * np.pi * 0.1 * np.expm1(octaves * t_s) / octaves)
    late = round(dead_time_s / dt_s)
    fine = np.concatenate([np.zeros(late), np.repeat(target, STEPS)])
    q, reached, held = np.zeros(len(target)), 0.0, 0.0
    for k in range(len(target)):
        q[k] = held
        for command in fine[k * STEPS : (k + 1) * STEPS]:
            reached += (command - reached) * (dt_s / lag_s if lag_s else 1.0)
            held = min(max(held, reached - play_rad / 2), reached + play_rad / 2)
    return target, q


@pytest.mark.parametrize(("dead_time_s", "lag_s"), [(0.06, 0.0), (0.0, 0.06), (0.03, 0.05)])
def test_a_sweep_tells_a_dead_time_from_a_lag(
    measure: Any, dead_time_s: float, lag_s: float
) -> None:
    hz, response = measure.measure_response(*sweep(dead_time_s, lag_s, 0.01), PERIOD_S)
    found = measure.fit_loop(hz, response, 1)
    # A position is read at the end of the period that holds a command: a whole period late behind
    # a dead time, half of one behind a lag much longer than a period.
    held_s = PERIOD_S / 2 if lag_s else PERIOD_S
    assert found["dead_time_s"] == pytest.approx(dead_time_s + held_s, abs=0.004)
    assert found["lag_s"] == pytest.approx(lag_s, abs=0.003)


def test_a_dead_time_alone_does_not_explain_an_amplitude_that_falls(measure: Any) -> None:
    hz, response = measure.measure_response(*sweep(0.03, 0.05, 0.01), PERIOD_S)
    alone, both = (measure.fit_loop(hz, response, order) for order in (0, 1))
    # At 1.95 Hz the gain of a lag of 0.05 s is 1 / sqrt(1 + 0.61^2) = 0.85.
    assert np.abs(response[-1] / response[0]) == pytest.approx(0.85 / 0.98, abs=0.02)
    assert alone["misfit"] > 2.0 * both["misfit"]
    assert "lag_s" not in alone
