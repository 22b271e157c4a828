"""What is measured of a trial, on recordings made by hand, and beside the published algorithm and the project's own kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from brokk_rl.kinematics import Kinematics, compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from study import measures, tlx
from study.design import Hole, Success
from study.measures import compute_sparc

RATE_HZ = 20.0
SUCCESS = Success(depth_m=0.1, clearance_m=0.013)


def recorded(
    machine: Machine, q: np.ndarray, u: np.ndarray | None = None, **extra: np.ndarray
) -> Recording:
    return Recording(
        machine=machine.name, joints=machine.joint_names, units=("rad",) * 5, rate_hz=RATE_HZ, t_s=np.arange(len(q)) / RATE_HZ,
        u=np.zeros_like(q) if u is None else u, q=q, extra=extra,
    )  # fmt: skip


def test_the_tool_is_where_the_projects_kinematics_has_it(machine: Machine) -> None:
    q = np.random.default_rng(0).uniform(machine.lower, machine.upper, (20, 5))
    here, there = (
        compute_tool_kinematics(machine, q),
        Kinematics(machine).pose(torch.tensor(q, dtype=torch.float32)),
    )
    jacobian = Kinematics(machine).jacobian(torch.tensor(q, dtype=torch.float32))
    assert np.allclose(here.tip_in_base_m, there.tip_in_base_m, atol=1e-5)
    assert np.allclose(here.axis_in_base, there.axis_in_base, atol=1e-5)
    assert np.allclose(here.jacobian, jacobian.tip, atol=1e-5)
    step = 1e-6 * np.eye(5)[3]
    slope = (compute_tool_kinematics(machine, q + step).axis_in_base - here.axis_in_base) / 1e-6
    assert np.allclose(here.turn[..., 3], slope, atol=1e-4)


def test_sparc_is_that_of_the_published_algorithm() -> None:
    t = np.arange(-1, 1, 0.01)
    # The example of the authors' own code.
    assert compute_sparc(np.exp(-5 * t**2), 100.0) == pytest.approx(-1.41403, abs=1e-5)
    two = np.exp(-40 * (t + 0.5) ** 2) + np.exp(-40 * (t - 0.5) ** 2)
    assert compute_sparc(two, 100.0) < -1.6
    assert compute_sparc(7 * two, 100.0) == pytest.approx(compute_sparc(two, 100.0))
    assert math.isnan(compute_sparc(np.zeros(50), 20.0))


def test_a_straight_path_has_its_length_and_noise_hardly_adds_to_it() -> None:
    line = np.linspace([0.0, 0.0, 0.0], [3.0, 4.0, 0.0], 401)
    assert measures.measure_path_length(line, 0.05) == pytest.approx(5.0)
    noisy = line + 0.002 * np.random.default_rng(0).standard_normal(line.shape)
    assert measures.measure_path_length(noisy, 0.05) == pytest.approx(5.0, abs=0.01)
    assert np.linalg.norm(np.diff(noisy, axis=0), axis=1).sum() > 5.2


def test_lever_movements_are_counted_with_a_margin_for_tremor() -> None:
    u = np.zeros((12, 2))
    u[1:5, 0] = [0.3, 0.08, 0.12, 0.3]  # one movement: 0.08 is not yet let go
    u[6:8, 0] = [0.2, 0.2]
    u[9:, 1] = 0.5
    assert measures.detect_lever_movements(u).tolist() == [[1, 0], [6, 0], [9, 1]]
    assert not len(measures.detect_lever_movements(np.full((5, 2), 0.07)))


def test_a_trial_of_known_motion_gives_known_numbers(machine: Machine) -> None:
    q = np.repeat(machine.home[None], 201, 0)
    q[:, 0] += np.clip(np.arange(201) - 40, 0, 80) * 0.05 * 0.2  # q1 at half speed from 2 s to 6 s
    q[:, 2] += np.clip(np.arange(201) - 80, 0, 80) * 0.05 * 0.13  # q3 from 4 s to 8 s
    u = np.zeros((201, 5))
    u[40:120, 0], u[80:160, 2] = 0.5, 0.5
    hole = Hole(center_in_base_m=(9.0, 0.0, 0.75), radius_m=0.05)
    found = measures.measure(
        recorded(machine, q, u, force_n=np.zeros(201)), machine, hole, SUCCESS, 60.0
    )
    assert found["success"] == 0 and found["time_s"] == 60.0 and math.isnan(found["efficiency"])
    assert found["several_joints"] == pytest.approx(40 / 201, abs=6 / 201)
    assert (
        found["lever_movements"] == 2
        and found["joint_switches"] == 1
        and found["exclusive_share"] == 0
    )
    assert found["control_effort"] == pytest.approx(2.0 / 10.0)
    assert found["contacts"] == 0 and math.isnan(found["advice_error"])
    turn, radius = (
        80 * 0.05 * 0.2,
        np.linalg.norm(compute_tool_kinematics(machine, machine.home).tip_in_base_m[:2]),
    )
    alone = measures.measure(recorded(machine, q[:81], u[:81]), machine, hole, SUCCESS, 60.0)
    assert alone["path_m"] == pytest.approx(radius * turn / 2, rel=0.01) and math.isnan(
        alone["contacts"]
    )


def test_insertion_ends_the_trial(machine: Machine) -> None:
    tip = compute_tool_kinematics(machine, machine.home).tip_in_base_m
    q = np.repeat(machine.home[None], 100, 0)
    q[:50, 0] += 0.3  # far off until 2.5 s
    hole = Hole(center_in_base_m=(tip[0] + 0.012, tip[1], tip[2] + 0.101), radius_m=0.05)
    found = measures.measure(recorded(machine, q), machine, hole, SUCCESS, 60.0)
    assert found["success"] == 1 and found["time_s"] == pytest.approx(2.5)
    late = measures.measure(recorded(machine, q), machine, hole, SUCCESS, 2.0)
    assert late["success"] == 0 and late["time_s"] == 2.0
    beside = Hole(center_in_base_m=(tip[0] + 0.014, tip[1], tip[2] + 0.101), radius_m=0.05)
    assert measures.measure(recorded(machine, q), machine, beside, SUCCESS, 60.0)["success"] == 0


def test_lag_and_distance_from_the_advice() -> None:
    advice = np.zeros((200, 5))
    advice[:, 0] = np.sin(np.arange(200) * 0.1)
    late = np.roll(advice, 6, 0)
    found = measures.measure_tracking(late, advice, 0.05)
    assert found["advice_lag_s"] == pytest.approx(0.3, abs=0.051)
    assert measures.measure_tracking(advice + 0.1, advice, 0.05)["advice_error"] == pytest.approx(
        0.1
    )
    assert math.isnan(
        measures.measure_tracking(advice, np.full_like(advice, np.nan), 0.05)["advice_error"]
    )


ANSWERS = {
    "ratings": {
        "mental": 70,
        "physical": 20,
        "temporal": 40,
        "performance": 30,
        "effort": 60,
        "frustration": 50,
    },
    # the scale named first in the list of all wins each of its pairs: weights 5 4 3 2 1 0
    "pairs": [{"pair": list(pair), "chosen": pair[0]} for pair in tlx.PAIRS],
}


def test_tlx_raw_and_weighted_by_hand() -> None:
    assert len(tlx.PAIRS) == 15
    assert tlx.compute_raw_tlx(ANSWERS) == pytest.approx(45.0)
    assert tlx.compute_weighted_tlx(ANSWERS) == pytest.approx(
        (5 * 70 + 4 * 20 + 3 * 40 + 2 * 30 + 1 * 60) / 15
    )
    assert tlx.check(ANSWERS) == []
    shown = tlx.list_pairs(np.random.default_rng(0))
    assert {frozenset(pair) for pair in shown} == {
        frozenset(pair) for pair in tlx.PAIRS
    } and shown != list(tlx.PAIRS)


def test_a_half_filled_questionnaire_has_no_score_and_says_why() -> None:
    half = {"ratings": {**ANSWERS["ratings"], "effort": None}, "pairs": ANSWERS["pairs"][:9]}
    assert math.isnan(tlx.compute_raw_tlx(half)) and math.isnan(tlx.compute_weighted_tlx(half))
    assert tlx.read_ratings(half)["mental"] == 70
    assert "effort not answered" in tlx.check(half)[0] and "9 of 15" in tlx.check(half)[1]
    assert "expected 0 to 100" in tlx.check({"ratings": {**ANSWERS["ratings"], "mental": 170}})[0]
    never = {"ratings": {**ANSWERS["ratings"], "frustration": None}, "pairs": ANSWERS["pairs"]}
    # Its weight is 0.
    assert tlx.compute_weighted_tlx(never) == pytest.approx(tlx.compute_weighted_tlx(ANSWERS))
