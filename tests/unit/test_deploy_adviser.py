"""The policy process without a policy: what it remembers, what it asks for, and when it takes that back."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE, option

from deploy.guidance import HandLag
from deploy.kernel.guard import GuardTrip
from deploy.policy import policy_process
from deploy.policy.policy_process import PolicyAdviser, PolicyHistory, PolicyProcessConfig
from deploy.runtime.operator_state import AdviceStatus, OperatorState
from deploy.runtime.shared_memory import RecordLayout
from deploy.runtime.shm_layout import TEXT, LoopMemory

NUM_JOINTS, NUM_HISTORY = MACHINE.num_joints, MACHINE.num_history
CONFIG = PolicyProcessConfig(MACHINE, "nowhere", option("guidance", "machine"), 0.15, 60.0, 0.3)
ANSWER = np.array([0.5, 0.0, -0.4, 0.0, 0.1])


class Encoder:
    """Remembers what it was given."""

    size = 7

    def __init__(self) -> None:
        self.given: dict[str, Any] = {}
        self.observation = np.zeros((1, self.size))

    def encode(self, given: dict[str, Any]) -> np.ndarray:
        self.given = given
        return self.observation


class Bundle:
    """A policy that answers as it is told."""

    def __init__(self) -> None:
        self.encoder, self.answer, self.asked = Encoder(), ANSWER, 0
        self.knows, self.done = True, False
        self.hand: HandLag | None = None

    def is_trained_for(self, target_m: np.ndarray) -> bool:
        return self.knows

    def is_done(self, *args: object) -> bool:
        return self.done

    def command(self, observation: np.ndarray) -> np.ndarray:
        assert observation.shape == (1, self.encoder.size)
        self.asked += 1
        return self.answer[None]


class Desk:
    """An adviser, the memory around it, and a clock."""

    def __init__(self, commands: bool = True) -> None:
        self.memory = LoopMemory(NUM_JOINTS, commands)
        self.bundle = Bundle()
        self.now_s = 1000.0
        self.adviser = PolicyAdviser(CONFIG, self.bundle, self.memory)  # type: ignore[arg-type]
        self.number = 0

    def state(self, **changes: Any) -> OperatorState:
        self.number += 4
        blank = RecordLayout(OperatorState, NUM_JOINTS).new()
        known = {"t_s": self.now_s, "q_t_s": self.now_s, "q": MACHINE.home, "q_plausible": True}
        known |= {"trusted": True, "flow_number": self.number, "flow_t_s": self.now_s}
        return replace(blank, **(known | changes))

    def aim(self, t_s: float | None = None) -> None:
        target = self.memory.target.new()
        target["t_s"] = self.now_s if t_s is None else t_s
        target["center_in_base_m"] = (2.6, 0.1, 0.75)
        self.memory.target.write(target)

    def go(self, periods: int = 1, missed: int = 0, **changes: Any) -> AdviceStatus:
        status = AdviceStatus.NO_STATE
        for _ in range(periods):
            self.now_s += MACHINE.period_s
            self.memory.state.write(self.state(**changes))
            status = self.adviser.run_cycle(missed, self.now_s)
        return status

    def advised(self) -> Desk:
        self.aim()
        assert self.go(NUM_HISTORY) is AdviceStatus.VALID
        return self

    @property
    def request(self) -> Any:
        return self.memory.request.read()

    @property
    def advice(self) -> Any:
        return self.memory.advice.read()


@pytest.fixture
def desk() -> Iterator[Desk]:
    made = Desk()
    yield made
    made.memory.close()


def test_an_advice_is_shown_asked_for_and_recorded(desk: Desk) -> None:
    desk.advised()
    advice, request = desk.advice, desk.request
    assert advice.valid and advice.t_s == request.t_s == desk.now_s
    assert advice.u.tolist() == request.u.tolist() == ANSWER.tolist()
    assert advice.number == NUM_HISTORY and 0.0 < advice.infer_s < 1.0
    assert advice.target_in_base_m.tolist() == [2.6, 0.1, 0.75]
    assert advice.lever_rad.any() and not advice.button_right
    told = [json.loads(one.removeprefix(TEXT)) for one in desk.memory.policy_log.take()]
    assert len(told) == NUM_HISTORY and {one["topic"] for one in told} == {"advice"}
    assert told[-1]["reason"] == "valid" and told[-1]["u"] == ANSWER.tolist()
    assert told[-1]["t_s"] == desk.now_s and told[-1]["target_in_base_m"] == [2.6, 0.1, 0.75]
    assert told[-1]["infer_s"] == pytest.approx(advice.infer_s, abs=1e-6)
    assert told[-1]["lever_rad"] == pytest.approx(advice.lever_rad, abs=1e-5)
    assert told[-1]["button_right"] is False


def test_the_policy_is_given_target_history_pitch_and_proposals(desk: Desk) -> None:
    desk.advised()
    desk.go(2)
    given = desk.bundle.encoder.given
    assert given["target_in_base_m"].tolist() == [[2.6, 0.1, 0.75]]
    assert given["pitch_rad"].tolist() == [0.3]
    for name in ("q", "u", "proposals"):
        assert given[name].shape == (1, NUM_HISTORY, NUM_JOINTS)
    proposed = given["proposals"][0]
    assert proposed[-2:].tolist() == [ANSWER.tolist()] * 2 and not proposed[0].any()


def test_the_first_call_is_made_before_anything_depends_on_it() -> None:
    desk = Desk()
    assert desk.bundle.asked == 1
    desk.memory.close()


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"q_plausible": False}, AdviceStatus.IMPLAUSIBLE),
        ({"trusted": False}, AdviceStatus.IMPLAUSIBLE),
        ({"q_t_s": -0.151}, AdviceStatus.STALE),
        ({"flow_t_s": -0.151}, AdviceStatus.STALE),
        ({"t_s": -0.151}, AdviceStatus.STALE),
    ],
)
def test_without_positions_the_command_is_withdrawn_at_once_and_the_history_begins_anew(
    desk: Desk, changes: dict[str, Any], status: AdviceStatus
) -> None:
    desk.advised()
    later_s = desk.now_s + MACHINE.period_s
    for name in changes:
        changes[name] += later_s * name.endswith("t_s")
    assert desk.go(**changes) is status
    assert desk.request.t_s == -math.inf and not desk.advice.u.any() and not desk.advice.valid
    assert desk.advice.infer_s == 0.0
    assert desk.go(NUM_HISTORY - 1) is AdviceStatus.WARMING_UP
    assert desk.request.t_s == -math.inf
    assert desk.go() is AdviceStatus.VALID and desk.request.t_s == desk.now_s


def test_positions_up_to_the_limit_are_fresh_and_no_state_is_none(desk: Desk) -> None:
    assert desk.adviser.run_cycle(0, desk.now_s) is AdviceStatus.NO_STATE
    desk.advised()
    fresh_s = desk.now_s + MACHINE.period_s - 0.15
    assert desk.go(q_t_s=fresh_s, flow_t_s=fresh_s, t_s=fresh_s) is AdviceStatus.VALID


def test_without_a_borehole_or_with_an_old_one_there_is_no_advice(desk: Desk) -> None:
    assert desk.go(NUM_HISTORY) is AdviceStatus.NO_TARGET
    assert desk.request.t_s == -math.inf and desk.advice.target_in_base_m.tolist() == [0, 0, 0]
    desk.aim(desk.now_s + MACHINE.period_s - 60.0)
    assert desk.go() is AdviceStatus.VALID
    assert desk.go() is AdviceStatus.TARGET_OLD and desk.request.t_s == -math.inf


@pytest.mark.parametrize(
    "answer",
    [
        [math.nan, 0, 0, 0, 0],
        [0, 0, 0, 0, math.inf],
        [1e30] * 5,
        [1.00001, 0, 0, 0, 0],
        [0, 0, 0, 0, -1.00001],
        [0.1, 0.1, 0, 0, 0],
        [0, -0.1, 0, 0, 1e-6],
    ],
)
def test_an_answer_that_makes_no_sense_is_told_to_the_guard_at_once(
    desk: Desk, answer: list[float]
) -> None:
    desk.advised()
    desk.bundle.answer = np.array(answer)
    assert desk.go() is AdviceStatus.REJECTED
    assert np.isnan(desk.request.u).all() and desk.request.t_s == desk.now_s
    assert not desk.advice.u.any()
    desk.bundle.answer = ANSWER
    assert desk.go() is AdviceStatus.VALID and desk.request.u.tolist() == ANSWER.tolist()
    # nothing was proposed in that period
    assert not desk.bundle.encoder.given["proposals"][0, -1].any()


@pytest.mark.parametrize("answer", [[1.0, 0, 0, 0, -1.0], [0, 1.0, 0, 0, 0], [1.0000009] + [0] * 4])
def test_an_answer_up_to_full_is_taken(desk: Desk, answer: list[float]) -> None:
    desk.bundle.answer = np.array(answer)
    desk.advised()


def test_an_observation_that_is_no_number_never_reaches_the_policy(desk: Desk) -> None:
    desk.advised()
    asked = desk.bundle.asked
    desk.bundle.encoder.observation[0, 3] = math.nan
    assert desk.go() is AdviceStatus.REJECTED and desk.bundle.asked == asked


def test_where_nothing_is_ever_sent_nothing_is_asked_for() -> None:
    desk = Desk(commands=False).advised()
    assert desk.memory.request is None
    desk.memory.close()


def test_what_is_sent_goes_through_the_hand_that_the_policy_counts_on(desk: Desk) -> None:
    desk.bundle.hand = HandLag({"lag_s": [0.1, 0.2], "dead_zone": 0.025}, MACHINE)
    assert 0.0 < desk.advised().request.u[0] < desk.advice.u[0] == ANSWER[0]
    desk.go(q_plausible=False)
    assert not desk.request.u.any()


def test_the_display_moves_by_one_period_also_without_advice(desk: Desk) -> None:
    desk.advised()
    before = np.abs(desk.advice.lever_rad).max()
    desk.go(q_plausible=False)
    after = np.abs(desk.advice.lever_rad).max()
    assert after == pytest.approx(max(0.0, before - 2.0 * MACHINE.period_s))


# ---- the history


def sample(
    history: PolicyHistory,
    number: int,
    flow_sum: float,
    q: float,
    missed: int = 0,
    flow: float = 9.0,
) -> None:
    each = np.ones(NUM_JOINTS)
    blank = RecordLayout(OperatorState, NUM_JOINTS).new()
    flows = {"flow_number": number, "flow_sum": flow_sum * each, "flow": flow * each}
    state = replace(blank, **flows, q=q * each)
    history.sample(state, missed)


def test_a_period_holds_the_mean_feedback_since_the_one_before() -> None:
    history = PolicyHistory(MACHINE)
    assert history.filled == 0 and not history.full
    sample(history, 10, 3.0, 1.0, flow=0.7)
    assert history.u[-1].tolist() == [0.7] * 5, "the first has nothing to compare with"
    sample(history, 14, 5.0, 2.0)
    assert history.u[-1] == pytest.approx(0.5) and history.q[-2:, 0].tolist() == [1.0, 2.0]
    assert history.filled == 2


def test_one_period_without_feedback_keeps_the_last_and_two_empty_the_history() -> None:
    history = PolicyHistory(MACHINE)
    for k in range(NUM_HISTORY):
        sample(history, 4 * k, 2.0 * k, float(k))
    assert history.full
    sample(history, 4 * k, 2.0 * k, 20.0, flow=0.25)
    assert history.full and history.u[-1].tolist() == [0.25] * 5
    sample(history, 4 * k, 2.0 * k, 21.0)
    assert history.filled == 1
    sample(history, 4 * k + 4, 2.0 * k + 2.0, 22.0)
    assert history.filled == 2
    sample(history, 4 * k + 4, 2.0 * k + 2.0, 23.0)
    assert history.filled == 3, "the count of silent periods began anew"


def test_feedback_that_counts_backwards_is_of_another_run() -> None:
    history = PolicyHistory(MACHINE)
    sample(history, 10, 3.0, 1.0)
    sample(history, 4, 1.0, 2.0, flow=0.6)
    assert history.u[-1].tolist() == [0.6] * 5


def test_one_missed_period_is_the_middle_and_two_empty_the_history() -> None:
    history = PolicyHistory(MACHINE)
    sample(history, 0, 0.0, 5.0, missed=1)
    assert history.filled == 1, "there is nothing to bridge"
    sample(history, 4, 2.0, 7.0, missed=1)
    assert history.filled == 3 and history.q[-3:, 0].tolist() == [5.0, 6.0, 7.0]
    assert history.u[-2:, 0].tolist() == [0.5, 0.5]
    sample(history, 8, 4.0, 9.0, missed=2)
    assert history.filled == 1 and history.q[-1, 0] == 9.0


def test_proposals_of_another_motion_are_forgotten() -> None:
    history = PolicyHistory(MACHINE)
    sample(history, 0, 0.0, 0.0)
    history.propose(np.full(NUM_JOINTS, 0.3))
    history.propose(np.full(NUM_JOINTS, 0.4))
    assert history.proposed[-2:, 0].tolist() == [0.3, 0.4] and not history.proposed[:-2].any()
    sample(history, 4, 0.0, 0.0)
    assert history.proposed.any()
    history.empty()
    assert history.filled == 0
    sample(history, 8, 4.0, 0.0, flow=0.1)
    assert not history.proposed.any() and history.u[-1].tolist() == [0.1] * 5


def test_a_history_that_was_emptied_has_heard_of_no_silence() -> None:
    history = PolicyHistory(MACHINE)
    sample(history, 4, 0.0, 0.0)
    sample(history, 4, 0.0, 0.0)
    history.empty()
    sample(history, 4, 0.0, 0.0)
    sample(history, 4, 0.0, 0.0)
    assert history.filled == 2


def test_the_process_runs_until_it_is_asked_to_stop_and_reports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    memory, turns = LoopMemory(NUM_JOINTS, commands=True), iter([False, False, True])
    monkeypatch.setattr(policy_process, "PolicyBundle", lambda folder, machine: Bundle())
    begun_s = time.monotonic()
    policy_process.run(lambda: next(turns), CONFIG, memory)
    assert time.monotonic() - begun_s >= 2 * MACHINE.period_s - 0.01
    advice = memory.advice.read()
    assert advice is not None and advice.number == 2
    (report,) = [json.loads(one) for one in memory.reports.take()]
    assert report["process"] == "policy" and report["cycles"] == 2
    assert report["period_s"] == MACHINE.period_s
    memory.close()


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"observed_joint": 3}, AdviceStatus.FAULT),
        ({"target": GuardTrip.TARGET_GROUND}, AdviceStatus.TARGET_REFUSED),
    ],
)
def test_a_faulty_joint_and_a_borehole_beyond_its_limits_end_the_advice(
    desk: Desk, changes: dict[str, Any], status: AdviceStatus
) -> None:
    desk.advised()
    assert desk.go(**changes) is status
    assert desk.request.t_s == -math.inf and not desk.advice.valid


def test_a_borehole_unlike_those_of_the_training_gets_no_advice(desk: Desk) -> None:
    desk.advised()
    desk.bundle.knows = False
    assert desk.go() is AdviceStatus.TARGET_UNKNOWN


def test_where_the_training_ends_there_is_no_advice_and_zero_is_asked_for(desk: Desk) -> None:
    desk.advised()
    desk.bundle.done = True
    assert desk.go() is AdviceStatus.DONE
    assert not desk.advice.valid and desk.request.t_s == desk.now_s and not desk.request.u.any()
