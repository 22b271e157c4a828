"""The network and its training: samples are changed as they should, it learns, and leaves files that say the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cuboid
import numpy as np
import pytest
import torch
from conftest import Brokk

from brokk_rl import cli
from perception import dataset
from perception.dataset import FrameLabel
from perception.train import trainer
from perception.train.samples import Augmentation, Crop, Samples, TrainingViews

SMALL = (
    "training.size_px=[64,40]", "training.widths=[6,12,16]", "training.batch=6", "training.rate=0.01",
    "session.device=cpu",
)  # fmt: skip


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of small frames with masks."""
    folder, generator = tmp_path_factory.mktemp("frames"), np.random.default_rng(0)
    for number in range(14):
        angle, distance_m = generator.uniform(-0.6, 0.6), generator.uniform(1.0, 1.6)
        x, y = -distance_m * np.cos(angle), -distance_m * np.sin(angle)
        eye = (x, y, generator.uniform(0.4, 0.9))
        view = cuboid.seen(cuboid.looking(eye, (0.0, 0.0, 0.3)), (160, 90), with_box=number != 5)
        label = FrameLabel(view.block, view.mouth, view.occluder)
        dataset.write_frame(folder / f"{number:02d}", view.frame.color, None, label=label)
    return folder


def test_figures_of_a_worked_example_are_right() -> None:
    known = torch.zeros(2, 2, 2, 4, 6, dtype=torch.bool)
    known[0, 0, 0, :, :4] = True  # 16 px of block
    known[0, 1, 1, 0, 0] = known[0, 1, 1, 3, 4:] = True  # two mouths
    said = torch.zeros(2, 2, 2, 4, 6)
    said[0, 0, 0, :, :5] = 0.9  # 20 px
    said[0, 1, 1, 3, 3:] = 0.9  # the second mouth, one pixel too much: overlap 2 / 3
    said[1, 1, 1, 0, 0] = 0.9  # a mouth where there is none
    table = trainer.compute_metrics(said, known, ["clean", "empty"])
    assert table["all"] == {"block": pytest.approx(0.8), "mouth": pytest.approx(0.4), "frames": 2}
    assert table["empty"] == {"block": None, "mouth": None, "frames": 1}


@pytest.fixture(scope="module")
def trained(frames: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a training of 60 updates."""
    folder = tmp_path_factory.mktemp("trained")
    fields = {"frames": str(frames), "updates": 60, "validate_every": 30, "hold_out": 4}
    overrides = [f"training.{name}={value}" for name, value in fields.items()]
    command = ["brokk", "mode=train_perception", *overrides, *SMALL, "session.out=run"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("sys.argv", command)
        assert cli.main() == 0
    return folder / "run"


def test_a_small_network_learns_the_block_in_seconds(trained: Path) -> None:
    result = json.loads((trained / "training.json").read_text())
    assert result["conditions"]["all"]["block"] > 0.6
    assert result["parity"] < 1e-4
    assert {path.name for path in trained.iterdir()} >= {"segmenter.onnx", "segmenter.safetensors"}


def test_a_stopped_training_leaves_the_best_network_to_go_on_with(
    brokk: Brokk, frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = (
        "mode=train_perception", f"training.frames={frames}", *SMALL, "training.updates=9", "training.validate_every=3",
    )  # fmt: skip
    step, count = trainer._Training._step, 0

    def until_the_fifth(self: Any, *batch: torch.Tensor) -> torch.Tensor:
        nonlocal count
        count += 1
        if count == 5:
            raise KeyboardInterrupt
        return step(self, *batch)

    with monkeypatch.context() as patch:
        patch.setattr(trainer._Training, "_step", until_the_fifth)
        brokk(*command, "session.out=parts", code=130)
    brokk(*command, "session.out=more", "training.start=parts/segmenter.safetensors")


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
    waves, nothing = 127 + 60 * np.sin(across / 9.0), 0 * down
    layers = np.stack([across, down, waves, nothing, nothing]).astype(np.uint8)
    both = torch.from_numpy(np.stack([layers, layers[:, ::-1].copy()])[None])
    views = TrainingViews(both, ("clean",), ("one",))
    seen, _ = trainer.crop_segmenter_views(views, (80, 48))
    sample, _ = Samples(
        views, plain, torch.nn.Identity(), (80, 48), closer, torch.device("cpu")
    ).draw(1)
    assert float((255.0 * sample[0] - seen[0, int(closer)].float()).abs().mean()) < 2.0
