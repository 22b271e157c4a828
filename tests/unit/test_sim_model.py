"""From a machine and its MJCF to a model."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from composed import MACHINE
from scipy.spatial.transform import Rotation

from brokk_rl.errors import ConfigError
from brokk_rl.sim.model import compile_model
from brokk_rl.sim.scene import ScenePlacement, build_collision_geoms, make_nominal_scenes


def test_numbers_of_the_machine_stand_in_the_model():
    model = compile_model(MACHINE, 0.01)
    np.testing.assert_allclose(model.jnt_range, np.stack([MACHINE.lower, MACHINE.upper], 1))
    masses = [model.body(f"{joint.name}_link").mass[0] for joint in MACHINE.joints]
    numbers = {"mass_kg": masses, "stiffness": model.actuator_gainprm[:, 0]}
    numbers["yield_force"] = model.actuator_forcerange[:, 1]
    for name, found in numbers.items():
        expected = [getattr(body, name).value for body in MACHINE.bodies]
        np.testing.assert_allclose(found, expected, err_msg=name)
    assert [model.actuator(i).name for i in range(model.nu)] == list(MACHINE.joint_names)


def test_pictures_do_not_change_the_physics():
    models = [compile_model(MACHINE, 0.01, visual=visual) for visual in (False, True)]
    finals = []
    for model in models:
        data = mujoco.MjData(model)
        data.qpos[:] = data.act[:] = MACHINE.home
        data.ctrl[:] = 0.1
        mujoco.mj_step(model, data, 200)
        finals.append(data.qpos.copy())
    np.testing.assert_allclose(*finals, rtol=0, atol=1e-9)


def test_joints_that_do_not_match_are_named():
    other = dataclasses.replace(MACHINE, joints=MACHINE.joints[:4], levers=())
    with pytest.raises(ConfigError, match=r"missing: none, unknown: q5"):
        compile_model(other, 0.01)


@pytest.mark.parametrize(("scale", "radius_m"), [(1.0, 0.05), (1.1, 0.045), (0.9, 0.08)])
def test_a_hole_has_walls_all_round_and_nothing_inside(scale, radius_m):
    block = build_collision_geoms(scale, radius_m)
    angles = np.linspace(0, 2 * np.pi, 721)
    around = 1.0 / np.cos(np.pi / 8) + 0.001
    for distance, expected in ((0.999, False), (around, True), (1.4, True), (1.8, True)):
        points = distance * radius_m * np.stack([np.cos(angles), np.sin(angles)], 1)
        inside = np.zeros(len(points), dtype=bool)
        walls = zip(block.names, block.size, block.pos, block.yaw_rad, strict=True)
        for name, size, pos, yaw in walls:
            if name.startswith(("slab", "post")):
                turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
                inside |= (np.abs((points - pos[:2]) @ turn) <= size[:2]).all(1)
        assert (inside == expected).all()


def test_scenes_become_the_geoms_of_their_block():
    model = compile_model(MACHINE, 0.01)
    placement = ScenePlacement(model, "cpu", torch.float64)
    scene = make_nominal_scenes(2)
    scene[1, 3:6] = torch.tensor([0.3, 1.1, 0.06])
    size, pos = placement.geoms(scene)
    for row, (scale, radius_m) in enumerate([(1.0, 0.05), (1.1, 0.06)]):
        block = build_collision_geoms(scale, radius_m)
        np.testing.assert_allclose(size[row, :-1], block.size, atol=1e-7)
        np.testing.assert_allclose(pos[row, :-1], block.pos, atol=1e-7)
    # The ground lies under the rim.
    np.testing.assert_allclose(pos[:, -1, 2], [-0.75, -0.75], atol=1e-7)
    _, turn = placement.pose(scene)
    np.testing.assert_allclose(turn[1], [np.cos(0.15), 0, 0, np.sin(0.15)], atol=1e-7)


def test_a_block_that_leans_turns_its_hole_away_from_the_machine_and_stands_on_nothing():
    placement = ScenePlacement(compile_model(MACHINE, 0.01), "cpu", torch.float64)
    scene = make_nominal_scenes(1)
    hole_m, yaw_rad, lean_rad = [1.5, 2.0], 0.4, 0.2
    scene[0, :2], scene[0, 3], scene[0, 6] = torch.tensor(hole_m), yaw_rad, lean_rad
    _, turn = placement.pose(scene)
    across = np.array([-0.8, 0.6, 0.0])  # horizontal, at right angles to the bearing of the hole
    leaning = Rotation.from_rotvec(lean_rad * across) * Rotation.from_rotvec([0.0, 0.0, yaw_rad])
    np.testing.assert_allclose(turn[0], leaning.as_quat(scalar_first=True), atol=1e-7)
    assert placement.geoms(scene)[1][0, -1, 2] < -5.0


def test_bounding_volumes_hold_every_block():
    model = compile_model(MACHINE, 0.01)
    placement = ScenePlacement(model, "cpu", torch.float64)
    scene = make_nominal_scenes(4)
    scene[:, 4:6] = torch.tensor([[0.5, 0.01], [1.25, 0.01], [0.5, 0.08], [9.0, 9.0]])
    size, _ = placement.geoms(scene)
    assert (size.norm(dim=-1) <= torch.tensor(model.geom_rbound)[placement.geom_ids] + 1e-9).all()
    assert (size <= torch.tensor(model.geom_aabb[:, 3:])[placement.geom_ids] + 1e-9).all()
