"""What a training run writes down and shows while it runs.

Takes the place of rsl-rl's logger in the runner: that one reads finished episodes back to the host
in every step, this one asks the control loop for its sums once an iteration.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from brokk_rl.errors import SimulationError
from brokk_rl.rl.tracking import Tracker

PROGRESS = "progress.csv"


class Logbook:
    """Fulfils what `rsl_rl.runners.OnPolicyRunner` asks of its logger.

    Args:
        folder: Run folder.
        tracker: Where figures go beside `progress.csv`.
        statistics: Returns the figures of the finished episodes since it was last asked; see
            `ControlLoop.statistics`.
        steps_per_iteration: Control steps of all environments (and ranks) in one iteration.
        max_fault_rate: Share of control steps that may end in a diverged or overflowing world.
        share_done: Returns how much of the run's budget is spent, 0 to 1, from control steps and
            seconds.
        quiet: Count only, show and write nothing: of several processes the first writes for all.
    """

    def __init__(
        self,
        folder: Path,
        tracker: Tracker,
        statistics: Callable[[], dict[str, float]],
        steps_per_iteration: int,
        max_fault_rate: float,
        share_done: Callable[[int, float], float],
        quiet: bool = False,
    ) -> None:
        self.log_dir = str(folder)
        self.writer: Tracker | None = tracker
        self.env_steps, self.seconds = 0, 0.0
        self._statistics, self._steps, self._max_fault_rate = (
            statistics,
            steps_per_iteration,
            max_fault_rate,
        )
        self._share_done, self._quiet = share_done, quiet
        self._path = folder / PROGRESS
        self._rows: list[dict[str, Any]] = []
        self._pending = 0
        self._last: dict[str, float] = {}
        self._clock = time.perf_counter()
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self._bar = Progress(*columns, console=Console(stderr=True), disable=quiet)
        self._job = self._bar.add_task("training", total=1.0, figures="")

    def __enter__(self) -> Logbook:
        self._bar.start()
        self._clock = time.perf_counter()
        return self

    def __exit__(self, *exc: object) -> None:
        self._bar.stop()
        self.flush()
        if self.writer is not None:
            self.writer.close()

    def init_logging_writer(self) -> None:
        """Nothing to do: the tracker is open before the runner exists."""

    def process_env_step(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to do: the control loop adds up finished episodes on the device."""

    def save_model(self, path: str, it: int) -> None:
        """Checkpoints stay in the run folder."""

    def stop_logging_writer(self) -> None:
        """The tracker stays open until the whole run ends."""

    def log(
        self,
        *,
        it: int,
        collect_time: float,
        learn_time: float,
        loss_dict: dict[str, float],
        **rest: Any,
    ) -> None:
        """Writes the figures of one iteration.

        Raises:
            SimulationError: More worlds diverged or overflowed than `max_fault_rate` allows.
        """
        now = time.perf_counter()
        self.seconds += now - self._clock
        self._clock = now
        self.env_steps += self._steps
        found = self._statistics()
        if found["fault_rate"] > self._max_fault_rate:
            raise SimulationError(
                f"{found['fault_rate']:.2%} of the control steps of iteration {it} ended in a world that diverged, became NaN or "
                f"overflowed its contact buffers (limit {self._max_fault_rate:.2%}). Look at the drive's stiffness, the time step "
                "(sim.substeps) and the sizes of the buffers (sim)."
            )
        episode = {
            f"episode/{name}": value
            for name, value in found.items()
            if name not in ("episodes", "fault_rate")
        }
        figures = {
            "env_steps": float(self.env_steps),
            "seconds": self.seconds,
            "rate/env_steps_per_s": self._steps / (collect_time + learn_time),
            "rate/collect_s": collect_time,
            "rate/learn_s": learn_time,
            "episodes": found["episodes"],
            "fault_rate": found["fault_rate"],
            "policy/learning_rate": float(rest["learning_rate"]),
            "policy/action_std": float(rest["action_std"].detach().mean()),
            **{f"loss/{name}": float(value) for name, value in loss_dict.items()},
        }
        # an iteration in which no episode ended says nothing about episodes: keep what was known
        self._last = episode if found["episodes"] else (self._last or episode)
        figures |= self._last
        self._rows.append({"iteration": it, **figures})
        self._pending += 1
        if self.writer is not None:
            self.writer.log(figures, it)
        text = f"{figures['rate/env_steps_per_s']:,.0f} steps/s  success {figures.get('episode/success_strict', 0.0):.2f}"
        self._bar.update(
            self._job, completed=self._share_done(self.env_steps, self.seconds), figures=text
        )

    def flush(self) -> None:
        """Appends what is new to `progress.csv`; called with every checkpoint, so that both tell the same story."""
        if not self._pending or self._quiet:
            return
        rows, self._pending = self._rows[-self._pending :], 0
        fresh = not self._path.exists()
        with self._path.open("a", newline="") as file:
            table = csv.DictWriter(file, fieldnames=list(rows[0]), extrasaction="ignore")
            if fresh:
                table.writeheader()
            table.writerows(rows)

    def state_dict(self) -> dict[str, float]:
        """Returns what a resumed run counts on from."""
        return {"env_steps": self.env_steps, "seconds": self.seconds}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restores what `state_dict` returned and drops rows of `progress.csv` that were written after it."""
        self.env_steps, self.seconds = int(state["env_steps"]), float(state["seconds"])
        if not self._path.exists() or self._quiet:
            return
        with self._path.open(newline="") as file:
            rows = [
                row for row in csv.DictReader(file) if float(row["env_steps"]) <= self.env_steps
            ]
        self._path.unlink()
        self._rows, self._pending = rows, len(rows)
        self.flush()
