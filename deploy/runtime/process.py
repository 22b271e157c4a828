"""Child processes: fresh interpreters that import only what they need, die with their parent, and are asked before they are killed.

Not `multiprocessing`: its forks inherit threads and its spawned children import the command again.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal

log = logging.getLogger(__name__)

_ENTRY = "from deploy.runtime.process import enter_child; enter_child()"
_DIE_WITH_PARENT, _LOCK_ALL, _ON_USE = (
    1,
    3,
    4,
)  # PR_SET_PDEATHSIG; MCL_CURRENT | MCL_FUTURE; MCL_ONFAULT
_LARGE_BYTES = 1 << 30

Stop = Callable[[], bool]
"""Says whether the process is asked to end."""


class ChildProcess:
    """A running child process.

    Args:
        name: What it does, for people.
        target: `module:function`, called as `function(stop, *arguments)`.
        arguments: Anything that can be pickled.
        files: File descriptors that it inherits.
        realtime: Priority of SCHED_FIFO to ask for, 1 to 99; `None` for an ordinary process.
    """

    def __init__(
        self,
        name: str,
        target: str,
        arguments: Sequence[Any],
        files: Sequence[int],
        realtime: int | None = None,
    ) -> None:
        self.name = name
        command = [sys.executable, "-P", "-c", _ENTRY]
        # libraries of numbers would start threads that compete with the loop
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, pass_fds=tuple(files), env=environment
        )
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died already; `code` says so
            self._process.stdin.write(pickle.dumps((name, target, realtime, os.getpid())))
            self._process.stdin.write(pickle.dumps(tuple(arguments)))
            self._process.stdin.close()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def code(self) -> int | None:
        """Its exit code, `None` while it runs."""
        return self._process.poll()

    def ask_to_stop(self) -> None:
        """Asks it to end."""
        with contextlib.suppress(ProcessLookupError):
            self._process.terminate()

    def end(self, patience_s: float) -> int:
        """Asks it to end, waits, then kills it; returns its exit code."""
        self.ask_to_stop()
        try:
            return self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            log.warning("%s did not end within %g s and is killed", self.name, patience_s)
            self._process.kill()
            return self._process.wait()


def enter_child() -> None:
    """Where a child process begins."""
    name, target, realtime, parent = pickle.load(sys.stdin.buffer)
    _load_libc().prctl(_DIE_WITH_PARENT, signal.SIGTERM)
    if os.getppid() != parent:
        raise SystemExit(1)  # it died meanwhile
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches the whole group; the parent asks each in turn
    asked: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))
    logging.basicConfig(level=logging.INFO, format=f"{name}: %(message)s")
    if realtime is not None:
        ask_for_priority(
            realtime
        )  # before all that has to be imported: a busy computer would take ten times as long
    arguments, function = pickle.load(sys.stdin.buffer), resolve_name(target)
    if realtime is not None:
        keep_in_memory()
    function(lambda: bool(asked), *arguments)


def keep_in_memory() -> None:
    """Asks for locked memory, and keeps the garbage collector out.

    What maps gigabytes, as the simulator of a twin does, keeps what it has used; all else is there
    from the beginning.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    mapped_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    if _load_libc().mlockall(_LOCK_ALL | (_ON_USE if mapped_bytes > _LARGE_BYTES else 0)) != 0:
        log.debug("memory is not locked: %s", os.strerror(ctypes.get_errno()))


def ask_for_priority(priority: int) -> Literal["fifo", "ordinary"]:
    """Asks for SCHED_FIFO; returns what was granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        log.warning(
            "no real-time priority (%s): the loop may run late. Allow it, for example by RTPRIO and MEMLOCK limits for this user, "
            "or `setcap cap_sys_nice,cap_ipc_lock+ep` on a copy of the interpreter",
            error.strerror,
        )
        return "ordinary"
    return "fifo"


def give_up_priority() -> None:
    """Gives the priority of `ask_for_priority` back."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


class CycleTimer:
    """Absolute deadlines on the monotonic clock; a missed one is skipped, not made up for.

    Args:
        period_s: Between deadlines.

    Attributes:
        next_s: The coming deadline.
        cycles: Deadlines kept.
        missed: Deadlines that were over before their turn.
        lateness_s: How late cycles began, the last `KEPT` of them, in a ring.
    """

    KEPT = 100_000

    def __init__(self, period_s: float) -> None:
        self.period_s, self.next_s = period_s, time.monotonic() + period_s
        self.cycles, self.missed = 0, 0
        self.lateness_s = array(
            "d", bytes(8 * self.KEPT)
        )  # all at once: memory that grows for an hour looks like a leak

    def begin(self) -> int:
        """Marks that the cycle of `next_s` begins now, and moves on; returns the number of deadlines missed before it."""
        now_s = time.monotonic()
        skipped = int((now_s - self.next_s) // self.period_s) if now_s > self.next_s else 0
        late_s = now_s - self.next_s - skipped * self.period_s
        self.lateness_s[self.cycles % self.KEPT] = now_s - self.next_s
        self.cycles += 1
        self.missed += skipped
        self.next_s = now_s - late_s + self.period_s
        return skipped

    def wait(self) -> None:
        """Sleeps until the coming deadline."""
        time.sleep(max(0.0, self.next_s - time.monotonic()))

    def report(self) -> dict[str, float]:
        """Returns cycles, missed deadlines and lateness as plain data."""
        ordered = sorted(self.lateness_s[: self.cycles]) or [0.0]

        def quantile(part: float) -> float:
            return ordered[min(len(ordered) - 1, int(part * len(ordered)))]

        return {
            "period_s": self.period_s, "cycles": self.cycles, "missed": self.missed, "late_p50_s": quantile(0.5),
            "late_p99_s": quantile(0.99), "late_p999_s": quantile(0.999), "late_max_s": ordered[-1],
        }  # fmt: skip


def _load_libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
