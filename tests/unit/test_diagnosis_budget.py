"""Noise of sensors, against what was planted."""

from __future__ import annotations

import numpy as np
import pytest

from brokk_rl.machine import Machine
from brokk_rl.record import Recording, make_motion
from diagnosis.sensors import estimate_sensor_noise

ROWS = 1800


def record(machine: Machine, q: np.ndarray) -> Recording:
    return make_motion(machine, "slow", 0.05 * np.arange(ROWS), np.zeros_like(q), q)


def test_the_noise_of_a_sensor_is_told_from_its_motion(machine: Machine) -> None:
    slow = machine.home + np.outer(0.1 * np.sin(0.02 * np.arange(ROWS)), np.ones(5))
    sigma = np.array([0.0003, 0.001, 0.002, 0.0005, 0.004])
    noise = sigma * np.random.default_rng(0).standard_normal((ROWS, 5))
    found = estimate_sensor_noise([record(machine, slow + noise)])
    assert found == pytest.approx(sigma, rel=0.15)
    assert estimate_sensor_noise([record(machine, slow)]).max() < 1e-6
