"""Faults that once reached the valves or the operator unnoticed, injected into the running twin and loop again.

Each test notes its figures as properties of the report; `benchmarks/run.py measure found` makes the
table of them. Simulated clock, but for `test_deploy_processes.py`.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from composed import MACHINE
from conftest import Note
from desk import build_feed
from stage import DBC, Mode, Stage

from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.registry import resolve_package_path
from deploy.kernel.guard import GuardState
from deploy.kernel.limits import StayOutBox
from deploy.page.alarms import list_alarms

IN_TIME_MS = 100


class Watch:
    """A stage, and what its page tells.

    Attributes:
        told_ms: When each alarm was told first, since the injection, by its name and joint.
    """

    def __init__(self, stage: Stage, folder: Path) -> None:
        self.stage, self.told_ms = stage, dict[str, int]()
        self._feed = build_feed(stage.memory, folder, clock=lambda: stage.now_s)

    def go(self, seconds: float) -> None:
        """Let time go by from an injection on."""
        begun_ms = self.stage.ms
        self.told_ms.clear()

        def look() -> bool:
            for alarm in list_alarms(self._feed.read_state()):
                text = f"{alarm.name} {alarm.detail}".strip()
                self.told_ms.setdefault(text, self.stage.ms - begun_ms)
            return False

        self.stage.go(seconds, look)


@pytest.fixture(scope="module")
def watches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Watch]]:
    folder, found = tmp_path_factory.mktemp("found"), {}
    modes: tuple[Mode, ...] = ("listen", "collect")
    for mode in modes:
        found[mode] = Watch(Stage(MACHINE, mode, folder), folder)
    yield found
    for watch in found.values():
        watch.stage.close()


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    """A stage of its own that collects and is under way."""
    stage = Stage(MACHINE, "collect", tmp_path)
    stage.get_going()
    yield stage
    stage.close()


def change_valves(stage: Stage, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Let the gateway's valves do something else than it decides, and say so truly."""
    decide = type(stage.twin._gateway).decide

    def decide_wrong(now_s: float) -> tuple[np.ndarray, int, object]:
        flow, source, state = decide(stage.twin._gateway, now_s)
        return change(flow.copy()), source, state

    stage.twin._gateway.decide = decide_wrong  # type: ignore[method-assign, assignment]


@pytest.mark.parametrize(
    ("fault", "alarm"),
    [
        ("stuck", "a joint stands still: sensor, valve or hose joint 4"),
        ("mirrored", "a joint moves the wrong way: sensor or valve turned joint 4"),
        ("drift", "a joint moves unasked: sensor drifts, or valve leaks joint 1"),
    ],
)
def test_where_nothing_is_sent_a_sensors_fault_is_told(
    tmp_path: Path, fault: str, alarm: str, record_property: Note
) -> None:
    stage = Stage(MACHINE, "listen", tmp_path)
    watch = Watch(stage, tmp_path)
    stage.get_going()
    stage.fault("lever")
    stage.go(0.3)
    stage.fault(fault)
    watch.go(2.0)
    assert alarm in watch.told_ms, watch.told_ms
    assert not stage.advised and not stage.air.sent
    stage.close()
    record_property(f"sensors: {fault}; alarm with its joint, ms", watch.told_ms[alarm])


def swap(flow: np.ndarray) -> np.ndarray:
    """q1 and q5 are swapped."""
    flow[[0, 4]] = flow[[4, 0]]
    return flow


def drive_third(flow: np.ndarray) -> np.ndarray:
    """q3 is driven unasked while others are."""
    flow[2] = 0.3 * flow.any()
    return flow


VALVES = {
    "q1 and q5 swapped": swap,
    "commands doubled": lambda flow: 2.0 * flow,
    "signs turned": lambda flow: -flow,
    "q3 driven unasked": drive_third,
}


