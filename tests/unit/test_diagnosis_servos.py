"""Diagnosis of position servos: late frames, faults of their own numbers, noise of readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from composed import option
from servos import DAMPING, RESPONSE_S, record_arm

from brokk_rl.machine import Machine
from diagnosis import baseline, effect_library, timing
from diagnosis.error_covariance import LevelCovariance, compute_loss
from diagnosis.number_faults import list_number_faults
from diagnosis.residuals import Residuals


@pytest.fixture(scope="module")
def arm() -> Machine:
    """An arm of five position servos."""
    return option("machine", "so101")


@pytest.fixture(scope="module")
def held(arm: Machine) -> dict[str, Residuals]:
    """The right servo against recordings without late frames, with lost ones, with late ones."""
    servo = replace(
        option("actuator", "servo"), dead_time_s=0.0, response_s=RESPONSE_S, damping=DAMPING
    )
    kinds = {"whole": (0.0, 0.0), "other": (0.0, 0.0), "lost": (0.2, 0.0), "late": (0.0, 0.045)}
    found = {}
    for seed, (name, (lost, late_s)) in enumerate(kinds.items()):
        rows = [(record_arm(arm, seed, lost, late_s), 0.0)]
        found[name] = baseline.compare_simulator(servo, rows, arm, 0)
    noise = baseline.fit_covariances([found["whole"], found["other"]], arm)
    return {name: replace(one.residuals, noise=noise) for name, one in found.items()}


@pytest.mark.parametrize(
    ("name", "effect", "number", "true"),
    [("lost", "frame_loss", "probability", 0.2), ("late", "delay_jitter", "jitter_s", 0.045)],
)
def test_late_frames_of_servos_are_named_with_their_size(
    arm: Machine, held: dict[str, Residuals], name: str, effect: str, number: str, true: float
) -> None:
    kinds = effect_library.load_effects(arm, ["frame_loss", "delay_jitter"])
    changes, reference = timing.CommandChanges(held[name]), [held["whole"], held["other"]]
    found = timing.detect_timing_effect(changes, held[name].error, reference, kinds, 4.0, 12.0)
    assert found and found.kind.name == effect and found.joints.all()
    assert found.parameters[number]["elbow"].mean == pytest.approx(true, rel=0.35)
    # the mean delay is put into the simulator only as far as errors become likelier
    better = timing.add_mean_delay(held[name], found, [])
    assert compute_loss(better.z) < compute_loss(held[name].z)


def test_what_another_common_delay_gains_counts_against_late_frames(
    arm: Machine, held: dict[str, Residuals], monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = effect_library.load_effects(arm, ["frame_loss", "delay_jitter"])
    changes, reference = timing.CommandChanges(held["lost"]), [held["whole"], held["other"]]
    monkeypatch.setattr(timing.DelayErrorModel, "gain_by_shift", lambda *_: 1e6)
    found = timing.detect_timing_effect(changes, held["lost"].error, reference, kinds, 4.0, 12.0)
    assert found is None


def test_frames_that_arrive_in_time_are_not_called_late(
    arm: Machine, held: dict[str, Residuals]
) -> None:
    kinds = effect_library.load_effects(arm, ["frame_loss", "delay_jitter"])
    other = timing.CommandChanges(held["other"])
    reference = [held["whole"]]
    assert (
        timing.detect_timing_effect(other, held["other"].error, reference, kinds, 4.0, 12.0) is None
    )


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
