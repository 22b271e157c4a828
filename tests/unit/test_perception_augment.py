"""Augmentations change each picture its own way and no mask; a crop keeps both together."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from perception.train import evaluation
from perception.train.augmentation import Augmentation
from perception.train.samples import Crop, Samples, TrainingViews


def test_each_picture_is_changed_its_own_way_and_the_mask_is_not() -> None:
    change = Augmentation(
        probability=1.0, brightness=(0.6, 1.4), contrast=(0.5, 1.6), gamma=(0.6, 1.7),
        blur_px=(0.3, 1.2), motion_px=4, noise=0.03,
    ).build()  # fmt: skip
    ramp = np.broadcast_to(np.linspace(50, 150, 120), (2, 5, 72, 120)).astype(np.uint8)
    views = TrainingViews(torch.from_numpy(ramp.copy()[None]), ("clean",), ("one",))
    plain = Crop(width=(1.0, 1.0), shift=0.0, roll_rad=0.0, mirror=0.0)
    drawn = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        samples = Samples(views, plain, change, (80, 48), 0.0, torch.device("cpu"))
        drawn.append(samples.draw(2))
    (one, mask), (same, _), (other, _) = drawn
    assert one.shape == (2, 3, 48, 80) and one.min() >= 0.0 and one.max() <= 1.0
    assert torch.equal(one, same) and torch.equal(mask[0], mask[1])
    assert not torch.equal(one[0], one[1]) and not torch.equal(one, other)


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
    nothing = torch.nn.Identity()
    sample, _ = Samples(views, plain, nothing, (80, 48), closer, torch.device("cpu")).draw(1)
    assert float((255.0 * sample[0] - seen[0, int(closer)].float()).abs().mean()) < 2.0
