"""Learning curves: when a training reaches a level of success, and when it stops improving."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.rl.settings import Plateau

SUCCESS = "episode/success_strict"
"""Column of `progress.csv` with the share of successes among the episodes of an iteration."""
WINDOW = 4096
"""Newest finished episodes over which success is averaged. Every iteration is asked: with 1,024 a
training that succeeds in 0.98 of its episodes passed 0.99 by chance (benchmarks/h100/success)."""


def find_passing(
    rows: Sequence[Mapping[str, Any]], level: float, after: int = 0, window: int = WINDOW
) -> Mapping[str, Any] | None:
    """Return the first row of `progress.csv` at which the newest episodes reach a level of success.

    Args:
        rows: One an iteration, with `episodes` and `episode/success_strict`.
        level: Share of strict successes.
        after: Control steps whose episodes do not count. Among the first episodes to end are mostly
            short ones, and short ones are successes: give the steps of a whole episode in every
            world.
        window: Least number of newest episodes that are averaged; whole iterations.

    Returns:
        The row, or `None` where the level was never reached.
    """
    first, episodes, successes = 0, 0.0, 0.0
    if after:
        rows = [row for row in rows if float(row["env_steps"]) > after]
    for row in rows:
        episodes += float(row["episodes"])
        successes += float(row["episodes"]) * float(row[SUCCESS])
        while episodes - float(rows[first]["episodes"]) >= window:
            gone = float(rows[first]["episodes"])
            episodes -= gone
            successes -= gone * float(rows[first][SUCCESS])
            first += 1
        if episodes >= window and successes >= level * episodes:
            return row
    return None


def find_plateau(rows: Sequence[Mapping[str, Any]], plateau: Plateau) -> Mapping[str, Any] | None:
    """Return the first row of `progress.csv` at which success no longer grows.

    The newest `plateau.episodes` are compared with as many before them, in whole iterations.

    Args:
        rows: One an iteration, with `episodes` and `episode/success_strict`.
        plateau: What counts as growth.

    Returns:
        The row, or `None` where success still grows or is too low to stop.

    Raises:
        ConfigError: The task does not report success.
    """
    if rows and SUCCESS not in rows[0]:
        raise ConfigError(
            "rl.plateau: the task does not report success_strict; give rl.plateau=null"
        )
    finished = np.array([float(row["episodes"]) for row in rows])
    succeeded = finished * np.array([float(row[SUCCESS]) for row in rows])
    # totals before each row, and after the last
    episodes, successes = (np.append(0.0, value.cumsum()) for value in (finished, succeeded))

    def find_beginning(total: np.ndarray) -> np.ndarray:
        return np.searchsorted(episodes, total - plateau.episodes, "right") - 1

    middle = find_beginning(episodes[1:])
    first = find_beginning(episodes[middle])
    is_long = (middle >= 0) & (first >= 0)
    with np.errstate(invalid="ignore"):  # rows without enough episodes before them
        newest = (successes[1:] - successes[middle]) / (episodes[1:] - episodes[middle])
        before = (successes[middle] - successes[first]) / (episodes[middle] - episodes[first])
    levelled = is_long & (newest >= plateau.above) & (newest - before < plateau.least_gain)
    return rows[int(levelled.argmax())] if levelled.any() else None
