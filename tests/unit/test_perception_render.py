"""Rendered frames are what the mathematics says, to the pixel; worked by hand or by OpenCV's own projection."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest
from composed import names, option
from conftest import Brokk

from brokk_rl.extensions import load_part
from brokk_rl.session import Session
from perception.render.drilled_block import Chip, DrilledBlock, DrilledHole
from perception.render.frame_renderer import FrameRenderer
from perception.render.ray_tracer import Light, Pinhole, Tracer
from perception.render.scene_sampler import SceneSampler, compute_hidden_share, sample_rim
from perception.render.solids import Box, Material, PlaneSolid, SolidPose, build_frame
from perception.render.stereo_camera import (
    CameraExposure,
    LinearCamera,
    MosaicCamera,
    StereoRig,
    draw_dust,
    take_picture,
)

GREY = Material((0.5, 0.5, 0.5), 0.0, 0.001)
STONE = Material((0.5, 0.5, 0.5), 0.25, 0.0006, 2)
NOON = Light(np.array([0.0, 0.0, -1.0]), 1.0, 0.5)
"""Light from behind the camera."""
SMALL = Pinhole(320, 240, 400.0, np.zeros(3))
FACING = np.diag([1.0, -1.0, -1.0])
"""A block's pose with its drilled face towards the camera."""


def drilled(
    rotation: np.ndarray, center_m: np.ndarray, material: Material = GREY, **extra: Any
) -> DrilledBlock:
    """Returns a block, 1 x 0.8 x 0.6 m, with one hole of 50 mm, 0.3 m deep, in the middle of the face, which lies at `center_m`."""
    half = np.array([0.5, 0.4, 0.3])
    hole = DrilledHole(np.array([0.0, 0.0, half[2]]), 0.05, 0.3)
    pose = SolidPose(rotation, center_m - rotation @ hole.center_m)
    return DrilledBlock("block", pose, half, (material,) * 12, (hole,), **extra)


def seen(solids: list[Any], camera: Pinhole = SMALL, light: Light = NOON) -> Any:
    return Tracer(solids, light, (0.0, 0.0, 0.0)).view(camera)


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    """The default rig at a quarter of its size."""
    return replace(option("rig", "zed_2i_1080p"), width=480, height=270, focal_px=264.0)


def studio(
    name: str, rig: StereoRig, depth: Literal["matched", "exact", "none"] = "exact"
) -> FrameRenderer:
    parts: Any = {"scene": option("scene", name), "stereo": load_part("stereo")}
    return FrameRenderer(rig=rig, **parts, depth=depth, pair=True)


def test_a_wall_that_fills_the_picture_is_drawn_though_no_edge_crosses_it() -> None:
    wall = PlaneSolid("ground", SolidPose(FACING, np.array([0.0, 0.0, 2.0])), (GREY,))
    view = Tracer([wall], NOON, (0.0, 0.0, 0.0)).view(SMALL)
    np.testing.assert_allclose(view.depth_m, 2.0, rtol=1e-6)
    np.testing.assert_allclose(view.radiance, 0.5 * (1.0 + 0.5), rtol=1e-5)


def test_depths_into_a_hole_are_those_worked_by_hand() -> None:
    # f = 400 px: the pixel 8 px right of the axis looks along x / z = 0.02. The face is at z = 2 m,
    # so x = 0.04 m there: inside the rim of 0.05 m. It would meet the wall at z = 0.05 / 0.02 = 2.5
    # m, and meets the floor at 2.3 m
    # before. 9.6 px: x / z = 0.024, the wall at z = 0.05 / 0.024 = 2.0833 m. 12 px: x = 0.06 m, on
    # the face.
    camera = Pinhole(321, 241, 400.0, np.zeros(3))  # its axis goes through pixel (160, 120)
    block = drilled(FACING, np.array([0.0, 0.0, 2.0]))
    columns, rows = [160.0, 168.0, 169.6, 172.0, 160.0, 160.0], [120.0] * 4 + [129.6, 20.0]
    rays = camera.rays(np.column_stack([columns, rows]))
    depth, part, _ = block.hit(np.zeros(3), rays)
    np.testing.assert_allclose(depth[:5], [2.3, 2.3, 0.05 / 0.024, 2.0, 0.05 / 0.024], atol=1e-5)
    assert part[0] == part[1] == 7 and part[2] == part[4] == 6 and part[3] == 5  # floor, wall, face
    assert np.isinf(depth[5])  # over the block's edge at y = -0.4 m there is nothing


@pytest.mark.parametrize("obliquity", [0.0, 0.61, 1.05])
def test_the_mouth_is_the_projected_circle(obliquity: float) -> None:
    lean, turn = (
        cv2.Rodrigues(np.array(one))[0] for one in ([obliquity, 0.0, 0.0], [0.0, 0.0, 0.4])
    )
    rotation = FACING @ lean @ turn
    center = np.array([0.05, -0.03, 0.8])
    view = seen([drilled(rotation, center)])
    angle = np.linspace(0, 2 * np.pi, 2000)
    rim = center + 0.05 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) @ rotation.T
    projected = cv2.projectPoints(rim, np.zeros(3), np.zeros(3), SMALL.matrix, None)[0]
    pixels, inside = projected[:, 0].astype(np.float32), np.zeros((240, 320), bool)
    for y, x in np.ndindex(inside.shape):
        inside[y, x] = cv2.pointPolygonTest(pixels, (float(x), float(y)), False) > 0
    wrong = inside != view.mouth
    assert view.mouth.sum() > 500
    assert wrong.sum() <= 2  # the polygon of 2000 points against the circle


