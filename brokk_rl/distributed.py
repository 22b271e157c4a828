"""Rank of this process among those that `torchrun` started.

`torchrun` starts one process for each GPU and sets environment variables. A process started by
hand is alone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from brokk_rl.errors import ConfigError


@dataclass(frozen=True)
class Rank:
    """Rank of this process.

    Attributes:
        index: Rank over all computers; rank 0 writes, prints and evaluates.
        local: Rank on this computer, equal to the index of its GPU.
        count: Number of processes.
    """

    index: int
    local: int
    count: int

    @property
    def first(self) -> bool:
        """True for the process that writes and prints."""
        return self.index == 0


def read_rank() -> Rank:
    """Return the rank from the environment (`RANK`, `LOCAL_RANK`, `WORLD_SIZE`).

    Raises:
        ConfigError: The three variables contradict each other.
    """
    told = {name: os.environ.get(name) for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE")}
    count = int(told["WORLD_SIZE"] or 1)
    if count == 1:
        return Rank(0, 0, 1)
    index, local = int(told["RANK"] or -1), int(told["LOCAL_RANK"] or -1)
    if not (0 <= index < count and 0 <= local < count):
        raise ConfigError(
            f"the environment says {told}: expected RANK and LOCAL_RANK below WORLD_SIZE, as torchrun sets them. Start with "
            "torchrun --nproc-per-node=<GPUs>, or unset WORLD_SIZE."
        )
    return Rank(index, local, count)


def check_together(mode: type, sweep: bool) -> None:
    """Refuse several processes where each would do the whole work.

    Args:
        mode: Class of the mode; its attribute `together` is true if processes share its work.
        sweep: True for a job of a sweep.

    Raises:
        ConfigError: Several processes were started for such a mode or for a sweep.
    """
    if read_rank().count == 1:
        return
    if not getattr(mode, "together", False):
        raise ConfigError(f"{mode.__name__} is the work of one process: start it without torchrun")
    if sweep:
        raise ConfigError(
            "a job of a sweep is one process: start the sweep without torchrun, with hydra/launcher=submitit_local"
        )
