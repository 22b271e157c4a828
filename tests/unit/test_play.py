"""The core of `mode=play`: a person's commands go in, the state of the simulated machines comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import training as runs
from composed import option

from brokk_rl.play.session import DISTANCE_M, PERSON, PlaySession
from brokk_rl.rl.policy import ClassicalPolicy

NUM = 2
PERIOD_S = 0.05


@pytest.fixture(scope="module")
def made() -> Callable[..., PlaySession]:
    """Makes sessions of two quiet machines, on which the classical controller drives."""
    task = option("task", "borehole_insertion")
    task = replace(task, noise=replace(task.noise, filter="mean"))
    plant = runs.plant(task, option("sim", "native"))
    library = {"library": option("effect", "library")}
    config = replace(plant, actuator=option("actuator", "ideal"), effect=library)

    def make(neutral: bool = True) -> PlaySession:
        torch.manual_seed(0)
        loop = config.build(torch.device("cpu"), NUM, 16, seed=0)
        return PlaySession(loop, {"classical": ClassicalPolicy(task=None).build(loop, 0)}, neutral)

    return make


def run(session: PlaySession, steps: int) -> None:
    for _ in range(steps):
        session.step()


def test_simulated_time_follows_the_clock_at_the_wanted_speed(made: Callable) -> None:
    session = made()
    for _ in range(30):
        session.advance(1 / 30)
    assert session.t_s == pytest.approx(1.0, abs=PERIOD_S)
    assert session.measure_rate() == pytest.approx(1.0, abs=0.06)
    session.speed = 3.0
    for _ in range(30):
        session.advance(1 / 30)
    assert session.t_s == pytest.approx(4.0, abs=PERIOD_S)
    assert session.measure_rate() == pytest.approx(3.0, abs=0.2)


def test_a_pause_stops_time_and_a_step_is_one_control_period(made: Callable) -> None:
    session = made()
    run(session, 3)
    session.paused = True
    assert session.advance(1.0) == 0
    before_s = session.t_s
    assert session.measure_rate() == 0.0
    session.step()
    assert session.t_s == pytest.approx(before_s + PERIOD_S)
    session.paused = False
    assert session.advance(PERIOD_S) == 1


def test_a_reset_begins_one_episode_anew_and_is_no_ending(made: Callable) -> None:
    session = made()
    run(session, 10)
    before = session.read()
    session.reset(1)
    session.step()
    state = session.read()
    assert np.abs(state["q"][0] - before["q"][0]).max() < 0.05
    assert np.abs(state["scene"][1] - before["scene"][1]).max() > 0.05
    assert not session.endings
    session.select_world(1)
    assert session.episode_s < 2 * PERIOD_S


def test_a_target_that_is_moved_takes_block_estimate_and_arm_with_it(made: Callable) -> None:
    session = made()
    run(session, 20)
    before = session.read()
    place = before["target_m"][0] + np.array([0.0, 0.25, 0.05])
    session.move_target(place)
    state = session.read()
    np.testing.assert_allclose(state["target_m"][0], place, atol=1e-5)
    np.testing.assert_allclose(state["scene"][0, :3], place, atol=1e-5)
    # the machine believes the old error of the new place, and stands where it stood
    error = before["estimate_m"] - before["target_m"]
    np.testing.assert_allclose(state["estimate_m"] - state["target_m"], error, atol=1e-5)
    np.testing.assert_array_equal(state["q"], before["q"])
    np.testing.assert_array_equal(state["target_m"][1], before["target_m"][1])
    block = session.loop.world._views["mocap_pos"][0, 0].numpy()
    np.testing.assert_allclose(block, place, atol=1e-5)
    run(session, 1)
    # One more noisy sample in the mean of 22.
    np.testing.assert_allclose(session.read()["estimate_m"][0] - place, error[0], atol=5e-3)
    run(session, 400)
    np.testing.assert_allclose(session.read()["target_m"][0], place, atol=1e-5)
    assert session.successes >= 1, "the arm went to the new place"


def test_a_target_stays_out_of_the_machine_and_is_drawn_again_by_a_reset(made: Callable) -> None:
    session = made()
    moved_m = session.move_target(np.array([0.1, 0.0, 0.7]))
    assert np.hypot(*moved_m[:2]) == pytest.approx(DISTANCE_M[0])
    session.reset()
    session.step()
    assert np.hypot(*session.read()["target_m"][0, :2]) > DISTANCE_M[0] + 0.1


def test_a_push_moves_the_tip_its_own_way_and_ends(made: Callable) -> None:
    session, still = made(), made()
    for each in (session, still):
        each.choose_driver(PERSON)  # nobody corrects it
    session.push(np.array([0.0, 1500.0, 0.0]))
    run(session, 4)
    run(still, 4)
    tips = [s._kinematics.pose(s.loop.world.q).tip_in_base_m[0].numpy() for s in (session, still)]
    shift = tips[0] - tips[1]
    assert shift[1] > 0.01
    assert abs(shift[1]) > 3 * abs(shift[2])
    assert session.loop.world.joint_load[0].any()
    assert not session.loop.world.joint_load[1].any()
    run(session, 10)
    assert not session.loop.world.joint_load.any()


def test_a_person_drives_one_machine_and_the_policy_the_other(made: Callable) -> None:
    session = made()
    session.choose_driver(PERSON)
    before = session.read()["q"]
    session.nudge_lever(2, 0.5)
    session.nudge_lever(2, 0.75)  # to the end of the stroke
    session.put_lever(0, 0.5)
    session.put_lever(0, 0.0)
    run(session, 30)
    traces, after = session.read_traces(), session.read()["q"]
    np.testing.assert_array_equal(traces["given"][-1], [0, 0, 1, 0, 0])
    assert np.abs(traces["proposed"][-1]).max() > 0, "the policy's proposal is shown"
    assert after[0, 2] - before[0, 2] > 0.1
    np.testing.assert_allclose(after[0, [0, 1, 3, 4]], before[0, [0, 1, 3, 4]], atol=2e-3)
    assert np.abs(after[1] - before[1]).max() > 0.05
    session.release_levers()
    session.step()
    assert not session.read_traces()["given"][-1].any()


def test_a_person_has_the_time_that_it_takes(made: Callable) -> None:
    session = made()
    session.choose_driver(PERSON)
    run(session, session.loop.task.max_episode_steps + 5)
    assert session.endings.get("time_limit", 0) <= 1  # that of the other machine
    assert session.loop.task.state["age"][0] > session.loop.task.max_episode_steps


def test_effects_begin_off_and_a_dial_gives_them_to_all_machines(made: Callable) -> None:
    session = made()
    dial = session.dials["backlash.gap_rad"]
    assert not dial.parameters[dial.key].any()
    dial.turn(1.0)
    expected = torch.as_tensor(dial.typical).expand(NUM, -1)
    torch.testing.assert_close(dial.parameters[dial.key], expected)
    session.reset()
    session.step()  # a new episode draws no other size
    torch.testing.assert_close(dial.parameters[dial.key], expected)
    dial.turn(-5.0)
    assert not dial.parameters[dial.key].any()
    name = "dead_time.dead_time_s"
    assert made(neutral=False).dials[name].parameters[name].any()
