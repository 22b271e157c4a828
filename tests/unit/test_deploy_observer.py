"""Observer: the numpy model against torch's, and faults by name."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import MACHINE, option
from motion import build_nominal_tables

from brokk_rl.errors import ConfigError
from brokk_rl.history import History
from deploy.checks.observer import Observer, classify_fault
from deploy.checks.valve_model import ValvePredictor, load_observer_file
from deploy.guard_setup import read_observer_content
from deploy.kernel.guard import NOTHING_OBSERVED, GuardTrip

SHIPPED = Path(__file__).parents[2] / "deploy" / "observers" / "brokk170.json"
SPEED = np.array([joint.max_speed.value for joint in MACHINE.joints])
PERIOD_S = MACHINE.period_s
HOME = np.array(MACHINE.home)


def draw_commands(count: int, seed: int) -> np.ndarray:
    """Steps, ramps and rest, as recordings have them."""
    draw = np.random.default_rng(seed)
    marks = np.sort(draw.choice(np.arange(1, count), count // 20, replace=False))
    levels = draw.uniform(-1, 1, (len(marks) + 1, 5)) * (draw.random((len(marks) + 1, 5)) < 0.7)
    steps = levels[np.searchsorted(marks, np.arange(count), side="right")]
    return 0.5 * steps + 0.5 * np.roll(steps, 3, axis=0)


@pytest.mark.parametrize("fitted", [False, True])
def test_the_numpy_model_is_the_torch_model(fitted: bool) -> None:
    config = option("actuator", "valve")
    draw = np.random.default_rng(5)
    joints = MACHINE.joint_names
    if fitted:
        knots = (0.0, 0.1, 0.4, 1.0)

        def draw_curves() -> dict[str, tuple[float, ...]]:
            return {
                name: (0.0, 0.0, *np.sort(draw.uniform(0.1, 1.2, 2)).tolist()) for name in joints
            }

        config = replace(
            config, knots=knots, curve_extend=draw_curves(), curve_retract=draw_curves(), play=0.1, spool_s=0.06,
            speed_s=0.09, demand=0.7, dead_time_s=dict(zip(joints, (0.5, 0.52, 0.13, 0.2, 0.3), strict=True)),
            pose_extend={name: tuple(draw.uniform(-0.3, 0.3, 7).tolist()) for name in joints},
            pose_retract={name: tuple(draw.uniform(-0.3, 0.3, 7).tolist()) for name in joints},
        )  # fmt: skip
    q = HOME.copy()
    # Two joints begin beyond their stops, one of them far; one runs into it.
    q[3] = MACHINE.upper[3] + 0.05
    q[4] = MACHINE.upper[4] + 0.3 * (MACHINE.upper[4] - MACHINE.lower[4])
    compare_models(MACHINE, config, q)


def test_the_numpy_model_is_the_torch_model_without_masses_too() -> None:
    small, draw = option("machine", "mini_excavator"), np.random.default_rng(6)
    slopes = {name: tuple(draw.uniform(-0.3, 0.3, 4).tolist()) for name in small.joint_names}
    config = replace(option("actuator", "valve"), pose_extend=slopes, pose_retract=slopes)
    compare_models(small, config, np.array(small.home))


def compare_models(machine: Any, config: Any, q: np.ndarray) -> None:
    """Hold both models against each other over 25 s of commands."""
    model = config.build(machine, 1, torch.device("cpu"))
    predictor = ValvePredictor(json.loads(json.dumps(config.export_tables(machine))), machine)
    length, num = machine.num_history, machine.num_joints
    u_past, q_past = np.zeros((length, num)), np.tile(q, (length, 1))
    largest = 0.0
    for u in draw_commands(500, 1)[:, :num]:
        u_past, before = np.concatenate([u_past[1:], u[None]]), q_past[-1]
        past = [torch.as_tensor(one[None], dtype=torch.float32) for one in (q_past, u_past)]
        history = History(q=past[0], u=past[1])
        after = model.step(history)[0].numpy().astype(float)
        moved = predictor.predict(u, before.astype(np.float32).astype(float))
        assert moved == pytest.approx(after - before, abs=3e-5)
        largest = max(largest, float(np.abs(moved).max()))
        q_past = np.concatenate([q_past[1:], after[None]])
    assert largest > 0.1 * machine.period_s * machine.max_speed.max()


SLACK_S, SHARE = 0.06, 0.25


class Joints:
    """A plain machine behind an observer; a fault changes what its sensors say."""

    def __init__(self, slack_s: float | list[float] = SLACK_S, **change: Any):
        slacks_s = slack_s if isinstance(slack_s, list) else [slack_s] * 5
        thresholds = {"window_s": 1.0, "share": SHARE, "slack_s": slacks_s, "minutes": 60.0}
        content = {"model": build_nominal_tables(MACHINE, dead_time_s=0.2) | change}
        self.observer = Observer(content | {"thresholds": thresholds}, MACHINE)
        self.q, self.now_s, self.waiting = HOME.copy(), 20.0, [np.zeros(5)] * 4
        self.offset, self.drift, self.gain = np.zeros(5), np.zeros(5), np.ones(5)
        self.may_touch = False

    @property
    def fault(self) -> GuardTrip:
        return self.observer.observation.fault

    def go(self, u: tuple[float, ...], seconds: float) -> float:
        """Time until a fault is named, or all of it."""
        for number in range(round(seconds / PERIOD_S)):
            self.waiting.append(np.array(u))
            step = self.waiting.pop(0) * SPEED * PERIOD_S
            self.q = self.q + step
            self.offset = self.offset + (self.gain - 1.0) * step + self.drift * PERIOD_S
            self.now_s += PERIOD_S
            place = self.q + self.offset
            self.observer.update(self.now_s, place, np.array(u), self.may_touch)
            if self.fault is not GuardTrip.NONE:
                return (number + 1) * PERIOD_S
        return seconds


SLOWLY = (0.3, 0.0, -0.3, 0.0, 0.2)


def test_a_healthy_machine_has_no_fault() -> None:
    joints = Joints()
    for u in (SLOWLY, (0.0,) * 5, tuple(-one for one in SLOWLY)):
        assert joints.go(u, 2.0) == 2.0
    assert joints.observer.observation == NOTHING_OBSERVED


@pytest.mark.parametrize(
    ("gain", "drift", "fault"),
    [
        (0.0, 0.0, GuardTrip.JOINT_STILL),
        (-1.0, 0.0, GuardTrip.JOINT_TURNED),
        (0.4, 0.0, GuardTrip.JOINT_WEAK),
        (1.6, 0.0, GuardTrip.JOINT_DRIFTS),
        (1.0, -0.1, GuardTrip.JOINT_DRIFTS),
    ],
)
@pytest.mark.parametrize("joint", [0, 2, 4])
def test_a_fault_is_named_with_its_joint_within_a_second_of_motion(
    gain: float, drift: float, fault: GuardTrip, joint: int
) -> None:
    joints = Joints()
    joints.go(SLOWLY, 3.0)
    joints.gain[joint] = gain
    joints.drift[joint] = drift * (1.0 if SLOWLY[joint] < 0 else -1.0)
    assert joints.go(SLOWLY, 1.0) < 1.0
    found = joints.observer.observation
    assert (found.fault, found.joint) == (fault, joint)


@pytest.mark.parametrize(("gain", "named"), [(0.0, False), (0.4, False), (-1.0, True), (2.5, True)])
def test_at_a_borehole_a_joint_may_be_held_but_not_turn_or_go_on(gain: float, named: bool) -> None:
    joints = Joints()
    joints.go(SLOWLY, 3.0)
    joints.may_touch, joints.gain[2] = True, gain
    assert (joints.go(SLOWLY, 2.0) < 2.0) is named
    # Away from it a joint that stands still is a fault again.
    joints.may_touch, joints.gain[2] = False, 0.0
    joints.go(SLOWLY, 2.0)
    assert joints.fault is not GuardTrip.NONE


def test_a_sensor_that_drifts_at_rest_is_named() -> None:
    joints = Joints()
    joints.go((0.0,) * 5, 2.0)
    joints.drift[1] = 0.1
    seconds = joints.go((0.0,) * 5, 1.0)
    # The limit is what so much time at full speed would give.
    assert seconds == pytest.approx(SLACK_S * SPEED[1] / 0.1, abs=PERIOD_S)
    assert joints.observer.observation.joint == 1 and joints.fault is GuardTrip.JOINT_DRIFTS


def test_slow_drift_and_small_errors_of_the_model_pass() -> None:
    joints = Joints()
    joints.drift[0], joints.gain[:] = 0.01, 1.2
    assert joints.go(SLOWLY, 4.0) == 4.0


def test_the_newest_window_worked_by_hand() -> None:
    joints, first = Joints([0.2, 0.06, 0.06, 0.06, 0.06]), np.eye(5)[0]
    before = joints.observer.window
    assert not before.moved.any() and not before.way.any()
    joints.gain[0] = 1.1
    joints.go((0.5, 0.0, 0.0, 0.0, 0.0), 3.0)
    # To and fro in the last second: the newest 0.2 s are still under way.
    joints.go((-0.5, 0.0, 0.0, 0.0, 0.0), 0.6)
    seen = joints.observer.window
    assert seen.wanted == pytest.approx(0.5 * (0.6 - 0.4) * SPEED * first, abs=1e-9)
    assert seen.moved == pytest.approx(1.1 * seen.wanted, abs=1e-9)
    assert seen.way == pytest.approx(0.5 * SPEED * first, abs=1e-9)
    slack = SPEED * np.array([0.2, 0.06, 0.06, 0.06, 0.06])
    assert seen.limit == pytest.approx(slack + SHARE * seen.way)


def test_a_fault_stays_until_it_is_cleared_and_comes_again() -> None:
    joints = Joints()
    joints.gain[0] = 0.0
    joints.go(SLOWLY, 3.0)
    assert joints.fault is GuardTrip.JOINT_STILL
    joints.gain[0] = 1.0
    joints.waiting = [np.array(SLOWLY)] * 4
    for _ in range(40):
        joints.go(SLOWLY, PERIOD_S)
    assert joints.fault is GuardTrip.JOINT_STILL
    joints.observer.clear()
    assert joints.observer.observation == NOTHING_OBSERVED and joints.go(SLOWLY, 2.0) == 2.0
    joints.observer.clear()
    joints.gain[0] = 0.0
    assert joints.go(SLOWLY, 2.0) < 1.0


def test_nothing_is_judged_before_the_first_look_can_know() -> None:
    joints = Joints()
    # In motion from before: commands of the dead time are unknown.
    joints.waiting = [np.array(SLOWLY)] * 4
    joints.go(SLOWLY, 3.0)
    assert joints.fault is GuardTrip.NONE
    # A gap, or positions that were missing, begin anew; each time the arm has moved on unseen.
    for begin in ("gap", "forget"):
        joints.q = joints.q - 0.3 * np.sign(SLOWLY)
        if begin == "gap":
            joints.now_s += 0.06
        else:
            joints.observer.forget()
        joints.go(SLOWLY, 3.0)
        assert joints.fault is GuardTrip.NONE
    joints.q = joints.q - 0.3
    joints.go(SLOWLY, 0.1)
    assert joints.fault is not GuardTrip.NONE


def test_the_first_periods_pass_unjudged_and_no_more() -> None:
    # A dead time of 0.55 s and 0.3 s until the arm rests, in periods of 0.05 s.
    for periods, fault in ((18, GuardTrip.NONE), (19, GuardTrip.JOINT_DRIFTS)):
        joints = Joints()
        for number in range(periods):
            joints.q = HOME + 0.5 * (number == periods - 1)
            joints.go((0.0,) * 5, PERIOD_S)
        assert joints.fault is fault, periods


def test_letting_go_without_a_fault_forgets_no_motion() -> None:
    joints = Joints()
    joints.go((0.0,) * 5, 2.0)
    joints.drift[1], found = 0.1, set()
    for _ in range(20):
        joints.observer.clear()
        joints.go((0.0,) * 5, PERIOD_S)
        found.add(joints.fault)
    assert GuardTrip.JOINT_DRIFTS in found


def name_fault(measured: list[float], predicted: list[float]) -> GuardTrip:
    """The fault of the second joint by a whole window of its motions, of a full step each."""
    observer = Joints(1e-3).observer
    step = SPEED * PERIOD_S
    for own, model in zip(measured, predicted, strict=True):
        # Only the last motion is judged.
        observer._fault, observer._joint = GuardTrip.LEVER, 0
        if len(observer._measured) == len(measured) - 1:
            observer._fault = GuardTrip.NONE
        second = np.eye(5)[1]
        observer._compare(own * step * second, model * step * second, SHARE)
    return observer.observation.fault


def test_the_newest_quarter_of_the_window_names_the_fault() -> None:
    moves = [1.0] * 15
    for newest, expected, fault in (
        # Five of twenty: without the first of them, or with one more, the joint stood still.
        ([-2.5, 0.0, 0.0, 0.0, 0.0], [1.0] * 5, GuardTrip.JOINT_TURNED),
        ([0.0, 0.0, 0.0, 0.0, -2.5], [1.0] * 5, GuardTrip.JOINT_TURNED),
        ([0.0] * 5, [1.0] * 5, GuardTrip.JOINT_STILL),
        # At rest: all of the window names it.
        ([0.0] * 5, [0.0] * 5, GuardTrip.JOINT_STILL),
        # To and fro: the way counts as it was predicted.
        ([0.0] * 5, [1.0, -1.0, 1.0, -1.0, 0.6], GuardTrip.JOINT_DRIFTS),
    ):
        before = [0.9] * 15 if expected[1] > 0 else [0.2] * 15
        assert name_fault(before + newest, moves + expected) is fault
    turned = [*moves[:14], 0.0, -0.5, -0.5, -0.5, -0.5, 0.0]
    assert name_fault(turned, [1.0] * 20) is GuardTrip.JOINT_TURNED
    # Of a short window the last motion alone.
    assert name_fault([0.0, 0.0, 2.0, -1.0], [1.0] * 4) is GuardTrip.JOINT_TURNED
    assert name_fault([0.0, 2.0, -1.0], [1.0] * 3) is GuardTrip.JOINT_TURNED


def test_a_period_is_due_when_it_is_over() -> None:
    observer = Joints().observer
    assert observer.is_due(0.0)
    observer.update(10.0, HOME, np.zeros(5), may_touch=False)
    assert not observer.is_due(10.0 + 0.85 * PERIOD_S) and observer.is_due(10.0 + 0.95 * PERIOD_S)
    observer.forget()
    assert observer.is_due(10.0)


def test_classes_of_faults() -> None:
    for moved, wanted, way, fault in (
        (0.0, 0.1, 0.1, GuardTrip.JOINT_STILL),
        (0.02, -0.1, 0.1, GuardTrip.JOINT_STILL),
        (-0.1, 0.1, 0.1, GuardTrip.JOINT_TURNED),
        (0.1, -0.1, 0.1, GuardTrip.JOINT_TURNED),
        (-0.05, -0.1, 0.1, GuardTrip.JOINT_WEAK),
        (0.2, 0.1, 0.1, GuardTrip.JOINT_DRIFTS),
        (0.1, 0.0, 0.0, GuardTrip.JOINT_DRIFTS),
        (-0.1, 0.02, 0.02, GuardTrip.JOINT_DRIFTS),
        (0.0, 0.04, 0.1, GuardTrip.JOINT_DRIFTS),  # to and fro
        # At the limits themselves, which binary fractions hold exactly.
        (0.0, 0.5, 1.0, GuardTrip.JOINT_STILL),
        (-3.0, 1.0, 1.0, GuardTrip.JOINT_TURNED),
        (-3.5, 1.0, 1.0, GuardTrip.JOINT_DRIFTS),
        (-0.3, 1.0, 1.0, GuardTrip.JOINT_STILL),
        (0.3, 1.0, 1.0, GuardTrip.JOINT_WEAK),
        (1.0, 1.0, 1.0, GuardTrip.JOINT_DRIFTS),
    ):
        assert classify_fault(moved, wanted, way) is fault, (moved, wanted, way)


def test_the_shipped_file_is_that_of_the_machine() -> None:
    content = load_observer_file(SHIPPED)
    assert content["fingerprint"] == MACHINE.fingerprint() and content["machine"] == "brokk170"
    assert min(content["thresholds"]["slack_s"]) >= SLACK_S
    assert any("Hydraulic" in one for one in content["sources"])
    assert Observer(content, MACHINE).observation == NOTHING_OBSERVED


@pytest.mark.parametrize(
    "change",
    [
        {"thresholds": None}, {"thresholds": {"share": 0.5}}, {"model": []}, {"sources": []},
        {"thresholds": {"share": math.nan, "window_s": 1.0, "slack_s": [0.1] * 5}},
        {"thresholds": {"share": 0.5, "window_s": 1.0, "slack_s": [0.1] * 3}},
        {"thresholds": {"share": 0.5, "window_s": 1.0, "slack_s": [0.1] * 4 + [-0.1]}},
        {"thresholds": {"share": 0.5, "window_s": 1.0, "slack_s": [0.1] * 4 + [2.0]}},
        {"thresholds": {"share": 1.5, "window_s": 1.0, "slack_s": [0.1] * 5}},
        {"thresholds": {"share": 0.5, "window_s": 1e6, "slack_s": [0.1] * 5}},
    ],
)  # fmt: skip
def test_a_file_by_which_no_motion_can_be_judged_is_refused(
    tmp_path: Path, change: dict[str, object]
) -> None:
    path = tmp_path / "observer.json"
    path.write_text(json.dumps(load_observer_file(SHIPPED) | change))
    guard = option("guard", "default")
    guard = replace(guard, observer=replace(guard.observer, path=str(path)))
    with pytest.raises(ConfigError, match="make it again by brokk mode=observe"):
        read_observer_content(guard, MACHINE, "virtual", commands=False)


@pytest.mark.parametrize("text", ["", "[]", '{"schema": 1}', "{"])
def test_a_file_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "observer.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match="mode=observe"):
        load_observer_file(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_observer_file(tmp_path / "none.json")