@pytest.mark.parametrize("kind", VALVES)
def test_valves_that_do_something_else_stop_the_machine(
    watches: dict[str, Watch], kind: str, record_property: Note
) -> None:
    watch, stage = watches["collect"], watches["collect"].stage
    stage.get_going()
    change_valves(stage, VALVES[kind])
    begun_ms = stage.ms
    watch.go(0.6)
    del stage.twin._gateway.decide
    assert stage.stopped_ms is not None
    told = {name: ms for name, ms in watch.told_ms.items() if "driven" in name}
    stopped_ms = stage.stopped_ms - begun_ms
    assert stopped_ms <= IN_TIME_MS and len(told) == 1, watch.told_ms
    record_property(f"valves: {kind}; no flow, ms", stopped_ms)
    record_property(f"valves: {kind}; alarm, ms", *told.values())


@pytest.mark.parametrize("mode", ["listen", "collect"])
@pytest.mark.parametrize("fault", ["deadman_released", "estop"])
def test_a_flow_that_nobody_can_ask_for_is_told(
    watches: dict[str, Watch], mode: str, fault: str, record_property: Note
) -> None:
    watch, stage = watches[mode], watches[mode].stage
    stage.get_going()
    stage.fault(fault)
    stage.go(0.3)
    change_valves(stage, lambda flow: np.array([0.0, 0.0, 0.3, 0.0, 0.0]))
    watch.go(1.0)
    del stage.twin._gateway.decide
    alarm = "a joint is driven unasked, or in place of another joint 3"
    assert watch.told_ms[alarm] <= IN_TIME_MS
    record_property(f"valves: flow of 0.3, {fault}, {mode}; alarm, ms", watch.told_ms[alarm])


DESCRIPTIONS = {
    "offset of 0.1 rad": (("Position_q1 : 0|16@1- (0.0001,0)", "Position_q1 : 0|16@1- (0.0001,0.1)"),),
    "swapped identifiers": (("2365592067 ", "other "), ("2365592323 ", "2365592067 "), ("other ", "2365592323 ")),
    "narrower range": (("Command_q1 : 0|9@1- (0.004,0) [-1|1]", "Command_q1 : 0|9@1- (0.004,0) [-0.2|0.2]"),),
}  # fmt: skip


@pytest.mark.parametrize("kind", DESCRIPTIONS)
@pytest.mark.parametrize("side", ["dbc", pytest.param("twin_dbc", marks=pytest.mark.slow)])
def test_ends_of_other_descriptions_never_get_ready(
    tmp_path: Path, kind: str, side: str, record_property: Note
) -> None:
    text, path = resolve_package_path(DBC).read_text(), tmp_path / "other.dbc"
    for old, new in DESCRIPTIONS[kind]:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    ends = {"dbc": DBC, "twin_dbc": DBC} | {side: str(path)}
    stage = Stage(MACHINE, "collect", tmp_path, again_s=0.5, **ends)
    highest, moved_ms = [0], [0]

    def look() -> bool:
        highest[0] = max(highest[0], stage.memory.state.peek("guard") or 0)
        moved_ms[0] += 10 * stage.moves
        return False

    stage.go(6.0, look)
    cycles = stage.bus_process._timer.cycles
    stage.close()
    assert highest[0] == GuardState.LATCHED.value and moved_ms[0] == 0 and cycles > 500
    record_property(f"description: {kind} at the {side}; ms of motion in 6 s", moved_ms[0])


PLACES = {"50 m ahead": (50.0, 0.0, 0.75), "behind the machine": (-2.6, 0.0, 0.75)}
PLACES["1.5 m underground"] = (2.6, 0.0, -1.5)


@pytest.mark.parametrize("kind", PLACES)
def test_no_motion_is_for_a_borehole_beyond_its_limits(
    watches: dict[str, Watch], kind: str, record_property: Note
) -> None:
    watch, stage = watches["collect"], watches["collect"].stage
    stage.get_going()
    stage._write("target", t_s=stage.now_s, center_in_base_m=PLACES[kind])
    begun_ms = stage.ms
    watch.go(3.0)
    assert stage.stopped_ms is not None
    stopped_ms = stage.stopped_ms - begun_ms
    assert stopped_ms <= 30 and any("borehole" in one for one in watch.told_ms)
    record_property(f"borehole: {kind}; ms of motion", stopped_ms)


