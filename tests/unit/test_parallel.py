"""Work on several processes: the same results in the same order, errors of the function, a helper that dies."""

from __future__ import annotations

import os
import signal
import sys

import numpy as np
import pytest

from brokk_rl import parallel
from brokk_rl.parallel import map_parallel, use_workers

linux = pytest.mark.skipif(sys.platform != "linux", reason="needs fork")


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_results_come_in_the_order_of_the_items(workers: int) -> None:
    with use_workers(workers):
        found = map_parallel(lambda n: np.full(3, n**2), range(7))
    assert [one.tolist() for one in found] == [[n**2] * 3 for n in range(7)]


@linux
def test_another_process_takes_part() -> None:
    def work(_: int) -> int:
        # Long enough that none has taken all items before the other began.
        return (os.getpid(), sum(range(400_000)))[0]

    with use_workers(2):
        assert len(set(map_parallel(work, range(60)))) == 2
    assert set(map_parallel(work, range(3))) == {os.getpid()}, "one worker is the default"


@linux
def test_work_inside_of_work_is_done_in_turn() -> None:
    def nested(_: int) -> bool:
        return set(map_parallel(lambda _: os.getpid(), range(20))) == {os.getpid()}

    with use_workers(2):
        assert all(map_parallel(nested, range(4)))


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_raised_as_in_turn(workers: int) -> None:
    with use_workers(workers), pytest.raises(ZeroDivisionError):
        map_parallel(lambda n: 1 // (n - 3), range(8))


@linux
def test_the_work_of_a_helper_that_dies_is_done_here() -> None:
    mother = os.getpid()

    def work(n: int) -> int:
        if os.getpid() != mother:
            os.kill(os.getpid(), signal.SIGKILL)
        return sum(range(200_000)) * 0 + n

    with use_workers(3):
        assert map_parallel(work, range(20)) == list(range(20))


@linux
def test_a_helper_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    mother = os.getpid()
    monkeypatch.setattr(parallel, "PATIENCE_S", 0.1)

    def work(n: int) -> int:
        while os.getpid() != mother:
            signal.pause()
        return n

    with use_workers(2):
        assert map_parallel(work, range(5)) == list(range(5))


def test_systems_without_fork_work_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    with use_workers(4):
        assert map_parallel(lambda _: os.getpid(), range(3)) == [os.getpid()] * 3
