"""Jobs of a local sweep share GPUs: one at a time on each, whoever started them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from brokk_rl import sweep


@pytest.fixture(autouse=True)
def a_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This process is a job that submitit started on this computer, and nobody else's jobs are in its way."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(sweep, "POLL_S", 0.01)
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "local")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv(sweep.OFFERED, "2,5")


def test_jobs_take_different_gpus_and_leave_them_again() -> None:
    with sweep.take_place() as first, sweep.take_place() as second:
        assert (first, second) == ("2", "5") and os.environ["CUDA_VISIBLE_DEVICES"] == "5"
    with sweep.take_place() as third:
        assert third == "2"


def test_a_job_waits_until_a_place_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(sweep.OFFERED, "7")
    held = sweep.take_place()
    held.__enter__()
    waited: list[float] = []

    def leaves(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            held.__exit__(None, None, None)

    monkeypatch.setattr("time.sleep", leaves)
    with sweep.take_place() as gpu:
        assert gpu == "7" and len(waited) == 3


def test_what_a_person_names_goes_before_what_is_there() -> None:
    sweep.offer_places()
    assert os.environ[sweep.OFFERED] == "2,5"


def test_without_a_gpu_there_is_one_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(sweep.OFFERED)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    sweep.offer_places()
    assert os.environ[sweep.OFFERED] == "cpu"


def test_every_gpu_that_is_visible_is_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(sweep.OFFERED)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    sweep.offer_places()
    assert os.environ.pop(sweep.OFFERED) == "0,1"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")
    sweep.offer_places()
    assert os.environ[sweep.OFFERED] == "4,6"


def test_elsewhere_nothing_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    with sweep.take_place() as gpu:
        assert gpu is None and os.environ["CUDA_VISIBLE_DEVICES"] == ""
