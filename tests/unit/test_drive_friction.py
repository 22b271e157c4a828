"""Friction of drives under load: worked numbers, MuJoCo C, and the fit that reads them off a log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pendulum
import pytest
import torch
from composed import option
from pendulum import run_drive

from actuators.contracts import FitTask
from actuators.models.friction import LOADS, compute_dry_friction
from diagnosis import api

CPU = torch.device("cpu")
BAM = {
    "friction_base": 0.15, "friction_stribeck": 0.2, "dtheta_stribeck": 0.3, "alpha": 1.0,
    "load_friction_motor": 0.2, "load_friction_external": 0.05,
}  # fmt: skip
"""A servo with every term of M5 but those at rest, by the names of BAM's files."""
TRUE = {
    "mass_kg": pendulum.INERTIA, "viscous_n_s_m": 0.08, "coulomb_n": 0.15, "offset_n": pendulum.WEIGHT_NM,
    "pose_cos_n": pendulum.WEIGHT_NM, "stribeck_n": 0.2, "stribeck_m_s": 0.3, "motor_load": 0.2, "outside_load": 0.05,
}  # fmt: skip
"""The same by ours. The arm is level in the middle of its travel."""


ARM = pendulum.make_pendulum()


@pytest.mark.parametrize(
    ("numbers", "motor", "outside", "speed", "expected"),
    [
        ({}, 3.0, 1.0, 0.0, 0.5),
        ({"stribeck_n": 0.4}, 3.0, 1.0, 0.2, 0.5 + 0.4 * np.exp(-1.0)),
        ({"stribeck_n": 0.4, "stribeck_power": 2.0}, 3.0, 1.0, 0.4, 0.5 + 0.4 * np.exp(-4.0)),
        ({"motor_load": 0.1, "outside_load": 0.1}, 3.0, 1.0, 9.0, 0.5 + 0.1 * 4.0),
        ({"motor_load": 0.1, "outside_load": 0.3}, 3.0, -1.0, 9.0, 0.5),
        ({"motor_load_at_rest": 0.1, "outside_load_at_rest": 0.2}, 3.0, 1.0, 0.0, 0.5 + 0.5),
        # of the larger load: 0.1 * 2^2 / 2
        ({"outside_load_square": 0.1, "motor_load_square": 7.0}, 3.0, 2.0, 0.0, 0.5 + 0.2),
        ({"outside_load_square": 7.0, "motor_load_square": 0.1}, 2.0, 3.0, 0.0, 0.5 + 0.2),
        ({"outside_load_square": 7.0, "motor_load_square": 7.0}, 2.0, -3.0, 0.0, 0.5),
    ],
)
def test_friction_under_load_is_that_of_the_paper(
    numbers: dict[str, float], motor: float, outside: float, speed: float, expected: float
) -> None:
    """M1 to M6 by hand: a Stribeck speed of 0.2, 2 N at full command; both loads positive push against each other."""
    value = {"coulomb_n": 0.5, "stribeck_n": 0.0, "stribeck_m_s": 0.2, "stribeck_power": 1.0}
    value |= dict.fromkeys(LOADS, 0.0) | numbers
    tensors = {name: torch.tensor(one) for name, one in value.items()}
    found = compute_dry_friction(tensors, *map(torch.tensor, (speed, motor, outside, 2.0)))
    assert float(found) == pytest.approx(expected)


def test_a_drive_under_load_moves_like_a_pendulum_of_mujoco() -> None:
    """Torques given beforehand, in the sense of the motion and against it; MuJoCo has a fifth of the period."""
    u = 0.2 + 0.2 * np.sin(np.arange(400) / 20.0)
    model: Any = option("actuator", "force", dead_time_s=0.0, **TRUE).build(ARM, 1, CPU)
    found = run_drive(model, ARM, u, -0.4)
    plant = pendulum.build_model(damping=TRUE["viscous_n_s_m"])
    data, budget, expected = mujoco.MjData(plant), pendulum.compute_bam_friction(BAM), []
    data.qpos[0] = -0.4
    for command in u:
        data.ctrl[0] = torque = float(command * ARM.max_force[0])
        for _ in range(5):
            outside = -pendulum.WEIGHT_NM * float(np.cos(data.qpos[0]))
            plant.dof_frictionloss[0] = budget(torque, outside, float(data.qvel[0]))
            mujoco.mj_step(plant, data)
        expected.append(float(data.qpos[0]))
    np.testing.assert_allclose(found, expected, atol=0.04)
    model = option("actuator", "force", dead_time_s=0.0, **{**TRUE, "motor_load": 0.0})
    without = run_drive(model.build(ARM, 1, CPU), ARM, u, -0.4)
    assert np.abs(without - expected).max() > 0.5, "the load makes the difference"


