"""Work on several processes: the same results in the same order, which process is which, and a helper that dies."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from brokk_rl import distributed, job
from brokk_rl.errors import ConfigError, DeviceError
from brokk_rl.parallel import map_parallel, use_workers
from brokk_rl.rl.group import TrainingGroup, hash_tensors
from brokk_rl.session import Session

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


def told(monkeypatch: pytest.MonkeyPatch, **values: int) -> None:
    for name, value in values.items():
        monkeypatch.setenv(name, str(value))


def session(folder: Path, device: str = "cpu") -> Session:
    return Session(out=str(folder / "run"), seed=3, device=device)


def test_a_process_started_by_hand_is_alone() -> None:
    assert distributed.read_rank() == distributed.Rank(0, 0, 1) and distributed.read_rank().first


def test_torchrun_says_which_process_this_is(monkeypatch: pytest.MonkeyPatch) -> None:
    told(monkeypatch, RANK=5, LOCAL_RANK=1, WORLD_SIZE=8)
    rank = distributed.read_rank()
    assert rank == distributed.Rank(5, 1, 8) and not rank.first


def test_half_an_environment_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    told(monkeypatch, WORLD_SIZE=2)
    with pytest.raises(ConfigError, match="RANK and LOCAL_RANK below WORLD_SIZE"):
        distributed.read_rank()


def test_only_modes_that_share_their_work_run_in_several_processes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Shares:
        together = True

    distributed.check_together(int, sweep=True)
    told(monkeypatch, RANK=1, LOCAL_RANK=1, WORLD_SIZE=2)
    distributed.check_together(Shares, sweep=False)
    with pytest.raises(ConfigError, match="int is the work of one process"):
        distributed.check_together(int, sweep=False)
    with pytest.raises(ConfigError, match="hydra/launcher=submitit_local"):
        distributed.check_together(Shares, sweep=True)


def test_the_first_has_the_streams_of_one_alone_and_the_others_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = session(tmp_path).stream("starts")
    seeds = []
    for index in range(3):
        told(monkeypatch, RANK=index, LOCAL_RANK=index, WORLD_SIZE=3)
        seeds.append(session(tmp_path).stream("starts"))
    assert seeds[0] == alone and len(set(seeds)) == 3


def test_only_the_first_writes_a_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told(monkeypatch, RANK=1, LOCAL_RANK=1, WORLD_SIZE=2)
    with session(tmp_path).start("", {}) as record:
        record["objective"] = 1.0
    assert not list(tmp_path.iterdir())


def test_each_process_has_its_own_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    told(monkeypatch, RANK=5, LOCAL_RANK=1, WORLD_SIZE=8)
    assert session(tmp_path, "auto").torch_device() == torch.device("cuda", 1)
    told(monkeypatch, RANK=2, LOCAL_RANK=2, WORLD_SIZE=8)
    with pytest.raises(DeviceError, match="no more processes than GPUs"):
        session(tmp_path, "cuda").torch_device()


def test_alone_a_group_changes_nothing() -> None:
    with TrainingGroup(torch.device("cpu")) as group:
        assert not group.together and group.gather(3) == [3] and group.broadcast_first(4) == 4
        assert group.gather_on_first({"a": 1}) == [{"a": 1}]
        figures = {"x": 0.25, "episodes": 8.0, "fault_rate": 0.5}
        assert group.pool_statistics(figures) == figures


def test_figures_of_several_weigh_by_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    group = TrainingGroup(torch.device("cpu"))
    names = ("x", "episodes", "fault_rate")
    parts = [dict(zip(names, row, strict=True)) for row in ((1.0, 3.0, 0.0), (0.0, 1.0, 0.5))]
    monkeypatch.setattr(group, "gather", lambda figures: parts)
    assert group.pool_statistics(parts[0]) == {"x": 0.75, "episodes": 4.0, "fault_rate": 0.25}


def test_a_fingerprint_sees_the_last_bit() -> None:
    weights = {"a": torch.ones(3), "b": torch.tensor(2.0)}
    nudged = weights | {"b": torch.nextafter(weights["b"], torch.tensor(3.0))}
    again = {name: value.clone() for name, value in weights.items()}
    assert hash_tensors(weights) == hash_tensors(again) != hash_tensors(nudged)
