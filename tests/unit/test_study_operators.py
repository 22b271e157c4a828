"""Simulated operators: each kind works as it says, on an arm with dead time; a study of them; and what a study does without."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from composed import MACHINE, option
from conftest import Brokk
from sitting import make_design

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.session import Session
from brokk_rl.signals import Command
from deploy.twin.faults import ActiveFaults
from study.design import plan_trials
from study.operators.person import Person
from study.twins import BEFORE_S, TwinDesk

RNG = np.random.default_rng(0)
SPREAD = RNG.uniform(-0.3, 0.3, (8, 5)) * [1.5, 0.2, 0.5, 0.5, 0.5]
STARTS = np.array([0.0, -0.95, 0.5, 1.15, 0.6]) + SPREAD
RIMS_M = np.column_stack((RNG.uniform(2.4, 2.8, 8), RNG.uniform(-0.8, 0.8, 8), np.full(8, 0.75)))


def test_a_person_is_the_same_in_every_trial_and_condition() -> None:
    def draw(number: int, seed: int, low: float, high: float) -> float:
        return Person(number, seed, np.random.default_rng()).draw("delay_s", (low, high))

    assert draw(1, 3, 0.2, 0.4) == draw(1, 3, 0.2, 0.4)
    assert draw(1, 3, 2.0, 4.0) == pytest.approx(10 * draw(1, 3, 0.2, 0.4))
    assert len({draw(0, 3, 0.2, 0.4), draw(1, 3, 0.2, 0.4), draw(1, 4, 0.2, 0.4)}) == 3


def worked(
    name: str, trial: int, seconds: float, advice: float = np.nan
) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and commands, `(T, J)`, on an arm of pure dead time whose valves open linearly beyond 0.08."""
    person = Person(trial, 7, np.random.default_rng(trial))
    model = option("operator", name).build(MACHINE, person)
    q = STARTS[trial]
    pipe = [np.zeros(5)] * round(MACHINE.dead_time_s / MACHINE.period_s)
    shown, qs, us = np.array([advice, 0.0, 0.0, 0.0, 0.0]), [], []
    for _ in range(round(seconds / MACHINE.period_s)):
        u = model(q, RIMS_M[trial], shown)
        pipe = [*pipe[1:], u]
        opening = np.sign(pipe[0]) * np.maximum(np.abs(pipe[0]) - 0.08, 0) / 0.92
        q = q + opening * MACHINE.max_speed * MACHINE.period_s
        q = np.clip(q, MACHINE.lower, MACHINE.upper)
        qs.append(q)
        us.append(u)
        tip = compute_tool_kinematics(MACHINE, q).tip_in_base_m - RIMS_M[trial]
        # Without a block to lean on a little is forgiven.
        if np.hypot(tip[0], tip[1]) < 0.02 and tip[2] < -0.05:
            break
    return np.array(qs), np.array(us)


@pytest.fixture(scope="module")
def median_s() -> dict[str, float]:
    return {}


@pytest.mark.parametrize(("name", "at_once"), [("novice", 1), ("crossover", 2), ("expert", 4)])
def test_operators_without_guidance_find_the_hole_each_in_their_way(
    name: str, at_once: int, median_s: dict[str, float]
) -> None:
    times, most = [], 0
    for trial in range(3):
        _, u = worked(name, trial, 120.0)
        moved = np.abs(u) > 0
        assert not (moved[:, 1] & moved[:, [0, 2, 3, 4]].any(1)).any()  # q2 alone
        times.append(len(u) * MACHINE.period_s)
        most = max(most, int(moved.sum(1).max()))
    assert 1 <= most <= at_once
    assert (np.array(times) < 120.0).mean() >= 0.6
    assert (worked(name, 0, 5.0)[0] == worked(name, 0, 5.0)[0]).all()
    median_s[name] = float(np.median(times))
    if name == "expert":
        assert median_s["expert"] < 0.5 * median_s["crossover"] < 0.5 * median_s["novice"]


def test_the_follower_does_what_is_advised_and_without_advice_nothing() -> None:
    assert not worked("follower", 0, 2.0)[1].any()
    _, moved = worked("follower", 0, 3.0, advice=0.5)
    assert moved[-1, 0] == pytest.approx(0.5, abs=0.15) and not moved[:, 1:].any()