def test_a_ray_goes_through_a_chip_into_the_hole_and_out_of_neither() -> None:
    # On the rim, 1 cm above the face: a bowl 22.9 mm wide, 15 mm deep.
    chip = Chip(np.array([0.05, 0.0, 0.31]), 0.025)
    ahead_m = np.array([0.0, 0.0, 1.0])
    plain, chipped = drilled(FACING, ahead_m), drilled(FACING, ahead_m, chips=(chip,))
    before, after = seen([plain]), seen([chipped])
    np.testing.assert_array_equal(before.mouth, after.mouth)  # the drilled circle stays what it is
    deeper = after.depth_m - before.depth_m
    assert np.nanmin(deeper) > -1e-6
    # straight ahead through the bowl beside the rim: at x = 0.06 m the ball ends sqrt(25^2 - 10^2)
    # - 10 = 12.91 mm below the face
    ahead = np.array([[0.0, 0.0, 1.0]], np.float32)
    t, part, _ = chipped.hit(np.array([0.06, 0.0, 0.0]), ahead)
    assert t[0] == pytest.approx(1.0 + 0.01291, abs=1e-5) and part[0] == chipped.break_part


def test_a_shadow_lies_where_the_light_is_blocked() -> None:
    wall = PlaneSolid("ground", SolidPose(FACING, np.array([0.0, 0.0, 2.0])), (GREY,))
    pose = SolidPose(np.eye(3), np.array([0.5, 0.0, 1.0]))
    board = Box("arm", pose, np.array([0.1, 0.1, 0.01]), (GREY,))
    # From x = 0 on the wall through x = 0.5, z = 1: the middle of the board.
    to_sun = np.array([1.0, 0.0, -2.0]) / np.sqrt(5)
    view = seen([wall, board], light=Light(to_sun, 1.0, 0.5))
    lit, dark = 0.5 * (0.5 + 2 / np.sqrt(5)), 0.5 * 0.5
    # The shadow is 0.2 m wide: 20 px about x = 0.
    np.testing.assert_allclose(view.radiance[120, 160], dark, rtol=1e-3)
    np.testing.assert_allclose(view.radiance[120, 160 + 30], lit, rtol=1e-3)
    np.testing.assert_allclose(view.radiance[120, 160 - 30], lit, rtol=1e-3)


def test_matched_depth_is_as_uncertain_as_real_pairs_and_has_no_bias(rig: StereoRig) -> None:
    full = replace(rig, width=960, height=540, focal_px=1056.0)  # the middle of a 1080p picture
    rotation, center = build_frame(np.array([0.1, -0.57, -0.82]), 0.3), np.array([0.0, 0.0, 2.5])
    wall = PlaneSolid("ground", SolidPose(FACING, np.array([0.0, 0.0, 5.0])), (STONE,))
    tracer = Tracer([drilled(rotation, center, STONE), wall], NOON, (0, 0, 0))
    exposure = CameraExposure(1.0, 0.0, 0.0, 0.0, 0.5, 8000.0, 8.0, 1.0, 0.0)
    chance = np.random.default_rng(0)
    views = [tracer.view(camera) for camera in (full.left, full.right)]
    pictures = []
    for view in views:
        dust = draw_dust(0.0, chance)
        seen_by = (exposure, dust, LinearCamera(), chance)
        pictures.append(take_picture(view.radiance, view.depth_m, *seen_by))
    left, right = pictures
    stereo = load_part("stereo")
    face = cv2.erode((views[0].solid == 0).astype(np.uint8), np.ones((21, 21))).astype(bool)
    face &= ~cv2.dilate(views[0].mouth.astype(np.uint8), np.ones((21, 21))).astype(bool)
    error, known = {}, {}
    changes: dict[str, dict[str, int]] = {
        "refined": {},
        "plain": {"refinements": 0},
        "half": {"shrink": 2},
    }
    for name, change in changes.items():
        matcher = replace(stereo, **change)
        depth = matcher.depth_m(left, right, 1056.0, 0.12)
        wrong = (1056.0 * 0.12 * (1 / depth - 1 / views[0].depth_m))[face]
        known[name], error[name] = np.isfinite(wrong).mean(), wrong[np.isfinite(wrong)]
    assert known["refined"] > 0.9 and known["half"] > 0.9
    assert abs(np.median(error["half"])) < 0.04
    assert abs(np.median(error["refined"])) < 0.02 < abs(np.median(error["plain"]))
    spread = 1.48 * np.median(np.abs(error["refined"] - np.median(error["refined"])))
    assert 0.03 < spread < 0.35  # 0.29 px on real pairs with dense truth
    # What the right camera does not see.
    assert np.isnan(stereo.depth_m(left, right, 1056.0, 0.12)[:, :20]).all()


