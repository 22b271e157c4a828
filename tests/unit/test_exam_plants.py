"""Plants of an exam with valves: physics worked by hand, effects as their numbers say, causes that show."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from composed import option

from brokk_rl.kinematics import Gravity, Kinematics
from brokk_rl.machine import Machine
from brokk_rl.signals import Command
from exam.plants import valve_causes, valve_parameters
from exam.plants.changes import PlantParameters
from exam.plants.electronics import CommandBus, SteppedEncoders, draw_bursts
from exam.plants.family import PlantRun, UnknownFault
from exam.plants.linkage import Arm
from exam.plants.valve_arm import SensingArm
from exam.plants.valve_parameters import change_machine, draw_machine

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
            float(valve_parameters.compute_notch_area(np.array(value), np.array(0.2)))
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
    kinds: list[str | None] = list(valve_causes.CAUSES)
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
    assert set(mix.troubles) <= set(valve_parameters.CHANGES)
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


def test_lost_frames_hold_the_command_before_and_late_ones_keep_their_order() -> None:
    numbers = {
        "transport_s": np.full((1, 1), 0.1),
        "jitter_s": np.full((1, 1), 0.1),
        "loss": np.full((1, 1), 0.5),
    }
    line = CommandBus(numbers, 0.05)
    frames = [
        (1.0, 0.9, 0.0),
        (2.0, 0.4, 0.0),
        (3.0, 0.9, 1.0),
        (4.0, 0.9, 0.0),
    ]  # command, luck, lateness
    seen = []
    for k, (u, luck, late) in enumerate(frames):
        line.send(
            np.full((1, 1), u),
            0.05 * k,
            np.full((1, 1), luck),
            np.full((1, 1), late),
            np.zeros((1, 1)),
        )
    for i in range(31):
        seen.append(float(line.at(0.01 * i + 1e-9)[0, 0]))
    # 1 arrives at 0.10; 2 is lost; 3 is sent at 0.10 and comes at 0.30; 4 would come at 0.25 and
    # waits for it
    assert seen[:10] == [0.0] * 10 and set(seen[10:30]) == {1.0}
    line.at(0.301)
    assert float(line.at(0.302)[0, 0]) == 4.0


def test_weight_and_tool_are_those_of_the_machine(machine: Machine) -> None:
    q = np.random.default_rng(0).uniform(machine.lower, machine.upper, (6, machine.num_joints))
    arm = Arm(
        machine,
        {name: np.zeros((6, machine.num_joints)) for name in ("extra_m", "roll_rad", "pitch_rad")},
    )
    yields = np.array([body.yield_force.value for body in machine.bodies])
    torque = (
        Gravity(machine, torch.device("cpu")).load(torch.as_tensor(q, dtype=torch.float32)).numpy()
    )
    assert arm.load(q) == pytest.approx(torque / yields, abs=1e-4)
    tip_m, pitch_rad = arm.tool(q)
    pose = Kinematics(machine).pose(torch.as_tensor(q, dtype=torch.float32))
    assert tip_m == pytest.approx(pose.tip_in_base_m.numpy(), abs=1e-4)
    assert np.cos(pitch_rad - pose.pitch_rad.numpy()) == pytest.approx(np.ones(6), abs=1e-6)


def test_a_longer_link_and_a_tilted_base_move_the_tool_as_geometry_says(machine: Machine) -> None:
    zero = np.zeros((1, machine.num_joints))
    straight = np.zeros((1, machine.num_joints))  # all along x
    tips = []
    for change in (
        {},
        {"extra_m": np.array([[0.0, 0.0, 0.02, 0.0, 0.0]])},
        {"pitch_rad": zero + 0.03},
    ):
        numbers = dict.fromkeys(("extra_m", "roll_rad", "pitch_rad"), zero) | change
        tips.append(Arm(machine, numbers).tool(straight)[0][0])
    assert tips[1] - tips[0] == pytest.approx([0.02, 0.0, 0.0], abs=1e-9)
    x, y, z = tips[0]
    cos, sin = np.cos(0.03), np.sin(0.03)
    assert tips[2] == pytest.approx(
        [cos * x + sin * z, y, -sin * x + cos * z], abs=1e-9
    )  # the front goes down


def test_backlash_takes_its_gap_at_each_reversal(machine: Machine) -> None:
    u, well = np.concatenate([push(machine, 0.6, 30), push(machine, -0.6, 30)]), clean(machine)
    worn = change_machine(well, {"backlash": {"gap_rad": on_q3(machine, 0.0, 0.02)}})
    before, after = played(machine, [(well, u), (worn, u)])[:, :, Q3].T
    assert before.max() - after.max() == pytest.approx(0.01, abs=0.001)  # half, from the middle
    assert after[-1] - before[-1] == pytest.approx(0.01, abs=0.001)  # the other half


def test_stiction_asks_for_more_command_to_start(machine: Machine) -> None:
    well = clean(machine)
    stuck = change_machine(well, {"stiction": {"start": on_q3(machine, 0.0, 0.25)}})
    runs = [(stuck, push(machine, 0.18)), (well, push(machine, 0.18)), (stuck, push(machine, 0.6))]
    moved = np.ptp(played(machine, runs)[:, :, Q3], axis=0)
    assert moved[0] < 0.002 and moved[1] > 0.005 and moved[2] > 0.1


def test_what_is_soft_rings_and_what_is_not_does_not(machine: Machine) -> None:
    u = np.concatenate([push(machine, 0.8, 30), push(machine, 0.0, 50)])
    size = {"ringing_s": on_q3(machine, 0.0, 0.5), "damping": on_q3(machine, 0.1, 0.1)}
    soft = change_machine(clean(machine), {"compliance": size})
    q = played(machine, [(clean(machine), u), (soft, u)])[42:, :, Q3]
    stiff, ringing = np.abs(np.diff(q, axis=0)).sum(0) - np.abs(q[-1] - q[0])
    assert ringing > 5.0 * stiff and ringing > 0.004


def test_a_loose_compensator_lifts_slower_than_it_lowers(machine: Machine) -> None:
    well = clean(machine)
    loose = change_machine(well, {"load_dependence": {"sensitivity": on_q3(machine, 0.0, 0.6)}})
    runs = [(numbers, level) for numbers in (loose, well) for level in (1.0, -1.0)]
    down, up, *even = np.abs(find_speeds(machine, runs))
    assert down / up > 1.05 * even[0] / even[1]  # positive lowers
