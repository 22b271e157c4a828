"""Simulated operators: their hands are those of `follower=person`, and each kind works as it says, on an arm with dead time."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composed import option

from actuators.person import HumanFollower
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from study.operators.hands import Hands
from study.operators.traits import Traits
from study.trial_contract import OperatorView

RNG = np.random.default_rng(0)
START = np.array([0.0, -0.95, 0.5, 1.15, 0.6]) + RNG.uniform(-0.3, 0.3, (8, 5)) * [
    1.5,
    0.2,
    0.5,
    0.5,
    0.5,
]
RIM_M = np.column_stack((RNG.uniform(2.4, 2.8, 8), RNG.uniform(-0.8, 0.8, 8), np.full(8, 0.75)))
ROOT = Path(__file__).parents[2]
EXACT: dict[str, Any] = {
    "delay_s": 0.27,
    "lag_s": 0.15,
    "gain": 0.9,
    "tremor": 0.0,
    "dead_zone": 0.04,
    "grip_s": 0.5,
}


@pytest.mark.parametrize("most", [1, 2, 5])
def test_hands_are_those_of_the_follower(most: int, machine: Machine) -> None:
    proposed = np.random.default_rng(0).uniform(-1, 1, (80, 3, 5)) * (
        np.random.default_rng(1).random((80, 3, 5)) < 0.6
    )
    proposed[..., 1] *= np.arange(80)[:, None] % 20 < 5
    proposed = np.repeat(proposed[::4], 4, 0)
    here = Hands(joints_at_once=most, **EXACT).build(machine, np.arange(3), 0)
    there = HumanFollower(joints_at_once=most, attention_s=0.0, **EXACT).build(
        machine, 3, torch.device("cpu")
    )
    for row in proposed:
        expected = there.step(torch.tensor(row, dtype=torch.float32)).numpy()
        assert np.allclose(here.step(row), expected, atol=1e-5)


def test_a_person_is_the_same_in_every_trial_and_condition() -> None:
    one = Traits(np.array([0, 1, 1, 0]), seed=3).draw("delay_s", (0.2, 0.4))[:, 0]
    two = Traits(np.array([1]), seed=3).draw("delay_s", (2.0, 4.0))[0, 0]
    assert one[0] == one[3] and one[1] == one[2] != one[0]
    assert two == pytest.approx(10 * one[1])
    assert Traits(np.array([1]), seed=4).draw("delay_s", (0.2, 0.4))[0, 0] != one[1]


def worked(
    operator: Any, machine: Machine, seconds: float, advice: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and commands, `(T, N, J)`, on an arm of pure dead time whose valves open linearly beyond 0.08."""
    model = operator.build(machine, np.arange(len(START)), 7)
    q, pipe = START.copy(), [np.zeros_like(START)] * round(machine.dead_time_s / machine.period_s)
    qs, us = [], []
    for _ in range(round(seconds / machine.period_s)):
        shown = np.full_like(START, np.nan) if advice is None else advice
        u = model.step(OperatorView(q=q, rim_in_base_m=RIM_M, advice=shown))
        pipe = [*pipe[1:], u]
        opening = np.sign(pipe[0]) * np.maximum(np.abs(pipe[0]) - 0.08, 0) / 0.92
        q = np.clip(
            q + opening * machine.max_speed * machine.period_s, machine.lower, machine.upper
        )
        qs.append(q)
        us.append(u)
    return np.array(qs), np.array(us)


def found_after_s(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Returns when the tip was in the hole, `(N,)`, inf where it never was; without a block to lean on a little is forgiven."""
    tip = compute_tool_kinematics(machine, q).tip_in_base_m - RIM_M
    inside = (np.hypot(tip[..., 0], tip[..., 1]) < 0.02) & (tip[..., 2] < -0.05)
    return np.where(inside.any(0), inside.argmax(0) * machine.period_s, np.inf)


def test_operators_without_guidance_find_the_hole_each_in_their_way(machine: Machine) -> None:
    median_s, at_once = {}, {}
    for name in ("novice", "crossover", "expert"):
        q, u = worked(option("operator", name), machine, 120.0)
        times = found_after_s(q, machine)
        assert np.isfinite(times).mean() >= 0.6, name
        moved = np.abs(u) > 0
        assert not (moved[..., 1] & moved[..., [0, 2, 3, 4]].any(-1)).any()  # q2 alone
        median_s[name], at_once[name] = float(np.median(times)), int(moved.sum(-1).max())
        again, _ = worked(option("operator", name), machine, 5.0)
        assert (again == q[:100]).all()
    assert at_once == {"novice": 1, "crossover": 2, "expert": 4}
    assert median_s["expert"] < 0.5 * median_s["crossover"] < 0.5 * median_s["novice"]


def test_the_follower_does_what_is_advised_and_without_advice_nothing(machine: Machine) -> None:
    _, still = worked(option("operator", "follower"), machine, 2.0)
    assert not still.any()
    _, moved = worked(
        option("operator", "follower"),
        machine,
        3.0,
        np.tile([0.5, 0.0, 0.0, 0.0, 0.0], (len(START), 1)),
    )
    assert moved[-1, :, 0] == pytest.approx(0.5, abs=0.15) and not moved[..., 1:].any()


@pytest.mark.slow
def test_a_study_of_simulated_operators_from_nothing_by_one_command(
    brokk: Callable[..., Any], tmp_path: Path
) -> None:
    hole = "{_target_: study.design.Hole, center_in_base_m: [2.6, 0.0, 0.75], radius_m: 0.05}"
    done = brokk(
        "mode=study", "study.do=simulate", "session.out=run", "study.design.num_participants=4",
        "study.design.limit_s=2.0",
        "~study.design.holes", f"+study.design.holes={{A: {hole}, B: {hole}}}",
        "~study.design.starts", "+study.design.starts={a: [0.0, -0.95, 0.55, 1.15, 0.6], b: [0.1, -0.95, 0.55, 1.15, 0.6]}",
    )  # fmt: skip
    assert done.code == 0, done.err
    run = tmp_path / "run"
    assert len(list((run / "recordings").iterdir())) == 16
    report = json.loads((run / "report.json").read_text())
    assert report["simulated"] is True and report["effects"]["several_joints"]["num_persons"] == 4
    assert "no person took part" in (run / "report.html").read_text()
    trial = json.loads((run / "trials" / "P01_1_01.json").read_text())
    assert trial["simulated"] is True and trial["operator"] in ("follower", "novice")
    assert (
        "simulated operators" in (run / "plan.html").read_text()
        and "of 100 studies" in (run / "plan.html").read_text()
    )
    erased = brokk(
        "mode=study",
        "study.do=erase",
        "study.folder=run",
        "study.participant=P02",
        "session.out=forget",
    )
    assert erased.code == 0 and not list(run.rglob("P02*"))


def test_a_study_needs_neither_torch_nor_simulator() -> None:
    code = (
        "import sys, study.modes.study, study.study_steps;"
        "print([m for m in ('torch', 'mujoco', 'warp') if m in sys.modules])"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
        ).stdout
        == "[]\n"
    )
