"""Servo plants of the exam: statics worked by hand, each fault and cause shows where it is, runs stand alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import option

from brokk_rl.commands import find_rest, read_targets
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.signals import Command
from exam.plants import servo_parameters
from exam.plants.family import PlantRun, UnknownFault
from exam.plants.servo_causes import CAUSES
from exam.plants.servos import ServoArm, ServoPlants

ELBOW, NUM_PERIODS = 2, 90
RUN = PlantRun(seed=3, roughness="mild", chance=1, elapsed_s=900.0)
SIZES = {
    "dead_time": ("dead_time_s", 0.0, 0.06), "delay_jitter": ("jitter_s", 0.0, 0.05), "frame_loss": ("probability", 0.0, 0.25),
    "lag": ("time_constant_s", 0.0, 0.1), "rate_limit": ("stroke_s", 0.0, 0.6), "backlash": ("gap_rad", 0.0, 0.04),
    "sag": ("sag_rad", 0.0, 0.03), "quantisation": ("step_rad", 0.0, 0.012), "sensor_noise": ("sigma_rad", 0.0, 0.004),
    "joint_friction": ("part", 0.0, 0.3), "joint_damping": ("part", 0.0, 0.4), "joint_armature": ("part", 0.0, 1.0),
    "drive_gain": ("gain", 1.0, 0.6), "torque_limit": ("shortage", 0.0, 2.0),
}  # fmt: skip


@pytest.fixture(scope="module")
def arm() -> Machine:
    return option("machine", "so101")


@pytest.fixture(scope="module")
def plants() -> ServoPlants:
    return option("exam_plants", "servos")


def of_elbow(none: float, value: float) -> np.ndarray:
    return np.where(np.arange(5) == ELBOW, value, none)


def wave(machine: Machine) -> np.ndarray:
    t_s = machine.period_s * np.arange(NUM_PERIODS)[:, None]
    swing = 0.8 * np.sin(2 * np.pi * t_s / [1.9, 1.5, 1.2, 1.3, 1.1])
    return np.clip(find_rest(machine.home, machine) + swing * np.minimum(t_s / 0.3, 1.0), -1, 1)


def play(plant: ServoArm, u: np.ndarray, count: int) -> np.ndarray:
    """Returns readings `(T, N, J)` under the same commands `(T, J)` for all runs."""
    found = []
    for row in u:
        found.append(plant.read().q)
        plant.send(Command(np.tile(row, (count, 1))))
    return np.array(found)


@pytest.mark.parametrize("seed", [3, 0])  # bristles, dry
def test_each_fault_and_cause_shows_on_the_joint_that_has_it(
    arm: Machine, plants: ServoPlants, seed: int
) -> None:
    assert set(SIZES) == set(plants.effects)
    runs, names = [replace(RUN, seed=seed)], ["none"]
    for name, (number, none, value) in SIZES.items():
        faults: Mapping[str, Any] = {name: {number: of_elbow(none, value)}}
        runs.append(replace(runs[0], faults=faults))
        names.append(name)
    for cause in set(CAUSES) - {"heat", "overload_trip"}:  # these need longer or heavier work
        runs.append(replace(runs[0], outside_fault=UnknownFault(cause, of_elbow(0.0, 1.0))))
        names.append(cause)
    path = play(plants.build(arm, runs, 2.0), wave(arm), len(runs))
    moved = np.sqrt(np.square(path - path[:, :1]).mean(0))  # (N, J)
    for name, row in zip(names[1:], moved[1:], strict=True):
        assert row[ELBOW] > 2e-3, name
        assert np.delete(row, ELBOW).max() < 0.3 * row[ELBOW], name  # coupled by weight and mass


def test_a_run_does_not_depend_on_its_neighbours(arm: Machine, plants: ServoPlants) -> None:
    other = replace(RUN, chance=5, faults={"lag": {"time_constant_s": of_elbow(0.0, 0.1)}})
    beside = play(plants.build(arm, [other, RUN], 2.0), wave(arm)[:40], 2)[:, 1]
    alone = play(plants.build(arm, [RUN], 2.0), wave(arm)[:40], 1)[:, 0]
    np.testing.assert_array_equal(alone, beside)


def test_an_arm_sags_by_its_weight_over_the_stiffness(
    arm: Machine, plants: ServoPlants, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Masses and levers by hand: forearm 0.104 kg, wrist 0.079 kg, gripper 0.099 kg."""
    draw = servo_parameters.draw_servos

    def draw_ideal(*args: Any) -> Any:
        make, n = draw(*args)
        for name in ("coulomb_n_m", "cogging_n_m", "dead_zone_rad", "load_friction", "noise_rad"):
            n[name] = np.full(5, 1e-6)
        return make, n | {"step_rad": np.full(5, 1e-9)}

    monkeypatch.setattr(servo_parameters, "draw_servos", draw_ideal)
    plant = plants.build(arm, [RUN], 3.0)
    rest = find_rest(arm.home, arm)
    path = play(plant, np.tile(rest, (120, 1)), 1)[-1, 0]
    _, n = draw_ideal(arm, RUN.seed, 1.0)
    pitch, elbow, wrist = path[1], path[1] + path[2], path[1] + path[2] + path[3]

    def turn(x: float, z: float, angle: float) -> float:
        """Returns how far forward a point comes, m."""
        return x * np.cos(angle) + z * np.sin(angle)

    forearm = turn(0.098, 0.003, elbow)
    hand = turn(0.135, 0.005, elbow)
    weight = 0.104 * forearm + 0.079 * (hand + 0.039 * np.cos(wrist))
    weight += 0.099 * (hand + 0.086 * np.cos(wrist))
    below = read_targets(rest, arm)[2] - path[2]
    supply = 1.0 - n["supply_drop"][2] * 0.3  # duties of a few tenths in all
    assert pitch == pytest.approx(arm.home[1], abs=0.03)
    assert -below * n["stiffness"][2] * supply == pytest.approx(9.81 * weight, rel=0.03)


