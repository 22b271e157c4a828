"""The fit of a servo finds numbers that are known, says how sure they are, and refuses what it cannot fit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from arm import make_machine, run_servo
from composed import MACHINE, option
from conftest import Brokk

from actuators.contracts import FitTask
from actuators.models.servo import Servo
from brokk_rl.errors import BrokkError, ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, make_motion

ARM = make_machine("a", "b")
LOOPS = {
    "slow": {"dead_time_s": 0.1, "response_s": 0.05, "damping": 0.8, "play_rad": 0.03, "sag_rad": 0.02, "sag_slope": 0.05},
    "ringing": {"dead_time_s": 0.0, "response_s": 0.12, "damping": 0.3, "play_rad": 0.06, "sag_rad": 0.0, "sag_slope": -0.1},
}  # fmt: skip
NEAR = {"dead_time_s": 3e-3, "response_s": 3e-3, "damping": 0.02, "play_rad": 2e-3, "sag_rad": 1e-3, "sag_slope": 0.01}  # fmt: skip


def record(servo: Servo, count: int, seconds: float = 16.0) -> list[Recording]:
    """Returns runs under steps and a slow sine in turn, with noise of the encoder."""
    rng, found = np.random.default_rng(0), []
    num = round(seconds / ARM.period_s)
    t = np.arange(num)[:, None]
    for run in range(count):
        steps = np.repeat(rng.uniform(-0.2, 0.2, (num // 25 + 1, ARM.num_joints)), 25, 0)[:num]
        u = np.where((t // 300) % 2 == 1, 0.3 * np.sin(0.02 * t), steps)
        q = run_servo(servo.build(ARM, 1, torch.device("cpu")), ARM, u)
        q = q + 2e-4 * rng.standard_normal(q.shape)
        # A command acts on the position of the row after it.
        motion = make_motion(ARM, "log", ARM.period_s * np.arange(num - 1), u[1:], q[:-1])
        found.append(replace(motion, metadata={"run": str(run)}))
    return found


@pytest.mark.parametrize("name", LOOPS)
def test_known_numbers_are_found_and_an_option_holds_them(
    name: str, tmp_path: Path, brokk: Brokk
) -> None:
    truth = LOOPS[name]
    runs = record(replace(option("actuator", "servo"), **truth), 2)
    fitted = option("fit", "servo").fit(FitTask(ARM, runs, [], tmp_path))
    told = json.loads((tmp_path / "servo.json").read_text())["parameters"]
    for number, value in truth.items():
        for joint in ARM.joint_names:
            assert getattr(fitted, number)[joint] == pytest.approx(value, abs=NEAR[number]), number
            assert 0.0 < told[number][joint]["standard_error"] < 2.0 * NEAR[number]
    done = brokk("mode=diagnose", f"actuator=@{tmp_path}/servo.yaml", "--cfg", "job")
    node = yaml.safe_load(done.out)["actuator"]
    assert node.pop("_target_") == "actuators.models.servo.Servo"
    assert Servo(**node) == fitted


def test_a_joint_that_was_blocked_for_a_while_hardly_moves_the_numbers(tmp_path: Path) -> None:
    runs = record(replace(option("actuator", "servo"), **LOOPS["slow"]), 2)
    blocked = runs[0].q.copy()
    blocked[400:460] = blocked[400]
    runs = [replace(runs[0], q=blocked), *runs[1:]]
    fitted = option("fit", "servo").fit(FitTask(ARM, runs, [], tmp_path))
    assert list(fitted.dead_time_s.values()) == pytest.approx([0.1] * 2, abs=0.005)
    assert list(fitted.response_s.values()) == pytest.approx([0.05] * 2, abs=0.005)


@pytest.mark.parametrize(
    ("machine", "seconds", "error", "told"),
    [
        (MACHINE, 16.0, ConfigError, "a servo follows positions"),
        (ARM, 1.5, RecordingError, "no recording is longer than 2 s"),
        (ARM, 0.0, RecordingError, "joint b is never commanded"),
    ],
)
def test_what_cannot_be_fitted_is_refused(
    machine: Machine, seconds: float, error: type[BrokkError], told: str, tmp_path: Path
) -> None:
    runs = record(option("actuator", "servo"), 1, seconds or 4.0)
    if not seconds:
        runs = [replace(runs[0], u=runs[0].u * np.float32([1.0, 0.0]))]
    with pytest.raises(error, match=told):
        option("fit", "servo").fit(FitTask(machine, runs, [], tmp_path))
    assert list(tmp_path.iterdir()) == []
