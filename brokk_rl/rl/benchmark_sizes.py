"""Sizes of the measurements of `mode=bench`."""

from __future__ import annotations

import itertools
from typing import Literal

from brokk_rl.bounds import require_number
from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

KEYS = ("num_envs", "epochs", "mini_batches", "seed")
"""Names of what differs between the trainings of a sweep."""


@spec
class SuccessSweep:
    """Sizes of a training over which the time to success is measured.

    Attributes:
        num_envs: Numbers of environments, of each process.
        epochs: Passes over a rollout (`num_learning_epochs`).
        mini_batches: Mini-batches of a pass (`num_mini_batches`).
        seeds: Seeds of each point.
        max_seconds: Longest training; one that passes the highest level ends earlier.
    """

    num_envs: tuple[int, ...]
    epochs: tuple[int, ...]
    mini_batches: tuple[int, ...]
    seeds: tuple[int, ...]
    max_seconds: float

    def check(self) -> None:
        for name in ("num_envs", "epochs", "mini_batches"):
            values = getattr(self, name)
            if not values or min(values) < 1:
                raise ConfigError(
                    f"bench.success.{name}: expected one or more positive numbers, "
                    f"got {list(values)}"
                )
        if not self.seeds:
            raise ConfigError("bench.success.seeds: expected one or more seeds, got none")
        require_number("bench.success.max_seconds", self.max_seconds, above=0)

    def list_points(self) -> list[dict[str, int]]:
        """Return all trainings; those with as many environments follow each other."""
        values = itertools.product(self.num_envs, self.epochs, self.mini_batches, self.seeds)
        return [dict(zip(KEYS, point, strict=True)) for point in values]


@spec
class BenchmarkSizes:
    """Measurements: numbers of environments, durations, and a run to compare with.

    Attributes:
        num_envs: Numbers of environments, one row each; of each process where `torchrun` starts
            several.
        seconds: Least time of each measurement.
        iterations: Training iterations timed, after one to warm up.
        against: `benchmark.json` of one process with the same numbers of environments, to compare
            several processes with; `null` for no comparison.
        measure: `rates` of physics, control step and training, or seconds of training until
            `success`.
        success: Sizes of the trainings whose time to success is measured.
    """

    num_envs: tuple[int, ...]
    seconds: float
    iterations: int
    against: str | None
    measure: Literal["rates", "success"]
    success: SuccessSweep

    def check(self) -> None:
        require_number("bench.seconds", self.seconds, above=0)
        require_number("bench.iterations", self.iterations, least=1)
        if not self.num_envs or min(self.num_envs) < 1:
            raise ConfigError(
                f"bench.num_envs: expected one or more positive numbers, got {list(self.num_envs)}"
            )
