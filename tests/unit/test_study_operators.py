"""Simulated operators: each kind works as it says, on an arm with dead time; a study of them; and what a study does without."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from composed import option
from sitting import MACHINE

from brokk_rl.kinematics import compute_tool_kinematics
from study.operators.person import Person

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
    brokk: Callable[..., Any], tmp_path: Path
) -> None:
    hole = "{_target_: study.design.Hole, center_in_base_m: [2.6, 0.0, 0.75], radius_m: 0.05}"
    done = brokk(
        "mode=study", "study.do=simulate", "ground=twin", "session.out=run",
        "study.design.num_participants=4", "study.design.limit_s=2.0",
        "~study.design.holes", f"+study.design.holes={{A: {hole}, B: {hole}}}",
        "~study.design.starts", "+study.design.starts={a: [0.0, -0.95, 0.55, 1.15, 0.6], b: [0.1, -0.95, 0.55, 1.15, 0.6]}",
    )  # fmt: skip
    assert done.code == 0, done.err
    run = tmp_path / "run"
    assert len(list((run / "recordings").iterdir())) == 16
    effects = pd.read_csv(run / "effects.csv", index_col="measure")
    assert effects.simulated.all() and effects.num_persons["several_joints"] == 4
    assert "no person took part" in (run / "report.html").read_text()
    trial = json.loads((run / "trials" / "P01_1_01.json").read_text())
    assert trial["simulated"] is True and trial["operator"] in ("advicefollower", "novice")
    assert "simulated operators" in (run / "plan.html").read_text()
    erased = brokk(
        "mode=study", "study.do=erase", "study.folder=run", "study.participant=P02",
        "session.out=forget",
    )  # fmt: skip
    assert erased.code == 0 and not list(run.rglob("P02*"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["study.do=simulate"], "needs simulated operators; ground=twin"),
        (["study.do=run"], "needs study.folder=<folder>"),
        (["study.do=erase", "study.folder=there"], "needs study.participant=<participant>"),
        (["study.do=plan", "study.design.primary=time"], "did you mean 'time_s'"),
        (["study.do=report", "study.folder=nowhere"], "holds no study"),
    ],
)
def test_what_a_step_lacks_is_said(
    words: list[str], message: str, brokk: Callable[..., Any]
) -> None:
    done = brokk("mode=study", *words)
    assert done.code == 2 and message in done.err
