"""Where figures go beside `progress.csv`."""

from __future__ import annotations

from pathlib import Path

import pytest
import wandb
from composed import option
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from brokk_rl.errors import ConfigError
from brokk_rl.rl.tracking import NoTracking, TensorBoardTracking, WandbTracking


def test_without_a_tracker_nothing_is_written(tmp_path: Path) -> None:
    tracker = NoTracking().open(tmp_path, {})
    tracker.log({"a": 1.0}, 0)
    tracker.close()
    assert not list(tmp_path.iterdir())


def test_tensorboard_gets_every_figure_at_its_step(tmp_path: Path) -> None:
    tracker = TensorBoardTracking().open(tmp_path, {})
    for step in range(3):
        tracker.log({"episode/success_strict": 0.1 * step, "loss/value": 2.0}, step)
    tracker.close()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    scalars = events.Scalars("episode/success_strict")
    assert [(event.step, round(event.value, 3)) for event in scalars] == [
        (0, 0.0),
        (1, 0.1),
        (2, 0.2),
    ]
    assert len(events.Scalars("loss/value")) == 3


def test_wandb_is_offline_unless_asked() -> None:
    assert option("tracking", "wandb").mode == "offline" and isinstance(
        option("tracking", "none"), NoTracking
    )


@pytest.mark.slow
def test_every_job_of_a_process_gets_a_wandb_run_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    tracking = WandbTracking(project="tests", group=None, tags=("a", "b"), mode="offline")
    folders = [tmp_path / name for name in ("job_0", "job_1")]
    for folder in folders:
        folder.mkdir()
        tracker = tracking.open(folder, {"seed": 0})
        tracker.log({"loss/value": 1.0}, 0)
        tracker.close()
    found = [list((folder / "wandb").glob("offline-run-*")) for folder in folders]
    assert [len(runs) for runs in found] == [1, 1], "one run a job, in its own run folder"
    assert found[0][0].name != found[1][0].name and all(
        list(runs[0].glob("run-*.wandb")) for runs in found
    )


@pytest.mark.parametrize("mode", ["", "sideways"])
def test_an_environment_that_wandb_refuses_is_explained(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    wandb.teardown()  # it reads the environment once a process
    monkeypatch.setenv("WANDB_MODE", mode)
    tracking = WandbTracking(project="tests", group=None, tags=(), mode="disabled")
    if mode:
        with pytest.raises(ConfigError, match="WANDB_MODE"):
            tracking.open(tmp_path, {})
    else:
        tracking.open(tmp_path, {}).close()
