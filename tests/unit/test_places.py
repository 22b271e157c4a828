"""Jobs of a local sweep share GPUs: one at a time on each, whoever started them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from brokk_rl import job


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
