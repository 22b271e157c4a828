"""Capture of steps in CUDA graphs, errors of `torch.compile`, and threads of small tensors."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import torch
from torch._dynamo.exc import BackendCompilerFailed

from brokk_rl.errors import ConfigError

WARM_UP = 3
"""Calls before the capture: kernels are compiled and buffers allocated before anything is
recorded."""


def capture_graph(
    step: Callable[[], None], device: torch.device, gradients: bool = False
) -> torch.cuda.CUDAGraph:
    """Return a CUDA graph of `step`.

    Args:
        step: The step; called `WARM_UP` times before. It must not synchronise with the host, and
            its tensors must keep their addresses.
        device: A CUDA device.
        gradients: Whether `step` differentiates.
    """
    with torch.cuda.device(device), torch.set_grad_enabled(gradients):
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                step()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # gradients remember the stream on which they were first added up; NCCL has a thread that
        # asks for events meanwhile
        with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            step()
    return graph


@contextlib.contextmanager
def report_compile_errors() -> Iterator[None]:
    """Turn an error of `torch.compile` without a compiler into a message with its remedy.

    Raises:
        ConfigError: Something that is first called in here cannot be compiled.
    """
    try:
        yield
    except BackendCompilerFailed as error:
        raise ConfigError(
            f"rl.fuse: cannot compile the control step ({str(error).splitlines()[0]}); install a "
            "C++ compiler (g++), or give "
            "rl.fuse=false"
        ) from error


@contextlib.contextmanager
def limit_to_one_thread(device: torch.device | str) -> Iterator[None]:
    """Limit torch to one thread inside of this context; nothing changes where `device` is a GPU.

    The tensors of a control step are too small to be shared by threads. Torch's other threads would
    wait for the next tensor in a busy loop, on the cores on which the physics runs. On a computer
    with other work, every step would then wait for the slowest thread.
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
