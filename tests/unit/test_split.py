"""Splits keep runs whole and share each joint out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actuators.recordings.split import (
    check_commanded,
    group_by_run,
    measure_commanded_s,
    split_runs,
)
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording


def recording(
    seconds: list[float], name: str = "", seed: str = "", path: str | None = None
) -> Recording:
    """A recording in which joint `j` is commanded for `seconds[j]`, one joint after another."""
    counts = [round(20 * s) for s in seconds]
    u = np.zeros((max(2, sum(counts)), len(seconds)), dtype=np.float32)
    begin = 0
    for joint, count in enumerate(counts):
        u[begin : begin + count, joint] = 0.5
        begin += count
    metadata = {key: value for key, value in (("run", name), ("seed", seed)) if value}
    joints = tuple(f"q{j + 1}" for j in range(len(seconds)))
    return Recording(
        machine="brokk170", joints=joints, units=("rad",) * len(seconds), rate_hz=20.0, t_s=np.arange(len(u)) * 0.05, u=u,
        q=np.zeros_like(u), metadata=metadata, path=Path(path) if path else None,
    )  # fmt: skip


def test_parts_of_a_run_are_one_and_files_that_say_nothing_are_each_their_own() -> None:
    parts = [
        recording([1.0], "a"),
        recording([1.0], path="x/b.parquet"),
        recording([1.0], "a"),
        recording([1.0], path="y/b.parquet"),
    ]
    assert {name: len(members) for name, members in group_by_run(parts).items()} == {
        "a": 2,
        "x/b.parquet": 1,
        "y/b.parquet": 1,
    }


def test_two_collections_that_named_their_runs_alike_are_told_apart_by_their_seeds() -> None:
    assert (
        len(
            group_by_run(
                [recording([1.0], "a", "1"), recording([1.0], "a", "2"), recording([1.0], "a", "1")]
            )
        )
        == 2
    )


def test_seconds_of_command_are_counted_joint_by_joint() -> None:
    assert measure_commanded_s([recording([2.0, 0.5]), recording([1.0, 0.0])]) == pytest.approx(
        [3.0, 0.5]
    )


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.lists(st.sampled_from([0.0, 5.0, 20.0, 60.0]), min_size=3, max_size=3),
        min_size=4,
        max_size=20,
    ),
    st.integers(2, 4),
)
def test_every_run_is_in_exactly_one_set_and_no_set_lacks_a_joint_that_could_be_shared(
    table: list[list[float]], count: int
) -> None:
    runs = group_by_run([recording(seconds, f"run {n}") for n, seconds in enumerate(table)])
    parts = split_runs(runs, {str(part): 1.0 / count for part in range(count)})
    assert sorted(name for members in parts.values() for name in members) == sorted(runs)
    assert parts == split_runs(
        dict(reversed(runs.items())), {str(part): 1.0 / count for part in range(count)}
    ) or all(
        set(members) == set(again)
        for members, again in zip(
            parts.values(),
            split_runs(dict(reversed(runs.items())), dict.fromkeys(parts, 1.0 / count)).values(),
            strict=True,
        )
    )
    moving = np.array(table) > 0
    first = moving.sum(0).argmin() if moving.any() else None  # the joint that is dealt with first
    if first is not None and moving[:, first].sum() >= count:
        for members in parts.values():
            assert any(moving[list(runs).index(name), first] for name in members)


def test_runs_of_one_joint_each_are_shared_out_joint_by_joint() -> None:
    table = [[60.0 if joint == run % 5 else 0.0 for joint in range(5)] for run in range(30)]
    runs = group_by_run([recording(seconds, f"run {n}") for n, seconds in enumerate(table)])
    parts = split_runs(runs, {"train": 4 / 6, "validation": 1 / 6, "test": 1 / 6})
    assert {part: len(names) for part, names in parts.items()} == {
        "train": 20,
        "validation": 5,
        "test": 5,
    }
    for names in parts.values():
        seconds = measure_commanded_s([part for name in names for part in runs[name]])
        assert (seconds == seconds[0]).all()


def test_unequal_runs_come_near_their_shares() -> None:
    generator = np.random.default_rng(0)
    runs = group_by_run(
        [recording(list(generator.uniform(0.0, 100.0, 3)), f"run {n}") for n in range(40)]
    )
    parts = split_runs(runs, {"train": 0.7, "test": 0.3})
    total = measure_commanded_s([part for members in runs.values() for part in members])
    share = measure_commanded_s([part for name in parts["test"] for part in runs[name]]) / total
    assert share == pytest.approx([0.3] * 3, abs=0.1)


def test_a_joint_that_is_not_commanded_is_named_with_what_to_record(machine: Machine) -> None:
    runs = group_by_run(
        [recording([9.0, 9.0, 9.0, 0.0, 9.0], "a"), recording([9.0, 9.0, 9.0, 9.0, 9.0], "b")]
    )
    check_commanded(runs, machine, 1, "why")
    with pytest.raises(
        RecordingError,
        match=r"joint q4 is commanded \(\|u\| > 0\.02\) in 1 \(b\) of 2 runs.*2 or more: why.*move q4",
    ):
        check_commanded(runs, machine, 2, "why")
