"""Sweeps: the folders of their jobs, and the GPUs for jobs that run at the same time.

submitit starts all jobs of a local sweep at once, and either gives them no GPU or the same ones. The
launching process therefore lists places, one for each GPU, and a job waits for a free place. A
place is a locked file, which the system unlocks when the process ends for any reason. So two sweeps
on one computer share the GPUs.
"""

from __future__ import annotations

import logging
import os
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, read_write

LONGEST_NAME = 120
"""Characters of a job's folder name; file systems take 255 bytes, and paths are read by people."""
OFFERED = "BROKK_PLACES"
"""Environment variable with the places, one job at a time in each.

`0,1,2,3` are four GPUs, `0,0` allows two jobs on one GPU, and `cpu,cpu` two jobs without a GPU.
"""
NO_GPU = "cpu"
POLL_S = 0.5
"""Seconds between looks for a free place; short against a job of minutes."""

log = logging.getLogger(__name__)


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
            offer_places()

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


def offer_places() -> None:
    """List the places in the environment: those the user has set, else each visible GPU, else one."""
    if OFFERED in os.environ:
        return
    import torch

    visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(
        map(str, range(torch.cuda.device_count()))
    )
    os.environ[OFFERED] = visible if torch.cuda.device_count() else NO_GPU


@contextmanager
def take_place() -> Iterator[str | None]:
    """Wait for a free place and show its GPU alone; does nothing outside a local submitit job."""
    offered = os.environ.get(OFFERED)
    if not offered or os.environ.get("SUBMITIT_EXECUTOR") != "local":
        yield None
        return
    names = [name.strip() for name in offered.split(",")]
    file, gpu = _wait_for_place(names)
    try:
        os.environ["CUDA_VISIBLE_DEVICES"] = "" if gpu == NO_GPU else gpu
        yield gpu
    finally:
        file.close()


def _wait_for_place(names: list[str]) -> tuple[IO[str], str]:
    """Return the open, locked file of the first free place, and its GPU."""
    import fcntl  # Windows has none; the command says so before it comes here

    folder = Path(tempfile.gettempdir()) / f"brokk_places_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    said = False
    while True:
        for number, name in enumerate(names):
            nth = names[:number].count(name)  # the same GPU named twice is two places
            file = (folder / f"{name.replace('/', '_')}.{nth}").open("w")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.close()
                continue
            return file, name
        if not said:
            log.info("waiting for one of %d places: %s", len(names), ", ".join(names))
            said = True
        time.sleep(POLL_S)
