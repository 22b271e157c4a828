"""A mount puts the camera where its axes say; the next view is the one that would tell the most."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE, every, option

from brokk_rl.contracts.vision import HolePose
from brokk_rl.extensions import load_part
from brokk_rl.machine import Machine
from perception.mount.mounts import (
    Capsules,
    HoleBelief,
    ViewPlanner,
    compute_visible_share,
    sample_circle,
)
from perception.render.scene_ranges import view_from
from perception.target_sensor import WatchedHole

RIG = option("rig", "zed_2i_1080p")
ARM = option("target", "perceived").camera.arm
UP = np.array([0.0, 0.0, 1.0])
HOLE_M = np.array([2.6, 0.0, 0.75])


def believe(std_m: float = 0.01) -> HoleBelief:
    return HoleBelief.expect(None, HOLE_M, 0.05, std_m)


def plan(name: str, **fields: Any) -> tuple[Any, Any]:
    mount = option("perception/mount", name, **fields).build(MACHINE)
    return mount, ViewPlanner(load_part("next_view"), MACHINE, mount, RIG, ARM)


@every("perception/mount")
def test_a_mount_is_at_its_start_at_once_and_later_elsewhere(name: str) -> None:
    mount = option("perception/mount", name).build(MACHINE)
    views, q = mount.views, MACHINE.home
    travel_s = mount.compute_travel_s(mount.start, np.concatenate([mount.start[None], views]))
    assert travel_s[0] == 0.0
    is_elsewhere = (np.abs(views - mount.start) > 0).any(-1)
    assert ((travel_s[1:] > 0) == is_elsewhere).all()
    poses = mount.locate(views[:, None], np.stack([q, q])[None])
    poses = np.broadcast_to(poses, (len(views), 2, 4, 4))
    turn = poses[..., :3, :3]
    np.testing.assert_allclose(
        turn @ np.swapaxes(turn, -1, -2), np.broadcast_to(np.eye(3), turn.shape), atol=1e-9
    )
    one = mount.locate(views[-1], q)
    np.testing.assert_allclose(one, poses[-1, 0], atol=1e-12)
    assert mount.describe(mount.start)


def test_lift_and_pan_move_the_camera_as_worked_out_by_hand() -> None:
    mount = option("perception/mount", "mast").build(MACHINE)
    q = np.zeros(5)
    q[0] = np.pi / 2
    pose = mount.locate(np.array([1.5, np.pi / 2]), q)
    # foot (0.05, 0.33) turned by 90 degrees with the tower, 0.62 m and the lift above the ground
    np.testing.assert_allclose(pose[:3, 3], [-0.33, 0.05, 0.62 + 1.5], atol=1e-9)
    # tower and pan together turn it to face backwards, 0.6 rad down
    np.testing.assert_allclose(pose[:3, 2], [-np.cos(0.6), 0.0, -np.sin(0.6)], atol=1e-9)


def test_a_rod_hides_exactly_the_part_of_the_rim_behind_it() -> None:
    camera, rim = np.array([0.0, 0.0, 2.0]), sample_circle(np.zeros(3), UP, 0.1)
    # half way up, a rod over the half x < 0: it looks twice as large
    rod = Capsules(np.array([[-0.06, -1.0, 1.0]]), np.array([[-0.06, 1.0, 1.0]]), np.array([0.05]))
    behind = np.abs(rim[:, 0] / 2 + 0.06) < 0.05
    share = compute_visible_share(camera, rim, rod)
    assert 0.3 < behind.mean() < 0.7
    assert share == pytest.approx(1.0 - behind.mean(), abs=1 / len(rim))
    aside = np.array([3.0, 0.0, 2.0])
    assert compute_visible_share(np.stack([camera, aside]), rim, rod)[1] == 1.0


def test_the_next_view_sees_a_hole_that_the_arm_will_hide() -> None:
    mount, planner = plan("mast")
    # the arm comes to rest between the camera and the hole
    q = np.array([0.0, -0.6, 1.2, 0.8, 0.3])
    between = (mount.locate(mount.start, q)[:3, 3] + 3 * HOLE_M) / 4
    planner._arm = _Wall(between)
    view = planner.aim(believe(), np.stack([q] * 7), 0.0)
    assert view.is_moving
    assert view.seen_before_s == 0.0 and view.seen_s > 3.0
    assert view.std_m < view.std_before_m


class _Wall:
    """A ball before the camera, in the place of an arm."""

    def __init__(self, center_m: np.ndarray) -> None:
        self._center_m = center_m

    def cover(self, machine: Machine, q: np.ndarray) -> Capsules:
        ends = np.broadcast_to(self._center_m, (len(q), 1, 3))
        return Capsules(ends, ends + 1e-3, np.array([0.1]))


def test_a_scene_seen_from_elsewhere_is_the_same_scene() -> None:
    camera = option("perception/source", "simulator")
    scene = camera.compose(camera.task_scene, np.zeros((0, 3)))
    motion = np.linalg.inv(RIG.base_from_camera)
    seen = view_from(scene, motion @ RIG.base_from_camera)
    np.testing.assert_allclose(seen.block.pose.center_m, scene.block.pose.center_m, atol=1e-12)
    # in the base frame the block's top is level, and the sun is where it was
    level = view_from(scene, RIG.base_from_camera)
    np.testing.assert_allclose(level.block.pose.rotation[:, 2], UP, atol=1e-9)
    np.testing.assert_allclose(
        level.light.to_sun, RIG.base_from_camera[:3, :3] @ scene.light.to_sun
    )
    assert any(solid is level.block for solid in level.solids)


def test_a_view_that_showed_nothing_is_left_for_another_one_and_not_for_itself() -> None:
    mount, planner = plan("mast")
    q = np.stack([MACHINE.home] * 7)
    assert not planner.aim(believe(), q, 0.0).is_moving
    planner.num_missed = 8
    view = planner.aim(believe(), q, 3.0)
    assert view.is_moving and not np.array_equal(planner.position, mount.start)
    assert (planner.num_missed, planner.arrives_s) == (0, 3.0 + view.travel_s)


def test_the_mast_turns_to_the_hole_wherever_the_arm_points() -> None:
    for q1 in (-1.2, 0.0, 1.2):
        mount, planner = plan("mast")
        q = MACHINE.home.copy()
        q[0] = q1
        planner.aim(believe(), np.stack([q] * 7), 0.0)
        ahead = mount.locate(planner.position, q)[:3, 2]
        camera_m = mount.locate(planner.position, q)[:3, 3]
        away = HOLE_M - camera_m
        bearing = np.arctan2(away[1], away[0]) - np.arctan2(ahead[1], ahead[0])
        assert abs(np.angle(np.exp(1j * bearing))) < 0.5


def watch() -> WatchedHole:
    mast = option("perception/mount", "mast")
    settings = replace(option("target", "perceived"), mount=mast, delay_s=0.35, hint_m=0.03)
    scene = np.array([*HOLE_M, 0.0, 1.0, 0.05, 0.0])
    return WatchedHole(settings, MACHINE, scene, (0,))


def detect(center_m: np.ndarray) -> HolePose:
    cov = 0.001**2 * np.eye(3)
    return HolePose(center_m, UP, 0.05, cov, np.zeros((3, 3)), "base", 0.9, 0.0)


def test_what_a_picture_shows_is_known_after_the_delay_and_near_the_pointed_place_alone() -> None:
    eye = watch()
    assert 0.0 < np.linalg.norm(eye.center_m - HOLE_M) < 0.15
    eye.wait_for([detect(HOLE_M + np.array([0.4, 0.0, 0.0]))], 0.0)
    eye.learn(0.4)
    assert eye.hole is None
    eye.wait_for([detect(HOLE_M)], 1.0)
    eye.learn(1.3)
    assert eye.hole is None
    eye.learn(1.35)
    np.testing.assert_allclose(eye.center_m, HOLE_M)
    assert [is_seen for is_seen, _ in eye.history] == [True, True]


def test_a_picture_that_was_not_taken_is_no_miss() -> None:
    eye = watch()
    for t_s, holes in ((0.0, ()), (0.5, None), (1.0, ())):
        eye.wait_for(holes, t_s)
    eye.learn(2.0)
    assert eye.planner.num_missed == 2
    eye.wait_for([detect(HOLE_M)], 2.0)
    eye.learn(3.0)
    assert eye.planner.num_missed == 0
