"""Joints commanded by position: the servo against its differential equation, effects on targets, the whole way of a command."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from arm import run_servo
from composed import MACHINE, option
from motion import roll

from actuators.excite.player import NominalLink
from brokk_rl.checks import check_actuator_model
from brokk_rl.commands import (
    SpeedProgram,
    accept_speeds,
    find_rest,
    read_targets,
    scale_targets,
    view_speeds,
)
from brokk_rl.errors import ConfigError
from brokk_rl.signals import Command
from diagnosis.effect_library import load_effects

CPU = torch.device("cpu")


ARM = option("machine", "so101")
"""An arm of five position servos."""


@pytest.mark.parametrize("factor", [0.4, 1.6])
def test_another_damping_is_that_of_the_servo_it_acts_on(factor: float) -> None:
    servo = replace(option("actuator", "servo"), damping=0.8, response_s=0.06, top_speed=50.0)
    spec = replace(option("effect", "damping"), joints=["pitch"], factor=factor)
    around = spec.wrap(servo.build(ARM, 1, CPU), ARM, 1, CPU)
    inside = replace(servo, damping={"pitch": 0.8 * factor, "other": 0.8}).build(ARM, 1, CPU)
    u = np.repeat([[-0.5] * ARM.num_joints, [0.5] * ARM.num_joints], [5, 35], 0)
    found, expected = (run_servo(one, ARM, u) for one in (around, inside))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_an_ideal_servo_is_at_its_target_after_a_period() -> None:
    u = np.random.default_rng(0).uniform(-0.1, 0.1, (30, ARM.num_joints)).cumsum(0).clip(-1, 1)
    found = run_servo(
        replace(option("actuator", "servo"), top_speed=50.0).build(ARM, 1, CPU), ARM, u
    )
    np.testing.assert_allclose(found, read_targets(u, ARM), atol=1e-6)


def test_play_and_sag_hold_the_joint_beside_its_target() -> None:
    servo = replace(option("actuator", "servo"), play_rad=0.02, sag_rad=0.03, sag_slope=0.1)
    wave = np.sin(np.linspace(0.0, 3 * np.pi, 200))[:, None] * np.full(ARM.num_joints, 0.5)
    found = run_servo(servo.build(ARM, 1, CPU), ARM, wave)
    target = read_targets(wave, ARM)
    middle = (ARM.lower + ARM.upper) / 2
    # up at row 20, down at row 100: half of the play behind, and the sag below
    for row, side in ((20, -1.0), (100, 1.0)):
        held = target[row] + side * 0.01
        np.testing.assert_allclose(found[row], held - 0.03 - 0.1 * (held - middle), atol=1e-5)


def test_effects_on_targets_are_what_the_servo_has_inside() -> None:
    """An ideal servo with effects around it is a servo with their numbers."""
    ideal = replace(option("actuator", "servo"), top_speed=50.0)
    wave = np.sin(np.linspace(0.0, 9.0, 150))[:, None] * np.full(ARM.num_joints, 0.6)
    around: Any = ideal.build(ARM, 1, CPU)
    kinds = {kind.name: kind for kind in load_effects(ARM)}
    values = {
        "backlash": {"gap_rad": 0.02},
        "sag": {"sag_rad": 0.03, "sag_slope": 0.1},
        "dead_time": {"dead_time_s": 0.04},
    }
    for name, numbers in values.items():
        around = kinds[name].wrap(around, ARM, 1, CPU)
        for key, value in numbers.items():
            around.parameters[key].fill_(value)
    inside = replace(ideal, dead_time_s=0.04, play_rad=0.02, sag_rad=0.03, sag_slope=0.1)
    found, expected = (run_servo(one, ARM, wave) for one in (around, inside.build(ARM, 1, CPU)))
    # the play works on the sagged target: a tenth of half the play
    np.testing.assert_allclose(found, expected, atol=1.1e-3)


def test_effects_of_valves_are_refused_by_servos_and_the_other_way_round() -> None:
    known = {kind.name for kind in load_effects(ARM)}
    assert known == {
        "backlash", "damping", "dead_time", "delay_jitter", "frame_loss", "lag", "quantisation", "rate_limit", "sag",
        "sensor_noise", "torque_limit",
    }  # fmt: skip
    model = option("actuator", "servo").build(ARM, 1, CPU)
    with pytest.raises(ConfigError, match="commanded by position, where it does not occur"):
        option("effect", "dead_band").wrap(model, ARM, 1, CPU)
    with pytest.raises(ConfigError, match="is commanded by speed"):
        option("actuator", "servo").build(MACHINE, 1, CPU)


@pytest.mark.parametrize("name", ["ideal", "lag", "valve", "hydraulic", "load_sensing", "force"])
def test_an_actuator_of_other_commands_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"commanded by position; choose actuator=servo"):
        option("actuator", name).build(ARM, 1, CPU)


def test_one_machine_is_commanded_by_one_quantity() -> None:
    joints = (replace(ARM.joints[0], command="torque", max_force=ARM.joints[0].max_speed), *ARM.joints[1:])  # fmt: skip
    with pytest.raises(ConfigError, match="commanded by different quantities"):
        replace(ARM, joints=joints)
    with pytest.raises(ConfigError, match="needs max_force"):
        replace(ARM.joints[0], command="torque")


def test_the_interface_is_part_of_the_fingerprint_of_servos_only() -> None:
    valves = replace(ARM, joints=tuple(replace(one, command="valve") for one in ARM.joints))
    assert valves.fingerprint()["joints"] != ARM.fingerprint()["joints"]
    # what a file of a valve has had since before there were interfaces
    drives = replace(ARM, joints=tuple(replace(one, command="velocity") for one in ARM.joints))
    assert drives.fingerprint()["joints"] != valves.fingerprint()["joints"]


def test_a_program_of_speeds_becomes_targets_and_is_read_back() -> None:
    speeds = np.random.default_rng(1).uniform(-0.2, 0.2, (50, ARM.num_joints))
    program, q = SpeedProgram(ARM), ARM.home
    u = np.array([program.command(one, q)[0] for one in speeds])
    np.testing.assert_allclose(view_speeds(u, ARM)[1:], speeds[1:], atol=1e-9)
    np.testing.assert_allclose(scale_targets(read_targets(u, ARM), ARM), u, atol=1e-12)
    # at the end of the travel a target goes no further
    for _ in range(100):
        at_end, carried_out = program.command(np.ones(ARM.num_joints), q)
    np.testing.assert_allclose(at_end, 1.0)
    np.testing.assert_allclose(carried_out, 0.0)


def test_a_nominal_servo_stays_and_follows() -> None:
    link = NominalLink(ARM, 1)
    rest = find_rest(ARM.home[None], ARM)
    link.send(Command(rest))
    np.testing.assert_allclose(link.read().q, ARM.home[None])
    for _ in range(10):
        link.send(Command(np.zeros((1, ARM.num_joints))))
    np.testing.assert_allclose(link.read().q[0], (ARM.lower + ARM.upper) / 2)


def test_a_policy_commands_speeds_and_the_servo_gets_targets() -> None:
    ideal = replace(option("actuator", "servo"), top_speed=50.0)
    model = accept_speeds(ideal.build(ARM, 4, CPU), ARM, 4, CPU)
    check_actuator_model(model, ARM, CPU)
    model = accept_speeds(ideal.build(ARM, 1, CPU), ARM, 1, CPU)
    speeds = np.random.default_rng(3).uniform(-0.3, 0.3, (30, ARM.num_joints))
    path = roll(model, ARM, torch.as_tensor(speeds[:, None], dtype=torch.float32))
    way = speeds.sum(0) * ARM.max_speed * ARM.period_s
    np.testing.assert_allclose(path[-1, 0], ARM.home + way, atol=1e-5)
    # a machine that is commanded by speed keeps its model, one by torque is refused
    known = option("actuator", "ideal").build(MACHINE, 1, CPU)
    assert accept_speeds(known, MACHINE, 1, CPU) is known
    drive = option("machine", "emps")
    with pytest.raises(ConfigError, match="commanded by torque"):
        accept_speeds(option("actuator", "force").build(drive, 1, CPU), drive, 1, CPU)