@pytest.mark.parametrize(("step_m", "every_s"), [(0.3, 10.0), (0.15, 0.1)])
def test_a_borehole_that_jumps_is_not_followed(
    watches: dict[str, Watch], step_m: float, every_s: float, record_property: Note
) -> None:
    stage, draw, moved_ms = watches["collect"].stage, random.Random(1), [0]
    stage.get_going()
    begun_ms = stage.ms

    def jump() -> None:
        if (stage.ms - begun_ms) % round(1e3 * every_s) == 1:
            angle_rad = draw.uniform(0.0, 2.0 * math.pi)
            off_m = step_m * np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
            place_m = np.array([2.5, 0.0, 0.75]) + off_m
            stage._write("target", t_s=stage.now_s, center_in_base_m=tuple(place_m.tolist()))
        moved_ms[0] += stage.moves

    stage.meddle = jump
    stage.go(2.0)
    assert moved_ms[0] <= 30
    record_property(f"borehole: jumps of {step_m} m every {every_s} s; ms of motion", moved_ms[0])


def test_the_seen_face_is_met_slowly_whatever_borehole_is_chosen(
    stage: Stage, record_property: Note
) -> None:
    def locate_tip() -> np.ndarray:
        return np.asarray(compute_tool_kinematics(MACHINE, np.asarray(stage.twin._q)).tip_in_base_m)

    # The chosen borehole lies more than a metre aside, on the level of the seen one.
    aside_m = np.array([0.3, 1.2, 0.0])
    face_m = locate_tip() - np.array([0.0, 0.0, 0.4])
    speeds_m_s, last_m = [], locate_tip()
    stage.wanted = (0.0, 0.0, 1.0, 0.0, 0.0)
    stage._write("target", t_s=stage.now_s, center_in_base_m=tuple(face_m + aside_m))

    def see() -> None:
        nonlocal last_m
        if stage.ms % 50 == 0:
            holes = stage.memory.holes.new()
            holes["count"] = 1
            holes["holes"][0]["t_s"] = stage.now_s
            holes["holes"][0]["center_in_base_m"] = face_m
            stage.memory.holes.write(holes)
            tip_m = locate_tip()
            if abs(tip_m[2] - face_m[2]) < 0.1:
                speeds_m_s.append(float(np.linalg.norm(tip_m - last_m)) / 0.05)
            last_m = tip_m

    stage.meddle = see
    stage.go(0.6)
    stage.fault("deadman_released")
    stage.go(0.1)
    stage.fault("none")
    stage.go(5.0)
    assert len(speeds_m_s) > 3 and max(speeds_m_s) < 0.28
    record_property("borehole: wrong one; speed at the seen face, m/s", round(max(speeds_m_s), 3))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_inside_a_box_the_slew_turns_outward_alone(
    tmp_path: Path, side: float, record_property: Note
) -> None:
    tip_m = compute_tool_kinematics(MACHINE, np.asarray(MACHINE.home)).tip_in_base_m
    x, y, z = map(float, tip_m)
    # The tip is 10 cm inside, and left is deeper.
    box = StayOutBox(lower_m=(x - 1.0, y - 0.1, z - 0.5), upper_m=(x + 1.0, y + 3.0, z + 0.5))
    stage = Stage(MACHINE, "collect", tmp_path, again_s=1.0, stay_out={"box": box})
    stage.wanted = (0.5 * side, 0.0, 0.0, 0.0, 0.0)
    stage.go(6.0)
    turned_rad = float(stage.twin._q[0] - MACHINE.home[0])
    stage.close()
    if side > 0:
        assert turned_rad == pytest.approx(0.0, abs=1e-3)
        record_property("envelope: begun in a box; turned deeper, rad", round(turned_rad, 3))
    else:
        assert turned_rad < -0.2


@pytest.mark.parametrize("side", [1.0, pytest.param(-1.0, marks=pytest.mark.slow)])
def test_a_joint_with_a_long_dead_time_rests_before_its_stop(
    tmp_path: Path, side: float, record_property: Note
) -> None:
    slow = replace(MACHINE, dead_time_s=0.55)
    stage = Stage(slow, "collect", tmp_path, again_s=1.0, watched=False)
    stage.wanted, beyond_rad = (side, 0.0, 0.0, 0.0, 0.0), [-math.inf]

    def look() -> bool:
        q = float(stage.twin._q[0])
        end = float(MACHINE.upper[0] if side > 0 else MACHINE.lower[0])
        beyond_rad[0] = max(beyond_rad[0], side * (q - end))
        return False

    stage.go(14.0, look)
    stage.close()
    assert -0.2 < beyond_rad[0] <= 0.0
    what = f"stops: 0.55 s of dead time, side {side:+.0f}; beyond, rad"
    record_property(what, round(beyond_rad[0], 3))


