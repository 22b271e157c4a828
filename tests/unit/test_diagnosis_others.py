"""What free runs do not show: sensors by their scatter, frames by hidden delays, geometry by measured tool points."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from actuators.models.lag import FirstOrderLag
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import baseline, effect_library, geometry, sensors, timing
from diagnosis.answer import Estimate
from diagnosis.case import GapCase
from diagnosis.effect_library import DetectedEffect, estimate_interval
from diagnosis.residuals import Residuals, build_rays
from diagnosis.responses import Response, fit_sizes

CPU = torch.device("cpu")
PLANT = FirstOrderLag(
    dead_time_s=0.3,
    dead_band_extend=0.05,
    dead_band_retract=0.05,
    gain=1.0,
    time_constant_s=0.1,
    spread={},
)


def swept(machine: Machine, seconds: float, seed: int, noise: float = 3e-4) -> Recording:
    """Returns a recording in which all joints move to and fro at steady speeds and rest in between."""
    random, count = np.random.default_rng(seed), round(seconds / machine.period_s)
    q, u = np.zeros((count, machine.num_joints)), np.zeros((count, machine.num_joints))
    for j, speed in enumerate(machine.max_speed):
        level, at = 0.0, machine.home[j]
        for t in range(count):
            if t % 40 == 0:
                middle = (machine.lower[j] + machine.upper[j]) / 2
                level = (
                    0.0
                    if random.random() < 0.3
                    else -np.sign(at - middle + 0.2 * random.standard_normal())
                )
            u[t, j], q[t, j] = 0.5 * level, at
            at += 0.5 * level * speed * machine.period_s
    q += noise * random.standard_normal(q.shape)
    return Recording(
        machine=machine.name, joints=machine.joint_names, units=("rad",) * 5, rate_hz=20.0, t_s=np.arange(count) * 0.05,
        u=u.astype(np.float32), q=q.astype(np.float32), metadata={"run": f"{seed}"},
    )  # fmt: skip


def test_a_coarse_sensor_and_a_noisy_one_are_told_apart_with_their_sizes(machine: Machine) -> None:
    reference, field = [swept(machine, 100.0, seed) for seed in (0, 1, 2)], swept(machine, 100.0, 3)
    q = field.q.copy()
    q[:, 1] += 1.5e-3 * np.random.default_rng(4).standard_normal(len(q))
    q[:, 3] = np.round(q[:, 3] / 0.004) * 0.004
    found = sensors.find_sensor_effects(
        GapCase(machine, reference, [dataclasses.replace(field, q=q)]),
        effect_library.load_effects(machine),
        8.0,
        12.0,
    )
    names = {one.kind.name: one for one in found}
    assert names.keys() == {"sensor_noise", "quantisation"}
    assert names["sensor_noise"].joints.tolist() == [False, True, False, False, False]
    assert names["sensor_noise"].parameters["sigma_rad"]["q2"].mean == pytest.approx(
        1.5e-3, rel=0.15
    )
    assert names["quantisation"].parameters["step_rad"]["q4"].mean == pytest.approx(0.004, rel=0.15)
    assert not sensors.find_sensor_effects(
        GapCase(machine, reference, [field]), effect_library.load_effects(machine), 8.0, 12.0
    )


def tracked(
    recording: Recording, machine: Machine, bias: np.ndarray, tilt_rad: float, seed: int
) -> Recording:
    """Returns a recording with tool points as measured beside a machine whose encoders show too much and whose base is tilted."""
    tip = (
        Kinematics(machine, CPU)
        .pose(torch.as_tensor(recording.q - bias, dtype=torch.float32))
        .tip_in_base_m.numpy()
    )
    turn = np.array(
        [
            [1, 0, 0],
            [0, np.cos(tilt_rad), -np.sin(tilt_rad)],
            [0, np.sin(tilt_rad), np.cos(tilt_rad)],
        ]
    )
    seen = tip @ turn.T + 2e-3 * np.random.default_rng(seed).standard_normal(tip.shape)
    return dataclasses.replace(
        recording, extra=dict(zip(geometry.COLUMNS_TOOL, seen.T, strict=True))
    )


def test_an_encoders_zero_is_told_from_a_tilted_base_by_tool_points(machine: Machine) -> None:
    none, bias = np.zeros(5), np.array([0.0, 0.0, 0.015, 0.0, 0.0])
    reference = tracked(swept(machine, 120.0, 5), machine, none, 0.0, 6)
    kinds = effect_library.load_effects(machine)
    biased, tilted = (
        tracked(swept(machine, 120.0, 7), machine, b, tilt, 8)
        for b, tilt in ((bias, 0.0), (none, 0.03))
    )
    one = geometry.find_geometry_errors(GapCase(machine, [reference], [biased]), kinds, 8.0, 12.0)
    assert [found.kind.name for found in one.found] == ["encoder_bias"] and one.left < 1.2
    assert one.found[0].parameters["bias_rad"]["q3"].mean == pytest.approx(0.015, abs=0.002)
    other = geometry.find_geometry_errors(GapCase(machine, [reference], [tilted]), kinds, 8.0, 12.0)
    assert [found.kind.name for found in other.found] == ["base_tilt"]
    assert other.found[0].parameters["roll_rad"]["machine"].mean == pytest.approx(0.03, abs=0.003)
    assert not geometry.find_geometry_errors(
        GapCase(machine, [reference], [reference]), kinds, 8.0, 12.0
    ).found
    # two milliradians are seen, explained, and not worth a name; nothing else is named in their
    # place
    faint = geometry.find_geometry_errors(
        GapCase(
            machine, [reference], [tracked(swept(machine, 120.0, 7), machine, bias / 7.5, 0.0, 8)]
        ),
        kinds,
        8.0,
        12.0,
    )
    assert not faint.found and faint.left < 1.2


def test_a_tracker_with_a_clock_of_its_own_hides_no_error_of_an_encoder(machine: Machine) -> None:
    none, bias = np.zeros(5), np.array([0.0, 0.0, 0.0, 0.012, 0.0])

    def late(recording: Recording) -> Recording:
        return dataclasses.replace(
            recording,
            extra={
                name: np.concatenate([row[:1], row[:-1]]) for name, row in recording.extra.items()
            },
        )

    reference, field, biased = (
        late(tracked(swept(machine, 120.0, seed), machine, b, 0.0, seed))
        for seed, b in ((5, none), (7, none), (7, bias))
    )
    kinds = effect_library.load_effects(machine)
    one = geometry.find_geometry_errors(GapCase(machine, [reference], [biased]), kinds, 8.0, 12.0)
    assert [found.kind.name for found in one.found] == ["encoder_bias"] and one.left < 1.2
    assert one.found[0].joints.tolist() == [False, False, False, True, False]
    assert one.found[0].parameters["bias_rad"]["q4"].mean == pytest.approx(0.012, abs=0.001)
    # the clock itself is no error of geometry, even where the reference is not late at all
    plain = tracked(swept(machine, 120.0, 5), machine, none, 0.0, 5)
    assert not geometry.find_geometry_errors(
        GapCase(machine, [plain], [field]), kinds, 8.0, 12.0
    ).found


def test_without_measured_tool_points_geometry_says_nothing(machine: Machine) -> None:
    one = swept(machine, 20.0, 9)
    assert geometry.find_geometry_errors(
        GapCase(machine, [one], [one]), effect_library.load_effects(machine), 8.0, 12.0
    ) == geometry.GeometryFindings([], 1.0)


def held_over(
    machine: Machine,
    lost: float,
    seed: int,
    late: tuple[int, ...] = (0,) * 5,
    only: slice = slice(None),
) -> Recording:
    """Returns two minutes of a lag plant under levels to and fro, each lost frame holding the level before for a period more.

    `late`: periods by which all commands of each joint come later still; `only`: joints whose
    commands get lost.
    """
    random = np.random.default_rng(seed)
    levels = random.uniform(0.3, 0.8, (120, 5)) * np.where(np.arange(120) % 2, -1.0, 1.0)[:, None]
    u = np.repeat(levels, 20, 0)
    sent, missing = u.copy(), random.random(len(u)) < lost
    for t in range(1, len(u)):
        sent[t, only] = sent[t - 1, only] if missing[t] else u[t, only]
    sent = np.stack([np.roll(column, by) for column, by in zip(sent.T, late, strict=True)], 1)
    model, size = PLANT.build(machine, 1, CPU), machine.num_history
    known = torch.as_tensor(
        np.concatenate([np.zeros((size - 1, 5)), sent])[None], dtype=torch.float32
    )
    q = torch.as_tensor(machine.home, dtype=torch.float32)[None]
    model.reset(torch.ones(1, dtype=torch.bool))
    path = [q[0].numpy()]
    for t in range(len(u) - 1):
        q = model.step(History(q=q[:, None].repeat(1, size, 1), u=known[:, t : t + size]))
        path.append(q[0].numpy())
    wander = 1.0 + 0.02 * np.repeat(random.standard_normal((len(u) // 40, 5)), 40, 0)
    steps = np.diff(path, axis=0, prepend=path[:1]) * wander
    measured = path[0] + np.cumsum(steps, 0) + 2e-4 * random.standard_normal(u.shape)
    blank = swept(machine, 1.0, 0)
    return dataclasses.replace(
        blank,
        t_s=np.arange(len(u)) * 0.05,
        u=u.astype(np.float32),
        q=measured.astype(np.float32),
        metadata={"run": f"{seed}"},
    )


def test_frames_that_were_lost_are_counted_by_where_joints_end_up(machine: Machine) -> None:
    rows = [held_over(machine, lost, seed) for lost, seed in ((0.0, 10), (0.0, 11), (0.2, 12))]
    held = [baseline.compare_simulator(PLANT, [(one, 0.0)], machine, 0) for one in rows]
    noises = baseline.fit_covariances(held[:2], machine)
    whole, other, lossy = (dataclasses.replace(one.residuals, noise=noises) for one in held)
    kinds = effect_library.load_effects(machine, ["frame_loss", "delay_jitter"])
    changes = timing.CommandChanges(lossy)
    found = timing.detect_timing_effect(changes, lossy.error, [whole, other], kinds, 8.0, 12.0)
    assert found and found.kind.name == "frame_loss" and found.joints.all()
    assert found.parameters["probability"]["q1"].mean == pytest.approx(0.2, abs=0.08)
    assert (
        timing.detect_timing_effect(
            timing.CommandChanges(other), other.error, [whole], kinds, 8.0, 12.0
        )
        is None
    )
    # with their delays taken for chance, errors scatter far less: the rest is that lost frames
    # delay on average too
    chancy = dataclasses.replace(lossy, late=changes.spread(lossy.error))
    before, after = (float(np.mean(np.minimum(one.z**2, 25.0))) for one in (lossy, chancy))
    assert before > 5.0 and after < 0.4 * before
    for j in range(2):
        np.testing.assert_allclose(
            chancy.rewhiten(lossy, lossy.z[j : j + 1], j)[0], chancy.z[j], atol=1e-6
        )


def test_what_one_joint_alone_is_late_by_is_no_lost_frame(machine: Machine) -> None:
    rows = [
        held_over(machine, 0.0, 10),
        held_over(machine, 0.2, 12, only=slice(2, 3)),
        held_over(machine, 0.05, 13),
    ]
    held = [baseline.compare_simulator(PLANT, [(one, 0.0)], machine, 0) for one in rows]
    noises = baseline.fit_covariances(held[:1], machine)
    whole, alone, seldom = (dataclasses.replace(one.residuals, noise=noises) for one in held)
    kinds = effect_library.load_effects(machine, ["frame_loss", "delay_jitter"])
    assert (
        timing.detect_timing_effect(
            timing.CommandChanges(alone), alone.error, [whole], kinds, 4.0, 12.0
        )
        is None
    )
    # a frame carries the commands of all joints: one in twenty that is lost shows in all of them
    found = timing.detect_timing_effect(
        timing.CommandChanges(seldom), seldom.error, [whole], kinds, 4.0, 12.0
    )
    assert found and found.kind.name == "frame_loss"
    low, high = found.parameters["probability"]["q1"].ci95
    assert low < 0.05 < high


def test_delays_err_as_they_do_where_no_frame_is_late() -> None:
    random, error = np.random.default_rng(3), np.full(4000, 0.3)
    found = timing.DelayErrorModel.of(
        [timing.FrameDelays(1.2 * error * random.standard_t(5.0, 4000), error, np.zeros(4000))]
    )
    # A little is what all timing is off by.
    assert found.scale == pytest.approx(1.15, abs=0.11) and found.freedom in (5.0, 7.0)
    seen = timing.FrameDelays(np.repeat([0.0, 1.0], [90, 10]), np.full(100, 0.1), np.zeros(100))
    assert (
        found.gain(seen, np.repeat([0.0, 1.0], [9, 1]))
        > 0.0
        > found.gain(seen, np.repeat([0.0, 1.0], [1, 9]))
    )


def test_delays_beside_their_mean_are_another_common_delay_and_no_lost_frames() -> None:
    random = np.random.default_rng(4)
    usual = timing.DelayErrorModel(scale=1.0, freedom=5.0)
    error, nobody = np.full(500, 0.05), np.zeros(500)
    width = np.hypot(0.05, timing.TIMING_ERROR)
    drawn = np.repeat([-0.1, 0.9], [9, 1])  # a frame in ten comes a period late, less the mean

    # a few sure delays pull the mean to 0.2 periods beside most others: no frame is lost
    wrong = timing.FrameDelays(-0.2 + width * random.standard_t(3.0, 500), error, nobody)
    assert usual.gain(wrong, drawn) > 30.0  # so lost frames seem to be there
    assert usual.gain_by_shift(wrong) > usual.gain(wrong, drawn)

    lost = random.choice(drawn, 500) + width * random.standard_t(5.0, 500)
    lost = timing.FrameDelays(lost - lost.mean(), error, nobody)
    assert usual.gain(lost, drawn) > usual.gain_by_shift(lost) + 100.0

    # where frames arrive in time and the simulator is right, a shift gains next to nothing
    right = timing.FrameDelays(width * random.standard_t(5.0, 500), error, nobody)
    assert 0.0 <= usual.gain_by_shift(right) < 5.0


def test_the_mean_of_delays_by_chance_is_what_all_joints_are_late_by(machine: Machine) -> None:
    rows = [held_over(machine, 0.0, 10), held_over(machine, 0.2, 12, (1, 1, 1, 4, 1))]
    held = [baseline.compare_simulator(PLANT, [(one, 0.0)], machine, 0) for one in rows]
    residuals = dataclasses.replace(
        held[1].residuals, noise=baseline.fit_covariances(held[:1], machine)
    )
    loss, late = effect_library.load_effects(machine, ["frame_loss", "dead_time"])
    (ray,) = build_rays(late)

    def late_s(residuals: Residuals) -> list[float]:
        shapes = [Response(ray.sizes, change) for change in residuals.response(ray)]
        return [
            late.size_on("dead_time_s", 0) * fit_sizes(z, [shape])[0]
            for z, shape in zip(residuals.z, shapes, strict=True)
        ]

    def expected(lost: float) -> list[float]:
        every = {
            "probability": {name: Estimate(lost, (lost, lost)) for name in machine.joint_names}
        }
        found = DetectedEffect(loss, np.ones(5, bool), every, 0.0, 0.0, 0.0, {})
        return late_s(timing.add_mean_delay(residuals, found, []))

    assert late_s(residuals) == pytest.approx([0.05, 0.05, 0.05, 0.2, 0.05], abs=0.012)
    # where half of the frames are lost, these wait a period on average, and may two; what one joint
    # has alone is left
    shared = np.array(expected(0.5))
    assert (np.abs(np.delete(shared, 3)) < 0.02).all() and shared[3] > 0.08
    # one in ten lost does not make all late by a period
    assert expected(0.1) == pytest.approx([0.045, 0.045, 0.045, 0.195, 0.045], abs=0.012)


def test_the_interval_of_a_gaussian_likelihood_is_its_own() -> None:
    sizes = np.geomspace(0.5, 2.0, 25)
    mean, low, high = estimate_interval(sizes, -0.5 * np.square((sizes - 1.0) / 0.1))
    assert (mean, low, high) == pytest.approx((1.0, 0.804, 1.196), abs=0.02)
