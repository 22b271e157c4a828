"""Ideal, lag and the hydraulic plant against numbers worked by hand."""

from __future__ import annotations

import dataclasses
from typing import Any

import motion
import numpy as np
import pytest
import torch
from composed import MACHINE, option
from motion import rest

from actuators.models.hydraulic import Hydraulic
from actuators.models.lag import FirstOrderLag
from brokk_rl.errors import ConfigError
from brokk_rl.history import History

CPU = torch.device("cpu")
ALL = ("ideal", "lag", "hydraulic", "mlp")


def roll(actuator: Any, u: torch.Tensor, q: Any = None) -> torch.Tensor:
    """Returns the positions `(T + 1, N, J)` under the commands `u` `(T, N, J)`, from rest at `q` or at home."""
    return motion.roll(actuator.build(MACHINE, u.shape[1], CPU), MACHINE, u, q)


def held(steps: int, **level: float) -> torch.Tensor:
    """Returns `steps` periods of constant commands for one environment, `(T, 1, J)`, e.g. `held(machine, 20, q3=0.5)`."""
    u = torch.zeros(steps, 1, MACHINE.num_joints)
    for name, value in level.items():
        u[:, 0, MACHINE.joint_names.index(name)] = value
    return u


def lag(**changes: Any) -> FirstOrderLag:
    none = ("dead_time_s", "dead_band_extend", "dead_band_retract", "time_constant_s")
    return FirstOrderLag(**({"gain": 1.0} | dict.fromkeys(none, 0.0) | changes))


def hydraulic(**changes: Any) -> Hydraulic:
    return dataclasses.replace(option("actuator", "hydraulic"), **changes)


def plain_plant(**changes: Any) -> Hydraulic:
    """A plant without load sensitivity, dry friction, overlap, notch and drift: speed is flow, and well damped."""
    none = (
        "overlap_extend", "overlap_retract", "hysteresis", "notch", "load_sensitivity", "coulomb", "breakaway", "leak_hz",
        "thermal_gain",
    )  # fmt: skip
    plain = {"viscous": 0.3, "speed_scale": 1.0, "retract_ratio": 1.0, "flow_share": 0.1}
    return hydraulic(**(dict.fromkeys(none, 0.0) | plain | changes))


def speed(path: torch.Tensor, name: str) -> float:
    """Returns the mean speed of a joint over the last six periods."""
    j = MACHINE.joint_names.index(name)
    return float(path[-1, 0, j] - path[-7, 0, j]) / (6 * MACHINE.period_s)


def find_speed(plant: Any, name: str, **level: float) -> float:
    """Returns the speed of a joint after two seconds of constant commands."""
    return speed(roll(plant, held(40, **level)), name)


