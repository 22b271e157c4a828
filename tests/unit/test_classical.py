"""The classical controller: prediction over the dead time, valve map, least squares, and that it gets where it shall."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from composed import MACHINE, option
from kinematic import KinematicWorld
from motion import rest

from tasks.control import ClassicalController, _solve_4

CPU = torch.device("cpu")
RANGE_M = (1.7, 2.4)


def controller(**changes: Any) -> ClassicalController:
    config = replace(option("task", "borehole_insertion").classical, **changes)
    return ClassicalController(config, MACHINE, CPU)


def arms(count: int, seed: int = 0) -> torch.Tensor:
    torch.manual_seed(seed)
    lower, upper = (torch.tensor(v, dtype=torch.float32) for v in (MACHINE.lower, MACHINE.upper))
    return lower + (upper - lower) * (0.1 + 0.8 * torch.rand(count, MACHINE.num_joints))


def at_rest(q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    history = q[:, None].repeat(1, MACHINE.num_history, 1)
    return history, torch.zeros_like(history)


def test_commands_in_flight_are_counted_as_motion_to_come() -> None:
    """With 2.5 samples in flight and a dead band of 0.08, the last three commands of 0.54 make (0.54 - 0.08) / 0.92 = half speed.

    q1 runs at 0.4 rad/s, so that 2.5 samples of 50 ms add 0.2 rad/s x 0.125 s = 0.025 rad; older
    commands have acted already.
    """
    classical = controller(in_flight_samples=2.5, dead_band=0.08)
    q, u = at_rest(torch.tensor(MACHINE.home, dtype=torch.float32)[None])
    u[0, -3:, 0] = 0.54
    u[0, :-3, 0] = 1.0
    ahead = q[:, -1].clone()
    ahead[0, 0] += 0.025
    there = classical.kinematics.pose(ahead)
    found = classical.guide(q, u, there.tip_in_base_m, there.pitch_rad, RANGE_M)
    assert found.error_m.abs().max() < 1e-5 and found.pitch_error_rad.abs().max() < 1e-5
    assert (found.command[0, [0, 2, 3, 4]] == 0).all(), "what is on its way is enough"


def test_prediction_counts_what_left_the_joint_and_measures_the_reach_now() -> None:
    classical = controller()
    q, u = at_rest(torch.tensor(MACHINE.home, dtype=torch.float32)[None])
    target = torch.tensor([[2.8, 0.0, 0.75]])
    still = classical.guide(q, u, target, torch.tensor([1.57]), RANGE_M)
    u[0, :, 1] = 1.0
    moving = classical.guide(q, u, target, torch.tensor([1.57]), RANGE_M)
    for name in ("reach_m", "reach_3d_m", "tip_z_m"):
        assert torch.equal(getattr(still, name), getattr(moving, name)), name
    # 12 samples of q2 at 0.18 rad/s lower a tool 2.7 m away by some 0.29 m
    assert moving.error_m[0, 2] - still.error_m[0, 2] > 0.2


def test_the_reach_is_measured_in_the_plane_of_the_arm() -> None:
    """Home has q3's axis at x = 0.25 + 1.5 cos 0.95, z = 0.62 + 0.28 + 1.5 sin 0.95; a target 2 m before it, with q1 anywhere."""
    classical = controller()
    x, z = 0.25 + 1.5 * 0.581683, 0.9 + 1.5 * 0.813416
    q = torch.tensor(MACHINE.home, dtype=torch.float32).repeat(2, 1)
    q[1, 0] = 1.0
    target = torch.tensor([[x + 2.0, 0.0, z]]).repeat(2, 1)
    found = classical.guide(*at_rest(q), target, torch.full((2,), 1.57), RANGE_M)
    assert found.reach_m.tolist() == pytest.approx([2.0, 2.0], abs=1e-4)
    assert found.reach_3d_m[0].item() == pytest.approx(2.0, abs=1e-4)
    assert found.reach_3d_m[1].item() > 2.1


def test_exclusive_joints_rest_in_the_approach() -> None:
    classical = controller()
    q = arms(64)
    pose, jacobian = classical.kinematics.pose_and_jacobian(q)
    error = torch.randn(64, 3)
    share = classical.approach(jacobian.tip, jacobian.pitch, error, torch.randn(64))
    assert (share[:, 1] == 0).all() and (share.abs() <= 1).all()
    assert (share[:, [0, 2, 3, 4]].abs().amax(1) > 0).all()
    assert pose.tip_in_base_m.isfinite().all()


def test_the_approach_moves_the_tool_straight_to_the_target() -> None:
    """J share speed is parallel to the error where the damping is nothing and no joint is at its limit."""
    classical = controller(damping=1e-3)
    q = torch.tensor([[0.3, -0.9, 0.6, 1.1, 0.6]])
    jacobian = classical.kinematics.jacobian(q)
    error = torch.tensor([[0.1, -0.05, 0.08]])
    share = classical.approach(jacobian.tip, jacobian.pitch, error, torch.zeros(1))
    velocity = (jacobian.tip @ (share * classical.speed)[..., None])[0, :, 0]
    cosine = torch.nn.functional.cosine_similarity(velocity, error[0], dim=0)
    assert cosine.item() > 0.9999
    assert (jacobian.pitch * share * classical.speed).sum().abs().item() < 1e-3


def test_the_valve_map_is_inverted_where_it_moves_anything() -> None:
    classical = controller()
    share = torch.linspace(0.06, 1.0, 20)[:, None].repeat(1, 5)  # more than creep
    share[1::2] *= -1
    found = classical.rate(classical.valve(share)) / classical.speed
    torch.testing.assert_close(found, share, rtol=0, atol=1e-6)


