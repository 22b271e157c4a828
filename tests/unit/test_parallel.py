"""Work on several processes: the same results in the same order, errors of the function, a helper that dies."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from brokk_rl import job
from brokk_rl.parallel import map_parallel, use_workers

linux = pytest.mark.skipif(sys.platform != "linux", reason="needs fork")


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_results_come_in_the_order_of_the_items(workers: int) -> None:
    told = []
    with use_workers(workers):
        found = map_parallel(lambda n: np.full(3, n**2), range(4), lambda *one: told.append(one))
    assert [one.tolist() for one in found] == [[n**2] * 3 for n in range(4)]
    assert told == [(0, 0.0), (1, 0.25), (2, 0.5), (3, 0.75)]


@linux
def test_two_processes_work_and_each_does_its_inner_work_in_turn() -> None:
    def work(_: int) -> set[int]:
        time.sleep(0.02)  # none takes all items before the other begins
        return set(map_parallel(lambda _: os.getpid(), range(5)))

    with use_workers(2):
        found = map_parallel(work, range(20))
    assert all(len(one) == 1 for one in found)
    assert len(set.union(*found) - {os.getpid()}) == 2
    assert map_parallel(work, range(1)) == [{os.getpid()}], "one worker is the default"


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_raised_as_in_turn(workers: int) -> None:
    with use_workers(workers), pytest.raises(ZeroDivisionError):
        map_parallel(lambda n: 1 // (n - 3), range(8))


@linux
def test_the_work_of_helpers_that_die_is_done_here(caplog: pytest.LogCaptureFixture) -> None:
    mother = os.getpid()

    def work(n: int) -> int:
        if os.getpid() != mother:
            os.kill(os.getpid(), signal.SIGKILL)
        return n

    with use_workers(3):
        assert map_parallel(work, range(20)) == list(range(20))
    assert "was killed" in caplog.text


def test_systems_without_fork_work_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    with use_workers(4):
        assert map_parallel(lambda _: os.getpid(), range(3)) == [os.getpid()] * 3


@pytest.fixture(autouse=True)
def a_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This process is a job that submitit started on this computer, and nobody else's jobs are in its way."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(job, "POLL_S", 0.01)
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "local")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv(job.OFFERED, "2,5")


def test_jobs_take_different_gpus_and_leave_them_again() -> None:
    with job.take_place() as first, job.take_place() as second:
        assert (first, second) == ("2", "5") and os.environ["CUDA_VISIBLE_DEVICES"] == "5"
    with job.take_place() as third:
        assert third == "2"


def test_a_job_waits_until_a_place_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(job.OFFERED, "7")
    held = job.take_place()
    held.__enter__()
    waited: list[float] = []

    def leaves(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            held.__exit__(None, None, None)

    monkeypatch.setattr("time.sleep", leaves)
    with job.take_place() as gpu:
        assert gpu == "7" and len(waited) == 3


@pytest.mark.parametrize(
    ("named", "visible", "count", "places"),
    [("2,5", "", 2, "2,5"), (None, "", 0, "cpu"), (None, "", 2, "0,1"), (None, "4,6", 2, "4,6")],
    ids=["a person names them", "no GPU", "every GPU", "every visible GPU"],
)
def test_places_are_those_that_a_person_names_or_the_visible_gpus(
    named: str | None, visible: str, count: int, places: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if named is None:
        monkeypatch.delenv(job.OFFERED)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr("torch.cuda.device_count", lambda: count)
    job.offer_places()
    assert os.environ[job.OFFERED] == places


def test_elsewhere_nothing_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    with job.take_place() as gpu:
        assert gpu is None and os.environ["CUDA_VISIBLE_DEVICES"] == ""
