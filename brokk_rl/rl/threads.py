"""How many threads torch uses on a CPU: all for an update, one for everything in a control step."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def one_thread(device: torch.device | str) -> Iterator[None]:
    """Keeps torch to one thread meanwhile; nothing changes where `device` is a GPU.

    The tensors of a control step are too small to share. Torch's other threads would only wait for
    the next one, and they wait spinning, on the cores on which the physics runs; where the computer
    has other work too, all stand still for the slowest.
    """
    before = torch.get_num_threads()
    if torch.device(device).type != "cpu" or before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
