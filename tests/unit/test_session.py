"""A session: folder, seed, device, record."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import random
from pathlib import Path

import numpy as np
import pytest
import torch

from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import ConfigError, DeviceError, StorageError
from brokk_rl.explain import explain
from brokk_rl.progress import SHARE, ItemProgress
from brokk_rl.session import Session, read_record, require_new_folder, write_json


def session(folder: Path, seed: int = 0, device: str = "cpu") -> Session:
    return Session(out=str(folder), seed=seed, device=device)


def test_a_gpu_that_is_missing_is_an_error_that_says_what_to_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match=r"session\.device=cpu"):
        session(tmp_path, device="cuda").torch_device()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert session(tmp_path, device="cuda:1").torch_device() == torch.device("cuda", 1)
    with pytest.raises(DeviceError, match="sees 2"):
        session(tmp_path, device="cuda:2").torch_device()


def test_streams_repeat_with_the_seed_and_differ_by_name(tmp_path: Path) -> None:
    first, again, other = session(tmp_path), session(tmp_path), session(tmp_path, seed=1)
    assert first.generator("starts").random() == again.generator("starts").random()
    assert len({s.stream(name) for s in (first, other) for name in ("starts", "noise")}) == 4


def test_seed_all_repeats_python_numpy_and_torch(tmp_path: Path) -> None:
    def draws() -> tuple[float, float, float]:
        session(tmp_path).seed_all()
        return random.random(), float(np.random.rand()), float(torch.rand(()))

    assert draws() == draws()


def test_the_record_tells_how_it_went(tmp_path: Path) -> None:
    with session(tmp_path / "run", seed=3).start("a: 1\n", {"mode": "train"}) as record:
        assert read_record(tmp_path / "run")["outcome"] == "running"
        record["objective"] = 0.5
    found = read_record(tmp_path / "run")
    expected = {"outcome": "finished", "objective": 0.5, "seed": 3, "mode": "train"}
    assert found.items() >= expected.items()
    assert found["versions"]["torch"] == torch.__version__.split("+")[0]
    assert (tmp_path / "run" / "resolved.yaml").read_text() == "a: 1\n"


def test_resuming_keeps_the_first_start_and_adds_another(tmp_path: Path) -> None:
    for resume in (False, True, True):
        with session(tmp_path).start("", {}, resume=resume):
            pass
    assert len(read_record(tmp_path)["resumed"]) == 2


@pytest.mark.parametrize("is_there", [False, True])
def test_a_run_that_is_refused_leaves_what_was_there(is_there: bool, tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "a"
    if is_there:
        folder.mkdir(parents=True)
    before = list(tmp_path.rglob("*"))
    with pytest.raises(ConfigError), session(folder).start("", {}):
        raise ConfigError("no")
    assert list(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("writes", [False, True])
def test_a_refused_resume_leaves_the_record_unless_it_wrote(writes: bool, tmp_path: Path) -> None:
    (tmp_path / "model_0.pt").touch()
    for text in ("a: 1\n", "a: 2\n"):
        with contextlib.suppress(ConfigError), session(tmp_path).start(text, {}, resume=True):
            os.utime(tmp_path / "model_0.pt", None if writes else (0, 0))
            if text == "a: 2\n":
                raise ConfigError("no")
    assert (tmp_path / "resolved.yaml").read_text() == ("a: 2\n" if writes else "a: 1\n")
    assert read_record(tmp_path)["outcome"] == ("failed" if writes else "finished")


def test_the_folder_of_a_killed_training_names_the_command_that_goes_on(tmp_path: Path) -> None:
    write_json(tmp_path / "session.json", {"mode": "train", "outcome": "running"})
    for iteration in (9, 20):
        (tmp_path / f"model_{iteration}.pt").touch()
    command = f"go on from {tmp_path}/model_20.pt: brokk mode=train policy={tmp_path} session.out="
    with pytest.raises(StorageError, match=command):
        require_new_folder(tmp_path)


def test_a_file_is_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_json(tmp_path / "a.json", {"old": 1})

    def fill_disk(path: Path, data: bytes) -> None:
        with path.open("wb") as file:
            file.write(data[:3])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", fill_disk)
    with pytest.raises(StorageError, match="No space left") as caught:
        write_json(tmp_path / "a.json", {"new": 2})
    assert json.loads((tmp_path / "a.json").read_bytes()) == {"old": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert "the disk is full" in (explain(caught.value) or "")


def test_a_broken_record_is_named(tmp_path: Path) -> None:
    (tmp_path / "session.json").write_text("{")
    with pytest.raises(StorageError, match=r"session\.json"):
        read_record(tmp_path)


HEADINGS = ["policy", *(f"quantity {k}" for k in range(20))]


def test_a_file_gets_every_row_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    print_table(HEADINGS, [[name, *(f"{k}.5" for k in range(20))] for name in ("a[b]", "c")])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["policy", "a[b]", "c"]
    assert lines[1].split()[1:] == [f"{k}.5" for k in range(20)]


def test_missing_values_are_dashes_and_text_is_no_markup(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_table([], [["a", None], ["b", 1.5]], title="[bold]")
    print_text("position[foot] " * 20)
    out = capsys.readouterr().out
    assert "–" in out and "1.5" in out and "[bold]" in out
    assert "position[foot] " * 20 in out


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that the module reads, s."""
    now = [0.0]
    monkeypatch.setattr("rich.console.monotonic", lambda: now[0])
    return now


def test_a_log_file_gets_a_line_a_minute(
    clock: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    work = ItemProgress("training", SHARE)
    for second in range(0, 181, 10):
        clock[0] = float(second)
        work.reach(second / 360.0, note="300 steps/s")
    # 70 s are 0.194 of the whole: 290 s are left; the next line comes more than a minute later
    assert caplog.messages == [
        "training: 19%, about 5 min left, 300 steps/s",
        "training: 39%, about 4 min left, 300 steps/s",
    ]


def test_a_repeated_step_does_not_go_back_and_quiet_work_says_nothing(
    clock: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    work = ItemProgress("frames", None, quiet=True)
    work.reach(7)
    clock[0] = 100.0
    work.reach(3, title="looking")
    assert work.describe() == "7 of ?" and caplog.messages == []
