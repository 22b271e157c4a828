"""Segmenters: planes in depth against a renderer's masks, windows there and back, what stands in files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cuboid
import numpy as np
import pytest
import torch
from composed import option
from drawn import blank

from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.extensions import load_part
from brokk_rl.signals import Frame
from perception.render.frame_renderer import FrameRenderer
from perception.render.scene_sampler import SceneSampler
from perception.segment import network as segment_network
from perception.segment import unet
from perception.segment.network import NetworkSegmenter
from perception.segment.unet import UNet, read_checkpoint

SIZE_PX = (640, 360)


@pytest.mark.parametrize("distance_m", [1.3, 4.0])
@pytest.mark.parametrize("around_rad", [0.2, 1.2])
def test_planes_before_their_surroundings_are_the_block(
    distance_m: float, around_rad: float
) -> None:
    eye = (-distance_m * np.cos(around_rad), -distance_m * np.sin(around_rad), 1.1)
    view = cuboid.seen(cuboid.looking(eye, (0.1, 0.0, 0.3)), SIZE_PX, noise_per_m=0.0024)
    masks = option("perception/segmenter", "depth_plane").build().segment(view.frame)
    assert masks.hole_mask is None
    assert masks.block.shape == view.block.shape and masks.block.dtype == np.float32
    assert masks.block.min() >= 0.0 and masks.block.max() <= 1.0
    found = masks.block > 0.5
    # An edge is off by half a cell of 2 px; at 4 m the block has 150 px.
    assert (found & view.block).sum() > 0.94 * found.sum()
    # A top seen at a grazing angle is thinner than a matcher's noise.
    front_and_side = 0.8 if distance_m < 3 else 0.7
    assert cuboid.overlap(found, view.block) > front_and_side


def test_ground_alone_is_no_block_and_the_same_frame_gives_the_same_mask() -> None:
    segmenter = option("perception/segmenter", "depth_plane").build()
    pose = cuboid.looking((-2.0, 0.4, 1.0), (0.0, 0.0, 0.3))
    empty = cuboid.seen(pose, SIZE_PX, 0.0024, with_box=False)
    assert segmenter.segment(empty.frame).block.max() < 0.5
    view = cuboid.seen(pose, SIZE_PX, 0.0024)
    one, other = (segmenter.segment(view.frame).block for _ in range(2))
    np.testing.assert_array_equal(one, other)


def test_what_stands_before_a_face_is_not_part_of_it_and_a_mouth_is() -> None:
    pose = cuboid.looking((-1.6, -0.3, 0.8), (0.1, 0.0, 0.3))
    view = cuboid.seen(pose, SIZE_PX, 0.0024, occluder_m=(-0.4, -0.2, 0.45))
    found = option("perception/segmenter", "depth_plane").build().segment(view.frame).block > 0.5
    assert view.occluder.sum() > 1000
    assert (found & view.occluder).mean() < 0.1 * view.occluder.mean()
    assert (found & view.mouth).sum() > 0.9 * view.mouth.sum()


def test_a_network_looks_twice_and_sees_a_mouth_it_was_too_far_from() -> None:
    frame = blank(360, 640)
    frame.color[100:200, 300:450] = 128  # the block
    frame.color[140:150, 380:390] = 255  # its mouth, two pixels at the first look
    shown = []

    def infer(picture: np.ndarray) -> np.ndarray:
        shown.append(picture)
        bright = picture[0]
        mouth = (bright > 0.95) & ((bright > 0.95).sum() > 20)
        return np.stack([bright > 0.3, mouth]).astype(np.float32)

    once = NetworkSegmenter(infer, (160, 96), None).segment(frame)
    assert once.hole_mask is not None and once.hole_mask.max() == 0.0
    twice = NetworkSegmenter(infer, (160, 96), 0.15).segment(frame)
    assert len(shown) == 3 and shown[2].shape == (3, 96, 160)
    true_mouth, true_block = frame.color[..., 0] == 255, frame.color[..., 0] > 0
    assert twice.hole_mask is not None and cuboid.overlap(twice.hole_mask > 0.5, true_mouth) > 0.7
    assert cuboid.overlap(twice.block > 0.5, true_block) > 0.95


def test_a_block_that_is_not_seen_in_the_whole_is_looked_for_in_parts() -> None:
    frame = blank(360, 640)
    frame.color[100:200, 300:450] = 128
    shown = []

    def infer(picture: np.ndarray) -> np.ndarray:
        shown.append(picture)
        bright = picture[0] > 0.3
        if len(shown) <= 6:  # nothing in the whole, nor in five of its parts
            bright[:] = False
        if len(shown) == 7:  # in the last one what is there of it
            bright &= np.arange(160) < 60
        return np.stack([bright, 0.0 * bright]).astype(np.float32)

    masks = NetworkSegmenter(infer, (160, 96), 0.15).segment(frame)
    # the whole, six parts, and two closer looks, since the first of them changed the box
    assert len(shown) == 9
    assert cuboid.overlap(masks.block > 0.5, frame.color[..., 0] > 0) > 0.9
    shown.clear()
    nothing = np.zeros((2, 96, 160), np.float32)
    empty = NetworkSegmenter(lambda picture: nothing, (160, 96), 0.15).segment(frame)
    assert not empty.block.any() and empty.hole_mask is not None and not empty.hole_mask.any()


def test_the_network_that_ships_sees_blocks_and_mouths_it_was_not_trained_on() -> None:
    rig = option("rig", "zed_2i_720p")
    segmenter = option("perception/segmenter", "onnx").build()
    shared, either = np.zeros(2), np.zeros(2)
    for seed in (101, 103):
        chance, kind = np.random.default_rng(seed), option("scene", "clean")
        parts: Any = {"rig": rig, "scene": kind, "stereo": load_part("stereo")}
        studio = FrameRenderer(**parts, depth="none", pair=False)
        shot = studio.shot(SceneSampler(kind, rig, chance).compose(), chance)
        frame = Frame(shot.color, shot.exact_depth_m, rig.left.matrix, None, 0.0)
        masks = segmenter.segment(frame)
        blocks, mouths = (masks.block, shot.label.block), (masks.hole_mask, shot.label.hole_mask)
        for k, (said, known) in enumerate((blocks, mouths)):
            said = said > 0.5
            shared[k] += (said & known).sum()
            either[k] += (said | known).sum()
    assert (shared / either > [0.9, 0.6]).all()
    for name in (unet.ONNX, unet.TENSORS):
        assert (segment_network.SHIPPED / name).stat().st_size < 5_000_000


def test_files_that_are_no_network_of_ours_are_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.onnx").write_bytes(b"no network at all")
    (tmp_path / "broken.safetensors").write_bytes(b"no network at all")
    onnx = option("perception/segmenter", "onnx")
    with pytest.raises(CheckpointError, match="corrupt or no ONNX file"):
        replace(onnx, weights=str(tmp_path / "broken.onnx")).build()
    with pytest.raises(CheckpointError, match="corrupt or no segmenter"):
        read_checkpoint(tmp_path / "broken.safetensors")
    with pytest.raises(CheckpointError, match=r"there is no file 'nowhere\.onnx'"):
        replace(onnx, weights="nowhere.onnx").build()
    network = UNet((4, 8)).eval()
    other = unet.build_header(network, (64, 32), {}) | {"channels": ["cat", "dog"]}
    unet.write_onnx(tmp_path / "other.onnx", network, other, torch.rand(1, 3, 32, 64))
    with pytest.raises(CheckpointError, match="channels block, mouth"):
        replace(onnx, weights=str(tmp_path / "other.onnx")).build()
    with pytest.raises(ConfigError, match="margin"):
        replace(onnx, margin=-0.1)
