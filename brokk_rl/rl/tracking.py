"""Trackers of a training run's figures, beside `progress.csv` in the run folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal, Protocol

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec


class Tracker(Protocol):
    """An open tracking run."""

    def log(self, figures: dict[str, float], step: int) -> None:
        """Store the figures of one iteration."""
        ...

    def close(self) -> None:
        """End the tracking run; called on success, failure and interruption alike."""
        ...


class Tracking(Protocol):
    """A spec in `conf/tracking`: opens a tracking run."""

    def open(self, folder: Path, config: dict[str, Any]) -> Tracker:
        """Return an open tracking run for the run in `folder`."""
        ...


@spec
class NoTracking:
    """No tracker: `progress.csv` and the pictures of the run folder only."""

    def open(self, folder: Path, config: dict[str, Any]) -> Tracker:
        """Return a tracker that does nothing."""
        return _NoTracker()


@spec
class TensorBoardTracking:
    """TensorBoard event files in the run folder."""

    def open(self, folder: Path, config: dict[str, Any]) -> Tracker:
        """Return a tracker that writes `folder/tensorboard`."""
        return _TensorBoardTracker(folder)


@spec
class WandbTracking:
    """Weights & Biases, offline first: one run per job, sent later by `wandb sync`.

    With `wandb.mode=online` it is sent at once.

    Attributes:
        project: Project name.
        group: Group of runs, or `null`.
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


class _NoTracker:
    def log(self, figures: dict[str, float], step: int) -> None:
        pass

    def close(self) -> None:
        pass


class _TensorBoardTracker:
    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder / "tensorboard"))

    def log(self, figures: dict[str, float], step: int) -> None:
        for name, value in figures.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._writer.close()


class _WandbTracker:
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
                group=config.group,
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

    def close(self) -> None:
        self._run.finish()
