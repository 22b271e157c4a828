"""Augmentations: each does what it is called, the same seed does the same, and picture and mask stay together."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hydra.utils import instantiate

import conf
from perception.train import augmentation, evaluation
from perception.train.samples import Crop, Samples, TrainingViews, cut_windows

SHIPPED: dict[str, Any] = instantiate(
    yaml.safe_load(Path(next(iter(conf.__path__)), "mode/train_perception.yaml").read_text())[
        "training"
    ]["augment"],
    _convert_="all",
)


def picture() -> torch.Tensor:
    """Two pictures of a grey ramp with a bright square, `(2, 3, 64, 96)`."""
    values = torch.linspace(0.2, 0.6, 96).repeat(64, 1)
    values[20:36, 40:60] = 0.9
    return values.repeat(2, 3, 1, 1)


def chance(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("name", SHIPPED)
def test_each_changes_each_picture_its_own_way_and_the_same_for_the_same_seed(name: str) -> None:
    step = {name: replace(SHIPPED[name], probability=1.0)}
    one, same, other = (
        augmentation.apply_augmentations(picture(), step, chance(seed), chance(seed))
        for seed in (1, 1, 2)
    )
    assert one.shape == (2, 3, 64, 96) and one.dtype == torch.float32
    assert one.min() >= 0.0 and one.max() <= 1.0
    assert torch.equal(one, same)
    for different in (other[0], picture()[0], one[1]):
        assert not torch.equal(one[0], different)


def test_contrast_gamma_exposure_and_haze_follow_their_formulas() -> None:
    flat, close = (
        torch.full((1, 3, 8, 8), 0.25),
        functools.partial(torch.testing.assert_close, rtol=1e-5, atol=1e-6),
    )
    gamma = augmentation.Gamma(probability=1.0, exponent=(2.0, 2.0))
    close(gamma.changed(flat, chance(0)), flat * 0.25)
    exposure = augmentation.Exposure(probability=1.0, gain=(2.0, 2.0), tint=0.0)
    close(exposure.changed(flat, chance(0)), flat * 2.0)
    contrast = augmentation.Contrast(probability=1.0, gain=(0.5, 0.5))
    stretched = contrast.changed(picture(), chance(0))
    close(stretched.mean(), picture().mean())
    close(stretched.std(), 0.5 * picture().std())
    haze = augmentation.Haze(
        probability=1.0, transmission=(0.25, 0.25), brightness=(0.8, 0.8), unevenness=0.0
    )
    far, near = haze.changed(0 * flat, chance(0)), haze.changed(0 * flat + 1.0, chance(0))
    close(near - far, flat)  # what is left of the contrast
    assert far.min() >= 0.75 * 0.8 * 0.85 and far.max() <= 0.75 * 0.8


def test_noise_has_the_strength_it_is_given_whatever_its_grain() -> None:
    flat = torch.full((1, 3, 200, 200), 0.5)
    for grain_px in (0.0, 0.3, 1.0):
        noise = augmentation.PictureNoise(
            probability=1.0, constant=(0.03, 0.03), photon=(0.0, 0.0), grain_px=(grain_px, grain_px)
        )
        assert float(noise.changed(flat, chance(0)).std()) == pytest.approx(0.03, rel=0.05)


def test_a_crop_keeps_picture_and_mask_together() -> None:
    crop = Crop(width=(0.5, 1.1), shift=0.2, roll_rad=0.3, mirror=0.5)
    bright = torch.zeros(12, 2, 144, 240, dtype=torch.uint8)
    bright[:, 0, 50:90, 80:150] = 255
    bright[:, 1] = 255 - bright[:, 0]
    windows = crop.windows(torch.ones(12), (144, 240), chance(3))
    seen = cut_windows(bright, windows, (80, 48))
    assert seen.shape == (12, 2, 48, 80)
    inside = cut_windows(torch.full_like(bright, 255), windows, (80, 48))[:, 0]
    torch.testing.assert_close(seen[:, 0] + seen[:, 1], inside)
    assert len({round(float(one.sum()), 1) for one in seen[:, 0]}) == 12


@pytest.mark.parametrize("closer", [0.0, 1.0])
def test_a_sample_that_nothing_is_done_to_is_what_the_segmenter_would_see(closer: float) -> None:
    plain = Crop(width=(1.0, 1.0), shift=0.0, roll_rad=0.0, mirror=0.0)
    down, across = np.mgrid[0:72, 0:120]
    layers = np.stack([across, down, 127 + 60 * np.sin(across / 9.0), 0 * down, 0 * down]).astype(
        np.uint8
    )
    views = TrainingViews(
        torch.from_numpy(np.stack([layers, layers[:, ::-1].copy()])[None]), ("clean",), ("one",)
    )
    seen, _ = evaluation.crop_segmenter_views(views, (80, 48))
    sample, _ = Samples(views, plain, {}, (80, 48), closer, 0, torch.device("cpu")).batch(0, 1)
    assert float((255.0 * sample[0] - seen[0, int(closer)].float()).abs().mean()) < 2.0
