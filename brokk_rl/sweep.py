"""What a sweep needs before its first job: a folder that is not left behind empty, and places for its jobs on this computer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from brokk_rl import gpu_pool
from brokk_rl.session import list_missing_folders, remove_empty_folders


class SweepFolder(Callback):
    """Remembers the folder that Hydra makes for a sweep before it has composed a single job."""

    new: tuple[Path, ...] = ()

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Called by Hydra before it makes the folder."""
        type(self).new = tuple(list_missing_folders(Path(str(config.hydra.sweep.dir))))
        if str(config.hydra.launcher._target_).endswith(".LocalLauncher"):
            gpu_pool.offer_places()

    @classmethod
    def drop_if_unused(cls) -> None:
        """Removes what Hydra made when no job has written into it."""
        if (
            cls.new
            and cls.new[0].is_dir()
            and {path.name for path in cls.new[0].iterdir()} <= {"multirun.yaml"}
        ):
            (cls.new[0] / "multirun.yaml").unlink(missing_ok=True)
            remove_empty_folders(cls.new)
        cls.new = ()