@pytest.mark.parametrize("load", [0.0, 0.1])
def test_a_fit_tells_friction_under_load_from_friction_without(tmp_path: Path, load: float) -> None:
    """Logs of a controller in MuJoCo C; the arm's weight follows the cosine of its angle."""
    loads = {"load_friction_motor": load, "load_friction_external": load}
    budget = pendulum.compute_bam_friction({**BAM, **loads, "friction_stribeck": 0.0})
    logs = [pendulum.log_pendulum(ARM, budget, 0.08, seed, 10.0) for seed in range(2)]
    fitted = option("fit", "force").fit(FitTask(ARM, logs, [], tmp_path))
    for name in ("mass_kg", "viscous_n_s_m", "offset_n", "pose_cos_n"):
        assert getattr(fitted, name)["arm"] == pytest.approx(TRUE[name], rel=0.05), name
    assert fitted.coulomb_n["arm"] == pytest.approx(TRUE["coulomb_n"], rel=0.1)
    assert fitted.stribeck_n["arm"] == pytest.approx(0.0, abs=0.01)
    assert fitted.motor_load["arm"] == pytest.approx(load, abs=0.005)
    assert fitted.outside_load["arm"] == pytest.approx(load, abs=0.005)
    fitted.build(ARM, 1, CPU)


def test_a_fit_recovers_the_whole_of_m5(tmp_path: Path) -> None:
    budget = pendulum.compute_bam_friction(BAM)
    logs = [pendulum.log_pendulum(ARM, budget, 0.08, seed, 15.0) for seed in range(3)]
    fitted = option("fit", "force").fit(FitTask(ARM, logs, [], tmp_path))
    for name, value in TRUE.items():
        assert getattr(fitted, name)["arm"] == pytest.approx(value, rel=0.05), name


def test_effects_of_friction_are_numbers_of_the_drive() -> None:
    """A drive with the effects around it and one with their numbers move alike, to the last bit."""
    u = 0.25 + 0.1 * np.sin(np.arange(100) / 22.0)
    plain = {name: TRUE[name] for name in ("mass_kg", "viscous_n_s_m", "coulomb_n", "offset_n")}
    drive = replace(option("actuator", "force", **plain), stribeck_m_s=TRUE["stribeck_m_s"])
    model: Any = drive.build(ARM, 1, CPU)
    model = option("effect", "stribeck_friction", stribeck_n=0.2).wrap(model, ARM, 1, CPU)
    load = option("effect", "load_friction", motor_load=0.2, outside_load=0.05)
    model = load.wrap(model, ARM, 1, CPU)
    model = option("effect", "pose_force", pose_sin_n=0.0, pose_cos_n=1.5).wrap(model, ARM, 1, CPU)
    whole = option("actuator", "force", **TRUE).build(ARM, 1, CPU)
    np.testing.assert_array_equal(run_drive(model, ARM, u, -0.4), run_drive(whole, ARM, u, -0.4))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "friction"),
    [
        ("stribeck_friction", {"friction_stribeck": 0.2}),
        ("load_friction", {"load_friction_motor": 0.1, "load_friction_external": 0.1}),
    ],
)
def test_a_diagnosis_names_what_a_drive_lacks(
    tmp_path: Path, effect: str, friction: dict[str, float]
) -> None:
    without = {"friction_stribeck": 0.0, "load_friction_motor": 0.0, "load_friction_external": 0.0}
    budget = pendulum.compute_bam_friction({**BAM, **without, **friction})
    logs = tuple(pendulum.log_pendulum(ARM, budget, 0.08, seed, 8.0) for seed in range(5))
    known = {**TRUE, "stribeck_n": 0.0, "motor_load": 0.0, "outside_load": 0.0}
    simulator = option("actuator", "force", **known)
    answer = api.diagnose(api.RecordingSet(logs, ARM), tmp_path, simulator=simulator).answer
    assert effect in {one.effect for one in answer.selected}
