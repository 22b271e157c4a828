"""Forward kinematics against MuJoCo, against differences, and by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from brokk_rl.kinematics import Gravity, Kinematics, compute_tool_kinematics, solve_joint_step
from brokk_rl.machine import Dimension, Machine
from brokk_rl.sim.model import compile_model


def _random_positions(machine: Machine, count: int) -> torch.Tensor:
    shape = (count, machine.num_joints)
    q = np.random.default_rng(0).uniform(machine.lower, machine.upper, shape)
    return torch.tensor(q).float()


def _dimensions(*values: float) -> tuple[Dimension, ...]:
    return tuple(Dimension(value=value, source="test", confidence="high") for value in values)


def _chain(machine: Machine, kinds: str, axes: list[tuple[float, float, float]]) -> Machine:
    """Returns a machine with joints of `kinds` (h or s) about `axes` and skew origins."""
    joints = []
    for i, (letter, axis) in enumerate(zip(kinds, axes, strict=True)):
        origin_m = _dimensions(0.3, 0.1 * i, 0.2)
        body = replace(machine.bodies[0], axis=axis, origin_m=origin_m)
        kind = "hinge" if letter == "h" else "slide"
        joints.append(replace(machine.joints[0], name=f"j{i}", kind=kind, body=body))
    tool_m = _dimensions(0.4, 0.1, -0.2)
    return replace(machine, joints=tuple(joints), exclusive=(), levers=(), tool_m=tool_m)


def _mujoco_chain(machine: Machine) -> mujoco.MjModel:
    """Returns a bare MuJoCo model of the chain."""
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for joint, link in zip(machine.joints, machine.bodies, strict=True):
        body = body.add_body(pos=[d.value for d in link.origin_m])
        body.mass, body.ipos, body.inertia = link.mass_kg.value, link.com_m, (1.0, 1.0, 1.0)
        body.explicitinertial = True
        kind = mujoco.mjtJoint.mjJNT_HINGE if joint.kind == "hinge" else mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(type=kind, axis=link.axis)
    body.add_site(name="tip", pos=machine.tip_m)
    return spec.compile()


def test_a_tool_that_points_straight_down_has_the_papers_pitch(machine):
    pose = Kinematics(machine).pose(torch.tensor([math.pi / 2, 0.0, 0.0, 0.0, math.pi / 2]))
    # slewed to the left; 0.25 + 1.50 + 1.25 + 1.00 to the side, 0.9 - 1.2 up
    assert pose.tip_in_base_m.tolist() == pytest.approx([0.0, 4.0, -0.3], abs=1e-6)
    assert pose.axis_in_base.tolist() == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)
    assert pose.pitch_rad.item() == pytest.approx(math.pi / 2, abs=1e-6)


@pytest.mark.parametrize(
    ("kinds", "axes"),
    [
        ("hhh", [(1, 0, 0), (0, 1, 0), (0, 0, 1)]),
        ("shs", [(0, 0, 1), (0, 1, 0), (1, 0, 0)]),
        ("hshs", [(0, 0, 1), (1, 0, 0), (0, 0, 1), (0, 1, 0)]),
        ("hhhs", [(0, 0, 1), (0, 0.6, 0.8), (0, 0.6, 0.8), (0, 0, 1)]),
        ("ss", [(1, 0, 0), (0, 1, 0)]),
    ],
)
def test_any_serial_chain_agrees_with_mujoco(machine, kinds, axes):
    chain = _chain(machine, kinds, axes)
    model = _mujoco_chain(chain)
    data = mujoco.MjData(model)
    q = torch.randn(20, len(kinds), generator=torch.Generator().manual_seed(1))
    kinematics = Kinematics(chain)
    tip, jacobian = kinematics.pose(q).tip_in_base_m, kinematics.jacobian(q).tip
    reference = np.zeros((3, len(kinds)))
    for i, row in enumerate(q.double().numpy()):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, reference, None, 0)
        np.testing.assert_allclose(tip[i], data.site("tip").xpos, atol=5e-6)
        np.testing.assert_allclose(jacobian[i], reference, atol=5e-6)


def test_an_arm_that_does_not_slew_pitches_by_the_sum_of_its_joints(machine):
    chain = _chain(machine, "hh", [(0, 1, 0), (0, 1, 0)])
    pose = Kinematics(chain).pose(torch.tensor([0.3, 0.4]))
    assert pose.pitch_rad.item() == pytest.approx(math.atan2(0.2, 0.4) + 0.3 + 0.4, abs=1e-5)


def test_arrays_have_the_jacobians_of_differences_behind_slides_too(machine):
    chain = _chain(machine, "shs", [(0, 0, 1), (0, 1, 0), (1, 0, 0)])
    q, step = np.array([0.2, 0.3, -0.1]), 1e-6
    tool = compute_tool_kinematics(chain, q)
    assert np.linalg.norm(tool.axis_in_base) == pytest.approx(1.0)
    for j, shift in enumerate(step * np.eye(3)):
        ahead, behind = (compute_tool_kinematics(chain, q + sign * shift) for sign in (1, -1))
        tip = (ahead.tip_in_base_m - behind.tip_in_base_m) / (2 * step)
        turn = (ahead.axis_in_base - behind.axis_in_base) / (2 * step)
        np.testing.assert_allclose(tool.jacobian[:, j], tip, atol=1e-8)
        np.testing.assert_allclose(tool.turn[:, j], turn, atol=1e-8)


def test_a_step_of_the_joints_is_the_damped_least_squares_solution(machine):
    tool = compute_tool_kinematics(machine, np.array([0.1, 0.4, -0.3, 0.2, 0.5]))
    wanted, scale = np.array([0.1, -0.05, 0.02, 0.0, 0.1, 0.0]), np.array([1.0, 2.0, 0.0, 0.5, 1.0])
    rows = np.concatenate((np.vstack((tool.jacobian, tool.turn)) * scale, 0.2 * np.eye(5)))
    expected = np.linalg.lstsq(rows, np.concatenate((wanted, np.zeros(5))), rcond=None)[0]
    np.testing.assert_allclose(solve_joint_step(tool, wanted, scale, 0.2), expected, atol=1e-12)


def test_jacobians_are_the_derivatives_of_the_pose(machine):
    kinematics = Kinematics(machine)
    q, step = _random_positions(machine, 50), 1e-2
    jacobian = kinematics.jacobian(q)
    for j in range(machine.num_joints):
        shift = torch.zeros(machine.num_joints)
        shift[j] = step
        ahead, behind = kinematics.pose(q + shift), kinematics.pose(q - shift)
        moved = (ahead.tip_in_base_m - behind.tip_in_base_m) / (2 * step)
        torch.testing.assert_close(jacobian.tip[..., j], moved, atol=3e-4, rtol=0)
        turned = ahead.pitch_rad - behind.pitch_rad
        turned = torch.remainder(turned + math.pi, 2 * math.pi) - math.pi
        torch.testing.assert_close(jacobian.pitch[..., j], turned / (2 * step), atol=3e-4, rtol=0)


def test_the_weight_on_each_joint_is_mujocos_in_both_libraries(machine):
    model = _mujoco_chain(machine)
    data = mujoco.MjData(model)
    q = _random_positions(machine, 20).double().numpy()
    load = Gravity(machine).load(q)
    for i, row in enumerate(q):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(load[i], -data.qfrc_bias, rtol=1e-6, atol=1e-3)
    tensors = Gravity(machine, torch.device("cpu")).load(torch.tensor(q).float())
    np.testing.assert_allclose(tensors, load, rtol=1e-4, atol=0.1)


def of_one_joint(num_envs: int = 1) -> History:
    return History(q=torch.zeros(num_envs, 3, 1), u=torch.zeros(num_envs, 3, 1))


def rows(history: History, env: int = 0) -> tuple[list[float], list[float]]:
    return history.q[env, :, 0].tolist(), history.u[env, :, 0].tolist()


def test_one_control_step_follows_the_trace_of_the_docstring() -> None:
    history = of_one_joint()
    history.q[0, :, 0] = torch.tensor([8.0, 9.0, 10.0])  # q(t-2), q(t-1), q(t) at t = 10
    history.u[0, :, 0] = torch.tensor([7.0, 8.0, 9.0])  # u(t-3), u(t-2), u(t-1)
    history.push_u(torch.tensor([[10.0]]))
    # the actuator model sees position and command of the same moment in one row
    assert rows(history) == ([8, 9, 10], [8, 9, 10])
    history.push_q(torch.tensor([[11.0]]))
    # the next observation knows one position more than commands
    assert rows(history) == ([9, 10, 11], [8, 9, 10])


def test_a_reset_backfills_its_environments_and_leaves_the_others() -> None:
    history = of_one_joint(2)
    history.q += 1.0
    history.u += 0.5
    history.reset(torch.tensor([False, True]), torch.tensor([[7.0], [8.0]]))
    assert rows(history, 0) == ([1, 1, 1], [0.5, 0.5, 0.5])
    assert rows(history, 1) == ([8, 8, 8], [0, 0, 0])


def test_every_update_keeps_the_addresses() -> None:
    history = of_one_joint()
    before = history.q.data_ptr(), history.u.data_ptr()
    history.push_u(torch.ones(1, 1))
    history.push_q(torch.ones(1, 1))
    history.reset(torch.tensor([True]), torch.zeros(1, 1))
    assert (history.q.data_ptr(), history.u.data_ptr()) == before


@pytest.fixture
def unseen(machine: Machine) -> Machine:
    joints = tuple(replace(joint, body=None) for joint in machine.joints)
    return replace(machine, name="unseen", mjcf=None, tool_m=None, joints=joints)


@pytest.mark.parametrize(
    "use", [Kinematics, lambda m: Gravity(m, torch.device("cpu")), lambda m: compile_model(m, 0.01)]
)
def test_what_needs_its_links_says_what_is_missing(unseen: Machine, use) -> None:
    with pytest.raises(ConfigError, match=r"'?unseen'? (is known by its joints|has no MJCF)"):
        use(unseen)


def test_bodies_stand_in_the_fingerprint(machine: Machine, unseen: Machine) -> None:
    assert machine.has_bodies
    known, other = machine.fingerprint(), unseen.fingerprint()
    assert {key for key in known if known[key] != other[key]} == {"name", "geometry"}
