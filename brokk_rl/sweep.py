"""Prepare a sweep: name the folders of its jobs, remove its own if it stays empty, offer GPUs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, read_write

from brokk_rl import gpu_pool

LONGEST_NAME = 120
"""Characters of a job's folder name; file systems take 255 bytes, and paths are read by people."""


def name_job(number: int, overrides: Sequence[str], fixed: Sequence[str]) -> str:
    """Return the folder name of a job: its number, and the values that vary over the sweep.

    The name consists of letters, digits, dots, `-` and `_`, so that it needs no quotes in a shell or an
    override. Of a path the stem is kept.

    Args:
        number: Number of the job in its sweep.
        overrides: Overrides of the job.
        fixed: Keys of overrides that all jobs share.
    """
    parts = [str(number)]
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if key not in fixed:
            files = re.sub(r"[^\s,\[\]]*/([^\s,\[\]/]+)", r"\1", value)
            text = f"{re.split('[./@]', key)[-1]}-{re.sub(r'[.]ya?ml', '', files)}"
            parts.append(re.sub(r"[^\w.]+", "-", text).strip("-"))
    return "_".join(parts)[:LONGEST_NAME]


class SweepFolder(Callback):
    """Hydra callback that remembers the folders made for a sweep."""

    new: tuple[Path, ...] = ()

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember missing folders and fixed overrides; Hydra calls this before it makes them.

        The jobs, which may run in other processes, find the keys of the fixed overrides where Hydra
        keeps those that no folder name should have.
        """
        fixed = []
        for override in OverridesParser.create().parse_overrides(list(config.hydra.overrides.task)):
            if not override.is_sweep_override():
                fixed.append(override.get_key_element().lstrip("+~"))
        with read_write(config):
            config.hydra.overrides.hydra.append(
                f"hydra.job.config.override_dirname.exclude_keys={fixed}"
            )
        from brokk_rl.session import list_missing_folders  # numpy comes with it

        type(self).new = tuple(list_missing_folders(Path(str(config.hydra.sweep.dir))))
        if str(config.hydra.launcher._target_).endswith(".LocalLauncher"):
            gpu_pool.offer_places()

    @classmethod
    def drop_if_unused(cls) -> None:
        """Remove the folders of a sweep into which no job has written."""
        from brokk_rl.session import remove_empty_folders

        if (
            cls.new
            and cls.new[0].is_dir()
            and {path.name for path in cls.new[0].iterdir()} <= {"multirun.yaml"}
        ):
            (cls.new[0] / "multirun.yaml").unlink(missing_ok=True)
            remove_empty_folders(cls.new)
        cls.new = ()
