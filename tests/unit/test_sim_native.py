"""The native world against plain MuJoCo, and what drive, contact, resets and faults must do."""

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from composed import MACHINE

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.sim.model import ASSETS
from brokk_rl.sim.native_world import NativeWorld
from brokk_rl.sim.scene import make_nominal_scenes
from brokk_rl.sim.simulator import NativeSimulator

DOWN = math.pi / 2


def _world(machine: Machine, num_worlds: int = 1) -> NativeWorld:
    return NativeSimulator(num_worlds=num_worlds, substeps=5, num_threads=2).build(machine, "cpu")


def _all(num_worlds: int) -> torch.Tensor:
    return torch.ones(num_worlds, dtype=torch.bool)


def _motion(
    kinematics: Kinematics, q: torch.Tensor, shift_m: torch.Tensor, turn_rad: torch.Tensor
) -> torch.Tensor:
    """Returns the increment of q1, q3, q4, q5 that shifts the tip and turns the tool, first order."""
    jacobian = kinematics.jacobian(q)
    rows = torch.cat([jacobian.tip, jacobian.pitch[:, None]], 1)[..., [0, 2, 3, 4]]
    step = torch.zeros_like(q)
    step[:, [0, 2, 3, 4]] = torch.linalg.solve(rows, torch.cat([shift_m, turn_rad[:, None]], 1))
    return step


def _above_hole(
    scene: torch.Tensor, offset_m: torch.Tensor, height_m: float = 0.05
) -> torch.Tensor:
    """Returns joint positions that hold the chisel upright above the hole of each scene, `offset_m` to the side."""
    kinematics = Kinematics(MACHINE)
    q = torch.tensor(MACHINE.home, dtype=torch.float32).repeat(len(scene), 1)
    goal = scene[:, :3] + torch.cat([offset_m, torch.full((len(scene), 1), height_m)], 1)
    for _ in range(40):
        pose = kinematics.pose(q)
        q = q + 0.5 * _motion(kinematics, q, goal - pose.tip_in_base_m, DOWN - pose.pitch_rad)
    return q


def _lower(
    world: NativeWorld, q: torch.Tensor, depth_m: float, speed_m_s: float = 0.1
) -> torch.Tensor:
    """Commands a straight way down for `depth_m`; returns the greatest contact force of each world."""
    kinematics = Kinematics(MACHINE)
    peak, command = torch.zeros(len(q)), q.clone()
    down = torch.tensor([[0.0, 0.0, -speed_m_s * MACHINE.period_s]]).expand(len(q), -1)
    for _ in range(round(depth_m / speed_m_s / MACHINE.period_s)):
        step = _motion(kinematics, command, down, DOWN - kinematics.pose(command).pitch_rad)
        command = command + step
        world.step(step)
        peak = torch.maximum(peak, world.contact_force_n)
    return peak


