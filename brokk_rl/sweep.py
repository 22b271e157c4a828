"""Prepare a sweep: remove its folder if it stays empty, and offer GPUs to local jobs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from brokk_rl import gpu_pool
from brokk_rl.session import list_missing_folders, remove_empty_folders


class SweepFolder(Callback):
    """Hydra callback that remembers the folders made for a sweep."""

    new: tuple[Path, ...] = ()

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember missing folders; Hydra calls this before it makes them."""
        type(self).new = tuple(list_missing_folders(Path(str(config.hydra.sweep.dir))))
        if str(config.hydra.launcher._target_).endswith(".LocalLauncher"):
            gpu_pool.offer_places()

    @classmethod
    def drop_if_unused(cls) -> None:
        """Remove the folders of a sweep into which no job has written."""
        if (
            cls.new
            and cls.new[0].is_dir()
            and {path.name for path in cls.new[0].iterdir()} <= {"multirun.yaml"}
        ):
            (cls.new[0] / "multirun.yaml").unlink(missing_ok=True)
            remove_empty_folders(cls.new)
        cls.new = ()
