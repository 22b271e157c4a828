"""Splits keep runs whole and share each joint out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from composed import MACHINE
from hypothesis import given, settings
from hypothesis import strategies as st

from actuators.recordings import split
from actuators.recordings.split import group_by_run, split_runs
from brokk_rl.errors import RecordingError
from brokk_rl.record import Recording


def recording(
    seconds: Sequence[float], name: str = "", seed: str = "", path: str | None = None
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


def test_parts_of_a_run_are_one_and_runs_of_other_collections_or_files_are_not() -> None:
    parts = [recording([1.0], "a"), recording([1.0], "a"), recording([1.0], "a", "2")]
    parts += [recording([1.0], path=f"{folder}/b.parquet") for folder in "xy"]
    assert [len(members) for members in group_by_run(parts).values()] == [2, 1, 1, 1]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.sampled_from([0.0, 5.0, 20.0, 60.0])] * 3), min_size=4, max_size=20),
    st.integers(2, 4),
)
def test_every_run_is_in_exactly_one_set_and_no_set_lacks_a_joint_that_could_be_shared(
    table: list[tuple[float, ...]], count: int
) -> None:
    runs = group_by_run([recording(seconds, f"run {n}") for n, seconds in enumerate(table)])
    shares = {str(part): 1.0 / count for part in range(count)}
    parts = split_runs(runs, shares)
    assert sorted(name for members in parts.values() for name in members) == sorted(runs)
    again = split_runs(dict(reversed(runs.items())), shares)
    assert all(set(members) == set(parts[part]) for part, members in again.items())
    moving = np.array(table) > 0
    first = moving.sum(0).argmin() if moving.any() else None  # the joint that is dealt with first
    if first is not None and moving[:, first].sum() >= count:
        for members in parts.values():
            assert any(moving[list(runs).index(name), first] for name in members)


def test_runs_of_one_joint_each_are_shared_out_joint_by_joint() -> None:
    table = [[60.0 if joint == run % 5 else 0.0 for joint in range(5)] for run in range(30)]
    runs = group_by_run([recording(seconds, f"run {n}") for n, seconds in enumerate(table)])
    parts = split_runs(runs, {"train": 4 / 6, "validation": 1 / 6, "test": 1 / 6})
    assert [len(names) for names in parts.values()] == [20, 5, 5]
    for names in parts.values():
        seconds = split.measure_commanded_s([part for name in names for part in runs[name]])
        assert (seconds == seconds[0]).all()


def test_a_joint_that_is_not_commanded_is_named_with_what_to_record() -> None:
    first, second = recording([9.0, 9.0, 9.0, 0.0, 9.0], "a"), recording([9.0] * 5, "b")
    runs = group_by_run([first, second])
    split.check_commanded(runs, MACHINE, 1, "why")
    with pytest.raises(RecordingError, match=r"joint q4 .* in 1 \(b\) of 2 runs.*move q4"):
        split.check_commanded(runs, MACHINE, 2, "why")
