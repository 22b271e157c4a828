"""Joints commanded by torque: the mass against its differential equation, and its numbers from logs of a controller."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from composed import option
from pendulum import run_drive

from actuators.contracts import FitTask
from actuators.recordings.log_signals import Signal
from brokk_rl import record
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.record import Recording
from diagnosis import api
from diagnosis.case import GapCase
from diagnosis.effect_library import load_effects

CPU = torch.device("cpu")
TRUE = {"mass_kg": 60.0, "viscous_n_s_m": 120.0, "coulomb_n": 15.0, "offset_n": 5.0}


DRIVE = option("machine", "emps")
"""A carriage that is commanded by a force."""


def test_friction_holds_a_joint_and_brings_it_to_rest() -> None:
    model: Any = option("actuator", "force", **TRUE | {"offset_n": 0.0}).build(DRIVE, 1, CPU)
    still = run_drive(model, DRIVE, np.full(50, 14.9 / DRIVE.max_force[0]), 0.1)
    np.testing.assert_array_equal(still, np.float32(0.1))
    pushed = run_drive(model, DRIVE, np.r_[np.full(40, 0.3), np.zeros(200)], 0.05)
    assert pushed[40] > 0.051
    assert pushed[-1] == pushed[-2]


def log_controller(seed: int, seconds: float = 20.0) -> Recording:
    """Returns a log of a PD controller at 5 ms on a mass that is solved at 1 ms, friction smooth about 0."""
    rng, steps = np.random.default_rng(seed), round(seconds / DRIVE.period_s)
    rate, phase = rng.uniform(0.5, 3.0, 3), rng.uniform(0.0, 6.0, 3)
    q, v, period_s = 0.12, 0.0, DRIVE.period_s
    found, commands = np.empty(steps), np.empty(steps)
    for k in range(steps):
        angle = rate * k * period_s + phase
        target, speed = 0.12 + 0.025 * np.sin(angle).sum(), 0.025 * (rate * np.cos(angle)).sum()
        found[k] = q
        force = float(np.clip(4e4 * (target - q) + 3e3 * (speed - v), -300.0, 300.0))
        commands[k] = force / DRIVE.max_force[0]
        for _ in range(5):
            friction = TRUE["viscous_n_s_m"] * v + TRUE["coulomb_n"] * np.tanh(v / 1e-3)
            v += 0.001 * (force - friction - TRUE["offset_n"]) / TRUE["mass_kg"]
            q += 0.001 * v
    noise = 1e-6 * rng.standard_normal(steps)
    t_s = period_s * np.arange(steps)
    return record.make_motion(DRIVE, f"{seed}", t_s, commands[:, None], (found + noise)[:, None])


def test_mass_friction_and_offset_are_read_off_a_controllers_log(tmp_path: Path) -> None:
    logs = [log_controller(seed) for seed in range(2)]
    fitted = option("fit", "force").fit(FitTask(DRIVE, logs, [], tmp_path))
    for name, value in TRUE.items():
        assert getattr(fitted, name)["carriage"] == pytest.approx(value, rel=0.05), name
    for name in ("stribeck_n", "motor_load", "outside_load"):
        assert getattr(fitted, name)["carriage"] == pytest.approx(0.0, abs=0.01), name
    assert (tmp_path / "force.yaml").is_file()
    with pytest.raises(RecordingError, match="none of 0 recordings"):
        option("fit", "force").fit(FitTask(DRIVE, [], [], tmp_path))
    still = replace(logs[0], q=np.full_like(logs[0].q, 0.1))
    with pytest.raises(RecordingError, match="carriage never moves"):
        option("fit", "force").fit(FitTask(DRIVE, [still], [], tmp_path))
    with pytest.raises(ConfigError, match="cannot be filtered at a period"):
        option("fit", "force", motion_hz=95.0).fit(FitTask(DRIVE, logs, [], tmp_path))
    assert not GapCase(DRIVE, [], logs).doubts()


CHANGES = {
    "coulomb_friction": {"coulomb_n": TRUE["coulomb_n"]},
    "viscous_friction": {"viscous_n_s_m": TRUE["viscous_n_s_m"]},
    "force_offset": {"offset_n": TRUE["offset_n"]},
    "inertia": {"factor": TRUE["mass_kg"] / 80.0},
}


def test_effects_on_a_drive_are_its_mass_and_friction() -> None:
    u = 0.3 * np.sin(np.arange(150) / 12.0)
    whole = run_drive(option("actuator", "force", **TRUE).build(DRIVE, 1, CPU), DRIVE, u, 0.1)
    model: Any = option("actuator", "force", mass_kg=80.0).build(DRIVE, 1, CPU)
    for kind in load_effects(DRIVE, list(CHANGES)):
        model = kind.wrap(model, DRIVE, 1, CPU)
        for name, value in CHANGES[kind.name].items():
            model.parameters[name].fill_(value)
    np.testing.assert_allclose(run_drive(model, DRIVE, u, 0.1), whole, atol=1e-6)


def test_an_effect_on_a_drive_needs_one() -> None:
    with pytest.raises(ConfigError, match="numbers of a drive, and Blind has none"):
        option("effect", "inertia").wrap(Blind(), DRIVE, 1, CPU)


class Blind:
    """A model without numbers of a drive."""

    state: ClassVar = {}


@pytest.mark.slow
def test_a_diagnosis_names_mass_friction_and_offset_of_a_drive(tmp_path: Path) -> None:
    """The log is of a mass solved at 1 ms; the simulator is a mass of 80 kg without friction."""
    logs = api.RecordingSet(tuple(log_controller(seed, 8.0) for seed in range(4)), DRIVE)
    simulator = option("actuator", "force", mass_kg=80.0)
    answer = api.diagnose(logs, tmp_path, simulator=simulator).answer
    assert {one.effect for one in answer.selected} == set(CHANGES)
    for one in answer.selected:
        for name, value in CHANGES[one.effect].items():
            found = one.parameters[name]["carriage"].mean
            assert found == pytest.approx(value, rel=0.05), one.effect


def test_a_force_is_averaged_over_a_period() -> None:
    signal = Signal("", np.arange(0.0, 0.02, 0.001), np.arange(20.0), np.arange(20), "u")
    found = signal.average(np.array([0.0, 0.005, 0.01]), 0.005)
    np.testing.assert_allclose(found, [2.0, 7.0, 12.0])
