"""The DC motor against MuJoCo's own, and against numbers worked by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pendulum
import pytest
import torch
from composed import option

CPU = torch.device("cpu")
SUPPLY_V, OHM, CONSTANT, GEAR, ROTOR = 12.0, 2.0, 0.02, 100.0, 2e-6
"""A motor of 12 V that stalls at 12 Nm behind its gear, and turns at 6 rad/s without a load."""
DRIVE = f'<dcmotor joint="arm" gear="{GEAR}" resistance="{OHM}" motorconst="{CONSTANT}"/>'
LOAD = {
    "mass_kg": pendulum.INERTIA,
    "offset_n": pendulum.WEIGHT_NM,
    "pose_cos_n": pendulum.WEIGHT_NM,
}
STALL_NM, NO_LOAD = CONSTANT * GEAR * SUPPLY_V / OHM, SUPPLY_V / (CONSTANT * GEAR)


def build(**changes: Any) -> tuple[Any, Any]:
    """Returns the machine and its model."""
    machine = pendulum.make_pendulum(STALL_NM)
    numbers = {"no_load_m_s": NO_LOAD, "force_limit_n": None, "supply_share": 0.0, **changes}
    load = replace(option("actuator", "force"), dead_time_s=0.0, **numbers.pop("load", {}))
    spec = replace(option("actuator", "dc_motor"), **numbers)
    return machine, replace(spec, load=load).build(machine, 1, CPU)


def test_a_motor_lifts_a_pendulum_as_that_of_mujoco() -> None:
    """Twelve volts through a duty; both have back EMF, gear and rotor, MuJoCo by its own element."""
    plant = pendulum.build_model(damping=0.05, drive=DRIVE)
    plant.dof_frictionloss[0] = 0.1
    plant.dof_armature[0] += ROTOR * GEAR**2
    mass_kg = pendulum.INERTIA + ROTOR * GEAR**2
    load = {**LOAD, "mass_kg": mass_kg, "viscous_n_s_m": 0.05, "coulomb_n": 0.1}
    machine, model = build(load=load)
    u = 0.2 + 0.4 * np.sin(np.arange(300) / 15.0)
    found = pendulum.run_drive(model, machine, u, -0.4)
    data, expected = mujoco.MjData(plant), []
    data.qpos[0] = -0.4
    for duty in u:
        data.ctrl[0] = duty * SUPPLY_V
        mujoco.mj_step(plant, data, 5)
        expected.append(float(data.qpos[0]))
    assert np.ptp(expected) > 0.5 and np.abs(expected).max() < 1.4, "within the travel"
    np.testing.assert_allclose(found, expected, atol=0.01)


def test_a_motor_reaches_its_no_load_speed_and_no_more() -> None:
    machine, model = build(load={"mass_kg": 0.01})
    path = pendulum.run_drive(model, machine, np.full(60, 0.5), -1.5)
    speed = np.diff(path)[-5:] / machine.period_s
    np.testing.assert_allclose(speed, 0.5 * NO_LOAD, rtol=1e-3)


def test_a_current_limit_bounds_the_force() -> None:
    """A mass of 1 kg m² under 3 Nm turns by half the square of the time, times 3."""
    machine, model = build(load={"mass_kg": 1.0}, force_limit_n=3.0)
    path = pendulum.run_drive(model, machine, np.ones(40), -1.0)
    time_s = machine.period_s * np.arange(1, 41)
    np.testing.assert_allclose(path, -1.0 + 1.5 * np.square(time_s), atol=1e-4)


def test_a_supply_sags_under_a_motor_that_stalls() -> None:
    """A supply of a quarter of the winding's resistance keeps 4/5 of its voltage; at rest all of it."""
    _, model = build(supply_share=0.25)
    still = torch.zeros(1, 1)
    full = model.motor.compute_stall(torch.ones(1, 1), still)
    assert float(full) == pytest.approx(0.8 * STALL_NM)
    free = model.motor.compute_stall(torch.ones(1, 1), torch.full((1, 1), NO_LOAD))
    assert float(free) == pytest.approx(STALL_NM), "without a current nothing sags"
