"""Objects of a scene: their shape against geometry by hand, and what the tool feels of them in both simulators."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from composed import option
from kinematic import Kinematic

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.objects import DrilledObject, PipeObject, SceneObject, SlabObject, list_objects
from brokk_rl.sim.scene import make_nominal_scenes

UPRIGHT: dict[str, Any] = {"yaw_rad": 0.0, "tilt_rad": 0.0}


def drilled(**changes: Any) -> DrilledObject:
    fields: dict[str, Any] = {
        "place_m": (2.0, 0.5, 0.8), "size_m": (0.8, 0.4, 0.6), "holes_x_m": (-0.2, 0.15), "radius_m": 0.05,
        "depth_m": 0.3,
    }  # fmt: skip
    return DrilledObject(**fields | UPRIGHT | changes)


def measure_depths(
    machine: Machine, placed: SceneObject, points_m: list[tuple[float, float]]
) -> list[float]:
    """Returns how far rays along the object's -z come below its z = 0, m; -1 where they miss it."""
    model = compile_model(machine, 0.01, objects=[placed])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = data.body("object_0")
    turn = body.xmat.reshape(3, 3)
    # rays see group 1, and only the object is left in it
    model.geom_group[model.geom_bodyid != model.body("object_0").id] = 0
    groups, hit = np.array([0, 1, 0, 0, 0, 0], np.uint8), np.array([-1], np.int32)
    depths = []
    for x_m, y_m in points_m:
        start = body.xpos + turn @ np.array([x_m, y_m, 1.0])
        way = mujoco.mj_ray(model, data, start, -turn[:, 2], groups, 1, -1, hit, None)
        depths.append(-1.0 if way < 0 else float(way - 1.0))
    return depths


@pytest.mark.parametrize("tilt_rad", [0.0, 0.5])
def test_a_drilled_block_has_its_holes_and_nothing_else(tilt_rad: float, machine: Machine) -> None:
    slant = np.cos(np.pi / 4)
    expected = {
        (0.0, 0.0): 0.0,
        (-0.2, 0.0): 0.3,
        (0.15, 0.0): 0.3,
        (0.15, 0.049): 0.3,
        (0.15, 0.052): 0.0,
        (0.15 + 0.049 * slant, 0.049 * slant): 0.3,
        (0.15 + 0.052 * slant, 0.052 * slant): 0.0,
        (-0.39, 0.19): 0.0,
        (0.41, 0.0): -1.0,
    }
    found = measure_depths(machine, drilled(tilt_rad=tilt_rad), list(expected))
    assert found == pytest.approx(list(expected.values()))


def test_a_pipe_is_round_to_eight_percent_and_lies_as_it_is_turned(machine: Machine) -> None:
    pipe = PipeObject(
        place_m=(2.0, 0.0, 0.8), length_m=1.0, radius_m=0.1, yaw_rad=0.7, tilt_rad=0.0
    )
    corner = 0.1 / np.cos(np.pi / 8)
    at = corner * np.sin(np.pi / 8) - 1e-6
    points = [(0.49, 0.0), (0.51, 0.0), (0.0, at), (0.0, corner + 1e-3)]
    found = measure_depths(machine, pipe, points)
    assert found == pytest.approx([-0.1, -1.0, -0.1, -1.0], abs=1e-4)


def test_tilt_lowers_the_end_of_the_x_axis(machine: Machine) -> None:
    slab = SlabObject(place_m=(2.0, 0.0, 1.0), size_m=(1.0, 0.1, 0.1), yaw_rad=0.0, tilt_rad=0.3)
    model = compile_model(machine, 0.01, objects=[slab])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    along = data.body("object_0").xmat.reshape(3, 3)[:, 0]
    assert along == pytest.approx([np.cos(0.3), 0.0, -np.sin(0.3)])


@pytest.mark.parametrize("name", ["native", pytest.param("warp", marks=pytest.mark.slow)])
def test_the_tool_feels_a_wall_that_it_is_driven_against(name: str, machine: Machine) -> None:
    """q1 turns the arm to the left, and a wall stands in the way of the tool."""
    q = torch.tensor(machine.home, dtype=torch.float32)[None]
    tip_m = compute_tool_kinematics(machine, machine.home).tip_in_base_m
    across = (float(tip_m[0]), float(tip_m[1]) + 0.25, float(tip_m[2]))
    wall = SlabObject(place_m=across, size_m=(1.0, 0.1, 0.6), **UPRIGHT)
    scene = make_nominal_scenes(1)
    scene[:, 0] = -20.0
    forces, ends = [], []
    simulator = option("sim", name, **({"parity_worlds": 0} if name == "warp" else {}))
    for objects in ((), (wall,)):
        world = simulator.build(machine, "cpu", 1, objects=objects)
        world.reset(torch.ones(1, dtype=torch.bool), q, scene)
        increment = torch.zeros(1, 5)
        increment[0, 0] = 0.02
        force_n = 0.0
        for _ in range(15):
            world.step(increment)
            force_n = max(force_n, float(world.contact_force_n))
        assert not world.faults.any()
        forces.append(force_n)
        ends.append(float(world.q[0, 0]))
    assert forces[0] == 0.0 and forces[1] > 100.0
    assert ends[1] < ends[0] - 0.05, "the wall holds the arm"


def test_a_simulator_without_objects_says_so() -> None:
    slab = SlabObject(place_m=(2.0, 0.0, 1.0), size_m=(1.0, 0.1, 0.1), **UPRIGHT)
    task: Any = SimpleNamespace(scene={"wall": slab, "off": None})
    without: Any = Kinematic()
    assert list_objects(task, option("sim", "native")) == (slab,)
    assert list_objects(option("task", "goal_pose"), without) == ()
    with pytest.raises(ConfigError, match=r"task\.scene: sim=kinematic cannot build objects"):
        list_objects(task, without)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: drilled(holes_x_m=()), "holes_x_m of a DrilledObject"),
        (lambda: drilled(holes_x_m=(0.1, 0.2)), "0.072 m from"),
        (lambda: drilled(holes_x_m=(-0.38,)), "holes_x_m"),
        (lambda: drilled(depth_m=0.7), "less than its height of 0.6 m, got 0.7"),
        (lambda: SlabObject(place_m=(0, 0, 0), size_m=(0, 1, 1), **UPRIGHT), "size_m of a Slab"),
    ],
)
def test_an_object_that_cannot_be_is_refused(make: Any, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        make()
