"""Plants of an exam: each fault does what its numbers say, by other means than the library's."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from composed import option

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.signals import Command
from exam.case_distribution import PlantRun, UnknownFault
from exam.plants import out_of_library_faults
from exam.plants.electronics import CommandBus
from exam.plants.faults import FAULTS, apply_faults
from exam.plants.linkage import Arm
from exam.plants.plant import ExamPlant
from exam.plants.plant_parameters import MAKES, PlantParameters, draw_plant
from exam.plants.valve import SpoolValve

Q3 = 2


def clean(machine: Machine, make: str) -> PlantParameters:
    """A machine of this make without nuisances, noise or lever arms, so that numbers can be worked by hand."""
    numbers = next(
        found for seed in range(100) if (found := draw_plant(machine, seed, 0.0))[0] == make
    )[1]
    for name, value in {
        "noise_rad": 0.0,
        "lever": 0.0,
        "notch": 0.0,
        "speed_scale": 1.0,
        "retract_ratio": 1.0,
    }.items():
        numbers[name] = np.full(machine.num_joints, value)
    for name, value in {
        "overlap_extend": 0.1,
        "overlap_retract": 0.1,
        "demand": 0.2,
        "sensitivity": 0.0,
        "transport_s": 0.4,
    }.items():
        numbers[name] = np.full(machine.num_joints, value)
    return numbers


def size(machine: Machine, none: float, value: float) -> np.ndarray:
    return np.where(np.arange(machine.num_joints) == Q3, value, none)


def played(
    machine: Machine,
    make: str,
    runs: list[tuple[PlantParameters, np.ndarray]],
    outside_faults: Sequence[str | None] | None = None,
) -> np.ndarray:
    """Returns the positions of several machines of one make side by side, `(T + 1, N, J)`, each under commands `(T, J)`."""
    numbers, commands = [numbers for numbers, _ in runs], np.stack([u for _, u in runs], 1)
    count = len(runs)
    made = []
    for kind in outside_faults or [None] * count:
        fault = None if kind is None else UnknownFault(kind, np.ones(machine.num_joints))
        made.append(PlantRun(0, "mild", 0, 900.0, outside_fault=fault))
    plant = ExamPlant(machine, make, numbers, made, len(commands))
    path = [plant.read().q]
    for u in commands:
        plant.send(Command(u))
        path.append(plant.read().q)
    return np.array(path)


def step(machine: Machine, level: float, steps: int = 50, joint: int = Q3) -> np.ndarray:
    u = np.zeros((steps, machine.num_joints))
    u[:, joint] = level
    return u


def speeds(
    machine: Machine, make: str, runs: list[tuple[PlantParameters, float]], joint: int = Q3
) -> np.ndarray:
    """Steady speeds at commands, of `max_speed`."""
    q = played(
        machine, make, [(numbers, step(machine, level, joint=joint)) for numbers, level in runs]
    )[:, :, joint]
    return (q[50] - q[40]) / (10 * machine.period_s) / machine.max_speed[joint]


@pytest.mark.parametrize("make", MAKES)
def test_a_clean_machine_goes_at_full_speed_and_in_proportion_beyond_its_overlap(
    machine: Machine, make: str
) -> None:
    numbers = clean(machine, make)
    found = speeds(machine, make, [(numbers, level) for level in (1.0, -1.0, 0.55, 0.08)])
    assert found == pytest.approx([1.0, -1.0, 0.5, 0.0], abs=0.05)
    assert abs(found[3]) < 0.01


ONE_SIDED = {"extend_gain": (1.0, 0.7), "retract_gain": (1.0, 1.0)}
STEADY = (
    # opens at 0.1 + 0.9 * 0.2 = 0.28
    ("dead_band", {"extend": (0.0, 0.2), "retract": (0.0, 0.0)}, 0.64, 0.5),
    ("flow_gain", {"gain": (1.0, 0.8)}, 1.0, 0.8),
    ("asymmetry", ONE_SIDED, 1.0, 0.7),
    ("asymmetry", ONE_SIDED, -1.0, -1.0),
    # (0.55 - 0.1) / 0.9
    ("saturation", {"level": (1.0, 0.55)}, 1.0, 0.5),
    ("thermal_drift", {"change": (0.0, 0.3), "time_s": (1.0, 1.0)}, 1.0, 1.3),
    ("encoder_scale", {"scale": (1.0, 1.1)}, 1.0, 1.1),
)
"""Effects, their sizes, the command, and the steady speed with them, of full speed."""


@pytest.mark.parametrize("make", MAKES)
def test_a_fault_changes_the_steady_speed_of_its_joint_as_it_says(
    machine: Machine, make: str
) -> None:
    well = clean(machine, make)
    ill = []
    for effect, sizes, level, _ in STEADY:
        fault = {name: size(machine, *pair) for name, pair in sizes.items()}
        ill.append((apply_faults(well, {effect: fault}), level))
    found, full, others = (
        speeds(machine, make, *runs) for runs in ((ill,), ([(well, 1.0)],), (ill, 3))
    )
    assert found / full == pytest.approx([steady for *_, steady in STEADY], abs=0.05)
    there = speeds(machine, make, [(well, level) for _, level in ill], 3)
    assert others == pytest.approx(there, abs=0.01)


@pytest.mark.parametrize("make", MAKES)
def test_a_fault_in_time_costs_the_way_of_that_time(machine: Machine, make: str) -> None:
    well = clean(machine, make)
    # a filter of time constant T keeps the overlap (0.1) closed for T ln(1 / 0.9) and then costs T;
    # a ramp of 0.5 s costs 0.05 s before the land opens and half of 0.45 s after it, of which the
    # spool's own 0.04 to 0.08 s are
    # not lost twice
    late = {
        "dead_time": ("dead_time_s", 0.08, 0.08),
        "lag": ("time_constant_s", 0.1, 0.11),
        "rate_limit": ("stroke_s", 0.5, 0.215),
    }
    runs = [well] + [
        apply_faults(well, {effect: {name: size(machine, 0.0, value)}})
        for effect, (name, value, _) in late.items()
    ]
    q = played(machine, make, [(numbers, step(machine, 1.0)) for numbers in runs])[:, :, Q3]
    lost_s = (q[-1, 0] - q[-1, 1:]) / ((q[50, 0] - q[40, 0]) / (10 * machine.period_s))
    assert lost_s == pytest.approx([expected for _, _, expected in late.values()], abs=0.03)


@pytest.mark.parametrize("make", MAKES)
def test_backlash_takes_its_gap_at_each_reversal(machine: Machine, make: str) -> None:
    u = np.concatenate([step(machine, 0.6, 30), step(machine, -0.6, 30), step(machine, 0.0, 20)])
    faults = {"backlash": {"gap_rad": size(machine, 0.0, 0.02)}}
    before, after = played(
        machine, make, [(apply_faults(clean(machine, make), found), u) for found in ({}, faults)]
    )[:, :, Q3].T
    assert before.max() - after.max() == pytest.approx(
        0.01, abs=0.001
    )  # half of it from the middle
    assert after[-1] - before[-1] == pytest.approx(
        0.01, abs=0.002
    )  # then the other half, less what the oil springs back


@pytest.mark.parametrize("make", MAKES)
def test_a_leak_lets_a_heavy_joint_sink_in_proportion_to_its_load(
    machine: Machine, make: str
) -> None:
    numbers = apply_faults(
        clean(machine, make), {"creep": {"sink_rad_s": size(machine, 0.0, 0.05)}}
    )
    arm = Arm(machine, {name: value[None] for name, value in numbers.items()})
    load = arm.load(machine.home[None])[0, Q3]
    q = played(machine, make, [(numbers, step(machine, 0.0, 200))])[:, 0, Q3]
    assert abs(load) > 0.1
    assert (q[200] - q[100]) / 5.0 == pytest.approx(0.05 * load, rel=0.15)


@pytest.mark.parametrize("make", MAKES)
def test_a_worn_pump_slows_joints_that_move_together_only(machine: Machine, make: str) -> None:
    demand = np.array([0.5, 0.0, 0.5, 0.5, 0.5])
    numbers = apply_faults(clean(machine, make), {"flow_sharing": {"demand": demand}})
    together = np.ones((50, 5)) * [1.0, 0.0, 1.0, 1.0, 1.0]
    q = played(machine, make, [(numbers, together), (numbers, step(machine, 1.0))])
    flow, alone = (q[50] - q[40]) / 0.5 / machine.max_speed
    assert alone[Q3] == pytest.approx(1.0, abs=0.05)
    assert flow.sum() == pytest.approx(2.0, abs=0.15)  # the pump's flow at half each


@pytest.mark.parametrize("make", MAKES)
def test_stiction_asks_for_more_command_to_start_than_to_go_on(machine: Machine, make: str) -> None:
    numbers = apply_faults(clean(machine, make), {"stiction": {"start": size(machine, 0.0, 0.2)}})
    pushed = np.concatenate([step(machine, 0.25, 30), step(machine, 0.15, 50)])
    below, after = played(machine, make, [(numbers, step(machine, 0.15, 80)), (numbers, pushed)])[
        :, :, Q3
    ].T
    assert abs(below[80] - below[0]) < 0.002
    assert after[75] - after[50] > 0.01  # the same command keeps it moving


@pytest.mark.parametrize("make", MAKES)
def test_what_is_soft_rings_at_its_period_and_what_is_not_does_not(
    machine: Machine, make: str
) -> None:
    u = np.concatenate([step(machine, 0.8, 30), step(machine, 0.0, 50)])
    faults = {
        "compliance": {"ringing_s": size(machine, 0.0, 0.5), "damping": size(machine, 0.1, 0.1)}
    }

    q = played(
        machine, make, [(apply_faults(clean(machine, make), found), u) for found in ({}, faults)]
    )[42:, :, Q3]
    stiff, soft = np.abs(np.diff(q, axis=0)).sum(0) - np.abs(q[-1] - q[0])
    assert soft > 5.0 * stiff and soft > 0.004


@pytest.mark.parametrize("make", MAKES)
def test_a_loose_compensator_lifts_slower_than_it_lowers(machine: Machine, make: str) -> None:
    numbers = apply_faults(
        clean(machine, make), {"load_dependence": {"sensitivity": size(machine, 0.0, 0.6)}}
    )
    well = clean(machine, make)
    down, up, *even = np.abs(
        speeds(machine, make, [(n, level) for n in (numbers, well) for level in (1.0, -1.0)])
    )
    assert down / up > 1.05 * even[0] / even[1]  # positive lowers


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


def test_a_spool_with_bounded_slope_takes_its_time() -> None:
    machine_numbers = {name: np.full((1, 1), value) for name, value in {
        "hysteresis": 0.0, "stroke_s": 0.5, "breakaway": 0.0, "pilot_s": 0.0, "spool_hz": 8.0, "spool_damping": 0.9, "stop": 1.0,
        "overlap_extend": 0.0, "overlap_retract": 0.0, "notch": 0.0, "wave": 0.0, "wave_number": 2.0, "wave_phase": 0.0,
        "extend": 1.0, "retract": 1.0, "retract_ratio": 1.0, "speed_scale": 1.0}.items()}  # fmt: skip
    valve, one, none = SpoolValve(machine_numbers), np.ones((1, 1)), np.zeros((1, 1))
    path = [float(valve.step(one, 0.005, none, none > 0, none)[0, 0]) for _ in range(200)]
    assert path[60] - path[40] == pytest.approx(20 * 0.005 / 0.5, rel=0.01)
    assert path[-1] == pytest.approx(1.0, abs=0.01)


def test_weight_and_tool_are_those_of_the_machine(machine: Machine) -> None:
    from brokk_rl.gravity import Gravity

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


def test_a_run_is_the_same_whatever_runs_beside_it_and_machines_differ(machine: Machine) -> None:
    found = [draw_plant(machine, seed, 1.0) for seed in range(40)]
    mine = [numbers for make, numbers in found if make == "throttled"][:3]
    u = step(machine, 0.7, 40)

    def paths(numbers: list[PlantParameters], seeds: list[int]) -> np.ndarray:
        runs = [PlantRun(0, "mild", seed, 0.0) for seed in seeds]
        plant = ExamPlant(machine, "throttled", numbers, runs, 40)
        for command in u:
            plant.send(Command(np.repeat(command[None], len(numbers), 0)))
        return plant.read().q

    alone, together = paths(mine[1:2], [5]), paths(mine, [4, 5, 6])
    assert np.array_equal(alone[0], together[1])
    assert np.abs(together[0] - together[1]).max() > 0.005


@pytest.mark.parametrize(
    ("roughness", "low_rad", "high_rad"), [("mild", 0.005, 0.011), ("strong", 0.011, 0.025)]
)
def test_chance_alone_leaves_most_of_the_stated_floor(
    machine: Machine, roughness: str, low_rad: float, high_rad: float
) -> None:
    # the same machines twice under the same commands: what differs over 5 s no model can know
    rough = option("exam_plants", "valves").roughness[roughness]
    numbers = [
        found
        for seed in range(24)
        for make, found in [draw_plant(machine, seed, rough)]
        if make == "throttled"
    ]
    count, steps = len(numbers), 1200
    runs = [PlantRun(0, roughness, chance, 0.0) for chance in range(2 * count)]
    twice = ExamPlant(machine, "throttled", numbers * 2, runs, steps)
    generator, shape = np.random.default_rng(0), (steps // 30, count, machine.num_joints)
    levels = generator.uniform(-1.0, 1.0, shape) * (
        generator.random(shape) > 0.3
    )  # as excitation=levels: 0.3 of them rest
    levels *= mask_exclusive_joints(machine.is_exclusive, generator.random(shape[:2]) < 0.3)
    path = []
    for u in np.repeat(levels, 30, 0):
        path.append(twice.read().q)
        twice.send(Command(np.concatenate([u, u])))
    apart = np.diff(np.array(path).reshape(steps, 2, count, -1), axis=1)[:, 0]
    growth = np.stack([apart[k : k + 100] - apart[k] for k in range(0, steps - 100, 100)])
    assert low_rad < np.sqrt(np.square(growth).mean() / 2.0) < high_rad


def test_each_fault_outside_the_library_shows_and_a_machine_of_severity_zero_is_well(
    machine: Machine,
) -> None:
    well = clean(machine, "throttled")
    u = np.concatenate([step(machine, level, 60) for level in (0.8, 0.8, 0.8, -0.8, 0.3, -0.3)])
    u[:, 3] = np.where(u[:, Q3] > 0, 0.5, 0.0)
    ill, kinds = (
        well | {"outside_severity": size(machine, 0.0, 1.0)},
        list(out_of_library_faults.KINDS),
    )
    q = played(
        machine,
        "throttled",
        [(ill, u)] * len(kinds) + [(well, u)] * (len(kinds) + 1),
        [*kinds, *kinds, None],
    )[:, :, Q3]
    apart = np.abs(q - q[:, -1:]).max(0)
    assert dict(zip(kinds, apart[: len(kinds)] > 0.01, strict=True)) == dict.fromkeys(kinds, True)
    assert not apart[len(kinds) :].any()


def test_every_fault_is_neutral_where_a_joint_has_not_got_it(
    machine: Machine, mix_sizes: Callable[[str], dict[str, np.ndarray]]
) -> None:
    numbers = clean(machine, "compensated")
    for effect in FAULTS:
        found = apply_faults(numbers, {effect: mix_sizes(effect)})
        differing = [
            name for name in numbers if not np.array_equal(found[name][:2], numbers[name][:2])
        ]
        assert not set(differing) - {"drift_s", "soft_damping"}, (
            effect
        )  # these count where their size is above 0 only


@pytest.fixture
def mix_sizes(machine: Machine) -> Callable[[str], dict[str, np.ndarray]]:
    mix = option("exam_mix", "main")

    def sizes(effect: str) -> dict[str, np.ndarray]:
        trouble = mix.troubles[effect]
        found = {name: np.full(machine.num_joints, value) for name, value in trouble.shape.items()}
        for name, (none, typical) in trouble.numbers.items():
            found[name] = size(machine, none if none in (0.0, 1.0) else 0.0, typical)
        return found

    return sizes
