"""Diagnosis of position servos: faults of their own numbers, noise of readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from composed import option

from brokk_rl.machine import Machine
from diagnosis.error_covariance import LevelCovariance
from diagnosis.number_faults import list_number_faults


@pytest.fixture(scope="module")
def arm() -> Machine:
    """An arm of five position servos."""
    return option("machine", "so101")


def test_an_angle_is_off_by_a_thousandth_of_the_travel(arm: Machine) -> None:
    play, sag, damping, response_s = list_number_faults(
        ["play_rad", "sag_rad", "damping", "response_s"], arm
    )
    assert play[0] == pytest.approx(0.0016) and sag == pytest.approx(play)  # from -0.8 to 0.8 rad
    assert damping == pytest.approx([0.01] * 5)
    # the longer of 0.02 / 0.05 (period) and 0.1 / 0.55 (dead time) of the reference's 4 ms
    assert response_s == pytest.approx([0.0016] * 5)


def test_noise_of_readings_is_noise_of_the_held_position() -> None:
    generator = np.random.default_rng(5)
    noise = LevelCovariance(0.001, 0.0, 0.0, 4.0, 0.003, 0.002, 10)
    still = np.zeros((1, 10))
    np.testing.assert_allclose(noise.strayed(still), 0.001**2 + 0.002**2 + 0.003**2)
    quiet = replace(noise, reading=0.0)
    level = np.linalg.cholesky(quiet.level_covariance(still)[0]) @ generator.standard_normal(
        (10, 4000)
    )
    read = level + 0.003 * generator.standard_normal(level.shape)
    z = noise.whitener(still)[0] @ np.diff(read, axis=0, prepend=0.0)
    assert z.std() == pytest.approx(1.0, abs=0.02)