def plain_mosaic(**changes: Any) -> MosaicCamera:
    """Returns a colour camera without errors, noise or processing beyond its mosaic."""
    plain = MosaicCamera(
        gain=1.0, color_gain=(2.0, 1.0, 1.6), color_error=(1.0, 1.0, 1.0), focus_px=0.0, motion_px=(0.0, 0.0),
        full_well_e=1e9, read_noise_e=0.0, photo_response=0.0, bits=16, gamma=1.0, sharpening=0.0,
        jpeg_quality=100, pattern=0,
    )  # fmt: skip
    return replace(plain, **changes)


def test_raw_noise_of_a_mosaic_is_that_of_its_electrons() -> None:
    # Red sees 0.5 / 2 of 8000 e: 2000 e, whose noise with 5 e of reading and 1 % of unevenness is
    # sqrt(2000 + 25 + 20^2) = 49.2 e. Green: 4000 e, sqrt(4000 + 25 + 40^2) = 75.0 e.
    camera = plain_mosaic(full_well_e=8000.0, read_noise_e=5.0, photo_response=0.01, pattern=7)
    light = np.full((600, 600, 3), 0.5, np.float32)
    raw = 8000.0 * camera.read_out(light, np.random.default_rng(0))
    assert raw[::2, ::2].mean() == pytest.approx(2000, rel=0.002)
    assert raw[::2, ::2].std() == pytest.approx(49.2, rel=0.02)
    assert raw[::2, 1::2].std() == pytest.approx(75.0, rel=0.02)
    # Another picture of the same camera: unevenness is the same, the rest is new.
    again = 8000.0 * camera.read_out(light, np.random.default_rng(1))
    assert (raw - again)[::2, ::2].std() == pytest.approx(np.sqrt(2 * 2025), rel=0.02)


@pytest.mark.parametrize("name", names("scene"))
def test_truth_and_masks_agree_in_every_kind_of_scene(
    name: str, rig: StereoRig, tmp_path: Path
) -> None:
    rig = replace(rig, width=240, height=136, focal_px=132.0)
    maker = studio(name, rig)
    compose = maker.prepare(tmp_path / "frames", Session(out=".", seed=3, device="cpu"), 1)
    for number in range(1 if name != "varied" else 2):
        shot = maker.shot(*compose(number))
        assert shot.color.shape == shot.right.shape == (136, 240, 3)
        assert not (shot.label.hole_mask & ~shot.label.block).any()
        assert not (shot.label.arm & shot.label.block).any()
        if not any(hole.hidden < 1 for hole in shot.truth.holes):
            assert not shot.label.hole_mask.any()
        for hole in shot.truth.holes[:1]:
            center, base = np.array(hole.center_m), rig.base_from_camera
            assert np.array(hole.axis) @ center < 0  # out of the hole, towards the camera
            in_base_m = base[:3, :3] @ center + base[:3, 3]
            np.testing.assert_allclose(in_base_m, hole.center_in_base_m, atol=1e-9)
            x, y = rig.left.project(center)
            if hole.hidden == 0:
                assert shot.label.hole_mask[round(y), round(x)]
                # The rim or deeper.
                assert shot.exact_depth_m[round(y), round(x)] > center[2] - 0.06
            assert hole.in_view


def test_the_hidden_part_of_a_rim_is_what_the_arm_covers_in_the_picture(rig: StereoRig) -> None:
    chance = np.random.default_rng(7)
    large = replace(rig, width=640, height=360, focal_px=352.0)
    hidden = option("scene", "hidden")
    near = replace(hidden, sight=replace(hidden.sight, distance_m=(0.8, 0.8)))
    for _ in range(2):
        scene = SceneSampler(near, large, chance).compose()
        shot = studio("hidden", large).shot(scene, chance)
        rim = sample_rim(scene.block, scene.block.holes[0])
        pixel = np.round(large.left.project(rim)).astype(int)
        covered = shot.label.arm[pixel[:, 1], pixel[:, 0]].mean()
        assert covered == pytest.approx(scene.conditions["hidden"], abs=0.05)
        assert compute_hidden_share([], scene.block, scene.block.holes[0]) == 0.0


def digests(folder: Path) -> dict[str, str]:
    files = sorted(folder.iterdir())
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_the_command_renders_the_same_bytes_again_and_goes_on_where_it_stopped(
    brokk: Brokk, tmp_path: Path
) -> None:
    size = ("rig.width=320", "rig.height=180", "rig.focal_px=176.0", "render.count=3")
    brokk("mode=render", "scene=varied", "session.out=one", *size)
    first = digests(tmp_path / "one" / "frames")
    assert len(first) == 1 + 3 * 5
    # As if stopped while writing this one.
    (tmp_path / "one" / "frames" / "00001.truth.json").unlink()
    # Without resume it is somebody's run.
    brokk("mode=render", "scene=varied", "session.out=one", *size, code=2)
    brokk("mode=render", "scene=varied", "session.out=one", "resume=one", *size)
    assert digests(tmp_path / "one" / "frames") == first
