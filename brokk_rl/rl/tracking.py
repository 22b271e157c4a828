"""Trackers of a training run's figures, beside `progress.csv` in the run folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import yaml

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec


class Tracker:
    """An open tracking run; this one stores nothing."""

    def log(self, figures: dict[str, float], step: int) -> None:
        """Store the figures of one iteration."""

    def report(self, evaluation: dict[str, float], files: Sequence[Path]) -> None:
        """Store the figures of the evaluation, and files of the run: policy, pictures, video."""

    def close(self) -> None:
        """End the tracking run; called on success, failure and interruption alike."""


class Tracking(Protocol):
    """A spec in `conf/tracking`: opens a tracking run."""

    def open(self, folder: Path, config: dict[str, Any]) -> Tracker:
        """Return an open tracking run for the run in `folder`, described by `config`."""
        ...


@spec
class NoTracking:
    """No tracker: `progress.csv` and the pictures of the run folder only."""

    def open(self, folder: Path, config: dict[str, Any]) -> Tracker:
        """Return a tracker that does nothing."""
        return Tracker()


@spec
class TensorBoardTracking:
    """TensorBoard event files in the run folder."""

    def open(self, folder: Path, config: dict[str, Any]) -> Tracker:
        """Return a tracker that writes `folder/tensorboard`."""
        return _TensorBoardTracker(folder, config)


@spec
class WandbTracking:
    """Weights & Biases, offline first: one run per job, sent later by `wandb sync`.

    With `wandb.mode=online` it is sent at once.

    Attributes:
        project: Project name.
        group: Group of runs; `null`: the sweep's folder, where there is one.
        tags: Tags.
        mode: `offline`, `online` or `disabled`.
    """

    project: str
    group: str | None
    tags: tuple[str, ...]
    mode: Literal["offline", "online", "disabled"]

    def open(self, folder: Path, config: dict[str, Any]) -> Tracker:
        """Return a tracker with a run of its own, named after the run folder."""
        return _WandbTracker(self, folder, config)


class _TensorBoardTracker(Tracker):
    def __init__(self, folder: Path, config: dict[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer, self._step = SummaryWriter(str(folder / "tensorboard")), 0
        for name, value in config.items():
            text = value if isinstance(value, str) else yaml.safe_dump(value, sort_keys=False)
            self._writer.add_text(name, f"```\n{text.strip()}\n```")

    def log(self, figures: dict[str, float], step: int) -> None:
        self._step = step
        for name, value in figures.items():
            self._writer.add_scalar(name, value, step)

    def report(self, evaluation: dict[str, float], files: Sequence[Path]) -> None:
        from PIL import Image

        self.log(evaluation, self._step)
        for path in files:
            if path.suffix == ".png":
                picture = np.asarray(Image.open(path).convert("RGB"))
                self._writer.add_image(path.stem, picture, self._step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


class _WandbTracker(Tracker):
    def __init__(self, config: WandbTracking, folder: Path, run_config: dict[str, Any]) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")
        for name in [name for name in os.environ if name.startswith("WANDB_")]:
            if not os.environ[name]:  # wandb refuses an empty value where it takes a missing one
                del os.environ[name]
        import wandb

        # reinit: a sweep with Hydra's basic launcher runs its jobs in one process, and each must
        # get a run of its own
        try:
            self._run = wandb.init(
                project=config.project,
                group=config.group or _find_sweep(folder),
                tags=list(config.tags),
                name=folder.name,
                dir=str(folder),
                config=run_config,
                mode=config.mode,
                reinit="create_new",
            )
        except (ValueError, wandb.Error) as error:
            given = {n: value for n, value in os.environ.items() if n.startswith("WANDB_")}
            raise ConfigError(
                f"tracking=wandb cannot begin a run: {error}\nChange tracking.<field>=… or the "
                f"environment, which has {', '.join(sorted(given))}; tracking=none goes without."
            ) from error

    def log(self, figures: dict[str, float], step: int) -> None:
        self._run.log(figures, step=step)

    def report(self, evaluation: dict[str, float], files: Sequence[Path]) -> None:
        import wandb

        self._run.summary.update(evaluation)
        artifact = wandb.Artifact(f"policy-{self._run.id}", type="policy")
        pictures = {}
        for path in files:
            if path.suffix == ".mp4":
                pictures[path.stem] = wandb.Video(str(path), format="mp4")
            elif path.suffix == ".png":
                pictures[path.stem] = wandb.Image(str(path))
            else:
                artifact.add_file(str(path))
        self._run.log(pictures)
        self._run.log_artifact(artifact)

    def close(self) -> None:
        self._run.finish()


def _find_sweep(folder: Path) -> str | None:
    """Return the name of the sweep whose job runs in `folder`, `None` for a single run."""
    return folder.parent.name if (folder.parent / "multirun.yaml").is_file() else None
