"""A simulated study at the twin: what hands give reaches the valves, and what is shown comes back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from composed import option
from sitting import MACHINE, make_design

from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.session import Session
from brokk_rl.signals import Command
from deploy.twin.faults import ActiveFaults
from study.design import plan_trials
from study.twins import BEFORE_S, TwinDesk

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
