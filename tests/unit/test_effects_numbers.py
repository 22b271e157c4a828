"""Each effect does what its definition says, on numbers worked by hand; full speed of q1 is 0.4 rad/s, 0.02 rad a period."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import motion
import numpy as np
import pytest
import torch
from composed import MACHINE, option

from actuators.effects.composition import ActuatorWithEffects
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine

CPU = torch.device("cpu")
FULL = 0.02


class Probe:
    """An actuator that moves at once, and remembers what it was shown."""

    def __init__(self, machine: Machine) -> None:
        self.state: dict[str, torch.Tensor] = {}
        self.seen: list[float] = []
        self._step = torch.as_tensor(machine.max_speed * machine.period_s, dtype=torch.float32)

    def reset(self, mask: torch.Tensor) -> None:
        pass

    def step(self, history: History) -> torch.Tensor:
        self.history = history
        self.seen.append(history.u[0, -1, 0].item())
        return history.q[:, -1] + history.u[:, -1] * self._step


class Glide(Probe):
    """Keeps half of the increment that it sees in the history, as a learned model might."""

    def step(self, history: History) -> torch.Tensor:
        went = history.q[:, -1] - history.q[:, -2]
        return history.q[:, -1] + 0.5 * (went + history.u[:, -1] * self._step)


def wrapped(name: str, num: int = 1, inner: Any = None, **numbers: Any) -> Any:
    return replace(option("effect", name), **numbers).wrap(
        inner or Probe(MACHINE), MACHINE, num, CPU
    )


def roll(
    model: Any, levels: list[float], joints: tuple[int, ...] = (0,), num: int = 1, at: Any = None
) -> torch.Tensor:
    """Returns positions `(T + 1, N, J)` from rest at home, or `at`, with the same levels for all of `joints`."""
    u = torch.zeros(len(levels), num, MACHINE.num_joints)
    u[:, :, list(joints)] = torch.tensor(levels, dtype=torch.float32)[:, None, None]
    return motion.roll(model, MACHINE, u, at)


def steps(model: Any, levels: list[float]) -> list[float]:
    """Returns the increments of q1."""
    return roll(model, levels)[:, 0, 0].diff().tolist()


def seen(name: str, levels: list[float], **numbers: Any) -> list[float]:
    """Returns the commands that q1 of the inner model has seen last in each period."""
    model = wrapped(name, **numbers)
    roll(model, levels)
    return model.inner.seen


@pytest.mark.parametrize(
    ("name", "numbers", "levels", "expected"),
    [
        # 75 ms are one and a half periods: nothing, then half a period of full speed, then all of it
        ("dead_time", {"dead_time_s": 0.075}, [1, 1, 1, 0, 0, 0], [0, 0.5, 1, 1, 0.5, 0]),
        # (0.55 - 0.1) / 0.9 and (0.6 - 0.2) / 0.8
        ("dead_band", {"extend": 0.1, "retract": 0.2}, [1, 0.55, 0.1, 0, -0.2, -0.6, -1], [1, 0.5, 0, 0, 0, -0.5, -1]),
        ("saturation", {"level": 0.7}, [1, 0.6, -0.8, -1], [0.7, 0.6, -0.7, -0.7]),
        # a full stroke in 0.2 s is a quarter a period
        ("rate_limit", {"stroke_s": 0.2}, [1, 1, 0.6, 0.6, -1], [0.25, 0.5, 0.6, 0.6, 0.35]),
        # a reversal is a new start
        ("stiction", {"start": 0.15, "stop": 0.05}, [0.1, 0.2, 0.1, 0.06, 0.05, 0.1, -0.1, -0.16, 0.1],
         [0, 0.2, 0.1, 0.06, 0, 0, 0, -0.16, 0]),
        ("flow_gain", {"gain": 0.8}, [1, 0.5, -1], [0.8, 0.4, -0.8]),
        ("asymmetry", {"extend_gain": 1.0, "retract_gain": 1.5}, [1, -1], [1, -1.5]),
        # a play of 1.5 periods, half of it open at rest: 0.75 lost, then 1.5 at each reversal
        ("backlash", {"gap_rad": 0.03}, [1, 1, -1, -1, -1, 0, 1, 1], [0.25, 1, 0, -0.5, -1, 0, 0, 0.5]),
    ],
)  # fmt: skip
def test_the_joint_moves_by_so_much_of_full_speed(
    name: str, numbers: dict[str, float], levels: list[float], expected: list[float]
) -> None:
    got = steps(wrapped(name, **numbers), levels)
    assert got == pytest.approx(FULL * np.array(expected), abs=1e-6)


def build_late_model() -> Any:
    """Returns a joint that follows its command after 0.55 s."""
    sharp = {"dead_band_extend": 0.0, "dead_band_retract": 0.0, "time_constant_s": 0.0}
    return replace(option("actuator", "lag"), dead_time_s=0.55, **sharp).build(MACHINE, 1, CPU)


def test_dead_time_adds_to_that_of_the_model_beyond_the_history() -> None:
    model = wrapped("dead_time", inner=build_late_model(), dead_time_s=0.5)
    path = roll(model, [1.0] + [0.0] * 24)[:, 0, 0]
    # 1.05 s are 21 periods, more than the 13 samples of the history
    np.testing.assert_allclose(path[[21, 22, 25]], [0, FULL, FULL], atol=1e-6)


@pytest.mark.parametrize(("offset_s", "first"), [(0.1, 13), (0.0, 11), (-0.1, 9)])
def test_clock_offset_goes_both_ways(offset_s: float, first: int) -> None:
    inner = build_late_model()
    model = wrapped("clock_offset", inner=inner, offset_s=offset_s)
    path = roll(model, [1.0] * 20)[:, 0, 0]
    np.testing.assert_allclose(path[[first, first + 1]], [0, FULL], atol=1e-6)


def test_delay_jitter_never_goes_back_in_time() -> None:
    ramp = [k / 200 for k in range(200)]
    got = np.array(seen("delay_jitter", ramp, jitter_s=0.2))
    late = (np.array(ramp) - got)[4:] * 200  # in periods
    assert (np.diff(got) > -1e-6).all()
    assert late.min() >= -1e-4 and late.max() <= 4.0 + 1e-4 and late.max() > 2.5
    assert late.std() > 0.5


def test_delay_jitter_within_a_period_is_uniform() -> None:
    model = wrapped("delay_jitter", num=4000, jitter_s=0.04)
    path = roll(model, [1.0], num=4000)[1, :, :1] / FULL  # 1 - delay in periods
    assert path.min() >= 0.2 - 1e-6 and path.max() <= 1.0
    assert path.mean().item() == pytest.approx(0.6, abs=0.02)
    assert path.std().item() == pytest.approx(0.8 / math.sqrt(12), rel=0.05)


def test_frame_loss_holds_the_command_for_all_joints_at_once() -> None:
    num = 4000
    model = wrapped("frame_loss", num=num, probability=0.25)
    path = roll(model, [0.4, 0.8], joints=(0, 4), num=num)
    q1, q5 = (
        path[:, :, j].diff(dim=0) / torch.as_tensor(MACHINE.max_speed * 0.05)[j] for j in (0, 4)
    )
    torch.testing.assert_close(q1.float(), q5.float(), rtol=0, atol=1e-4)
    first, second = q1
    assert (first.abs() < 1e-4).float().mean().item() == pytest.approx(0.25, abs=0.03)
    assert ((second - 0.8).abs() < 1e-4).float().mean().item() == pytest.approx(0.75, abs=0.03)
    # Both frames are lost.
    assert (second.abs() < 1e-4).float().mean().item() == pytest.approx(0.0625, abs=0.015)


def test_effects_without_memory_hold_for_the_whole_history() -> None:
    model = wrapped("saturation", level=0.5)
    history = History(
        q=torch.zeros(1, 13, 5), u=torch.linspace(-1, 1, 13)[None, :, None].expand(1, 13, 5)
    )
    model.step(history)
    torch.testing.assert_close(model.inner.history.u, history.u.clamp(-0.5, 0.5))


def test_a_gain_does_not_compound_in_a_model_that_goes_on_from_increments() -> None:
    got = steps(wrapped("flow_gain", inner=Glide(MACHINE), gain=0.8), [1.0] * 20)
    plain = steps(Glide(MACHINE), [1.0] * 20)
    np.testing.assert_allclose(got, 0.8 * np.array(plain), atol=1e-6)
    assert got[-1] == pytest.approx(0.8 * FULL, abs=1e-5)


def test_lag_follows_the_analytic_step_response() -> None:
    path = roll(wrapped("lag", time_constant_s=0.12), [0.5] * 20)[:, 0, 0]
    t_s = 0.05 * np.arange(21)
    np.testing.assert_allclose(path, 0.2 * (t_s - 0.12 * (1 - np.exp(-t_s / 0.12))), atol=2e-6)


def test_backlash_of_a_moving_joint_is_closed() -> None:
    model = wrapped("backlash", gap_rad=0.03)
    q = 0.01 * torch.arange(13.0)[None, :, None].expand(1, 13, 5)
    history = History(q=q, u=torch.ones(1, 13, 5))
    assert (model.step(history) - history.q[:, -1])[0, 0].item() == pytest.approx(FULL, abs=1e-6)


def test_compliance_rings_as_an_oscillator_does() -> None:
    model = wrapped("compliance", ringing_s=0.4, damping=0.1)
    path = roll(model, [1.0] * 40)[:, 0, 0]
    t_s, w = 0.05 * np.arange(41), 2 * np.pi / 0.4
    ringing = w * np.sqrt(1 - 0.01)
    expected = 0.4 * t_s - 0.4 / ringing * np.exp(-0.1 * w * t_s) * np.sin(ringing * t_s)
    np.testing.assert_allclose(path, expected, atol=1e-5)


def test_thermal_drift_follows_running_time() -> None:
    cold = wrapped("thermal_drift", change=0.1, time_s=1.0, elapsed_s=0.0)
    got = np.array(steps(cold, [1.0] * 40))
    t_s = 0.05 * np.arange(40) + 0.025
    np.testing.assert_allclose(got, FULL * (1 + 0.1 * (1 - np.exp(-t_s))), atol=1e-6)
    warm = wrapped("thermal_drift", change=0.1, time_s=1.0, elapsed_s=3600.0)
    assert steps(warm, [1.0])[0] == pytest.approx(1.1 * FULL, abs=1e-6)


Q2_SHARE = (230 * 0.72 + 150 * 2.1 + 110 * 3.2 + 225 * 4.17) * 9.81 / 30_000
"""Weight on q2 of the arm stretched out level, over its yield force: masses times lever arms."""


def test_load_makes_lifting_slower_and_lowering_faster() -> None:
    level = np.zeros(5)
    model = wrapped("load_dependence", sensitivity=0.5)
    down, up = (
        roll(model, [side], joints=(1,), at=level)[-1, 0, 1].item() / 0.009 for side in (1.0, -1.0)
    )
    assert down == pytest.approx(math.sqrt(1 + 0.5 * Q2_SHARE), rel=1e-3) and down > 1.1
    assert up == pytest.approx(-math.sqrt(1 - 0.5 * Q2_SHARE), rel=1e-3)
    # The slew bears no weight.
    assert roll(model, [1.0], at=level)[-1, 0, 0].item() == pytest.approx(FULL, abs=1e-7)


def test_creep_sinks_at_zero_command() -> None:
    path = roll(wrapped("creep", sink_rad_s=0.01), [0.0], at=np.zeros(5))
    assert path[-1, 0, 1].item() == pytest.approx(0.01 * Q2_SHARE * 0.05, rel=1e-3)
    assert path[-1, 0, 0].item() == 0


def test_flow_sharing_slows_joints_in_proportion() -> None:
    demand = {"q3": 0.8, "q4": 0.5, "q5": 0.3, "other": 0.6}
    model = wrapped("flow_sharing", demand=demand, joints=["q3", "q4", "q5"])
    full = torch.as_tensor(MACHINE.max_speed * 0.05, dtype=torch.float32)

    def shares(level: float, *joints: int) -> list[float]:
        path = roll(model, [level], joints=joints)
        return ((path[1] - path[0])[0] / full).tolist()

    assert shares(1.0, 2) == pytest.approx([0, 0, 1, 0, 0], abs=1e-4)
    # 0.8 + 0.5 + 0.3 of the pump: 1 / 1.6; q1 is not on it
    assert shares(1.0, 0, 2, 3, 4) == pytest.approx([1, 0, 0.625, 0.625, 0.625], abs=1e-4)
    # 0.8 of it is enough.
    assert shares(-0.5, 2, 3, 4) == pytest.approx([0, 0, -0.5, -0.5, -0.5], abs=1e-4)


def test_no_effect_goes_through_a_stop() -> None:
    near = MACHINE.home.copy()
    near[0] = MACHINE.upper[0] - 0.01
    for name, numbers in (
        ("flow_gain", {"gain": 3.0}),
        ("lag", {"time_constant_s": 1.0}),
        ("compliance", {"ringing_s": 0.5}),
    ):
        inner = option("actuator", "ideal").build(MACHINE, 1, CPU)
        model = wrapped(name, inner=inner, **numbers)
        path = roll(model, [1.0] * 20 + [0.0] * 20, at=near)
        assert path[:, 0, 0].max() <= MACHINE.upper[0] + 1e-6


def test_quantisation_rounds_to_steps() -> None:
    q = torch.tensor([[0.104, 0.106, -0.104, 0.0, 1.0]])
    got = wrapped("quantisation", step_rad=0.01).measure(q)
    np.testing.assert_allclose(got[0], [0.10, 0.11, -0.10, 0.0, 1.0], atol=1e-6)


def test_sensor_noise_is_white_and_normal() -> None:
    model = wrapped("sensor_noise", num=4000, sigma_rad={"q1": 0.002, "other": 0.001})
    first, second = (model.measure(torch.zeros(4000, 5)) for _ in range(2))
    assert first[:, 0].std().item() == pytest.approx(0.002, rel=0.04)
    assert first[:, 1].std().item() == pytest.approx(0.001, rel=0.04)
    assert abs(first.mean().item()) < 5e-5
    assert (first[:, 0].abs() > 0.00392).float().mean().item() == pytest.approx(0.05, abs=0.012)
    # by draws, by joints, and from one machine to the next
    for other in (second[:, 0], first[:, 1], first[:, 0].roll(1)):
        assert abs(torch.corrcoef(torch.stack((first[:, 0], other)))[0, 1].item()) < 0.06


def test_bias_and_scale_are_taken_back_by_truth() -> None:
    q = torch.linspace(-1.0, 1.0, 5)[None]
    biased = wrapped("encoder_bias", bias_rad=0.01)
    np.testing.assert_allclose(biased.measure(q) - q, np.full((1, 5), 0.01), atol=1e-6)
    model = wrapped("encoder_scale", inner=biased, scale=1.02)
    np.testing.assert_allclose(model.measure(q), 1.02 * (q + 0.01), atol=1e-6)
    torch.testing.assert_close(model.truth(model.measure(q)), q)
    histories = q[:, None].expand(1, 13, 5)
    torch.testing.assert_close(model.truth(1.02 * (histories + 0.01)), histories)


def affected(actuator: str, **effects: Any) -> ActuatorWithEffects:
    specs = {name: replace(option("effect", name), **numbers) for name, numbers in effects.items()}
    return ActuatorWithEffects(actuator=option("actuator", actuator), effects=specs)


def test_a_free_run_with_sensors_stays_in_measured_positions() -> None:
    scaled = affected("ideal", encoder_scale={"scale": 1.1}).build(MACHINE, 1, CPU)
    path = roll(scaled, [1.0] * 3, at=np.full(5, 0.11))
    # the true angle starts at 0.1 and gains 0.02 a period; the encoder shows 1.1 of it
    np.testing.assert_allclose(path[:, 0, 0], [0.11, 0.132, 0.154, 0.176], atol=1e-6)
    coarse = affected("ideal", quantisation={"step_rad": 0.05}).build(MACHINE, 1, CPU)
    path = roll(coarse, [0.3] * 10, at=np.zeros(5))
    # 0.06 in truth: steps too small to see still add up.
    assert path[-1, 0, 0].item() == pytest.approx(0.05)


def test_candidates_run_side_by_side() -> None:
    model = affected("ideal", flow_gain={"gain": 1.0}, encoder_bias={"bias_rad": 0.1}).build(
        MACHINE, 3, CPU
    )
    model.effects["flow_gain"].parameters["gain"][:] = torch.tensor([0.5, 1.0, 2.0])[:, None]
    path = roll(model, [1.0], num=3, at=np.zeros(5))
    np.testing.assert_allclose(path[1, :, 0], [0.01, 0.02, 0.04], atol=1e-6)


def test_a_longer_link_moves_the_tool_along_it() -> None:
    q = torch.zeros(1, 5)  # stretched out level: every link behind q2 points ahead
    tip_m = Kinematics(MACHINE).pose(q).tip_in_base_m
    extra_m = {"q2": 0.01, "q4": -0.02, "q5": 0.005, "other": 0}
    model = wrapped("link_length", extra_m=extra_m)
    np.testing.assert_allclose(model.tool(tip_m, q) - tip_m, [[-0.005, 0, 0]], atol=1e-6)
    q[0, 3] = math.pi / 2  # the third arm and the tool hang down
    np.testing.assert_allclose(model.tool(tip_m, q) - tip_m, [[0.01, 0, 0.015]], atol=1e-6)
    np.testing.assert_allclose(model.misplacement(q), [[0.01, 0, 0.015]], atol=1e-6)


def test_tilt_turns_the_tool_with_the_base() -> None:
    point_m, q = torch.tensor([[3.0, 1.0, 0.5]]), torch.zeros(1, 5)
    nose_down = wrapped("base_tilt", roll_rad=0.0, pitch_rad=0.1).tool(point_m, q)
    cos, sin = math.cos(0.1), math.sin(0.1)
    np.testing.assert_allclose(
        nose_down, [[3 * cos + 0.5 * sin, 1, 0.5 * cos - 3 * sin]], atol=1e-6
    )
    left_up = wrapped("base_tilt", roll_rad=0.1, pitch_rad=0.0).tool(point_m, q)
    np.testing.assert_allclose(left_up, [[3, cos - 0.5 * sin, 0.5 * cos + sin]], atol=1e-6)
    both = wrapped("base_tilt", roll_rad=0.1, pitch_rad=-0.2)
    # The camera stands on the base.
    np.testing.assert_allclose(both.target(both.tool(point_m, q)), point_m, atol=1e-6)


def test_extrinsics_turn_and_displace_what_the_camera_sees() -> None:
    numbers = dict.fromkeys(("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad"), 0.0)
    model = wrapped("extrinsics", **numbers | {"z_m": 0.02, "yaw_rad": 0.1})
    np.testing.assert_allclose(
        model.target(torch.tensor([[2.0, 0.0, 0.7]])),
        [[2 * math.cos(0.1), 2 * math.sin(0.1), 0.72]],
        atol=1e-6,
    )
    tip_m = Kinematics(MACHINE).pose(torch.zeros(1, 5)).tip_in_base_m
    torch.testing.assert_close(model.misplacement(torch.zeros(1, 5)), model.target(tip_m) - tip_m)