def test_ideal_moves_full_speed_times_command() -> None:
    path = roll(option("actuator", "ideal"), held(1, q1=0.5, q4=-1.0))
    # 50 ms at half of 0.4 rad/s, and at full 0.34 rad/s the other way
    np.testing.assert_allclose((path[1] - path[0])[0], [0.010, 0, 0, -0.017, 0], atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_a_joint_stays_at_its_stop(name: str) -> None:
    near = torch.tensor(MACHINE.upper, dtype=torch.float32)[None] - 0.004
    path = roll(option("actuator", name), held(30, q1=1.0), near)
    assert path[-1, 0, 0] == pytest.approx(MACHINE.upper[0], abs=1e-6)


def test_lag_follows_the_analytic_step_response() -> None:
    delay_s, constant_s, level = 0.23, 0.12, 0.6
    model = lag(dead_time_s=delay_s, time_constant_s=constant_s)
    path = roll(model, held(24, q1=level))
    t_s = np.maximum(0.0, 0.05 * np.arange(25) - delay_s)
    expected = 0.4 * level * (t_s - constant_s * (1.0 - np.exp(-t_s / constant_s)))
    np.testing.assert_allclose(path[:, 0, 0], expected, atol=2e-6)


def test_the_machines_dead_time_shifts_by_eleven_periods() -> None:
    path = roll(lag(dead_time_s=None), held(13, q1=1.0))
    np.testing.assert_allclose(path[[11, 12, 13], 0, 0], [0.0, 0.02, 0.04], atol=1e-6)


@pytest.mark.parametrize("dead_time_s", [0.61, 2.0])
def test_a_dead_time_beyond_the_history_is_refused(dead_time_s: float) -> None:
    with pytest.raises(ConfigError, match=r"actuator\.dead_time_s.*num_history"):
        lag(dead_time_s=dead_time_s).build(MACHINE, 1, CPU)


def test_the_plant_starts_to_move_near_the_machines_dead_time() -> None:
    for j, name in enumerate(MACHINE.joint_names):
        path = roll(option("actuator", "hydraulic"), held(20, **{name: 1.0}))
        moved = (path - path[0])[:, 0, j].abs() > 0.002
        assert int(moved.int().argmax()) in (11, 12, 13)  # within 0.55 to 0.65 s


def test_the_plant_reaches_about_the_machines_speed() -> None:
    for name, full in zip(MACHINE.joint_names, MACHINE.max_speed, strict=True):
        found = find_speed(option("actuator", "hydraulic"), name, **{name: 1.0})
        assert found == pytest.approx(full, rel=0.12)


def test_retracting_is_faster_by_the_area_ratio() -> None:
    plant = plain_plant(retract_ratio=1.4)
    out, back = (find_speed(plant, "q3", q3=level) for level in (0.5, -0.5))
    assert back / out == pytest.approx(-1.4, rel=0.01)
    assert out == pytest.approx(0.5 * 0.26, rel=0.01)


def test_twice_the_pumps_flow_halves_the_speeds() -> None:
    plant = plain_plant(flow_share=1.0)
    alone = find_speed(plant, "q3", q3=1.0)
    both = [find_speed(plant, name, q3=1.0, q4=1.0) for name in ("q3", "q4")]
    assert both == pytest.approx([0.5 * alone, 0.5 * 0.34], rel=0.01)


def test_a_command_inside_the_overlap_moves_nothing() -> None:
    plant = hydraulic(leak_hz=0.0)
    path = roll(plant, held(60, q2=0.09, q3=-0.1))
    assert (path[-1] - path[0]).abs().max() < 2e-4
    assert abs(speed(roll(plant, held(60, q2=0.25)), "q2")) > 0.005


def test_lowering_is_faster_than_lifting_under_load() -> None:
    plant = plain_plant(load_sensitivity=1.0, viscous=0.02)
    down, up = (find_speed(plant, "q2", q2=level) for level in (1.0, -1.0))
    assert down > 0.18 > -up > 0.1


def test_a_machine_at_rest_creeps_no_more_than_its_leak() -> None:
    path = roll(option("actuator", "hydraulic"), held(200))
    assert (path[-1] - path[0]).abs().max() < 0.002
    leaking = roll(hydraulic(leak_hz=0.2), held(200))
    assert leaking[-1, 0, 1] - leaking[0, 0, 1] > 0.005  # the boom sinks


def test_oil_warms_with_work_and_speeds_the_machine_up() -> None:
    plant = hydraulic(oil_time_s=2.0, oil_start_c=20.0, thermal_gain=0.002)
    model = plant.build(MACHINE, 1, CPU)
    history = rest(MACHINE)
    history.u[:] = held(13, q1=1.0)[:, 0]
    early = float((model.step(history) - history.q[:, -1])[0, 0])
    steps = [float((model.step(history) - history.q[:, -1])[0, 0]) for _ in range(200)]
    # q1 takes 0.4 of the pump.
    assert model.state["oil_c"].item() == pytest.approx(20.0 + 45.0 * 0.4, abs=0.5)
    assert steps[-1] > early
    assert steps[-1] / steps[40] > 1.005


def test_half_the_time_step_gives_the_same_path() -> None:
    drawn = torch.rand(20, 1, 5, generator=torch.Generator().manual_seed(3))
    u = (2.0 * drawn - 1.0).repeat_interleave(5, 0)
    coarse, fine = (roll(hydraulic(substep_s=step_s), u) for step_s in (0.005, 0.0025))
    assert (coarse - fine).abs().max() < 0.01


@pytest.mark.parametrize(
    ("name", "value"), [("breakaway", 0.01), ("mode_hz", 0.0), ("notch", 1.5), ("substep_s", 0.02)]
)
def test_a_plant_that_makes_no_sense_is_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=name):
        hydraulic(**{name: value}).build(MACHINE, 1, CPU)


@pytest.mark.parametrize("name", ["lag", "hydraulic"])
def test_a_free_run_that_begins_in_motion_goes_on_with_it(name: str) -> None:
    actuator = option("actuator", name)
    levels = np.random.default_rng(0).uniform(-0.5, 0.5, (13, MACHINE.num_joints))
    u = torch.as_tensor(np.repeat(levels, 15, 0), dtype=torch.float32)[:, None]
    path = roll(actuator, u)
    missed, moved = 0.0, 0.0
    for start in range(40, 190, 7):
        rows = slice(start - MACHINE.num_history + 1, start + 1)
        model = actuator.build(MACHINE, 1, CPU)
        seen = History(q=path[rows].transpose(0, 1).clone(), u=u[rows].transpose(0, 1).clone())
        missed += float((model.step(seen) - path[start + 1]).abs().sum())
        moved += float((path[start + 1] - path[start]).abs().sum())
    assert missed < 0.2 * moved