def send_one_early(stage: Stage) -> None:
    """One frame is stamped 10 s ahead."""
    done: list[float] = []

    def spoil(values: dict[str, float]) -> None:
        if not done:
            done.append(values["Stamp"])
            values["Stamp"] = (values["Stamp"] + 10.0) % 65.536

    stage.bridge.alter = {"JointPos1": spoil}


def set_back(stage: Stage) -> None:
    """The gateway's clock steps back by 0.3 s."""
    stage.clock_jump_s -= 0.3


def flood(stage: Stage) -> None:
    """Random frames come for 3 s, under all identifiers."""
    draw, end_ms = np.random.default_rng(2), stage.ms + 3000
    ids = stage.bus_process._logic.receiver.frame_ids

    def send() -> None:
        if stage.ms < end_ms:
            frame_id = int(draw.choice(ids))
            frame = type(stage.air.sent[0])(frame_id, draw.bytes(8))
            stage.air.inbox.append(frame)

    stage.meddle = send


@pytest.mark.parametrize(
    ("inject", "goes_on"), [(send_one_early, True), (set_back, False), (flood, False)]
)
def test_a_healthy_sender_is_heard_again_after_a_press(
    stage: Stage, inject: Callable[[Stage], None], goes_on: bool, record_property: Note
) -> None:
    inject(stage)
    stage.go(3.5)
    moves_on = stage.moves
    stage.meddle, begun_ms = None, stage.ms
    for _ in range(4):
        stage.fault("deadman_released")
        stage.go(0.3)
        stage.fault("none")
        stage.go(1.0, lambda: stage.moves)
        if stage.moves:
            break
    moves, seconds = stage.moves, (stage.ms - begun_ms) / 1e3
    assert moves and moves_on == goes_on
    what = (inject.__doc__ or "").rstrip(".")
    record_property(f"clock: {what}; moves on", moves_on)
    record_property(f"clock: {what}; moves after presses of, s", round(seconds, 2))


@pytest.mark.parametrize("kind", ["dead-man bounces at 10 Hz", "policy asks for 1, 0, 1, 0"])
def test_valves_are_not_hammered(
    stage: Stage, tmp_path: Path, kind: str, record_property: Note
) -> None:
    watch, begun_ms, starts, before = Watch(stage, tmp_path), stage.ms, [0], [True]
    if kind.startswith("dead-man"):
        stage.twin._holds_deadman = lambda now_s: int(20.0 * now_s) % 2 == 0  # type: ignore[method-assign]

    def count() -> None:
        if kind.startswith("policy"):
            stage.wanted = (0.2 * ((stage.ms - begun_ms) // 50 % 2), 0.0, 0.0, 0.0, 0.0)
        starts[0] += stage.moves and not before[0]
        before[0] = stage.moves

    stage.meddle = count
    watch.go(3.0)
    assert 5 <= starts[0] <= 16, "five a second"
    assert any("valves switched too often" in one for one in watch.told_ms)
    record_property(f"pulses: {kind}; in 3 s", starts[0])


@pytest.mark.slow
def test_a_dead_man_that_nobody_holds_is_asked_about(tmp_path: Path, record_property: Note) -> None:
    stage = Stage(MACHINE, "collect", tmp_path, watched=False)
    stage.get_going()
    watch, begun_ms = Watch(stage, tmp_path), stage.ms

    def turn() -> None:
        if stage.ms % 2000 == 0:
            stage.wanted = tuple(-u for u in stage.wanted)

    stage.meddle = turn
    watch.go(75.0)
    assert stage.stopped_ms is not None
    asked_s, stopped_s = watch.told_ms["are you there"] / 1e3, (stage.stopped_ms - begun_ms) / 1e3
    stage.close()
    assert 59.0 < asked_s < 61.0 and 69.0 < stopped_s < 71.0
    record_property("vigilance: asked after, s", asked_s)
    record_property("vigilance: no flow after, s", stopped_s)
