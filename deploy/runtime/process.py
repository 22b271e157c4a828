"""Child processes and their cycles.

A child is a fresh interpreter that imports only its own needs and dies with its parent; it is asked
to stop before it is killed. Not `multiprocessing`: its forks inherit threads, and its spawned
children import the command again.
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

from brokk_rl.errors import BrokkError
from deploy.runtime.detached_log import DetachedHandler

log = logging.getLogger(__name__)

ENTRY = "from deploy.runtime.process import enter_child; enter_child()"
DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG (linux/prctl.h)."""
LOCK_ALL, LOCK_ON_USE = 3, 4
"""MCL_CURRENT | MCL_FUTURE, and MCL_ONFAULT (sys/mman.h)."""
LARGE_BYTES = 1 << 30
"""Mapped memory from which pages are locked only as they are used. Chosen by hand: a simulator maps
gigabytes that it never touches."""
MOST_LATENESS = 100_000
"""Cycles whose lateness a timer keeps: 17 minutes of the bus process, 800 kB."""

Stop = Callable[[], bool]
"""Returns whether the process is asked to end."""


class ChildProcess:
    """A running child process.

    Args:
        name: Of the process, for people.
        target: `module:function`, called as `function(stop, *arguments)`.
        arguments: Anything that can be pickled.
        files: File descriptors that it inherits.
        realtime: Priority of SCHED_FIFO to ask for, 1 to 99; `None` for an ordinary process.

    Attributes:
        asked_to_stop: Whether it is to end.
    """

    def __init__(
        self,
        name: str,
        target: str,
        arguments: Sequence[Any],
        files: Sequence[int],
        realtime: int | None = None,
    ) -> None:
        self.name, self.asked_to_stop = name, False
        command = [sys.executable, "-P", "-c", ENTRY]
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
        """Ask it to end."""
        self.asked_to_stop = True
        with contextlib.suppress(ProcessLookupError):
            self._process.terminate()

    def end(self, patience_s: float) -> int:
        """Ask it to end, waits, then kills it; returns its exit code."""
        self.ask_to_stop()
        try:
            return self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            log.warning("%s did not end within %g s and is killed", self.name, patience_s)
            self._process.kill()
            return self._process.wait()


def enter_child() -> None:
    """Run a child process, from its first line to its last."""
    name, target, realtime, parent = pickle.load(sys.stdin.buffer)
    _load_libc().prctl(DIE_WITH_PARENT, signal.SIGTERM)
    if os.getppid() != parent:
        raise SystemExit(1)  # it died meanwhile
    # Ctrl-C reaches the whole group; the parent asks each process in turn
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asked: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: asked.append(number))
    writer = logging.StreamHandler()
    writer.setFormatter(logging.Formatter(f"{name}: %(message)s"))
    # The message alone: the writer puts the name of the process before it.
    detached = DetachedHandler([writer])
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[detached])
    if realtime is not None:
        # before the imports: on a busy computer they would take ten times as long
        ask_for_priority(realtime)
    arguments, function = pickle.load(sys.stdin.buffer), resolve_name(target)
    if realtime is not None:
        keep_in_memory()
    try:
        function(lambda: bool(asked), *arguments)
    except BrokkError as error:
        log.error("%s", error)
        raise SystemExit(1) from None


def keep_in_memory() -> None:
    """Lock the memory of this process, and stop the garbage collector.

    A process that maps gigabytes, such as the simulator of a twin, locks pages as it uses them; any
    other locks all of them at once.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    mapped_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    flags = LOCK_ALL | (LOCK_ON_USE if mapped_bytes > LARGE_BYTES else 0)
    if _load_libc().mlockall(flags) != 0:
        log.debug("memory is not locked: %s", os.strerror(ctypes.get_errno()))


def ask_for_priority(priority: int, inherited: bool = True) -> Literal["fifo", "ordinary"]:
    """Ask for SCHED_FIFO; return the scheduling that was granted.

    Args:
        priority: 1 to 99.
        inherited: Whether processes that are started later get it too.
    """
    policy = os.SCHED_FIFO if inherited else os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        log.warning(
            "no real-time priority (%s): the loop may run late. Allow it, for example by RTPRIO and MEMLOCK limits for this user, "
            "or `setcap cap_sys_nice,cap_ipc_lock+ep` on a copy of the interpreter",
            error.strerror,
        )
        return "ordinary"
    return "fifo"


def give_up_priority() -> None:
    """Return to the ordinary scheduling."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def read_steady_s() -> float:
    """Return the time of this computer's crystal, in s: NTP slews the monotonic clock, but not this."""
    return time.clock_gettime(time.CLOCK_MONOTONIC_RAW)


class CycleTimer:
    """Absolute deadlines on the monotonic clock; a missed one is skipped, not made up for.

    Args:
        period_s: Between deadlines.

    Attributes:
        next_s: The coming deadline.
        cycles: Deadlines kept.
        missed: Deadlines that were over before their turn.
        lateness_s: Lateness of the last `MOST_LATENESS` cycles, in a ring.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s, self.next_s = period_s, time.monotonic() + period_s
        self.cycles, self.missed = 0, 0
        # allocated at once: memory that grows for an hour looks like a leak
        self.lateness_s = array("d", bytes(8 * MOST_LATENESS))

    def begin(self) -> int:
        """Begin the cycle of `next_s` and move on; return the number of deadlines missed before."""
        now_s = time.monotonic()
        skipped = int((now_s - self.next_s) // self.period_s) if now_s > self.next_s else 0
        late_s = now_s - self.next_s - skipped * self.period_s
        self.lateness_s[self.cycles % MOST_LATENESS] = now_s - self.next_s
        self.cycles += 1
        self.missed += skipped
        self.next_s = now_s - late_s + self.period_s
        return skipped

    def wait(self) -> None:
        """Sleep until the coming deadline."""
        time.sleep(max(0.0, self.next_s - time.monotonic()))

    def report(self) -> dict[str, float]:
        """Return cycles, missed deadlines and lateness as plain data."""
        ordered = sorted(self.lateness_s[: self.cycles]) or [0.0]
        return {
            "period_s": self.period_s,
            "cycles": self.cycles,
            "missed": self.missed,
            "late_p99_s": ordered[int(0.99 * len(ordered))],
            "late_max_s": ordered[-1],
        }


def _load_libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
