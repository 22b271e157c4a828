"""Which of several processes this one is, and what follows for its seeds and its record."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from brokk_rl import distributed
from brokk_rl.errors import ConfigError, DeviceError
from brokk_rl.rl.group import TrainingGroup, hash_tensors
from brokk_rl.session import Session


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
