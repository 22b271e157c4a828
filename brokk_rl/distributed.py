"""Which of several processes this one is.

`torchrun` starts one process a GPU and tells each by the environment; started by hand, a process is
alone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from brokk_rl.errors import ConfigError


@dataclass(frozen=True)
class Rank:
    """This process among those that work together.

    Attributes:
        index: Number over all computers; 0 is the one that writes, shows and evaluates.
        local: Number on this computer, that of its GPU.
        count: Number of processes.
    """

    index: int
    local: int
    count: int

    @property
    def first(self) -> bool:
        """Whether this process is the one that writes and shows."""
        return self.index == 0


def read_rank() -> Rank:
    """Returns what `torchrun` has said about this process (`RANK`, `LOCAL_RANK`, `WORLD_SIZE`).

    Raises:
        ConfigError: The three do not fit each other.
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
    """Refuses several processes where each would do the whole work of one.

    Args:
        mode: Class of the mode; `together` says that it shares its work.
        sweep: Whether it is a job of a sweep.

    Raises:
        ConfigError: There are several for a mode that is the work of one, or for a sweep.
    """
    if read_rank().count == 1:
        return
    if not getattr(mode, "together", False):
        raise ConfigError(f"{mode.__name__} is the work of one process: start it without torchrun")
    if sweep:
        raise ConfigError(
            "a job of a sweep is one process: start the sweep without torchrun, with hydra/launcher=submitit_local"
        )
