"""The held-out make: closed to development, physics worked by hand, causes that show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composed import option

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.signals import Command
from exam.case_distribution import PlantRun, UnknownFault
from exam.held_out import causes, parameters
from exam.held_out.arm import HeldOutPlants, SensingArm
from exam.held_out.parameters import change_machine, draw_machine
from exam.held_out.readings import SteppedEncoders, draw_bursts
from exam.plants.linkage import Arm
from exam.plants.plant_parameters import PlantParameters

Q1, Q3, Q4 = 0, 2, 3


def clean(machine: Machine) -> PlantParameters:
    """A machine without nuisances, noise or change of lever, so that numbers can be worked by hand."""
    numbers = draw_machine(machine, 5, 0.0)
    for name, value in {
        "noise_rad": 0.0, "overlap_extend": 0.1, "overlap_retract": 0.1, "notch": 0.2, "flow_force": 0.0,
        "extend": 1.0, "retract": 1.0, "linkage_rad": 1.57, "demand": 0.2, "transport_s": 0.4,
        "coulomb": 0.02, "pin": 0.0,
    }.items():  # fmt: skip
        numbers[name] = np.full(machine.num_joints, value)
    return numbers


def played(
    machine: Machine,
    runs: list[tuple[PlantParameters, np.ndarray]],
    kinds: list[str | None] | None = None,
    elapsed_s: float = 900.0,
) -> np.ndarray:
    """Positions of machines side by side, `(T + 1, N, J)`, each under commands `(T, J)`."""
    steps, made = len(runs[0][1]), []
    for kind in kinds or [None] * len(runs):
        cause = None if kind is None else UnknownFault(kind, np.ones(machine.num_joints))
        made.append(PlantRun(0, "mild", 0, elapsed_s, outside_fault=cause))
    plant = SensingArm(machine, "sensing", [numbers for numbers, _ in runs], made, steps)
    path = [plant.read().q]
    for k in range(steps):
        plant.send(Command(np.stack([u[k] for _, u in runs])))
        path.append(plant.read().q)
    return np.array(path)


def push(machine: Machine, level: float, steps: int = 50, joint: int = Q3) -> np.ndarray:
    u = np.zeros((steps, machine.num_joints))
    u[:, joint] = level
    return u


def on_q3(machine: Machine, none: float, value: float) -> np.ndarray:
    return np.where(np.arange(machine.num_joints) == Q3, value, none)


def find_speeds(machine: Machine, runs: list[tuple[PlantParameters, float]]) -> np.ndarray:
    """Steady speeds of q3, of full speed."""
    q = played(machine, [(numbers, push(machine, level)) for numbers, level in runs])[:, :, Q3]
    return (q[50] - q[40]) / (10 * machine.period_s) / machine.max_speed[Q3]


def test_development_cannot_draw_the_held_out_make(
    brokk: Callable[..., Any], machine: Machine, tmp_path: Path
) -> None:
    done = brokk(
        "mode=exam", "exam.do=make", "exam_plants=held_out", f"session.out={tmp_path / 'x'}"
    )
    assert done.code != 0 and "held out from development" in done.err
    assert not (tmp_path / "x").exists()
    # not by its own option either, nor from Python
    plants = HeldOutPlants(roughness={"mild": 1.0}, sealed=False, outside_not_on={})
    run = PlantRun(seed=1, roughness="mild", chance=1, elapsed_s=0.0)
    with pytest.raises(ConfigError, match="only a sealed exam draws from it"):
        plants.build(machine, [run], 1.0)
    assert replace(plants, sealed=True).build(machine, [run], 1.0).read().q.shape == (1, 5)


def test_a_clean_machine_goes_at_full_speed_and_by_its_notches_below(machine: Machine) -> None:
    found = find_speeds(machine, [(clean(machine), u) for u in (1.0, -1.0, 0.55, 0.19, 0.08)])
    # opening 0.5 of 0.9: (2 * 0.5 - 0.2) / 1.8; opening 0.1, in the notches: 0.01 / (0.2 * 1.8)
    assert found == pytest.approx([1.0, -1.0, 0.444, 0.028, 0.0], abs=0.035)
    assert abs(found[4]) < 0.002


STEADY = {
    "dead_band": ({"extend": (0.0, 0.2), "retract": (0.0, 0.0)}, 0.64, 0.5),  # (0.64 - 0.28) / 0.72 = 0.5 open
    "flow_gain": ({"gain": (1.0, 0.8)}, 1.0, 0.8),
    "asymmetry": ({"extend_gain": (1.0, 0.7), "retract_gain": (1.0, 1.0)}, 1.0, 0.7),
    "saturation": ({"level": (1.0, 0.55)}, 1.0, 0.5),  # 0.5 open
    "thermal_drift": ({"change": (0.0, 0.3), "time_s": (1.0, 1.0)}, 1.0, 1.3),
    "encoder_scale": ({"scale": (1.0, 1.1)}, 1.0, 1.1),
}  # fmt: skip
"""Sizes, the command, and the opening or the factor on the speed that they leave."""


def test_an_effect_changes_the_steady_speed_as_its_number_says(machine: Machine) -> None:
    well, runs, expected = clean(machine), [], []
    for effect, (sizes, level, value) in STEADY.items():
        numbers = {name: on_q3(machine, *pair) for name, pair in sizes.items()}
        runs.append((change_machine(well, {effect: numbers}), level))
        by_area = effect in ("dead_band", "saturation")
        expected.append(
            float(parameters.compute_notch_area(np.array(value), np.array(0.2)))
            if by_area
            else value
        )
    found = find_speeds(machine, [*runs, (well, 1.0)])
    assert found[:-1] / found[-1] == pytest.approx(expected, abs=0.04)


def test_a_fault_in_time_costs_the_way_of_that_time(machine: Machine) -> None:
    late = {"dead_time": ("dead_time_s", 0.08, 0.08), "lag": ("time_constant_s", 0.1, 0.10)}
    late["rate_limit"] = ("stroke_s", 0.5, 0.25)
    well = clean(machine)
    runs = [(well, push(machine, 1.0))]
    for effect, (name, value, _) in late.items():
        runs.append(
            (change_machine(well, {effect: {name: on_q3(machine, 0.0, value)}}), push(machine, 1.0))
        )
    q = played(machine, runs)[:, :, Q3]
    lost_s = (q[-1, 0] - q[-1, 1:]) / ((q[50, 0] - q[40, 0]) / (10 * machine.period_s))
    # a ramp of 0.5 s costs half of it and a little for the overlap and the notches
    assert lost_s == pytest.approx([expected for _, _, expected in late.values()], abs=0.04)


def test_a_leak_lets_a_heavy_joint_sink_and_the_slew_not(machine: Machine) -> None:
    size = np.full(machine.num_joints, 0.05)
    numbers = change_machine(clean(machine), {"creep": {"sink_rad_s": size}})
    weight = Arm(machine, {name: value[None] for name, value in numbers.items()})
    load = weight.load(machine.home[None])[0]
    q = played(machine, [(numbers, push(machine, 0.0, 200))])[:, 0]
    found = (q[200] - q[100]) / 5.0
    # turbulent: nominal at two fifths of the yield force, with the root of the load elsewhere
    expected = 0.4 * 0.05 * np.sign(load) * np.sqrt(np.abs(load) / 0.4)
    assert abs(load[Q3]) > 0.1 and found[Q3] == pytest.approx(expected[Q3], rel=0.25)
    assert abs(found[Q1]) < 1e-4


def test_a_worn_pump_slows_joints_that_move_together_only(machine: Machine) -> None:
    numbers = change_machine(clean(machine), {"flow_sharing": {"demand": np.full(5, 0.5)}})
    together = np.ones((50, 5)) * [1.0, 0.0, 1.0, 1.0, 1.0]
    q = played(machine, [(numbers, together), (numbers, push(machine, 1.0))])
    flow, alone = (q[50] - q[40]) / 0.5 / machine.max_speed
    assert alone[Q3] == pytest.approx(1.0, abs=0.05)
    assert flow.sum() == pytest.approx(2.0, rel=0.15)  # the pump's flow at half each
    assert np.ptp(flow[[0, 2, 3, 4]]) > 0.1  # no proportional split: the heaviest is starved


def test_frames_are_lost_in_bursts_at_the_stated_share() -> None:
    lost = draw_bursts(np.random.default_rng(0).random(200_000), 0.15)
    assert lost.mean() == pytest.approx(0.15, rel=0.05)
    starts = int((lost[1:] & ~lost[:-1]).sum())
    assert lost.sum() / starts == pytest.approx(1.8, rel=0.05)
    assert not draw_bursts(np.random.default_rng(0).random(1000), 0.0).any()


def test_a_coarse_encoder_keeps_its_reading_within_its_band(machine: Machine) -> None:
    numbers = {name: np.zeros((1, 1)) for name in ("noise_rad", "extra_noise_rad", "bias_rad")}
    numbers |= {"scale": np.ones((1, 1)), "step_rad": np.full((1, 1), 0.01)}
    encoder = SteppedEncoders(numbers)
    shown = [
        float(encoder.read(np.full((1, 1), q), np.zeros((1, 1)))[0, 0])
        for q in (0.0, 0.0055, 0.0061, 0.0045)
    ]
    # steps of 10 mrad: at 5.5 it stays, beyond 6 it goes, back at 4.5 it stays
    assert shown == pytest.approx([0.0, 0.0, 0.01, 0.01])


def test_each_cause_shows_on_its_joint_and_a_machine_of_severity_zero_is_well(
    machine: Machine,
) -> None:
    well = draw_machine(machine, 3, 0.0)
    ill = change_machine(well, {})
    ill["outside_severity"] = on_q3(machine, 0.0, 1.0)
    levels = (0.8, 0.8, 0.0, -0.8, 0.0, 0.25, -0.9, -0.9, -0.9, 0.7, 0.7, 0.7)
    u = np.concatenate([push(machine, level, 50) for level in levels])
    u[:, Q4] = np.where(np.arange(len(u)) % 150 > 109, 0.4, 0.0)  # q3 lifts alone at first
    u[-150:] = push(machine, 1.0, 150)  # to the end of the travel
    kinds: list[str | None] = list(causes.CAUSES)
    runs = [(ill, u)] * len(kinds) + [(well, u)] * (len(kinds) + 1)
    q = played(machine, runs, [*kinds, *kinds, None])[:, :, Q3]
    apart = np.abs(q - q[:, -1:]).max(0)
    assert dict(zip(kinds, apart[: len(kinds)] > 0.01, strict=True)) == dict.fromkeys(kinds, True)
    assert not apart[len(kinds) :].any()


def test_a_moved_stop_ends_the_travel_and_home_can_be_reached(machine: Machine) -> None:
    ill = change_machine(draw_machine(machine, 3, 0.0), {})
    ill["outside_severity"] = np.ones(machine.num_joints)
    q = played(machine, [(ill, push(machine, 1.0, 200))], ["moved_stop"])[:, 0, Q3]
    # 0.4 of 2.7 rad are cut off the side that is farther from home
    assert q.max() == pytest.approx(machine.upper[Q3] - 0.4 * 2.7, abs=0.003)
    assert (machine.home <= machine.upper).all()


def test_a_run_is_the_same_whatever_runs_beside_it(machine: Machine) -> None:
    drawn = [draw_machine(machine, seed, 1.0) for seed in range(3)]
    u = push(machine, 0.7, 40)
    alone, together = played(machine, [(drawn[0], u)]), played(machine, [(one, u) for one in drawn])
    assert np.array_equal(alone[:, 0], together[:, 0])
    assert np.abs(together[-1, 0] - together[-1, 1]).max() > 0.005


def test_every_effect_of_the_mix_is_neutral_where_a_joint_lacks_it(machine: Machine) -> None:
    mix, numbers = option("exam_mix", "main"), draw_machine(machine, 3, 1.0)
    assert set(mix.troubles) <= set(parameters.CHANGES)
    for effect, trouble in mix.troubles.items():
        if trouble.joints == "all":
            continue
        sizes = {name: np.full(5, value) for name, value in trouble.shape.items()}
        for name, (none, typical) in trouble.numbers.items():
            sizes[name] = on_q3(machine, none if none in (0.0, 1.0) else 0.0, typical)
        found = change_machine(numbers, {effect: sizes})
        differing = {
            name for name in numbers if not np.array_equal(found[name][:2], numbers[name][:2])
        }
        # the damping of a soft hose counts only where there is one
        assert not differing - {"soft_damping"}, effect
        assert any(not np.array_equal(found[name], numbers[name]) for name in numbers), effect


def test_thermal_drift_rises_earlier_than_the_library(machine: Machine) -> None:
    well = clean(machine)
    well["warm_change"] = np.zeros(5)
    size = {"change": np.full(5, 0.3), "time_s": np.full(5, 600.0)}
    ill = change_machine(well, {"thermal_drift": size})
    u, ratio = push(machine, 1.0, 50), []
    for elapsed_s in (150.0, 6000.0):
        q = played(machine, [(ill, u), (well, u)], elapsed_s=elapsed_s)[:, :, Q3]
        ratio.append((q[50, 0] - q[40, 0]) / (q[50, 1] - q[40, 1]))
    # after a quarter of the time constant: exponential in the logarithm of the viscosity
    part = (6.0 - 6.0 ** np.exp(-0.25)) / 5.0
    assert ratio == pytest.approx([1.0 + 0.3 * part, 1.3], abs=0.015)
    assert part > 1.0 - np.exp(-0.25) + 0.1, "the library's rises later"
