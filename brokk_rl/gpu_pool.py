"""Places for the jobs of a sweep that run at the same time on one computer.

submitit starts all jobs of a local sweep at once and shows each of them no GPU or the same ones. So
the launching process says what
places there are, a GPU each, and a job waits for a free one before it touches a GPU. A place is a
locked file: the system frees it when its process ends, however it ends, and two sweeps on one
computer share the GPUs without knowing of each other.
"""

from __future__ import annotations

import fcntl
import logging
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

OFFERED = "BROKK_PLACES"
"""Environment variable with the places, one job at a time in each: `0,1,2,3` are GPUs, `0,0` two
jobs on one, `cpu,cpu` none."""
NO_GPU = "cpu"
POLL_S = 0.5

log = logging.getLogger(__name__)


def offer_places() -> None:
    """Says to the jobs of this sweep which places there are: those that a person has named, else each visible GPU, else one."""
    if OFFERED in os.environ:
        return
    import torch

    visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(
        map(str, range(torch.cuda.device_count()))
    )
    os.environ[OFFERED] = visible if torch.cuda.device_count() else NO_GPU


@contextmanager
def take_place() -> Iterator[str | None]:
    """Waits for a free place in a job that submitit started locally, and shows it that GPU alone; elsewhere does nothing."""
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
    """Returns the open, locked file of the first place that is free, and its GPU."""
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
