"""Twins spread over processes, period by period; results do not depend on the number of processes.

The operators stay in one process, since their chance is drawn for all of them at once; here only
the machines are divided.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from multiprocessing.connection import Connection as Channel
from typing import Any, Self

import numpy as np

from brokk_rl.errors import BrokkError
from deploy.runtime.process import ChildProcess, Stop

PATIENCE_S = 5.0


class Crew:
    """Desks (see `study.twins`) in child processes; a context manager.

    Args:
        build: `module:function` that returns the desks of a process, called with each of `parts` as
            arguments.
        parts: Arguments of `build`, one tuple a process.
        rows: Which trials each process has, in order.
        count: Trials in all.
    """

    def __init__(
        self, build: str, parts: Sequence[tuple[Any, ...]], rows: Sequence[np.ndarray], count: int
    ) -> None:
        self._build, self._parts, self._rows, self._count = build, parts, rows, count
        self._children: list[tuple[ChildProcess, Channel]] = []

    def __enter__(self) -> Self:
        for number, part in enumerate(self._parts):
            mine, theirs = socket.socketpair()
            child = ChildProcess(
                f"twins {number + 1}",
                "study.twin_pool:run_worker",
                (theirs.fileno(), self._build, part),
                [theirs.fileno()],
            )
            theirs.close()
            self._children.append((child, Channel(mine.detach())))
        return self

    def __exit__(self, *exc: object) -> None:
        for child, channel in self._children:
            channel.close()
            child.end(PATIENCE_S)

    def ask(
        self, method: str, running: np.ndarray, values: np.ndarray | None = None
    ) -> dict[int, Any]:
        """Call a method of the desks of all running trials, `(N,)` bool, each with its row of `values`; returns answers by trial.

        Raises:
            BrokkError: a process has died.
        """
        asked = [rows[running[rows]] for rows in self._rows]
        found: dict[int, Any] = {}
        try:
            for (_, channel), mine, rows in zip(self._children, self._rows, asked, strict=True):
                arguments = [() if values is None else (values[n],) for n in rows]
                channel.send((method, np.searchsorted(mine, rows).tolist(), arguments))
            for (_, channel), rows in zip(self._children, asked, strict=True):
                found |= dict(zip(rows.tolist(), channel.recv(), strict=True))
        except (EOFError, OSError) as error:
            raise BrokkError("a process with twins has died; what it said stands above") from error
        return found


def run_worker(stop: Stop, file: int, build: str, part: tuple[Any, ...]) -> None:
    """Serve requests of the crew until the channel closes."""
    from pkgutil import resolve_name

    channel, desks = Channel(file), resolve_name(build)(*part)
    while True:
        try:
            method, places, arguments = channel.recv()
            answers = []
            for place, given in zip(places, arguments, strict=True):
                answers.append(getattr(desks[place], method)(*given))
            channel.send(answers)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return


def count_cores() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0))
