"""A servo whose torque is limited: by hand, against scipy, planned and stepped, and its diagnosis in MuJoCo C."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from arm import make_machine, run_servo
from composed import option
from motion import run_planned, step_through
from scipy.integrate import solve_ivp

from actuators.models.servo import Servo
from brokk_rl.commands import read_targets
from brokk_rl.record import Recording, make_motion
from diagnosis import api

CPU = torch.device("cpu")


ARM = make_machine("shoulder", "elbow")
"""Two position servos at 50 Hz, each with a travel of 3 rad."""


def make_servo(**numbers: Any) -> Servo:
    numbers = {"firmware_damping": 0.0} | numbers
    return replace(option("actuator", "servo"), top_speed=50.0, **numbers)


def limit_torque(model: Any, shortage: float) -> Any:
    """Returns the model with the effect around it."""
    spec = replace(option("effect", "torque_limit"), shortage=shortage)
    return spec.wrap(model, ARM, 1, CPU)


def draw_levels(seed: int, count: int = 12, hold: int = 15) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return np.repeat(generator.uniform(-0.4, 0.4, (count, ARM.num_joints)), hold, 0)


@pytest.mark.parametrize("response_s", [0.0, 0.04])
def test_a_joint_falls_where_the_limit_is_below_its_sag(response_s: float) -> None:
    """It comes to rest at its lower stop; the same joint above that limit keeps its sag."""
    u = np.zeros((150, 2))
    weak = make_servo(response_s=response_s, damping=1.0, sag_rad=0.05, limit_rad=0.04)
    strong = replace(weak, limit_rad=0.06)
    fallen, kept = (run_servo(one.build(ARM, 1, CPU), ARM, u) for one in (weak, strong))
    if response_s == 0.0:
        np.testing.assert_allclose(fallen[-1], ARM.lower, atol=1e-5)
    else:  # 0.01 / (2 * 0.04) rad/s
        np.testing.assert_allclose(fallen[-1] - fallen[-51], -0.125 * 50 * ARM.period_s, rtol=1e-3)
    np.testing.assert_allclose(kept[-1], -0.05, atol=1e-5)


@pytest.mark.parametrize("inside", [0.0, 0.6])
@pytest.mark.parametrize("limit_rad", [0.01, 0.08, None])
@pytest.mark.parametrize(
    ("response_s", "damping"), [(0.03, 0.8), (0.06, 0.4), (0.02, 2.0), (0.05, 1.0)]
)
def test_a_servo_follows_its_differential_equation(
    inside: float, limit_rad: float | None, response_s: float, damping: float
) -> None:
    dead_time_s, sag_rad = 0.03, 0.008
    servo = make_servo(
        dead_time_s=dead_time_s, response_s=response_s, damping=damping, sag_rad=sag_rad, limit_rad=limit_rad,
        firmware_damping=inside,
    )  # fmt: skip
    u = draw_levels(0)
    targets = read_targets(u, ARM)[:, 0]

    def solve(t_s: float, y: np.ndarray) -> list[float]:
        k = max(int(np.floor((t_s - dead_time_s) / ARM.period_s + 1e-9)), 0)
        brake = 2.0 * damping * response_s * y[1]
        pull = targets[min(k, len(u) - 1)] - y[0] - inside * brake
        if limit_rad:
            pull = np.clip(pull, -limit_rad, limit_rad)
        return [y[1], (pull - sag_rad - (1.0 - inside) * brake) / response_s**2]

    t_s = ARM.period_s * np.arange(1, len(u) + 1)
    solved: Any = solve_ivp(
        solve, (0.0, t_s[-1]), [targets[0], 0.0], t_eval=t_s, max_step=1e-3, rtol=1e-6, atol=1e-8
    )
    found = run_servo(servo.build(ARM, 1, CPU), ARM, u)[:, 0]
    assert np.abs(found - targets).max() > (limit_rad or 0.0)  # it is reached
    np.testing.assert_allclose(found, solved.y[0], atol=5e-4)  # of steps by 0.5 rad


def test_the_effect_is_the_limit_of_the_servo() -> None:
    """5 % of a travel of 3 rad over a shortage of 5 is a limit of 0.03 rad; the lower limit counts."""
    servo = make_servo(response_s=0.04, damping=0.8, sag_rad=0.01, firmware_damping=0.5)
    u = draw_levels(3, count=6)
    inside = run_servo(replace(servo, limit_rad=0.03).build(ARM, 1, CPU), ARM, u)
    around = run_servo(limit_torque(servo.build(ARM, 1, CPU), 5.0), ARM, u)
    np.testing.assert_allclose(around, inside, atol=1e-5)
    for own_rad, shortage in ((0.03, 2.0), (0.3, 5.0)):
        both = limit_torque(replace(servo, limit_rad=own_rad).build(ARM, 1, CPU), shortage)
        np.testing.assert_allclose(run_servo(both, ARM, u), inside, atol=1e-5)
    # the damping within is that of the limit that counts
    own = replace(servo, limit_rad=0.03, firmware_damping=0.1)
    both = limit_torque(own.build(ARM, 1, CPU), 2.0)
    np.testing.assert_allclose(
        run_servo(both, ARM, u), run_servo(own.build(ARM, 1, CPU), ARM, u), atol=1e-5
    )
    assert "limit_rad" not in servo.build(ARM, 1, CPU).parameters  # no number to be tuned


def test_a_planned_run_moves_as_its_steps_do() -> None:
    num_envs, size = 4, ARM.num_history
    u = torch.as_tensor(
        np.stack([draw_levels(seed) for seed in range(num_envs)], 1), dtype=torch.float32
    )
    servo = make_servo(dead_time_s=0.03, response_s=0.04, damping=0.5, sag_rad=0.01, play_rad=0.01)

    def build() -> Any:
        model: Any = servo.build(ARM, num_envs, CPU)
        for name, numbers in {"lag": {"time_constant_s": 0.05}, "torque_limit": {"shortage": 5.0}}.items():  # fmt: skip
            model = replace(option("effect", name), **numbers).wrap(model, ARM, num_envs, CPU)
        # An entry may be replaced after the effect was put around the model.
        model.parameters["shortage"] = torch.tensor([0.0, 3.0, 6.0, 9.0])[:, None].expand(-1, 2)
        return model

    q = torch.zeros(len(u) + 1, num_envs, 2)
    with torch.inference_mode():
        stepped = step_through(build(), u, q, size)
        planned = run_planned(build(), u, q, size)
    assert (stepped - planned).abs().max() < 1e-5
    free, limited = stepped[:, 0], stepped[:, 3]
    assert (free - limited).abs().max() > 0.05


def record_limited(seed: int, limit_n_m: float, seconds: float) -> Recording:
    """Returns a motion of two pendulum-like joints in MuJoCo C whose second drive is limited."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 -9.81"/><worldbody>
        <body pos="0 0 0"><joint name="shoulder" axis="0 0 1" damping="1.2" armature="0.03"/>
        <geom type="sphere" size="0.05" mass="0.1" contype="0"/></body>
        <body pos="0 2 0"><joint name="elbow" axis="0 -1 0" damping="1.2" armature="0.02"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.25" contype="0"/></body></worldbody>
        <actuator><position joint="shoulder" kp="30"/>
        <position joint="elbow" kp="30" forcerange="{-limit_n_m} {limit_n_m}"/></actuator></mujoco>"""
    )
    data, generator = mujoco.MjData(model), np.random.default_rng(seed)
    count = round(seconds / ARM.period_s)
    u = np.repeat(generator.uniform(-0.35, 0.35, (count // 30 + 1, 2)), 30, 0)[:count]
    steps = 2.0 * ARM.period_s / 1.5  # targets move by 2 rad/s at most
    for k in range(1, count):
        u[k] = u[k - 1] + np.clip(u[k] - u[k - 1], -steps, steps)
    targets, q = read_targets(u, ARM), np.empty((count, 2))
    data.qpos[:] = targets[0]
    for k in range(count):
        q[k] = data.qpos
        data.ctrl[:] = targets[k]
        mujoco.mj_step(model, data, 10)
    q += 2e-4 * generator.standard_normal(q.shape)
    return make_motion(ARM, f"{seed}", ARM.period_s * np.arange(count), u, q)


@pytest.mark.parametrize("limit_n_m", [1.3, 100.0])
def test_a_withheld_limit_is_named(tmp_path: Any, limit_n_m: float) -> None:
    """The weight of the elbow is 0.37 Nm; a drive without a limit has no gap."""
    reference = api.RecordingSet(tuple(record_limited(seed, 100.0, 60.0) for seed in range(4)), ARM)
    field = api.RecordingSet(
        tuple(record_limited(10 + seed, limit_n_m, 45.0) for seed in range(4)), ARM
    )
    answer = api.diagnose(field, tmp_path / "run", reference=reference, fit="servo").answer
    if limit_n_m > 10.0:
        assert answer.verdict == "none"
        return
    assert [(one.effect, one.joints) for one in answer.selected] == [("torque_limit", ("elbow",))]
    # 5 % of 3 rad at 30 Nm/rad are 4.5 Nm
    shortage = answer.selected[0].parameters["shortage"]["elbow"]
    assert shortage.ci95[0] < 4.5 / limit_n_m < shortage.ci95[1]
    assert shortage.mean == pytest.approx(4.5 / limit_n_m, rel=0.2)
