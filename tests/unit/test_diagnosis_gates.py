"""Gates of a verdict: each passes just below its limit and fails just above it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE
from gaps import recording

from actuators.recordings.recording_checks import RecordingRemark, examine_recordings
from brokk_rl.record import Recording
from diagnosis import gates
from diagnosis.closure import Gate
from diagnosis.reference_diagnosis import accept_named_joints


def by_name(found: list[Gate]) -> dict[str, Gate]:
    return {one.name: one for one in found}


def remark(name: str, joint: str, share: float) -> RecordingRemark:
    return RecordingRemark(name, joint, "planted", 0.0, 1.0, 1, "", share)


@pytest.mark.parametrize(("name", "limit"), gates.MAX_REMARK_SHARES.items())
def test_findings_beyond_their_share_forbid_any_telling(name: str, limit: float) -> None:
    field = [recording(MACHINE)]
    for share, passes in ((limit, True), (1.01 * limit, False)):
        found = by_name(gates.judge_recordings([remark(name, "q3", share)], [], field, [], MACHINE))
        gate = found[name.replace(" ", "_")]
        assert gate.passed is passes and gate.value == pytest.approx(share)
        others = [one for one in found.values() if one is not gate]
        assert all(one.passed for one in others)
        assert ("q3" in gate.text) is not passes
    # joints are judged one by one, recordings together: half of the time here, none there
    halves = [remark(name, "q3", limit), remark(name, "q4", limit)]
    assert by_name(gates.judge_recordings(halves, [], field, [], MACHINE))[gate.name].passed
    calm = replace(recording(MACHINE), metadata={"run": "calm"})
    some = [remark(name, "q3", 1.9 * limit)]
    assert by_name(gates.judge_recordings(some, [], [*field, calm], [], MACHINE))[gate.name].passed
    more = [remark(name, "q3", 2.1 * limit)]
    told = by_name(gates.judge_recordings(more, [], [*field, calm], [], MACHINE))
    assert not told[gate.name].passed


def test_what_the_reference_shows_as_often_forbids_no_telling() -> None:
    one, usual = [recording(MACHINE)], [remark("unlogged input", "q3", 0.2)]
    for share, passes in ((0.25, True), (0.35, False)):
        now = [remark("unlogged input", "q3", share)]
        found = by_name(gates.judge_recordings(now, usual, one, one, MACHINE))
        assert found["unlogged_input"].passed is passes


def test_an_effect_that_is_named_on_a_joint_may_be_what_locks_it() -> None:
    whole = recording(MACHINE)
    field = [recording(MACHINE, np.abs(whole.u[:, 3]) > 0)]
    told = gates.judge_recordings(examine_recordings(field, MACHINE), [], field, [whole], MACHINE)
    assert not by_name(told)["interlock"].passed
    assert not by_name(accept_named_joints(told, {"lag": ["q4"]}))["interlock"].passed
    assert by_name(accept_named_joints(told, {"lag": ["q4"], "creep": ["q3"]}))["interlock"].passed


@pytest.mark.parametrize(
    ("named", "passes"),
    [({"lag": ["q3"]}, False), ({"quantisation": ["q4"]}, False), ({"quantisation": ["q3"]}, True)],
)
def test_a_coarse_sensor_repeats_its_readings_and_jumps(
    named: dict[str, list[str]], passes: bool
) -> None:
    one = [recording(MACHINE)]
    remarks = [remark(name, "q3", 0.4) for name in ("frozen sensor", "jumps")]
    found = by_name(
        accept_named_joints(gates.judge_recordings(remarks, [], one, one, MACHINE), named)
    )
    assert found["frozen_sensor"].passed is found["jumps"].passed is passes


def test_limits_that_the_recordings_leave_are_told() -> None:
    plain = recording(MACHINE)
    travel = MACHINE.upper - MACHINE.lower

    def moved(beyond: float) -> Any:
        q = np.tile((MACHINE.lower + MACHINE.upper) / 2, (len(plain.q), 1))
        q[:400, 3] = MACHINE.upper[3] + beyond * travel[3]
        return replace(plain, q=q)

    def judge_limits(field: list[Recording], reference: list[Recording]) -> Gate:
        return by_name(gates.judge_recordings([], [], field, reference, MACHINE))["limits"]

    for beyond, passes in ((0.049, True), (0.051, False)):
        gate = judge_limits([moved(beyond)], [])
        assert gate.passed is passes and gate.value == pytest.approx(beyond)
        assert ("q4" in gate.text) is not passes
    below = replace(plain, q=2 * MACHINE.lower - MACHINE.upper + 0.0 * plain.q)
    assert not judge_limits([below], []).passed
    # a field that alone leaves them may have a biased encoder
    assert judge_limits([moved(0.3)], [plain]).passed
    assert not judge_limits([plain], [moved(0.3)]).passed
    spike = moved(0.3)
    spike.q[4:400, 3] = MACHINE.home[3]
    assert judge_limits([spike], []).passed


def test_fast_motion_without_command_is_an_unlogged_input_and_slow_one_a_leak() -> None:
    plain = recording(MACHINE, seconds=245.0)
    t_s = plain.t_s
    for share, name in ((0.5, "unlogged input"), (0.1, "motion without command")):
        q = plain.q.copy()
        swing = np.abs((0.1 * t_s) % 2.0 - 1.0)  # slope of 0.1 a second
        q[:, 1] = MACHINE.home[1] + share * MACHINE.max_speed[1] / 0.1 * swing
        found = examine_recordings([replace(plain, q=q)], MACHINE)
        names = {one.name: one for one in found if one.joint == "q2"}
        assert name in names and len({"unlogged input", "motion without command"} & {*names}) == 1
        assert names[name].share > 0.8
        told = gates.judge_recordings(found, [], [plain], [], MACHINE)
        assert by_name(told)["unlogged_input"].passed is (share < 0.2)