def _sum_normal_forces(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Returns the sum over all contacts, N."""
    total, force = 0.0, np.zeros(6)
    for contact in range(data.ncon):
        mujoco.mj_contactForce(model, data, contact, force)
        total += force[0]
    return total


@pytest.mark.parametrize(("size_m", "count"), [(0.02, 1), (3.0, 2)])
def test_touch_sensors_that_lie_do_not_change_the_force(
    size_m: float, count: int, tmp_path: Path
) -> None:
    text = (ASSETS / MACHINE.mjcf).read_text()
    text = text.replace('<site name="tip"', f'<site name="feel" size="{size_m}"/><site name="tip"')
    sensors = '<touch site="feel"/>' * count
    text = text.replace("</worldbody>", f"</worldbody><sensor>{sensors}</sensor>")
    (tmp_path / "arm.xml").write_text(text)
    scene = make_nominal_scenes(1)
    q = _above_hole(scene, torch.tensor([[0.15, 0.0]]))
    peaks = []
    for one in (MACHINE, replace(MACHINE, mjcf=str(tmp_path / "arm.xml"))):
        world = _world(one)
        world.reset(_all(1), q, scene)
        peaks.append(_lower(world, q, 0.1))
    assert peaks[0] > 1000.0 and torch.equal(*peaks)


def test_worlds_do_exactly_what_a_loop_over_plain_mujoco_does():
    world = _world(MACHINE, 3)
    generator = torch.Generator().manual_seed(0)
    speed = torch.tensor(MACHINE.max_speed, dtype=torch.float32)
    models = [world._batch.get_model(i) for i in range(3)]
    data = [mujoco.MjData(model) for model in models]

    def set_states() -> None:
        for model, one, state in zip(models, data, world._batch.state, strict=True):
            mujoco.mj_setState(model, one, state, mujoco.mjtState.mjSTATE_INTEGRATION)

    set_states()
    velocity = torch.zeros(3, 5)
    touched = False
    for _ in range(60):
        velocity = 0.9 * velocity + 0.3 * speed * torch.randn(3, 5, generator=generator)
        world.step(velocity * MACHINE.period_s)
        for i, (model, one) in enumerate(zip(models, data, strict=True)):
            # the drive's outputs at the start of the period: what MuJoCo integrated since is ctrl
            # for one period
            ctrl = world._views["ctrl"][i]
            one.ctrl[:] = ctrl
            one.act[:] = world._drive.reference[i] - 0.05 * ctrl + world._drive._lead * ctrl
            peak = 0.0
            for _ in range(5):
                mujoco.mj_step(model, one)
                peak = max(peak, _sum_normal_forces(model, one))
            assert world.contact_force_n[i].item() == pytest.approx(peak, rel=1e-4, abs=1e-3)
            np.testing.assert_allclose(world._views["qpos"][i].numpy(), one.qpos, atol=1e-6)
            touched = touched or peak > 0
        set_states()
    assert touched


def test_the_number_of_threads_changes_nothing():
    finals = []
    for threads in (1, 2):
        world = NativeSimulator(num_worlds=8, substeps=5, num_threads=threads).build(MACHINE, "cpu")
        generator = torch.Generator().manual_seed(0)
        for _ in range(20):
            world.step(0.02 * torch.randn(8, 5, generator=generator))
        finals.append(world.q.clone())
    assert torch.equal(*finals)


def test_the_arm_holds_its_place_for_a_minute():
    world = _world(MACHINE)
    start = world.q.clone()
    for _ in range(1200):
        world.step(torch.zeros(1, 5))
    assert (world.q - start).abs().max() < 1e-4


def test_free_motion_follows_the_prediction_within_a_milliradian():
    world = _world(MACHINE)
    reference, errors = world.q.double().clone(), []
    speed = 0.5 * torch.tensor(MACHINE.max_speed) * torch.tensor([1.0, 0.5, 1.0, 1.0, 1.0])
    for i in range(400):
        phase = 2 * math.pi * i * MACHINE.period_s / 6.0 + torch.arange(5)
        increment = (speed * phase.sin() * MACHINE.period_s)[None]
        reference += increment
        world.step(increment.float())
        errors.append((world.q - reference)[0])
    assert (torch.stack(errors) ** 2).mean(0).sqrt().max() < 1e-3


def test_a_blocked_joint_pushes_no_harder_than_its_relief_valve_and_does_not_wind_up():
    world = _world(MACHINE)
    scene = make_nominal_scenes(1)
    q = _above_hole(scene, torch.tensor([[0.25, 0.0]]))
    world.reset(_all(1), q, scene)
    _lower(world, q, depth_m=0.3)
    held = torch.stack([_settle(world) for _ in range(20)]).max()
    # 30 kNm of q2 at 2.35 m are 12.8 kN, and no joint pushes harder than that on the tip
    assert 1_000 < held < 14_000
    leash = torch.tensor([body.yield_force.value / body.stiffness.value for body in MACHINE.bodies])
    assert ((world._drive.reference - world._views["qpos"]).abs() <= leash + 0.02).all()
    kinematics = Kinematics(MACHINE)
    pressed = kinematics.pose(world.q).tip_in_base_m[0, 2]
    for _ in range(10):  # as soon as the command turns, the tip leaves the block
        world.step(_motion(kinematics, world.q, torch.tensor([[0.0, 0.0, 0.01]]), torch.zeros(1)))
    assert world.contact_force_n.item() == 0.0
    assert kinematics.pose(world.q).tip_in_base_m[0, 2] > pressed + 0.03


def _settle(world: NativeWorld) -> torch.Tensor:
    world.step(torch.zeros(world.num_worlds, 5))
    return world.contact_force_n.clone()


@pytest.mark.parametrize("offset_mm", [8, 15, 20])
def test_a_chisel_beside_the_middle_slides_in(offset_mm):
    angles = torch.arange(8) * math.pi / 4
    scene = make_nominal_scenes(8)
    scene[:, 3] = 0.2  # a turned block, so that the directions meet flats and corners
    world = _world(MACHINE, 8)
    q = _above_hole(scene, offset_mm / 1000 * torch.stack([angles.cos(), angles.sin()], 1))
    world.reset(_all(8), q, scene)
    _lower(world, q, depth_m=0.35)
    depth = scene[:, 2] - Kinematics(MACHINE).pose(world.q).tip_in_base_m[:, 2]
    assert (depth > 0.25).all()
    assert not world.faults.any()


def test_a_chisel_goes_in_where_the_hole_is_and_wide_enough_and_nowhere_else():
    """In the middle, in a hole deeper than the ground, in one that is too narrow, and beside it."""
    offset_m = torch.tensor([[0, 0], [0, 0], [0, 0], [0.12, 0], [-0.2, 0.1], [0, -0.15]])
    scene = make_nominal_scenes(6)
    scene[1, 2] = 0.2
    scene[2, 5] = 0.035
    world = _world(MACHINE, 6)
    q = _above_hole(scene, offset_m)
    world.reset(_all(6), q, scene)
    peak = _lower(world, q, depth_m=0.35)
    depth = scene[:, 2] - Kinematics(MACHINE).pose(world.q).tip_in_base_m[:, 2]
    assert (depth[:2] > 0.29).all() and (peak[:2] == 0.0).all()
    assert depth[2] < 0.04 and (depth[3:] < 0.01).all() and (peak[2:] > 1_000).all()
