"""The network and its training: it learns, goes on exactly where it was stopped, and leaves files that say the same."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cuboid
import numpy as np
import pytest
import torch

from brokk_rl import cli
from perception import dataset
from perception.dataset import FrameLabel
from perception.train import evaluation, trainer

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
        eye = (
            -distance_m * np.cos(angle),
            -distance_m * np.sin(angle),
            generator.uniform(0.4, 0.9),
        )
        view = cuboid.seen(cuboid.looking(eye, (0.0, 0.0, 0.3)), (160, 90), with_box=number != 5)
        dataset.write_frame(
            folder / f"{number:02d}",
            view.frame.color,
            None,
            label=FrameLabel(view.block, view.mouth, view.occluder),
        )
    return folder


def test_figures_of_a_worked_example_are_right() -> None:
    known = torch.zeros(2, 2, 2, 4, 6, dtype=torch.bool)
    known[0, 0, 0, :, :4] = True  # 16 px of block
    known[0, 1, 1, 0, 0] = known[0, 1, 1, 3, 4:] = True  # two mouths
    said = torch.zeros(2, 2, 2, 4, 6)
    said[0, 0, 0, :, :5] = 0.9  # 20 px
    said[0, 1, 1, 3, 3:] = 0.9  # the second mouth, one pixel too much: overlap 2 / 3
    said[1, 1, 1, 0, 0] = 0.9  # a mouth where there is none
    table = evaluation.compute_metrics(said, known, ["clean", "empty"])
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
    brokk: Callable[..., Any], frames: Path, monkeypatch: pytest.MonkeyPatch
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
        assert brokk(*command, "session.out=parts").code == 130
    done = brokk(*command, "session.out=more", "training.start=parts/segmenter.safetensors")
    assert done.code == 0, done.err


def test_folders_without_masks_are_refused(brokk: Callable[..., Any], tmp_path: Path) -> None:
    done = brokk("mode=train_perception", f"training.frames={tmp_path}", "session.out=run")
    assert done.code == 2 and "mode=render" in done.err and not Path("run").exists()
    done = brokk(
        "mode=train_perception", "training.frames=x", "training.size_px=[100,48]", "session.out=run"
    )
    assert done.code == 2 and "multiples of 32" in done.err
