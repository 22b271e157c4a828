"""Errors at the tool and noise of sensors, against what was planted or worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, make_motion
from diagnosis.free_runs import WindowedRuns
from diagnosis.sensors import estimate_sensor_noise
from diagnosis.survey import TARGET_COLUMNS, assess_perception, measure_tip_error

ROWS = 1800


@pytest.fixture(scope="module")
def still(machine: Machine) -> Recording:
    """A recording of the machine at its home."""
    q = np.tile(machine.home, (ROWS, 1))
    return make_motion(machine, "still", 0.05 * np.arange(ROWS), np.zeros_like(q), q)


@pytest.fixture(scope="module")
def tip_m(machine: Machine) -> np.ndarray:
    """Its tool point, `(3,)`."""
    pose = Kinematics(machine).pose(torch.tensor(machine.home, dtype=torch.float32))
    return pose.tip_in_base_m.numpy()


def move(still: Recording, error: np.ndarray) -> WindowedRuns:
    """Return free runs of a machine at rest that are off by an error, `(J,)` rad."""
    row = np.arange(40, ROWS - 99, 100)
    simulated = np.tile(still.q[0] + error, (len(row), 100, 1))
    return WindowedRuns([still], np.zeros(len(row), dtype=int), row, simulated)


def test_joints_share_the_tip_error_and_those_that_cancel_count_below_zero(
    machine: Machine, still: Recording, tip_m: np.ndarray
) -> None:
    found = measure_tip_error(move(still, 0.01 * np.eye(5)[0]), machine)
    # The slew moves the tip along its circle: a chord.
    assert found.tip_rms_m == pytest.approx(2.0 * np.sin(0.005) * np.hypot(*tip_m[:2]), rel=1e-3)
    assert found.joint_part["q1"] == pytest.approx(1.0)
    found = measure_tip_error(move(still, np.array([0.0, 0.010, -0.004, 0.0, 0.0])), machine)
    assert sum(found.joint_part.values()) == pytest.approx(1.0)
    assert found.joint_part["q3"] < 0.0 < 1.0 < found.joint_part["q2"]


def test_the_noise_of_a_sensor_is_told_from_its_motion(still: Recording) -> None:
    turn = np.outer(0.1 * np.sin(0.02 * np.arange(ROWS)), np.ones(5))
    sigma = np.array([0.0003, 0.001, 0.002, 0.0005, 0.004])
    noise = sigma * np.random.default_rng(0).standard_normal((ROWS, 5))
    found = estimate_sensor_noise([replace(still, q=still.q + turn + noise)])
    assert found == pytest.approx(sigma, rel=0.15)
    assert estimate_sensor_noise([replace(still, q=still.q + turn)]).max() < 1e-6


def test_touches_are_held_against_the_estimated_hole(
    machine: Machine, still: Recording, tip_m: np.ndarray
) -> None:
    force = np.zeros(ROWS)
    force[[300, 301, 302, 900, 901]] = 1000.0
    target = np.tile(tip_m + np.array([0.03, 0.04, 0.0]), (ROWS, 1))
    extra = dict(zip(TARGET_COLUMNS, target.T, strict=True)) | {"force_n": force}
    found = assess_perception([replace(still, extra=extra)], machine)
    assert found is not None and "2 touches" in found.text
    assert found.rms_m == pytest.approx(0.05, rel=1e-3)
    assert assess_perception([still], machine) is None
