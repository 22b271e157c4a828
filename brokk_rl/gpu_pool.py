"""GPU pool for the jobs of a sweep that run at the same time on one computer.

submitit starts all jobs of a local sweep at once, and either gives them no GPU or the same ones. The
launching process therefore lists places, one for each GPU, and a job waits for a free place. A
place is a locked file, which the system unlocks when the process ends for any reason. So two sweeps
on one computer share the GPUs.
"""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

OFFERED = "BROKK_PLACES"
"""Environment variable with the places, one job at a time in each.

`0,1,2,3` are four GPUs, `0,0` allows two jobs on one GPU, and `cpu,cpu` two jobs without a GPU.
"""
NO_GPU = "cpu"
POLL_S = 0.5
"""Seconds between looks for a free place; short against a job of minutes."""

log = logging.getLogger(__name__)


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
