"""What is measured of a trial, on recordings made by hand, and beside the published algorithm and the project's own kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sitting import MACHINE, recorded

from brokk_rl.kinematics import compute_tool_kinematics
from study import measures, tlx
from study.design import Hole, Success
from study.measures import measure_trial

SUCCESS = Success(depth_m=0.1, clearance_m=0.013)


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


def test_a_trial_of_known_motion_gives_known_numbers() -> None:
    q = np.repeat(MACHINE.home[None], 201, 0)
    q[:, 0] += np.clip(np.arange(201) - 40, 0, 80) * 0.05 * 0.2  # q1 at half speed from 2 s to 6 s
    q[:, 2] += np.clip(np.arange(201) - 80, 0, 80) * 0.05 * 0.13  # q3 from 4 s to 8 s
    u = np.zeros((201, 5))
    u[40:120, 0], u[80:160, 2] = 0.5, 0.5
    hole = Hole(center_in_base_m=(9.0, 0.0, 0.75), radius_m=0.05)
    found = measure_trial(recorded(q, u, force_n=np.zeros(201)), MACHINE, hole, SUCCESS, 60.0)
    assert found["success"] == 0 and found["time_s"] == 60.0
    assert found["several_joints"] == pytest.approx(40 / 201, abs=6 / 201)
    assert found["lever_movements"] == 2 and found["joint_switches"] == 1
    assert found["control_effort"] == pytest.approx(2.0 / 10.0)
    assert found["peak_force_n"] == 0 and math.isnan(found["advice_error"])
    tip_m = compute_tool_kinematics(MACHINE, MACHINE.home).tip_in_base_m
    alone = measure_trial(recorded(q[:81], u[:81]), MACHINE, hole, SUCCESS, 60.0)
    way_m = math.hypot(*tip_m[:2]) * 80 * 0.05 * 0.2 / 2
    assert alone["path_m"] == pytest.approx(way_m, rel=0.01) and math.isnan(alone["peak_force_n"])


@pytest.mark.parametrize(
    ("aside_m", "limit_s", "success", "time_s"),
    [(0.012, 60.0, 1, 2.5), (0.012, 2.0, 0, 2.0), (0.014, 60.0, 0, 60.0)],
)
def test_insertion_within_the_limit_ends_the_trial(
    aside_m: float, limit_s: float, success: int, time_s: float
) -> None:
    tip = compute_tool_kinematics(MACHINE, MACHINE.home).tip_in_base_m
    q = np.repeat(MACHINE.home[None], 100, 0)
    q[:50, 0] += 0.3  # far off until 2.5 s
    hole = Hole(center_in_base_m=(tip[0] + aside_m, tip[1], tip[2] + 0.101), radius_m=0.05)
    found = measure_trial(recorded(q), MACHINE, hole, SUCCESS, limit_s)
    assert found["success"] == success and found["time_s"] == pytest.approx(time_s)


def test_distance_from_the_advice_counts_where_it_was_shown() -> None:
    hole = Hole(center_in_base_m=(9.0, 0.0, 0.75), radius_m=0.05)
    u, advice = np.zeros((40, 5)), np.full(40, 0.1)
    advice[20:] = np.nan
    columns = {f"advice_{name}": advice for name in MACHINE.joint_names}
    q = np.repeat(MACHINE.home[None], 40, 0)
    found = measure_trial(recorded(q, u, **columns), MACHINE, hole, SUCCESS, 60.0)
    assert found["advice_error"] == pytest.approx(0.1)


RATINGS = dict(zip(tlx.SCALES, (70, 20, 40, 30, 60, 50), strict=True))


def test_tlx_by_hand() -> None:
    scores, faults = tlx.compute_scores({"ratings": RATINGS})
    assert scores["raw"] == pytest.approx(45.0) and faults == []


def test_a_half_filled_questionnaire_has_no_mean_and_says_why() -> None:
    half = {"ratings": {**RATINGS, "effort": None, "temporal": 170}}
    scores, faults = tlx.compute_scores(half)
    assert math.isnan(scores["raw"]) and scores["mental"] == 70
    assert faults == ["temporal is 170, expected 0 to 100: no mean", "effort not answered: no mean"]