def test_a_later_bus_shifts_the_motion_by_whole_periods(arm: Machine, plants: ServoPlants) -> None:
    late = replace(RUN, faults={"dead_time": {"dead_time_s": np.full(5, 3 * arm.period_s)}})
    u = np.tile(find_rest(arm.home, arm), (NUM_PERIODS, 1))
    u[40:] = u[40:] + 0.3  # at rest before
    path = play(plants.build(arm, [RUN, late], 2.0), u, 2)
    np.testing.assert_allclose(path[43:, 1], path[40:-3, 0], atol=4e-3)
    assert np.abs(path[43:, 1] - path[43:, 0]).max() > 0.03


def test_servos_are_refused_on_valves(machine: Machine, plants: ServoPlants) -> None:
    with pytest.raises(ConfigError, match="machine=so101"):
        plants.build(machine, [RUN], 1.0)


def test_the_mix_asks_for_effects_that_servos_and_library_have(
    arm: Machine, plants: ServoPlants
) -> None:
    from diagnosis.effect_library import load_effects

    mix = option("exam_mix", "servos")
    assert set(mix.troubles) <= set(plants.effects) & {kind.name for kind in load_effects(arm)}


def test_a_torque_limit_is_a_cap_of_the_duty(arm: Machine, plants: ServoPlants) -> None:
    """5 % of 0.7 rad at the elbow's stiffness, over a shortage of 2, over its torque at standstill."""
    limited = {"torque_limit": {"shortage": of_elbow(0.0, 2.0)}}
    _, n = servo_parameters.draw_servos(arm, RUN.seed, 1.0)
    changed = servo_parameters.change_servos(n, limited, arm)
    assert changed["duty_cap"][ELBOW] == pytest.approx(
        0.0175 * n["stiffness"][2] / n["stall_n_m"][2]
    )
    assert np.delete(changed["duty_cap"], ELBOW).tolist() == [1.0] * 4
    # the neutral value of the mix reaches no joint
    least = option("exam_mix", "servos").troubles["torque_limit"].numbers["shortage"][0]
    faults = {"torque_limit": {"shortage": np.full(5, least)}}
    runs = [RUN, replace(RUN, faults=faults)]
    path = play(plants.build(arm, runs, 2.0), wave(arm), 2)
    assert np.abs(path[:, 1] - path[:, 0]).max() < 2e-3


def test_a_firmware_that_winds_up_overshoots(arm: Machine, plants: ServoPlants) -> None:
    """An integral term passes the target after a step, and takes away the sag that stays without it."""
    wound = replace(RUN, outside_fault=UnknownFault("wind_up", of_elbow(0.0, 1.0)))
    u = np.tile(find_rest(arm.home, arm), (200, 1))
    u[40:, ELBOW] += 0.6
    path = play(plants.build(arm, [RUN, wound], 4.5), u, 2)[:, :, ELBOW]
    target = read_targets(u, arm)[-1, ELBOW]
    assert path[40:, 0].max() < target + 0.02 < path[40:, 1].max()
    assert abs(path[-1, 1] - target) < 0.5 * abs(path[-1, 0] - target)
