"""Augmentations: each does what it is called, the same seed does the same, and picture and mask stay together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hydra.utils import instantiate

import conf
from brokk_rl.errors import ConfigError
from perception import augment
from perception.training_data import Crop

SHIPPED: dict[str, Any] = instantiate(
    yaml.safe_load(Path(next(iter(conf.__path__)), "mode/train_perception.yaml").read_text())["training"]["augment"],
    _convert_="all",
)


def picture() -> np.ndarray:
    """A grey ramp with a bright square."""
    values = np.tile(np.linspace(0.2, 0.6, 96, dtype=np.float32), (64, 1))
    values[20:36, 40:60] = 0.9
    return np.repeat(values[..., None], 3, 2)


@pytest.mark.parametrize("name", SHIPPED)
def test_each_changes_the_picture_the_same_way_for_the_same_seed(name: str) -> None:
    step = {name: replace(SHIPPED[name], probability=1.0)}
    one, same, other = (augment.augmented(picture(), step, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one.shape == (64, 96, 3) and one.dtype == np.float32
    assert one.min() >= 0.0 and one.max() <= 1.0
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    assert not np.array_equal(one, picture())


@pytest.mark.parametrize("name", SHIPPED)
def test_each_is_switched_off_by_its_probability(name: str) -> None:
    step = {name: replace(SHIPPED[name], probability=0.0)}
    np.testing.assert_array_equal(augment.augmented(picture(), step, np.random.default_rng(0)), picture())


@pytest.mark.parametrize("name", sorted(SHIPPED.keys() - {"shadow", "haze"}))  # those change the light from place to place
def test_nothing_moves_in_the_picture(name: str) -> None:
    step, bright = {name: replace(SHIPPED[name], probability=1.0)}, np.zeros((64, 96, 3), np.float32)
    bright[28:36, 44:52] = 0.6
    rows, columns = np.meshgrid(np.arange(64), np.arange(96), indexing="ij")
    for seed in range(8):
        seen = augment.augmented(bright, step, np.random.default_rng(seed)).mean(2)
        weight = np.clip(seen - np.median(seen) - 0.12, 0.0, None)
        if weight.sum() > 1.0:  # strong dust leaves nothing to see
            assert abs((rows * weight).sum() / weight.sum() - 31.5) < 1.0
            assert abs((columns * weight).sum() / weight.sum() - 47.5) < 1.0


def test_contrast_gamma_exposure_and_haze_follow_their_formulas() -> None:
    generator = np.random.default_rng
    flat = np.full((8, 8, 3), 0.25, np.float32)
    gamma = augment.Gamma(probability=1.0, exponent=(2.0, 2.0))
    np.testing.assert_allclose(gamma.changed(flat, generator(0)), 0.0625)
    exposure = augment.Exposure(probability=1.0, gain=(2.0, 2.0), tint=0.0)
    np.testing.assert_allclose(exposure.changed(flat, generator(0)), 0.5, rtol=1e-6)
    contrast = augment.Contrast(probability=1.0, gain=(0.5, 0.5))
    stretched = contrast.changed(picture(), generator(0))
    assert stretched.mean() == pytest.approx(picture().mean(), abs=1e-5)
    assert stretched.std() == pytest.approx(0.5 * picture().std(), rel=1e-5)
    haze = augment.Haze(probability=1.0, transmission=(0.25, 0.25), brightness=(0.8, 0.8), unevenness=0.0)
    far, near = haze.changed(0 * flat, generator(0)), haze.changed(0 * flat + 1.0, generator(0))
    np.testing.assert_allclose(near - far, 0.25, rtol=1e-5)  # what is left of the contrast
    assert far.min() >= 0.75 * 0.8 * 0.85 and far.max() <= 0.75 * 0.8


def test_noise_has_the_strength_it_is_given_whatever_its_grain() -> None:
    flat = np.full((200, 200, 3), 0.5, np.float32)
    for grain_px in (0.0, 1.0):
        noise = augment.Noise(probability=1.0, constant=(0.03, 0.03), photon=(0.0, 0.0), grain_px=(grain_px, grain_px))
        assert noise.changed(flat, np.random.default_rng(0)).std() == pytest.approx(0.03, rel=0.05)


def test_a_shadow_only_darkens_and_motion_smears_as_far_as_it_says() -> None:
    shadow = augment.Shadow(probability=1.0, depth=(0.3, 0.3), width=(0.3, 0.3), softness=(0.05, 0.05))
    dark = shadow.changed(picture(), np.random.default_rng(4)) / picture()
    assert dark.max() <= 1.0 and dark.min() == pytest.approx(0.3, abs=0.01)
    point = np.zeros((41, 41, 3), np.float32)
    point[20, 20] = 1.0
    smear = augment.MotionBlur(probability=1.0, length_px=(9.0, 9.0)).changed(point, np.random.default_rng(2))[..., 0]
    rows, columns = np.nonzero(smear > 0.02)
    assert smear.sum() == pytest.approx(1.0, abs=1e-4)
    assert 7.0 <= np.hypot(np.ptp(rows), np.ptp(columns)) <= 11.0


@pytest.mark.parametrize("seed", range(12))
def test_a_crop_keeps_picture_and_mask_together(seed: int) -> None:
    crop = Crop(width=(0.5, 1.1), shift=0.2, roll_rad=0.3, mirror=0.5)
    bright = np.zeros((144, 240, 3), np.uint8)
    bright[50:90, 80:150] = 255
    shares = np.stack([bright[..., 0], 255 - bright[..., 0]], axis=-1)
    taken, known = crop.drawn(bright, shares, (80, 48), np.random.default_rng(seed))
    assert taken.shape == (48, 80, 3) and known.shape == (48, 80, 2)
    np.testing.assert_array_equal(taken[..., 0], known[..., 0])


@pytest.mark.parametrize("bad", [{"probability": 1.5}, {"sigma_px": (2.0, 1.0)}, {"sigma_px": (-1.0, 1.0)}])
def test_ranges_that_make_no_sense_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="Blur"):
        replace(SHIPPED["blur"], **bad)
