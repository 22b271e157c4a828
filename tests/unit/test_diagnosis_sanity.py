"""What is wrong with a recording is said where it was planted; a sound recording has nothing against it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from composed import MACHINE
from gaps import DELAY, recording

from actuators.recordings.recording_checks import REMARKS, RecordingRemark, examine_recordings
from brokk_rl.record import Recording

Examine = Callable[[Recording], dict[str, RecordingRemark]]


@pytest.fixture
def sound() -> Recording:
    return recording(MACHINE)


@pytest.fixture
def examine() -> Examine:
    """Returns the remarks on a recording by name."""

    def run(one: Recording) -> dict[str, RecordingRemark]:
        return {found.name: found for found in examine_recordings([one], MACHINE)}

    return run


def test_a_sound_recording_says_only_which_joint_rested(sound: Recording) -> None:
    (remark,) = examine_recordings([sound], MACHINE)
    assert (remark.name, remark.joint, remark.kind.severity) == ("joint at rest", "q2", "note")


def test_a_joint_locked_while_another_moves_is_an_interlock_and_says_which(
    sound: Recording, examine: Examine
) -> None:
    found = examine(recording(MACHINE, np.abs(sound.u[:, 3]) > 0))["interlock"]
    assert found.joint == "q3"
    assert found.kind.severity == "bad"
    assert found.recording == "planted"
    assert found.count >= 5
    assert "q3 ignores its command when q4 is commanded" in found.amount


def test_a_joint_locked_in_a_pose_is_an_interlock_and_says_where(
    sound: Recording, examine: Examine
) -> None:
    limit = float(np.quantile(sound.q[:, 0], 0.5))
    found = examine(recording(MACHINE, np.roll(sound.q[:, 0] > limit, -DELAY)))["interlock"]
    assert found.joint == "q3" and "q3 ignores its command when q1 is above" in found.amount


def test_a_lock_without_a_common_condition_stays_unexplained(examine: Examine) -> None:
    ignored = np.zeros(4800, dtype=bool)
    for begin in np.random.default_rng(3).integers(0, 4700, 12):
        ignored[begin : begin + 60] = True
    found = examine(recording(MACHINE, ignored))
    assert "interlock" not in found and found["command without motion"].joint == "q3"
    assert "s in all" in found["command without motion"].amount


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda t: t + 0.004 * np.random.default_rng(0).uniform(-0.5, 0.5, len(t)), None),
        (lambda t: t + 0.018 * (np.arange(len(t)) % 2) - 0.009, "irregular clock"),
    ],
)
def test_only_rows_that_are_not_equally_spaced_are_a_fault_of_the_clock(
    sound: Recording, examine: Examine, change, name: str | None
) -> None:
    found = examine(replace(sound, t_s=change(sound.t_s)))
    assert {key for key in found if "clock" in key} == ({name} if name else set())


def test_a_sensor_at_the_end_of_its_range_is_found_and_a_joint_at_its_stop_is_not(
    sound: Recording, examine: Examine
) -> None:
    middle = float(sound.q[:, 2].min() + 0.7 * np.ptp(sound.q[:, 2]))
    q = sound.q.copy()
    q[:, 2] = np.minimum(q[:, 2], middle)
    found = examine(replace(sound, q=q))["saturated sensor"]
    assert found.joint == "q3" and found.kind.severity == "bad"
    shifted = q.copy()
    shifted[:, 2] += MACHINE.upper[2] - q[:, 2].max()
    assert "saturated sensor" not in examine(replace(sound, q=shifted))


def test_the_gravest_comes_first_and_all_of_it_is_plain(sound: Recording) -> None:
    slow = replace(recording(MACHINE, np.abs(sound.u[:, 3]) > 0), t_s=sound.t_s * 1.004)
    remarks = examine_recordings([slow], MACHINE)
    places = [["bad", "warn", "note"].index(remark.kind.severity) for remark in remarks]
    assert places == sorted(places)
    for remark in remarks:
        assert remark.plain()["name"] in REMARKS
        assert remark.plain()["advice"]
        assert remark.to_s >= remark.from_s