@pytest.mark.slow
def test_a_study_of_simulated_operators_from_nothing_by_one_command(
    brokk: Brokk, tmp_path: Path
) -> None:
    hole = "{_target_: study.design.Hole, center_in_base_m: [2.6, 0.0, 0.75], radius_m: 0.05}"
    brokk(
        "mode=study", "study.do=simulate", "ground=twin", "session.out=run",
        "study.design.num_participants=4", "study.design.limit_s=2.0",
        "~study.design.holes", f"+study.design.holes={{A: {hole}, B: {hole}}}",
        "~study.design.starts", "+study.design.starts={a: [0.0, -0.95, 0.55, 1.15, 0.6], b: [0.1, -0.95, 0.55, 1.15, 0.6]}",
    )  # fmt: skip
    run = tmp_path / "run"
    assert len(list((run / "recordings").iterdir())) == 16
    effects = pd.read_csv(run / "effects.csv", index_col="measure")
    assert effects.simulated.all() and effects.num_persons["several_joints"] == 4
    assert "no person took part" in (run / "report.html").read_text()
    trial = json.loads((run / "trials" / "P01_1_01.json").read_text())
    assert trial["simulated"] is True and trial["operator"] in ("advicefollower", "novice")
    assert "simulated operators" in (run / "plan.html").read_text()
    brokk(
        "mode=study", "study.do=erase", "study.folder=run", "study.participant=P02",
        "session.out=forget",
    )  # fmt: skip
    assert not list(run.rglob("P02*"))


GROUND = option("ground", "twin")
START = np.array([0.1, -0.95, 0.55, 1.15, 0.6])
RIM_M = np.array([2.6, 0.3, 0.75])
GIVEN = np.array([0.5, 0.0, -0.4, 0.3, 0.2])
DEAD_SAMPLES = 11


def desk(place: Path, is_guided: bool = True) -> TwinDesk:
    session = Session(out=str(place), seed=7, device="cpu")
    return TwinDesk(GROUND, MACHINE, session, START, RIM_M, is_guided)


def test_what_is_given_reaches_the_valves(tmp_path: Path) -> None:
    one = desk(tmp_path, is_guided=False)
    for _ in range(20):
        one.run_period(GIVEN)
    for _ in range(3):
        one.run_period(np.array([0.0, 0.6, 0.0, 0.0, 0.0]))
    found = one.end()
    assert found.u[:20] == pytest.approx(np.tile(GIVEN, (20, 1)))
    assert found.u[-1] == pytest.approx([0.0, 0.6, 0.0, 0.0, 0.0])
    still, moved = found.q[: DEAD_SAMPLES - 1], found.q[DEAD_SAMPLES + 5 :]
    assert np.abs(still[:, 0] - START[0]).max() < 0.003, "the dead time, then motion"
    assert moved[-1, 0] > START[0] + 0.02
    assert found.t_s[0] == 0.0
    assert len(found.t_s) == 23, "what went before the trial is no part of it"
    assert not any(name.startswith("advice") for name in found.extra), "it was not shown"


def test_advice_is_shown_from_the_beginning_and_follows_hands_that_follow_it(
    tmp_path: Path,
) -> None:
    one = desk(tmp_path)
    first = one.seen()[1].copy()
    for _ in range(round(12.0 / MACHINE.period_s)):
        one.run_period(one.seen()[1])
    tip = compute_tool_kinematics(MACHINE, one.seen()[0]).tip_in_base_m
    assert np.abs(first).max() > 0.02, f"after {BEFORE_S} s the history is full"
    # Followed exactly, it leads into the hole.
    assert np.hypot(*(tip - RIM_M)[:2]) < 0.013 and tip[2] < RIM_M[2] - 0.05
    assert np.nanmax(np.abs(one.end().extra["advice_q1"])) > 0.02


def test_a_trial_is_the_same_whoever_does_it_beside(tmp_path: Path) -> None:
    design = replace(make_design(), limit_s=1.0)
    session = Session(out=str(tmp_path), seed=0, device="cpu")
    for trial in plan_trials(design, np.random.default_rng(0))[1:3]:
        one, two = (GROUND.run_trial(design, trial, 0, MACHINE, session) for _ in range(2))
        assert len(one.q) == 20 and (one.q == two.q).all() and (one.u == two.u).all()
        assert ("advice_q1" in one.extra) == (trial.condition == "guided")


def test_a_twin_is_put_elsewhere_with_its_block(tmp_path: Path) -> None:
    plant = replace(GROUND.plant, start=tuple(START), hole_in_base_m=(2.6, 0.0, 0.75))
    link = plant.build(MACHINE, 1, Session(out=str(tmp_path), seed=0, device="cpu"))
    for _ in range(30):
        link.send(Command(GIVEN))
    other = np.array([-0.3, -0.9, 0.5, 1.2, 0.5])
    link.place(other, np.array([2.4, -0.9, 0.72]))
    assert link.read().q == pytest.approx(other, abs=0.003)
    for _ in range(10):  # nothing of the commands before is still on its way
        link.send(Command(np.zeros(5)))
    assert link.read().q == pytest.approx(other, abs=0.01)


def test_a_place_is_asked_for_once_and_nonsense_refused() -> None:
    faults = ActiveFaults()
    place = {"q": [0.0] * 5, "hole_in_base_m": [2.6, 0.0, 0.75]}
    faults.request(json.dumps({"place": place}).encode(), 0.0)
    assert faults.take_place() == ([0.0] * 5, [2.6, 0.0, 0.75]) and faults.take_place() is None
    with pytest.raises(ConfigError, match="expected JSON"):
        faults.request(b'{"place": {"q": [0.0]}}', 0.0)