def test_small_speeds_become_pulses_of_creep_and_tiny_ones_nothing() -> None:
    # the smallest command is 0.08 + 0.92 x 0.06 = 0.1352
    classical = controller(dead_band=0.08, creep=0.06, rest=0.004)
    found = classical.valve(torch.tensor([0.003, -0.003, 0.005, -0.02, 3.0]))
    assert found.tolist() == pytest.approx([0.0, 0.0, 0.1352, -0.1352, 1.0])


def test_nothing_is_driven_into_a_limit() -> None:
    classical = controller()
    q = torch.tensor(MACHINE.home, dtype=torch.float32).repeat(2, 1)
    q[0, 4], q[1, 4] = float(MACHINE.upper[4]) - 0.04, float(MACHINE.lower[4]) + 0.04
    pose = classical.kinematics.pose(q)
    turn = torch.tensor([0.5, -0.5])
    further, back = (
        classical.guide(*at_rest(q), pose.tip_in_base_m, wanted, RANGE_M).command[:, 4]
        for wanted in (pose.pitch_rad + turn, pose.pitch_rad - turn)
    )
    assert further.tolist() == [0.0, 0.0] and back[0] < 0 < back[1]


def test_whoever_commands_within_the_bounds_slows_down_before_the_ends() -> None:
    """Half the braking distance before the margin a joint may go at half its speed, at the margin not at all, far away freely."""
    classical = controller(margin_rad=0.05, brake_s=0.2, dead_band=0.08)
    speed, upper = torch.tensor(MACHINE.max_speed), torch.tensor(MACHINE.upper)
    q = torch.stack([upper - 0.05 - share * speed * 0.2 for share in (0.0, 0.5, 2.0)]).float()
    target_m = torch.tensor([[2.8, 0.0, 0.75]]).repeat(3, 1)
    found = classical.guide(*at_rest(q), target_m, torch.full((3,), 1.57), RANGE_M)
    half_and_free = torch.tensor([[0.08 + 0.92 * 0.5], [1.0]]).expand(-1, 5)
    torch.testing.assert_close(found.highest[1:], half_and_free, atol=1e-5, rtol=0)
    assert (found.highest[0] <= 0.081).all() and (found.lowest == -1.0).all()


def test_the_tool_waits_above_the_hole_until_it_is_aligned() -> None:
    classical = controller(hover_m=0.24, funnel_m=(0.06, 0.012))
    q = torch.tensor(MACHINE.home, dtype=torch.float32).repeat(3, 1)
    tip = classical.kinematics.pose(q).tip_in_base_m
    target = tip + torch.tensor([[0.2, 0.0, -0.5], [0.036, 0.0, -0.5], [0.01, 0.0, -0.5]])
    found = classical.guide(*at_rest(q), target, torch.full((3,), 1.57), RANGE_M)
    # the whole hover height outside 6 cm, half of it at 36 mm, none within 12 mm
    assert found.goal_error_m.tolist() == pytest.approx([-0.26, -0.38, -0.5], abs=1e-5)


def test_errors_are_told_in_the_plane_of_the_arm() -> None:
    classical = controller()
    q = torch.tensor(MACHINE.home, dtype=torch.float32)[None].clone()
    q[0, 0] = torch.pi / 2  # the arm points along y
    tip = classical.kinematics.pose(q).tip_in_base_m
    target_m = tip + torch.tensor([[0.1, 0.2, 0.3]])
    found = classical.guide(*at_rest(q), target_m, torch.tensor([1.57]), RANGE_M)
    # radial, tangential, up
    assert found.error_m[0].tolist() == pytest.approx([0.2, -0.1, 0.3], abs=1e-5)


def test_the_block_solver_agrees_with_torch() -> None:
    torch.manual_seed(0)
    factor = torch.randn(256, 4, 5, dtype=torch.float64)
    a = factor @ factor.transpose(1, 2) + 0.05 * torch.eye(4, dtype=torch.float64)
    b = torch.randn(256, 4, 1, dtype=torch.float64)
    torch.testing.assert_close(_solve_4(a, b), torch.linalg.solve(a, b))


# Starts are all that some motion can do; from every eighth the greedy approach does not arrive.
@pytest.mark.parametrize(("name", "least"), [("borehole_insertion", 0.75), ("goal_pose", 0.82)])
def test_it_gets_there_from_many_starts_through_dead_time_and_lag(name: str, least: float) -> None:
    """No physics: joints go where the lag model says. Noise and masks are the task's."""
    num = 128
    torch.manual_seed(0)
    process: Any = option("task", name).build(MACHINE, num, CPU)
    model = option("actuator", "lag").build(MACHINE, num, CPU)
    world = KinematicWorld(MACHINE, num)
    start = process.starts(num, 11)
    everywhere = torch.ones(num, dtype=torch.bool)
    world.reset(everywhere, start["q"], start["scene"])
    history = rest(MACHINE, start["q"], num)
    model.reset(everywhere)
    process.reset(everywhere, start)
    running, done = everywhere.clone(), ~everywhere
    for _ in range(process.max_episode_steps):
        u = process.command(process.classical_action(process.observe(history)))
        assert ((u[:, 1] == 0) | (u[:, [0, 2, 3, 4]] == 0).all(1)).all()
        history.push_u(u)
        world.step(model.step(history) - history.q[:, -1])
        history.push_q(world.q)
        end = process.step(history, world)
        done |= running & (end.reason == 0)
        running &= ~(end.terminated | end.timed_out)
        if not running.any():
            break
    assert done.float().mean().item() >= least
