"""What free runs do not show: sensors by their scatter, frames by hidden delays, geometry by measured tool points."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE
from motion import make_recording
from scipy.spatial.transform import Rotation

from brokk_rl.kinematics import Kinematics
from brokk_rl.record import Recording
from diagnosis import effect_library, geometry, sensors
from diagnosis.case import GapCase
from diagnosis.effect_library import DetectedEffect
from diagnosis.engine.decide import Decider
from diagnosis.engine.direct import find_lattice
from diagnosis.engine.side import stack_side


def swept(seconds: float, seed: int, noise: float = 3e-4) -> Recording:
    """Returns a recording in which all joints move to and fro at steady speeds and rest in between."""
    random, count = np.random.default_rng(seed), round(seconds / MACHINE.period_s)
    q, u = np.zeros((count, MACHINE.num_joints)), np.zeros((count, MACHINE.num_joints))
    for j, speed in enumerate(MACHINE.max_speed):
        level, at = 0.0, MACHINE.home[j]
        for t in range(count):
            if t % 40 == 0:
                middle = (MACHINE.lower[j] + MACHINE.upper[j]) / 2
                level = 0.0
                if random.random() >= 0.3:
                    level = -np.sign(at - middle + 0.2 * random.standard_normal())
            u[t, j], q[t, j] = 0.5 * level, at
            at += 0.5 * level * speed * MACHINE.period_s
    q += noise * random.standard_normal(q.shape)
    return make_recording(MACHINE, u, q, f"{seed}")


def test_the_noise_of_a_sensor_is_told_from_its_motion() -> None:
    slow = MACHINE.home + np.outer(0.1 * np.sin(0.02 * np.arange(1800)), np.ones(5))
    sigma = np.array([0.0003, 0.001, 0.002, 0.0005, 0.004])
    noise = sigma * np.random.default_rng(0).standard_normal(slow.shape)
    noisy, clean = (make_recording(MACHINE, 0.0 * q, q, "slow") for q in (slow + noise, slow))
    assert sensors.estimate_sensor_noise([noisy]) == pytest.approx(sigma, rel=0.15)
    assert sensors.estimate_sensor_noise([clean]).max() < 1e-6


def test_a_noisy_sensor_is_told_from_a_coarse_one_with_its_size() -> None:
    reference, field = [swept(100.0, seed) for seed in (0, 1, 2)], swept(100.0, 3)
    q = field.q.copy()
    q[:, 1] += 1.5e-3 * np.random.default_rng(4).standard_normal(len(q))
    q[:, 3] = np.round(q[:, 3] / 0.0037) * 0.0037
    kinds = {kind.name: kind for kind in effect_library.load_effects(MACHINE)}
    noise = kinds["sensor_noise"]
    rough = GapCase(MACHINE, reference, [dataclasses.replace(field, q=q)])
    found = sensors.find_sensor_noise(rough, noise)
    assert found and found.joints.tolist() == [False, True, False, False, False]
    assert found.parameters["sigma_rad"]["q2"].mean == pytest.approx(1.5e-3, rel=0.15)
    # What shakes a joint after its command has changed is no noise of its sensor.
    shaken, changes = field.q.copy(), np.flatnonzero(np.diff(field.u[:, 2]))
    late = np.minimum(changes[:, None] + np.arange(15), len(shaken) - 1)
    shaken[late, 2] += 2e-3 * np.random.default_rng(5).standard_normal(late.shape)
    shaking = dataclasses.replace(field, q=shaken)
    assert sensors.find_sensor_noise(GapCase(MACHINE, reference, [shaking]), noise) is None
    assert sensors.find_sensor_noise(GapCase(MACHINE, reference, [field]), noise) is None
    # Noise is told beside the steps of a sensor that is always coarse, though they show in some parts only.
    usual = [swept(100.0, seed, 1e-6) for seed in range(7)]
    for one in usual[2:]:
        one.q[:, 1] = np.round(one.q[:, 1] / 0.004) * 0.004
    usual[-1].q[:, 1] += 0.03 * np.random.default_rng(4).standard_normal(len(usual[-1].q))
    found = sensors.find_sensor_noise(GapCase(MACHINE, usual[:-1], usual[-1:]), noise)
    assert found and found.parameters["sigma_rad"]["q2"].mean == pytest.approx(0.03, rel=0.1)


def tracked(recording: Recording, bias: np.ndarray, tilt_rad: float, seed: int) -> Recording:
    """Returns a recording with tool points as measured beside a machine whose encoders show too much and whose base is tilted."""
    true_q = torch.as_tensor(recording.q - bias, dtype=torch.float32)
    tip = Kinematics(MACHINE, torch.device("cpu")).pose(true_q).tip_in_base_m.numpy()
    turned = Rotation.from_rotvec([tilt_rad, 0.0, 0.0]).apply(tip)
    seen = turned + 2e-3 * np.random.default_rng(seed).standard_normal(tip.shape)
    columns = dict(zip(geometry.TOOL_COLUMNS, seen.T, strict=True))
    return dataclasses.replace(recording, extra=columns)


def find(reference: Recording, field: Recording) -> list[DetectedEffect]:
    """Returns the errors of geometry that a field shows."""
    kinds = effect_library.load_effects(MACHINE)
    return geometry.find_geometry_errors(GapCase(MACHINE, [reference], [field]), kinds)


def test_an_encoders_zero_is_told_from_a_tilted_base_by_tool_points() -> None:
    none, bias = np.zeros(5), np.array([0.0, 0.0, 0.015, 0.0, 0.0])
    reference = tracked(swept(120.0, 5), none, 0.0, 6)
    sound = swept(120.0, 7)
    biased = tracked(sound, bias, 0.0, 8)
    tilted = tracked(sound, none, 0.03, 8)
    one = find(reference, biased)
    assert [found.kind.name for found in one] == ["encoder_bias"]
    assert one[0].parameters["bias_rad"]["q3"].mean == pytest.approx(0.015, abs=0.002)
    other = find(reference, tilted)
    assert [found.kind.name for found in other] == ["base_tilt"]
    assert other[0].parameters["roll_rad"]["machine"].mean == pytest.approx(0.03, abs=0.003)
    # a zero that was wrong before is no change
    assert not find(tracked(swept(120.0, 5), bias, 0.0, 6), biased)
    # two milliradians are seen, explained, and not worth a name; nothing else is named in their
    # place
    assert not find(reference, tracked(sound, bias / 7.5, 0.0, 8))
    # What a tilt and a zero do to a point is more than the sum of both.
    found = find(reference, tracked(sound, 2 * bias, 0.05, 8))
    (roll,) = [one.parameters["roll_rad"]["machine"] for one in found if len(one.parameters) == 2]
    assert roll.ci95[0] <= 0.05 <= roll.ci95[1]
    # A zero leaves a law of geometry, an encoder that loses a tenth of each step forth does not.
    q = biased.q.copy()
    q[:, 3] -= 0.1 * np.cumsum(np.maximum(np.gradient(q[:, 3]), 0.0))
    fields = (biased, dataclasses.replace(biased, q=q))
    cases = [GapCase(MACHINE, [reference], [field]) for field in fields]
    kinds = effect_library.load_effects(MACHINE)
    unmoved, slipping = (geometry.measure_scatter_growth(case, kinds) for case in cases)
    assert slipping > 10.0 and unmoved == pytest.approx(1.0, abs=0.1)


def test_a_tracker_with_a_clock_of_its_own_hides_no_error_of_an_encoder() -> None:
    none, bias = np.zeros(5), np.array([0.0, 0.0, 0.0, 0.012, 0.0])

    def late(recording: Recording) -> Recording:
        columns = {name: np.r_[row[:1], row[:-1]] for name, row in recording.extra.items()}
        return dataclasses.replace(recording, extra=columns)

    reference, field, biased = (
        late(tracked(swept(120.0, seed), b, 0.0, seed))
        for seed, b in ((5, none), (7, none), (7, bias))
    )
    one = find(reference, biased)
    assert [found.kind.name for found in one] == ["encoder_bias"]
    assert one[0].joints.tolist() == [False, False, False, True, False]
    assert one[0].parameters["bias_rad"]["q4"].mean == pytest.approx(0.012, abs=0.001)
    # the clock itself is no error of geometry, even where the reference is not late at all
    plain = tracked(swept(120.0, 5), none, 0.0, 5)
    assert not find(plain, field)


def test_without_measured_tool_points_geometry_says_nothing() -> None:
    one = swept(20.0, 9)
    assert not find(one, one)


def test_a_lattice_that_motion_blurs_in_the_reference_is_no_coarse_sensor() -> None:
    """The reference is brought to another rate, so that only its rests lie on the lattice of its encoder."""
    fine, other = (swept(300.0, seed) for seed in (0, 1))
    shown, field_q = (np.round(one.q / 0.0037) * 0.0037 for one in (fine, other))
    moved = np.abs(np.gradient(shown, axis=0)) > 0.0
    blurred = dataclasses.replace(fine, q=np.where(moved, fine.q, shown))
    field = stack_side([dataclasses.replace(other, q=field_q)], MACHINE)
    assert find_lattice(field, stack_side([fine], MACHINE), 2) > 0.0
    assert find_lattice(field, stack_side([blurred], MACHINE), 2) == 0.0


def test_an_encoder_whose_scale_is_off_is_no_coarser_than_before() -> None:
    sides = []
    for seed, scale in ((0, 1.0), (1, 1.02), (1, 1.0), (1, 0.77)):
        one = swept(300.0, seed)
        fine = dataclasses.replace(one, q=scale * np.round(one.q / 0.0015) * 0.0015)
        sides.append(stack_side([fine], MACHINE))
    reference, scaled, recorded, corrected = sides
    assert find_lattice(scaled, reference, 2) == 0.0
    # Nor does the correction of a scale make it coarser, though its step is another.
    assert any(find_lattice(corrected, reference, j) for j in range(5))
    none = np.zeros(5)
    evidence = SimpleNamespace(reference=reference, field=corrected, noises=none, steps=none)
    decider: Any = SimpleNamespace(recorded=recorded, evidence=evidence)
    assert Decider._find_coarse(decider) == []
