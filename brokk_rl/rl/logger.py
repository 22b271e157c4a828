"""Log of a training run: `progress.csv`, trackers beside it, the progress bar, learning curves.

`TrainingLogger` replaces rsl-rl's logger in the runner. That one reads finished episodes back to
the host in every step; this one asks the control loop for its sums once an iteration.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import yaml

from brokk_rl.contracts.task import Figure
from brokk_rl.errors import ConfigError, SimulationError, TrainingError
from brokk_rl.plot import GREY, draw_grid, make_figure, save_figure
from brokk_rl.policy_folder import list_checkpoints
from brokk_rl.progress import SHARE, ItemProgress
from brokk_rl.rl.settings import TrainingConfig
from brokk_rl.spec import spec

if TYPE_CHECKING:
    from brokk_rl.rl.group import TrainingGroup
    from brokk_rl.rl.loop import ControlLoop

log = logging.getLogger(__name__)

PROGRESS = "progress.csv"
SUCCESS = "episode/success_strict"
"""Column of `progress.csv` with the share of successes among the episodes of an iteration."""
EPISODE = "episode/"
"""Begins the columns of `progress.csv` with means over the episodes of an iteration."""
NUM_COLUMNS = 3
"""Panels beside one another in the picture of the curves. Chosen by hand."""


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

    def open(self, folder: Path, config: dict[str, Any], step: int) -> Tracker:
        """Return an open tracking run for the run in `folder`, described by `config`.

        The run goes on at the iteration `step`: what an earlier process stored from there on is
        replaced.
        """
        ...


@spec
class NoTracking:
    """No tracker: `progress.csv` and the pictures of the run folder only."""

    def open(self, folder: Path, config: dict[str, Any], step: int) -> Tracker:
        """Return a tracker that does nothing."""
        return Tracker()


@spec
class TensorBoardTracking:
    """TensorBoard event files in the run folder."""

    def open(self, folder: Path, config: dict[str, Any], step: int) -> Tracker:
        """Return a tracker that writes `folder/tensorboard`."""
        return _TensorBoardTracker(folder, config, step)


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

    def open(self, folder: Path, config: dict[str, Any], step: int) -> Tracker:
        """Return a tracker with the one run of the run folder, named after it."""
        return _WandbTracker(self, folder, config)


class _TensorBoardTracker(Tracker):
    def __init__(self, folder: Path, config: dict[str, Any], step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._step = step
        self._writer = SummaryWriter(str(folder / "tensorboard"), purge_step=step)
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
                id=_find_wandb_run(folder),
                resume="allow",
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


def _find_wandb_run(folder: Path) -> str | None:
    """Return the id of the run that an earlier process began in a run folder, if any."""
    runs = sorted((folder / "wandb").glob("*run-*-*"))  # offline-run-<date>_<time>-<id>
    return runs[-1].name.rpartition("-")[2] if runs else None


def _find_sweep(folder: Path) -> str | None:
    """Return the name of the sweep whose job runs in `folder`, `None` for a single run."""
    return folder.parent.name if (folder.parent / "multirun.yaml").is_file() else None


class TrainingLogger:
    """Logger of one training run; has the methods that `OnPolicyRunner` of rsl-rl calls.

    Of several processes the first shows and writes for all; the others count.

    Args:
        folder: Run folder.
        loop: The control loop, asked for the figures of finished episodes.
        training: Configuration.
        group: The processes that train together.
    """

    def __init__(
        self, folder: Path, loop: ControlLoop, training: TrainingConfig, group: TrainingGroup
    ) -> None:
        self.log_dir = str(folder)
        self.writer = Tracker()
        """Where figures go beside `progress.csv`; its owner closes it."""
        self.env_steps, self.seconds = 0, 0.0
        num_steps = int(training.runner["num_steps_per_env"])
        self.steps_per_iteration = loop.num_envs * num_steps * group.rank.count
        self.first_episodes = loop.num_envs * group.rank.count * loop.task.max_episode_steps
        """Control steps in which the first episodes end. Mostly short ones are among them, and short
        ones are successes: their success is not told."""
        self._loop, self._training, self._group = loop, training, group
        self._folder, self._path = folder, folder / PROGRESS
        self._unwritten: list[dict[str, Any]] = []
        self._told_first = False
        self._last_episode: dict[str, float] = {}
        self._clock = time.perf_counter()
        self._progress = ItemProgress("training", SHARE, self._quiet)

    @property
    def _quiet(self) -> bool:
        return not self._group.rank.first

    @property
    def share_done(self) -> float:
        """Spent share of the run's budget, 1 or more at its end."""
        return self._training.budget.share_spent(self.env_steps, self.seconds)

    def __enter__(self) -> TrainingLogger:
        self._progress.__enter__()
        self._progress.skip(min(1.0, self.share_done))
        self._clock = time.perf_counter()
        return self

    def __exit__(self, *exc: object) -> None:
        self._progress.__exit__(*exc)
        self.flush()

    def init_logging_writer(self) -> None:
        """Do nothing: the tracker is open before the runner exists."""

    def process_env_step(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: the control loop adds up finished episodes on the device."""

    def stop_logging_writer(self) -> None:
        """Do nothing: the tracker stays open until the whole run ends."""

    def log(
        self,
        *,
        it: int,
        collect_time: float,
        learn_time: float,
        loss_dict: dict[str, float],
        **rest: Any,
    ) -> None:
        """Write the figures of one iteration.

        Raises:
            SimulationError: More worlds diverged or overflowed than `max_fault_rate` allows.
            TrainingError: A loss, a gradient or a weight is not finite.
        """
        now = time.perf_counter()
        self.seconds += now - self._clock
        self._clock = now
        self.env_steps += self.steps_per_iteration
        statistics = self._group.pool_statistics(self._loop.statistics())
        self._require_sound(it, statistics["fault_rate"], loss_dict | statistics)
        figures = {
            "env_steps": float(self.env_steps),
            "seconds": self.seconds,
            "rate/env_steps_per_s": self.steps_per_iteration / (collect_time + learn_time),
            "rate/collect_s": collect_time,
            "rate/learn_s": learn_time,
            "episodes": statistics.pop("episodes"),
            "fault_rate": statistics.pop("fault_rate"),
            "policy/learning_rate": float(rest["learning_rate"]),
            "policy/action_std": float(rest["action_std"].detach().mean()),
        }
        figures |= {f"loss/{name}": float(value) for name, value in loss_dict.items()}
        episode = {f"{EPISODE}{name}": value for name, value in statistics.items()}
        # an iteration without a finished episode repeats the last known figures of episodes
        if figures["episodes"] or not self._last_episode:
            self._last_episode = episode
        figures |= self._last_episode
        self._unwritten.append({"iteration": it, **figures})
        self.writer.log(figures, it)
        note = f"{figures['rate/env_steps_per_s']:,.0f} steps/s"
        if self.env_steps > self.first_episodes and SUCCESS in figures:
            note += f", success {figures[SUCCESS]:.2f}"
        # the last iteration may go beyond the budget
        self._progress.reach(min(1.0, self.share_done), note=note)
        if not self._told_first and not self._quiet:
            self._told_first = True
            log.info("first iteration after %.1f s: %s", self.seconds, note)

    def _require_sound(self, it: int, fault_rate: float, figures: Mapping[str, float]) -> None:
        """Refuse to go on after an iteration that lost worlds or spoiled the policy."""
        most = self._training.max_fault_rate
        if fault_rate > most:
            raise SimulationError(
                f"{fault_rate:.2%} of the control steps of iteration {it} ended in a world that "
                "diverged, became NaN or overflowed its contact buffers (limit "
                f"{most:.2%}); the log names the first ones. Look at the drive's stiffness, the time "
                "step (sim.substeps) and the sizes of the buffers (sim)."
            )
        spoiled = [name for name, value in figures.items() if not math.isfinite(value)]
        if spoiled:
            kept = list_checkpoints(self._folder)
            remains = (
                f"{kept[-1]} is the last whole checkpoint" if kept else "there is no checkpoint"
            )
            raise TrainingError(
                f"iteration {it}: expected finite numbers, got {figures[spoiled[0]]} for "
                f"{', '.join(spoiled)}; {remains}. Change rl.runner.algorithm.learning_rate, or the "
                "weights of task.reward"
            )

    def flush(self) -> None:
        """Append new rows to `progress.csv`; called with every checkpoint so that both agree."""
        if not self._unwritten or self._quiet:
            return
        import pandas as pd  # this import takes 0.3 s

        rows = pd.DataFrame(self._unwritten)
        self._unwritten = []
        is_new = not self._path.exists()
        if not is_new:  # perhaps of a version with fewer figures
            rows = rows.reindex(columns=pd.read_csv(self._path, nrows=0).columns)
        rows.to_csv(self._path, mode="a", header=is_new, index=False, lineterminator="\r\n")

    def state_dict(self) -> dict[str, float]:
        """Return the counts from which a resumed run goes on."""
        return {"env_steps": self.env_steps, "seconds": self.seconds}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore the counts; drop rows of `progress.csv` that were written after them."""
        self.env_steps, self.seconds = int(state["env_steps"]), float(state["seconds"])
        if not self._path.exists() or self._quiet:
            return
        import pandas as pd

        rows = pd.read_csv(self._path, dtype=str)
        kept: Any = rows[rows["env_steps"].astype(float) <= self.env_steps]
        kept.to_csv(self._path, index=False, lineterminator="\r\n")


def draw_curves(
    progress: Path,
    picture: Path,
    words: Mapping[str, Figure],
    first_episodes: int = 0,
    controller: float | None = None,
) -> None:
    """Draw `progress.csv` over control steps into a PNG; an empty file gives no picture.

    Args:
        progress: The file.
        picture: The PNG.
        words: Figures that the task names, by the name in `TaskProcess.episode`.
        first_episodes: Control steps for which no success is drawn; see `TrainingLogger`.
        controller: Success of the classical controller, drawn as a line; `None` for none.
    """
    import pandas as pd

    rows = pd.read_csv(progress, dtype=float)
    if rows.empty:
        return
    panels = _list_panels(words)
    for _, column, _ in panels["Success"]:
        if column in rows:
            rows[column] = rows[column].where(rows["env_steps"] > first_episodes)
    num_rows = -(-len(panels) // NUM_COLUMNS)
    figure = make_figure(13, 3.25 * num_rows)
    axes = figure.subplots(num_rows, NUM_COLUMNS, squeeze=False).flat
    for axis, (title, curves) in zip(axes, panels.items(), strict=False):
        for label, column, factor in curves:
            if column in rows:
                axis.plot(
                    rows["env_steps"] / 1e6, factor * rows[column], label=label, linewidth=1.2
                )
        axis.set_title(title, loc="left", fontsize=10)
        axis.set_xlabel("control steps, millions")
        draw_grid(axis)
        if title == "Success":
            axis.set_ylim(0.0, 1.02)
            if controller is not None:
                axis.axhline(controller, label="controller", color=GREY, linestyle="--")
        if len(axis.lines) > 1:
            axis.legend(frameon=False, fontsize=8)
    for axis in axes[len(panels) :]:
        axis.remove()
    title = f"{progress.parent.name}: {rows['seconds'].iloc[-1] / 60:.1f} minutes of training"
    figure.suptitle(title, x=0.01, ha="left")
    save_figure(figure, picture)


def _list_panels(words: Mapping[str, Figure]) -> dict[str, list[tuple[str, str, float]]]:
    """Return the curves of each panel, (label, column of `progress.csv`, factor), by its title."""
    panels = {
        "Success": [],
        "Return": [("", f"{EPISODE}return", 1.0)],
        "Episode length (control steps)": [("", f"{EPISODE}length", 1.0)],
    }
    for name, figure in words.items():
        curve = (figure.title, EPISODE + name, figure.factor)
        if figure.unit == "share":
            panels["Success"].append(curve)
        elif not figure.of_success:  # the mean over all episodes would count failures as zero
            panels[f"{figure.title.capitalize()} ({figure.unit})"] = [curve]
    panels["Exploration (standard deviation)"] = [("", "policy/action_std", 1.0)]
    panels["Rate (control steps per second)"] = [("", "rate/env_steps_per_s", 1.0)]
    return panels
