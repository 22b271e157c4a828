"""Plants of an exam: physics worked by hand, effects as their numbers say, causes that show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from small_exam import run_model

from brokk_rl.commands import find_rest, read_targets
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import Gravity, Kinematics
from brokk_rl.machine import Machine
from brokk_rl.signals import Command
from diagnosis.effect_library import load_effects
from exam.plants import servo_faults
from exam.plants.changes import PlantParameters
from exam.plants.electronics import CommandBus, SteppedEncoders, draw_bursts
from exam.plants.family import SEVERITY, DrawnPlants, PlantBatch, PlantLink, PlantRun
from exam.plants.hydraulics import STEP_S, SensingValves
from exam.plants.linkage import Arm
from exam.plants.valve_arm import ValveArm
from exam.plants.valve_faults import CHANGES, compute_notch_area

Q1, Q3 = 0, 2
RUN = PlantRun(seed=3, roughness="mild", chance=1, elapsed_s=900.0)


def smooth(name: str) -> DrawnPlants:
    """A family without nuisances."""
    return replace(option("exam_plants", name), roughness={"mild": 0.0})


def clean() -> PlantParameters:
    """A machine without nuisances, noise or change of lever, so that numbers can be worked by hand."""
    _, numbers = smooth("valves").draw(MACHINE, replace(RUN, seed=5))
    for name, value in {
        "noise_rad": 0.0, "overlap_extend": 0.1, "overlap_retract": 0.1, "notch": 0.2, "flow_force": 0.0,
        "extend": 1.0, "retract": 1.0, "linkage_rad": 1.57, "demand": 0.2, "transport_s": 0.4,
        "coulomb": 0.02, "pin": 0.0,
    }.items():  # fmt: skip
        numbers[name] = np.full(MACHINE.num_joints, value)
    return numbers


def change(numbers: PlantParameters, effect: str, **sizes: np.ndarray) -> PlantParameters:
    CHANGES[effect](changed := dict(numbers), sizes)
    return changed


def played(runs: list[tuple[PlantParameters, np.ndarray]]) -> np.ndarray:
    """Positions of machines side by side, `(T + 1, N, J)`, each under commands `(T, J)`."""
    numbers, u = [one for one, _ in runs], np.stack([given for _, given in runs], 1)
    batch = PlantBatch(MACHINE, "sensing", [RUN] * len(runs), numbers, len(u))
    return follow(ValveArm(batch, STEP_S, SensingValves), u)


def built(plants: DrawnPlants, machine: Machine, runs: list[PlantRun], run_s: float) -> PlantLink:
    """Runs of one make side by side."""
    ((_, link),) = plants.build(machine, runs, run_s)
    return link


def follow(plant: PlantLink, u: np.ndarray) -> np.ndarray:
    """Positions under commands, `(T + 1, N, J)`."""
    path = [plant.read().q]
    for row in u:
        plant.send(Command(row))
        path.append(plant.read().q)
    return np.array(path)


def push(level: float, steps: int = 50, joint: int = Q3) -> np.ndarray:
    u = np.zeros((steps, MACHINE.num_joints))
    u[:, joint] = level
    return u


def on_q3(machine: Machine, none: float, value: float) -> np.ndarray:
    return np.where(np.arange(machine.num_joints) == Q3, value, none)


def find_speeds(runs: list[tuple[PlantParameters, float]]) -> np.ndarray:
    """Steady speeds of q3, of full speed."""
    q = played([(numbers, push(level)) for numbers, level in runs])[:, :, Q3]
    return (q[50] - q[40]) / (10 * MACHINE.period_s) / MACHINE.max_speed[Q3]


def test_a_clean_machine_goes_at_full_speed_and_by_its_notches_below() -> None:
    found = find_speeds([(clean(), u) for u in (1.0, -1.0, 0.55, 0.19, 0.08)])
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


def test_an_effect_changes_the_steady_speed_as_its_number_says() -> None:
    well, runs, expected = clean(), [], []
    for effect, (sizes, level, value) in STEADY.items():
        numbers = {name: on_q3(MACHINE, *pair) for name, pair in sizes.items()}
        runs.append((change(well, effect, **numbers), level))
        by_area = effect in ("dead_band", "saturation")
        expected.append(compute_notch_area(np.array(value), np.array(0.2)) if by_area else value)
    found = find_speeds([*runs, (well, 1.0)])
    assert found[:-1] / found[-1] == pytest.approx(expected, abs=0.04)


def test_a_fault_in_time_costs_the_way_of_that_time() -> None:
    late = {"dead_time": ("dead_time_s", 0.08, 0.08), "lag": ("time_constant_s", 0.1, 0.10)}
    late["rate_limit"] = ("stroke_s", 0.5, 0.25)
    well = clean()
    runs = [(well, push(1.0))]
    for effect, (name, value, _) in late.items():
        slower = change(well, effect, **{name: on_q3(MACHINE, 0.0, value)})
        runs.append((slower, push(1.0)))
    q = played(runs)[:, :, Q3]
    lost_s = (q[-1, 0] - q[-1, 1:]) / ((q[50, 0] - q[40, 0]) / (10 * MACHINE.period_s))
    # a ramp of 0.5 s costs half of it and a little for the overlap and the notches
    assert lost_s == pytest.approx([expected for _, _, expected in late.values()], abs=0.04)


def test_a_leak_lets_a_heavy_joint_sink_and_the_slew_not() -> None:
    size = np.full(MACHINE.num_joints, 0.05)
    numbers = change(clean(), "creep", sink_rad_s=size)
    weight = Arm(MACHINE, {name: value[None] for name, value in numbers.items()})
    load = weight.load(MACHINE.home[None])[0]
    q = played([(numbers, push(0.0, 200))])[:, 0]
    found = (q[200] - q[100]) / 5.0
    # turbulent: nominal at two fifths of the yield force, with the root of the load elsewhere
    expected = 0.4 * 0.05 * np.sign(load) * np.sqrt(np.abs(load) / 0.4)
    assert abs(load[Q3]) > 0.1 and abs(found[Q1]) < 1e-4
    assert found[Q3] == pytest.approx(expected[Q3], rel=0.25)


def test_a_worn_pump_slows_joints_that_move_together_only() -> None:
    numbers = change(clean(), "flow_sharing", demand=np.full(5, 0.5))
    together = np.ones((50, 5)) * [1.0, 0.0, 1.0, 1.0, 1.0]
    q = played([(numbers, together), (numbers, push(1.0))])
    flow, alone = (q[50] - q[40]) / 0.5 / MACHINE.max_speed
    assert alone[Q3] == pytest.approx(1.0, abs=0.05)
    assert flow.sum() == pytest.approx(2.0, rel=0.15)  # the pump's flow at half each
    assert np.ptp(flow[[0, 2, 3, 4]]) > 0.1  # no proportional split: the heaviest is starved


def test_frames_are_lost_in_bursts_at_the_stated_share() -> None:
    lost = draw_bursts(np.random.default_rng(0).random(200_000), 0.15)
    assert lost.mean() == pytest.approx(0.15, rel=0.05)
    starts = int((lost[1:] & ~lost[:-1]).sum())
    assert lost.sum() / starts == pytest.approx(1.8, rel=0.05)
    assert not draw_bursts(np.random.default_rng(0).random(1000), 0.0).any()


def one(value: float) -> np.ndarray:
    return np.full((1, 1), value)


def test_a_coarse_encoder_keeps_its_reading_within_its_band() -> None:
    numbers = {name: one(0.0) for name in ("noise_rad", "extra_noise_rad", "bias_rad")}
    encoder = SteppedEncoders(numbers | {"scale": one(1.0), "step_rad": one(0.01)})
    shown = [encoder.read(one(q), one(0.0)).item() for q in (0.0, 0.0055, 0.0061, 0.0045)]
    # steps of 10 mrad: at 5.5 it stays, beyond 6 it goes, back at 4.5 it stays
    assert shown == pytest.approx([0.0, 0.0, 0.01, 0.01])


def test_lost_frames_hold_the_command_before_and_late_ones_keep_their_order() -> None:
    line = CommandBus({"transport_s": one(0.1), "jitter_s": one(0.1), "loss": one(0.5)})
    # command, luck, lateness
    frames = [(1.0, 0.9, 0.0), (2.0, 0.4, 0.0), (3.0, 0.9, 1.0), (4.0, 0.9, 0.0)]
    for k, (u, luck, late) in enumerate(frames):
        line.send(one(u), 0.05 * k, one(luck), one(late), one(0.0))
    seen = [line.at(0.01 * i + 1e-9).item() for i in range(31)]
    # 1 arrives at 0.10; 2 is lost; 3 is sent at 0.10 and comes at 0.30; 4 would come at 0.25 and waits
    assert seen[:10] == [0.0] * 10 and set(seen[10:30]) == {1.0}
    line.at(0.301)
    assert line.at(0.302).item() == 4.0


@pytest.mark.parametrize("name", ["brokk170", "crane"])
def test_weight_and_tool_are_those_of_the_machine(name: str) -> None:
    machine = option("machine", name)
    q = np.random.default_rng(0).uniform(machine.lower, machine.upper, (6, machine.num_joints))
    arm = Arm(machine, dict.fromkeys(("extra_m", "roll_rad", "pitch_rad"), np.zeros_like(q)))
    yields = np.array([body.yield_force.value for body in machine.bodies])
    assert arm.load(q) == pytest.approx(Gravity(machine).load(q) / yields, abs=1e-9)
    tip_m, pitch_rad = arm.tool(q)
    pose = Kinematics(machine).pose(torch.as_tensor(q, dtype=torch.float32))
    assert tip_m == pytest.approx(pose.tip_in_base_m.numpy(), abs=1e-4)
    assert np.cos(pitch_rad - pose.pitch_rad.numpy()) == pytest.approx(np.ones(6), abs=1e-6)


def test_a_longer_link_and_a_tilted_base_move_the_tool_as_geometry_says() -> None:
    zero, longer = np.zeros((1, 5)), np.array([[0.0, 0.0, 0.02, 0.0, 0.0]])
    tips = []
    for change in ({}, {"extra_m": longer}, {"pitch_rad": zero + 0.03}):
        numbers = dict.fromkeys(("extra_m", "roll_rad", "pitch_rad"), zero) | change
        tips.append(Arm(MACHINE, numbers).tool(zero)[0][0])  # stretched along x
    assert tips[1] - tips[0] == pytest.approx([0.02, 0.0, 0.0], abs=1e-9)
    x, y, z = tips[0]
    cos, sin = np.cos(0.03), np.sin(0.03)
    # the front goes down
    assert tips[2] == pytest.approx([cos * x + sin * z, y, -sin * x + cos * z], abs=1e-9)


def test_backlash_takes_its_gap_at_each_reversal() -> None:
    u, well = np.concatenate([push(0.6, 30), push(-0.6, 30)]), clean()
    worn = change(well, "backlash", gap_rad=on_q3(MACHINE, 0.0, 0.02))
    before, after = played([(well, u), (worn, u)])[:, :, Q3].T
    assert before.max() - after.max() == pytest.approx(0.01, abs=0.001)  # half, from the middle
    assert after[-1] - before[-1] == pytest.approx(0.01, abs=0.001)  # the other half


FAMILIES = {
    "valves": ("brokk170", "main", [3]),
    "circuits": ("crane", "circuits", [1, 0, 7]),
    "servos": ("so101", "servos", [3, 0]),
}
"""Machine, mix, and a seed of each make."""
MAKES = [(name, seed) for name, (_, _, seeds) in FAMILIES.items() for seed in seeds]
OF_FILES = {"joint_friction": 0.3, "joint_damping": 0.4, "joint_armature": 1.0}
"""Parts of effects on numbers of an MJCF file, which no mix has."""


def wave(machine: Machine, num_periods: int) -> np.ndarray:
    """A pose, or motion of all joints in turn with pauses, `(T, J)`."""
    t_s = machine.period_s * np.arange(num_periods)[:, None]
    if machine.interface == "position":
        swing = 0.8 * np.sin(2 * np.pi * t_s / [1.9, 1.5, 1.2, 1.3, 1.1])
        return np.clip(find_rest(machine.home, machine) + swing * np.minimum(t_s / 0.3, 1.0), -1, 1)
    levels = np.array([0.8, 0.8, 0.0, -0.8, 0.25, -0.9, 0.6])
    u = np.zeros((num_periods, machine.num_joints))
    u[:, Q3] = levels[(t_s[:, 0] / 2.0).astype(int) % len(levels)]
    u[:, Q3 + 1] = np.where(np.mod(t_s[:, 0], 7.0) > 5.0, 0.4, 0.0)  # q3 moves alone at first
    return u


@pytest.mark.parametrize(("name", "seed"), MAKES)
def test_each_fault_and_cause_shows_on_the_joint_that_has_it_and_a_run_stands_alone(
    name: str, seed: int
) -> None:
    machine_name, mix_name, seeds = FAMILIES[name]
    machine, plants = option("machine", machine_name), smooth(name)
    well, only = replace(RUN, seed=seed), np.arange(machine.num_joints) == Q3
    assert len({plants.draw(machine, replace(RUN, seed=one))[0] for one in seeds}) == len(seeds)
    runs = {"none": well}
    for effect, trouble in option("exam_mix", mix_name).troubles.items():
        if trouble.needs_tool or trouble.joints == "all":
            continue
        sizes = {key: np.full(len(only), value) for key, value in trouble.shape.items()}
        for key, (none, typical) in trouble.numbers.items():
            sizes[key] = np.where(only, typical, none if none in (0.0, 1.0) else 0.0)
        runs[effect] = replace(well, faults={effect: sizes})
    for effect, part in OF_FILES.items() if name == "servos" else ():
        runs[effect] = replace(well, faults={effect: {"part": part * only}})
    # Two causes need longer or heavier work.
    for cause in sorted({*plants.causes} - {"heat", "overload_trip"}):
        runs[cause] = replace(well, faults={cause: {SEVERITY: 1.0 * only}})
    runs["well"] = replace(well, faults={plants.causes[0]: {SEVERITY: 0.0 * only}})
    u = wave(machine, 90 if name == "servos" else round(14.0 / machine.period_s))
    run_s = len(u) * machine.period_s
    side_by_side = built(plants, machine, list(runs.values()), run_s)
    path = follow(side_by_side, np.repeat(u[:, None], len(runs), 1))
    alone = follow(built(plants, machine, [well], run_s), u[:40, None])
    np.testing.assert_array_equal(alone[:, 0], path[: len(alone), 0])
    apart = np.abs(path - path[:, :1])
    assert not apart[:, -1].any(), "a machine of severity 0 is well"
    moved = np.sqrt(np.square(apart).mean(0))
    for effect, row, most in list(zip(runs, moved, apart.max(0), strict=True))[1:-1]:
        assert most[Q3] > 3e-3, effect
        # weight and mass couple joints, and what q3 leaves of the oil speeds q4 up
        assert np.delete(row, [Q3, Q3 + 1]).max() < 0.4 * row[Q3], effect


def test_a_machine_ages_from_day_to_day_by_its_spread_alone() -> None:
    machine, plants = option("machine", "crane"), option("exam_plants", "circuits")
    apart: dict[str, list[float]] = {}
    for seed in range(40):
        days = [replace(RUN, seed=seed, day=day) for day in (0, 1)]
        before, after = (plants.draw(machine, run)[1] for run in days)
        for name, first in before.items():
            ratio = np.log(np.maximum(after[name], 1e-9) / np.maximum(first, 1e-9))
            apart.setdefault(name, []).extend(ratio.tolist())
    for name, ratios in apart.items():
        # two days differ by the root of two
        spread = np.sqrt(2.0) * plants.ageing.get(name, 0.0)
        assert np.std(ratios) == pytest.approx(spread, rel=0.25), name


def test_a_circuit_that_nothing_changes_moves_as_the_library_has_it() -> None:
    machine, family = option("machine", "crane"), option("exam_plants", "circuits")
    still = dict.fromkeys({**family.ranges, **family.nuisances}, (0.0, 0.0))
    plants = replace(
        family, ranges=still, nuisances={}, ageing={}, spread=dict.fromkeys(family.spread, 0.0)
    )
    u = wave(machine, 200)
    run = replace(RUN, seed=1)
    q = follow(built(plants, machine, [run], 5.0), u[:, None])[:-1, 0]
    circuit = option("actuator", plants.draw(machine, run)[0])
    expected = run_model(circuit.build(machine, 1, torch.device("cpu")), machine, u)
    # the library follows the lever arm once a period, the plant once a step
    moving = np.array(machine.joint_names) != "q4"  # the library has a triangle on the telescope
    assert np.ptp(q[:, Q3]) > 0.3
    np.testing.assert_allclose(q[:, moving], expected[:, moving], atol=4e-3)


def test_an_arm_sags_by_its_weight_over_the_stiffness(monkeypatch: pytest.MonkeyPatch) -> None:
    """Masses and levers by hand: forearm 0.104 kg, wrist 0.079 kg, gripper 0.099 kg."""
    arm, family = option("machine", "so101"), option("exam_plants", "servos")
    monkeypatch.setitem(servo_faults.NEUTRAL, "step_rad", 1e-9)
    tiny = (1e-6, 1e-6)
    plants = replace(
        family,
        ranges=family.ranges | {"coulomb_n_m": tiny, "noise_rad": tiny},
        nuisances=dict.fromkeys(family.nuisances, tiny),
    )
    rest = find_rest(arm.home, arm)
    path = follow(built(plants, arm, [RUN], 3.0), np.tile(rest, (120, 1, 1)))[-1, 0]
    pitch, elbow, wrist = path[1], path[1] + path[2], path[1] + path[2] + path[3]

    def turn(x: float, z: float, angle: float) -> float:
        """Returns how far forward a point comes, m."""
        return x * np.cos(angle) + z * np.sin(angle)

    forearm = turn(0.098, 0.003, elbow)
    hand = turn(0.135, 0.005, elbow)
    weight = 0.104 * forearm + 0.079 * (hand + 0.039 * np.cos(wrist))
    weight += 0.099 * (hand + 0.086 * np.cos(wrist))
    below = read_targets(rest, arm)[Q3] - path[Q3]
    stiffness = plants.draw(arm, RUN)[1]["stiffness"][Q3]
    assert pitch == pytest.approx(arm.home[1], abs=0.03)
    assert -below * stiffness == pytest.approx(9.81 * weight, rel=0.03)


def test_a_torque_limit_is_a_cap_of_the_duty() -> None:
    """5 % of 0.7 rad at the elbow's stiffness, over a shortage of 2, over its torque at standstill."""
    arm, plants = option("machine", "so101"), option("exam_plants", "servos")
    limited = {"torque_limit": {"shortage": on_q3(arm, 0.0, 2.0)}}
    _, n = plants.draw(arm, replace(RUN, faults=limited))
    assert n["duty_cap"][Q3] == pytest.approx(0.0175 * n["stiffness"][Q3] / n["stall_n_m"][Q3])
    assert np.delete(n["duty_cap"], Q3).tolist() == [1.0] * 4


def test_servos_are_refused_on_valves() -> None:
    with pytest.raises(ConfigError, match="machine=so101"):
        option("exam_plants", "servos").build(MACHINE, [RUN], 1.0)


@pytest.mark.parametrize("name", FAMILIES)
def test_the_mix_asks_for_effects_that_plants_and_library_have(name: str) -> None:
    machine_name, mix_name, _ = FAMILIES[name]
    library = {kind.name for kind in load_effects(option("machine", machine_name))}
    asked = set(option("exam_mix", mix_name).troubles)
    assert asked <= {*option("exam_plants", name).table} & library
