"""Seconds of training until a policy succeeds, over worlds, epochs and mini-batches.

Steps a second do not tell how soon a policy is good: more worlds make more steps and fewer updates.
Each point of the sweep trains policies from scratch, one a seed. A point that an earlier call has
measured is read from the table, so that a stopped sweep goes on.
"""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from brokk_rl.console_table import print_table
from brokk_rl.errors import ConfigError
from brokk_rl.plot import BLUE, ORANGE, make_figure, remove_frame
from brokk_rl.rl.benchmark_sizes import KEYS, SuccessSweep
from brokk_rl.rl.logger import PROGRESS, WINDOW, NoTracking, TrainingLogger, find_passing
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.runner import TrainingGroup, TrainingRunner
from brokk_rl.rl.settings import TrainingBudget, TrainingConfig
from brokk_rl.session import Session, write_json

log = logging.getLogger(__name__)

LEVELS = (0.95, 0.99)
"""Strict success whose time is measured."""
TABLE = "success_sweep.jsonl"
"""One line for each training that was measured."""


def run_sweep(
    sweep: SuccessSweep,
    training: TrainingConfig,
    session: Session,
    group: TrainingGroup,
    build: Callable[[int], ControlLoop],
) -> list[dict[str, Any]]:
    """Train every point that the table lacks; return the rows of all points.

    Args:
        sweep: The points.
        training: Everything else of the training.
        session: Gives folder and device.
        group: The processes that train together, entered.
        build: Returns a captured control loop with so many environments.

    Raises:
        ConfigError: The table in the folder is of another budget, or is damaged.
    """
    table = session.folder / TABLE
    known = _read_table(table, sweep)
    loop: ControlLoop | None = None
    rows = []
    for point in sweep.list_points():
        key = tuple(point.values())
        if key not in known:
            if loop is None or loop.num_envs != point["num_envs"]:
                loop = build(point["num_envs"])
            known[key] = _train(point, sweep, training, session, group, loop)
            if group.rank.first:
                with table.open("a") as file:
                    file.write(json.dumps(known[key]) + "\n")
        rows.append(known[key])
        log.info("%s", ", ".join(f"{name} {value}" for name, value in known[key].items()))
    return rows


def _train(
    point: dict[str, int],
    sweep: SuccessSweep,
    training: TrainingConfig,
    session: Session,
    group: TrainingGroup,
    loop: ControlLoop,
) -> dict[str, Any]:
    """Train one policy until the highest level is passed or time is up; return its row."""
    runner_config = copy.deepcopy(training.runner)
    runner_config["algorithm"]["num_learning_epochs"] = point["epochs"]
    runner_config["algorithm"]["num_mini_batches"] = point["mini_batches"]
    budget = TrainingBudget(max_env_steps=None, max_seconds=sweep.max_seconds)
    training = replace(training, runner=runner_config, budget=budget)
    replace(session, seed=point["seed"]).seed_all()
    loop.begin()
    loop.statistics()  # forget the episodes of the point before
    folder = session.folder / "_".join(f"{name}{value}" for name, value in point.items())
    folder.mkdir(exist_ok=True)
    (folder / PROGRESS).unlink(missing_ok=True)  # of a training that was stopped
    logger = TrainingLogger(
        folder,
        NoTracking().open(folder, {}),
        lambda: group.pool_statistics(loop.statistics()),
        point["num_envs"] * int(runner_config["num_steps_per_env"]) * group.rank.count,
        training.max_fault_rate,
        budget.share_spent,
        quiet=not group.rank.first,
    )
    first_episodes = group.rank.count * loop.num_envs * loop.task.max_episode_steps
    with logger:
        runner = TrainingRunner(loop, training, folder, loop.device, logger, group)
        runner.run(until=lambda: find_passing(logger.rows, max(LEVELS), first_episodes) is not None)
    row: dict[str, Any] = dict(point) | {"max_seconds": sweep.max_seconds}
    for level in LEVELS:
        passed = find_passing(logger.rows, level, first_episodes)
        row[f"seconds_to_{level:.2f}"] = passed and round(passed["seconds"], 2)
        row[f"env_steps_to_{level:.2f}"] = passed and int(passed["env_steps"])
    row |= {"seconds": round(logger.seconds, 2), "env_steps": logger.env_steps}
    # of the seconds: compilation and capture, by far most of the first iteration
    row["first_iteration_s"] = round(logger.rows[0]["seconds"], 2)
    if group.rank.first:
        for part in folder.glob("model_*.pt"):
            part.unlink()  # only the time counts; a sweep would fill the disk
    return row


