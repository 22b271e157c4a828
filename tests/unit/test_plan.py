"""A plan is played within its guards, on the machine as it is believed to be and on one that differs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from composed import MACHINE, option

from actuators.excite.plan_report import PlanTrack
from actuators.excite.player import (
    PLAY,
    CommandGuards,
    NominalLink,
    PlanPlayer,
    drive,
    measure_tool_speed,
)
from actuators.excite.schedule import ExcitationPlan, plan_runs
from brokk_rl.contracts.actuator import Segment
from brokk_rl.errors import LinkError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.signals import Command, JointState

OPEN = CommandGuards(max_command=1.0, max_tool_speed_m_s=None)


def measure_speed(q: np.ndarray) -> np.ndarray:
    return measure_tool_speed(MACHINE, q, np.gradient(q, MACHINE.period_s, axis=0))


def constant(joints: dict[int, float], seconds: float, start: np.ndarray, **fields: Any) -> Segment:
    u = np.zeros((round(seconds * 20), 5))
    for joint, level in joints.items():
        u[:, joint] = level
    plain = {"name": "a_00", "start": start, "u": u, "stops": "inward", "stop_margin": 0.05}
    return Segment(**(plain | fields))


RUN_S = 120.0


def played(
    runs: Sequence[Sequence[Segment]], guards: CommandGuards = OPEN, link: Any = None
) -> PlanTrack:
    plan = ExcitationPlan(runs=tuple(map(tuple, runs)), run_s=RUN_S, names=("a",))
    link = link or NominalLink(MACHINE, len(runs))
    player = PlanPlayer(plan, MACHINE, guards)
    return PlanTrack(drive(link, player, MACHINE, len(runs), RUN_S))


def find_shares(q: np.ndarray) -> np.ndarray:
    """Returns how far joints are from positions, in parts of their travel."""
    return np.abs(q) / (MACHINE.upper - MACHINE.lower)


def anywhere(seed: int) -> np.ndarray:
    margin = 0.1 * (MACHINE.upper - MACHINE.lower)
    return np.random.default_rng(seed).uniform(MACHINE.lower + margin, MACHINE.upper - margin)


def with_speed(scale: float) -> Machine:
    joints = []
    for joint in MACHINE.joints:
        speed = replace(joint.max_speed, value=joint.max_speed.value * scale)
        joints.append(replace(joint, max_speed=speed))
    return replace(MACHINE, joints=tuple(joints))


def test_a_program_is_played_unchanged_from_its_start_pose() -> None:
    generator = np.random.default_rng(0)
    start = np.stack([anywhere(seed) for seed in range(4)])
    programs = 0.05 * generator.uniform(-1, 1, (4, 100, 5)) * (np.arange(5) != 1)
    runs = [[constant({}, 1.0, s, u=u)] for s, u in zip(start, programs, strict=True)]
    track = played(runs)
    for n, (segment,) in enumerate(runs):
        inside = track.phase[:, n] == PLAY
        assert (track.u[inside, n] == segment.u).all()
        assert find_shares(track.q[inside, n][0] - segment.start).max() <= 0.04


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.5])
def test_approaches_arrive_on_machines_slower_or_faster_than_their_file(
    scale: float, caplog: pytest.LogCaptureFixture
) -> None:
    runs = []
    for n in range(5):
        starts = [anywhere(10 * n + i) for i in range(3)]
        runs.append([constant({}, 1.0, start, name=f"a_{i}") for i, start in enumerate(starts)])
    track = played(runs, link=NominalLink(with_speed(scale), 5))
    assert not caplog.records
    assert (track.phase[-1] == PLAY).any()
    assert track.segment[-1].tolist() == [2] * 5
    for n in range(5):
        for i in range(3):
            is_played = track.phase[:, n] == PLAY
            begin = np.flatnonzero((track.segment[:, n] == i) & is_played)[0]
            assert find_shares(track.q[begin, n] - runs[n][i].start).max() < 0.05


def test_exclusive_joints_never_move_together_with_others_on_the_way_either() -> None:
    # No excitation may ask for this; the runner drops q2.
    together = constant({1: 0.5, 3: 0.5}, 2.0, anywhere(0))
    runs = [[constant({}, 1.0, anywhere(n)), together] for n in range(6)]
    track = played(runs)
    alone, others = track.u[:, :, 1] != 0, (np.delete(track.u, 1, axis=2) != 0).any(2)
    assert alone.any() and others.any() and not (alone & others).any()


def test_the_stops_are_kept_although_the_command_acts_late() -> None:
    for scale in (1.0, 1.4):
        for sign in (-1.0, 1.0):
            segments = [constant({0: sign, 2: sign, 3: sign, 4: sign}, 30.0, MACHINE.home)]
            link = NominalLink(with_speed(scale), 1)
            track = played([segments], link=link)
            left = np.minimum(track.q - MACHINE.lower, MACHINE.upper - track.q).min((0, 1))
            assert left.min() > 0.0, f"speed x {scale}: {left}"
            assert np.delete(find_shares(left), 1).max() < 0.06, "and they are reached"


def test_inward_turns_a_joint_back_until_its_program_passes_zero() -> None:
    u = np.zeros((500, 5))
    u[:, 4] = 0.8
    u[400:, 4] = -0.8
    track = played([[constant({}, 0.0, MACHINE.home, u=u)]])
    inside = track.phase[:, 0] == PLAY
    sent = track.u[inside, 0, 4]
    assert set(np.abs(sent)) == {0.8}
    assert (np.diff(sent) != 0).sum() <= 3, "no chatter at the stop"
    assert (sent[400:420] == -0.8).all()


def test_home_takes_the_joint_back_and_goes_on_at_the_next_zero() -> None:
    u = np.zeros((2000, 5))
    # Drives into the stop, then slowly back.
    u[:, 2] = np.where(np.arange(2000) // 500 % 2 == 0, 0.9, -0.2)
    track = played([[constant({}, 0.0, MACHINE.home, u=u, stops="home")]])
    phase = track.phase[:, 0]
    begin = np.flatnonzero(phase >= PLAY)[0]
    away = np.flatnonzero(phase > PLAY) - begin
    assert 100 < away[0] < 200, "1.4 rad from home to the margin at 0.9 * 0.26 rad/s"
    back = away[np.flatnonzero(np.diff(away) > 1)[0]] + 1
    assert back == 500 and track.u[begin + 500, 0, 2] == -0.2
    assert abs(track.q[begin + 499, 0, 2] - MACHINE.home[2]) < 0.1
    assert (phase >= PLAY).sum() == 2000, "a segment lasts as long as its program"


def test_commands_keep_to_the_largest() -> None:
    guards = CommandGuards(max_command=0.3, max_tool_speed_m_s=None)
    segment = constant({0: 1.0, 3: -1.0}, 3.0, anywhere(1))
    track = played([[segment]], guards)
    assert np.abs(track.u).max() == 0.3


def test_the_tool_is_never_faster_than_allowed_and_proportions_are_kept() -> None:
    segment = constant({0: 1.0, 3: 0.5}, 4.0, MACHINE.home)
    guards = replace(OPEN, max_tool_speed_m_s=0.4)
    free, slow = (played([[segment]], one) for one in (OPEN, guards))
    fast, guarded = (measure_speed(track.q[:, 0]) for track in (free, slow))
    assert fast.max() > 0.8 and 0.35 < guarded.max() < 0.42
    u = slow.u[(slow.phase[:, 0] == PLAY), 0]
    assert u[:, 3] == pytest.approx(0.5 * u[:, 0]) and u[:, 0].max() < 1.0


def test_the_tool_speed_is_that_of_the_kinematics() -> None:
    # 0.1 rad/s about the vertical.
    q = MACHINE.home + np.linspace(0, 0.2, 41)[:, None] * np.array([1.0, 0, 0, 0, 0])
    radius_m = np.hypot(*compute_tool_kinematics(MACHINE, MACHINE.home).tip_in_base_m[:2])
    assert measure_speed(q) == pytest.approx(np.full(41, 0.1 * radius_m), rel=1e-3)


class Stuck(NominalLink):
    """One joint does not move."""

    def send(self, command: Command) -> Command:
        u = np.array(command.u)
        u[:, 3] = 0.0
        super().send(Command(u))
        return command


def test_an_approach_that_does_not_arrive_is_given_up_and_said(
    caplog: pytest.LogCaptureFixture,
) -> None:
    start = MACHINE.home + 0.8 * (np.arange(MACHINE.num_joints) == 3)
    track = played([[constant({0: 0.3}, 1.0, start)]], link=Stuck(MACHINE, 1))
    assert (track.u[track.phase[:, 0] == PLAY, 0, 0] == 0.3).all()
    assert "start of a_00 given up, out of place: q4" in caplog.text


class Silent(NominalLink):
    """Says nothing new after a second."""

    def send(self, command: Command) -> Command:
        return command if self.read().t_s > 1.0 else super().send(command)


class Broken(NominalLink):
    """Loses its sensors."""

    def read(self) -> JointState:
        state = super().read()
        return JointState(state.t_s, state.q * np.nan if state.t_s > 1.0 else state.q)


@pytest.mark.parametrize(
    ("link", "message"), [(Silent, "no state after"), (Broken, "finite positions")]
)
def test_a_link_that_fails_is_an_error(
    link: type[NominalLink], message: str, monkeypatch: Any
) -> None:
    monkeypatch.setattr("actuators.excite.player.SILENCE_S", 0.05)
    with pytest.raises(LinkError, match=message):
        played([[constant({0: 0.3}, 5.0, MACHINE.home)]], link=link(MACHINE, 1))


def test_a_plan_fills_its_time_and_repeats_with_its_seed() -> None:
    chosen = {name: option("excitation", name) for name in ("levels", "ramps", "holds")}
    plan, again, other = (
        plan_runs(chosen, MACHINE, 2, 600.0, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    link = NominalLink(MACHINE, 2)
    runner = PlanPlayer(plan, MACHINE, OPEN)
    track = PlanTrack(drive(link, runner, MACHINE, 2, 600.0))
    assert runner.done and len(track.t_s) > 0.75 * 600 * 20, "neither cut nor left empty"
    for run, same in zip(plan.runs, again.runs, strict=True):
        for a, b in zip(run, same, strict=True):
            assert a.name == b.name and (a.u == b.u).all() and (a.start == b.start).all()
        assert {segment.name.split("_")[0] for segment in run} == {"levels", "ramps", "holds"}
    assert (plan.runs[0][0].start != plan.runs[1][0].start).any()
    assert (plan.runs[0][0].start != other.runs[0][0].start).any()