def _read_table(path: Path, sweep: SuccessSweep) -> dict[tuple[int, ...], dict[str, Any]]:
    """Return the rows that an earlier call measured, by their point."""
    found: dict[tuple[int, ...], dict[str, Any]] = {}
    if not path.exists():
        return found
    for number, line in enumerate(path.read_text().splitlines(), 1):
        try:
            row = json.loads(line)
            key = tuple(row[name] for name in KEYS)
        except (ValueError, KeyError) as error:
            raise ConfigError(f"{path}, line {number}: no row of a sweep ({error!r})") from error
        if row["max_seconds"] != sweep.max_seconds:
            raise ConfigError(
                f"bench.success.max_seconds: expected {row['max_seconds']} as in {path}, "
                f"got {sweep.max_seconds}; give another session.out"
            )
        found[key] = row
    return found


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row for each size: medians over its seeds; a level counts where most seeds pass."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in KEYS[:-1]), []).append(row)
    found = []
    for key, members in groups.items():
        line: dict[str, Any] = dict(zip(KEYS, key, strict=False)) | {"seeds": len(members)}
        for level in LEVELS:
            name = f"seconds_to_{level:.2f}"
            times = [row[name] for row in members if row[name] is not None]
            line[f"passed_{level:.2f}"] = len(times)
            line[name] = median(times) if 2 * len(times) > len(members) else None
        line["env_steps_per_s"] = round(
            median(row["env_steps"] / row["seconds"] for row in members)
        )
        found.append(line)
    return found


def report_sweep(rows: Sequence[Mapping[str, Any]], folder: Path, facts: dict[str, Any]) -> None:
    """Write `success_sweep.json` and its picture; print the table.

    Args:
        rows: One a training.
        folder: Run folder.
        facts: Device and versions.
    """
    lines = summarise(rows)
    write_json(
        folder / "success_sweep.json",
        facts | {"window_episodes": WINDOW, "sizes": lines, "rows": list(rows)},
    )
    heads = [f"seconds to {level:.2f}" for level in LEVELS]
    cells = []
    for line in lines:
        times = [_describe_time(line, level) for level in LEVELS]
        sizes = [f"{line[name]:,}" for name in KEYS[:-1]]
        cells.append([*sizes, *times, f"{line['env_steps_per_s']:,}", str(line["seeds"])])
    headings = ["environments", "epochs", "mini-batches", *heads, "training /s", "seeds"]
    caption = f"Median over seeds; success over the newest {WINDOW:,} episodes of training."
    print_table(headings, cells, caption=caption)
    draw_sweep(lines, folder / "success_sweep.png")


def _describe_time(line: Mapping[str, Any], level: float) -> str:
    seconds, passed = line[f"seconds_to_{level:.2f}"], line[f"passed_{level:.2f}"]
    if seconds is None:
        return f"– ({passed} of {line['seeds']} passed)"
    return f"{seconds:,.1f}"


def draw_sweep(lines: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the seconds to each level of all sizes into a PNG; a missing bar was never reached."""
    figure = make_figure(7.5, 0.9 + 0.45 * len(lines))
    axis = figure.add_subplot()
    labels = []
    for place, line in enumerate(lines):
        worlds, epochs, batches = (line[name] for name in KEYS[:-1])
        labels.append(f"{worlds:,} worlds, {epochs} × {batches}")
        for shift, level, colour in zip((-0.2, 0.2), LEVELS, (BLUE, ORANGE), strict=True):
            seconds = line[f"seconds_to_{level:.2f}"]
            name = f"to {level:.2f}" if place == 0 else None
            axis.barh(place + shift, seconds or 0.0, 0.38, color=colour, label=name)
            text = "not reached" if seconds is None else f"{seconds:,.1f} s"
            axis.annotate(
                text, (seconds or 0.0, place + shift), (3, 0),
                textcoords="offset points", va="center", fontsize=8,
            )  # fmt: skip
    axis.set_yticks(range(len(lines)), labels)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.set_xlabel("seconds of training until strict success")
    axis.set_ylabel("worlds, epochs × mini-batches")
    remove_frame(axis)
    figure.legend(loc="outside upper right", ncols=len(LEVELS), frameon=False)
    figure.savefig(path, dpi=130)
