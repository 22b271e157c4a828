"""A planted error is found in its joint and in the moments in which it arises, although it stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion import make_recording

from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns
from diagnosis.where import REGIMES, label_regimes, locate_gap

MOMENTS = {
    "at rest": (0.3, 0.7), "after a start": (1.1, 1.4), "in steady motion": (1.8, 2.3),
    "after a reversal": (2.6, 2.9), "after a stop": (4.1, 4.4),
}  # fmt: skip
"""Moments of `run_freely`, s, inside of a regime of 0.6 s."""
Q3 = 2


def run_freely(machine: Machine, error: np.ndarray) -> WindowedRuns:
    """Returns a window of 5 s in which q3 rests for 1 s, moves out, turns at 2.5 s, and stops at 4 s."""
    t_s = 0.05 * np.arange(100)
    speed = np.select([t_s < 1.0, t_s < 2.5, t_s < 4.0], [0.0, 0.2, -0.2], 0.0)
    q = np.tile(machine.home, (100, 1))
    q[:, Q3] += 0.05 * np.cumsum(speed)
    recording = make_recording(machine, np.zeros_like(q), q, "run")
    return WindowedRuns([recording], np.array([0]), np.array([1]), q[None], q[None] - error)


def name_regimes(runs: WindowedRuns, machine: Machine, steps: tuple[int, ...]) -> list[str]:
    labels = label_regimes(runs, machine)[0, :, Q3]
    return [REGIMES[labels[step]] for step in steps]


@pytest.mark.parametrize("regime", REGIMES)
def test_an_error_lies_where_it_arises(machine: Machine, regime: str) -> None:
    begin_s, end_s = MOMENTS[regime]
    t_s = 0.05 * np.arange(100)
    error = np.zeros((1, 100, 5))
    error[0, :, Q3] = np.cumsum(np.where((t_s > begin_s) & (t_s < end_s), 0.001, 0.0))
    found = locate_gap(run_freely(machine, error), np.zeros(5), np.zeros(5), machine)
    assert [(one.joint, one.regime) for one in found.regimes] == [("q3", regime)]
    assert found.regimes[0].share == pytest.approx(1.0)
    assert found.joints["q3"]["rmse_rad"] == pytest.approx(np.sqrt(np.mean(error[0, :, Q3] ** 2)))


def test_a_joint_that_rested_in_between_turns_too(machine: Machine) -> None:
    runs = run_freely(machine, np.zeros((1, 100, 5)))
    out = runs.simulated.copy()
    held = np.concatenate([out[:, :50], np.repeat(out[:, 49:50], 20, 1), out[:, 50:80]], 1)
    found = name_regimes(replace(runs, simulated=held), machine, (30, 65, 75))
    assert found == ["after a start", "at rest", "after a reversal"]


def test_two_causes_share_the_square_of_their_sum(machine: Machine) -> None:
    """3 after the start and 1 more after the reversal, in 70 steps and in 40 of these."""
    error = np.zeros((1, 100, 5))
    error[0, 30:, Q3] += 0.003
    error[0, 60:, Q3] += 0.001
    runs = run_freely(machine, error)
    assert name_regimes(runs, machine, (30, 60)) == ["after a start", "after a reversal"]
    found = locate_gap(runs, np.zeros(5), np.zeros(5), machine)
    shares = [one.share for one in found.regimes]
    # Of the start 3 * 3 in 30 steps and 3 * 4 in 40, of the reversal 1 * 4 in 40.
    assert shares == pytest.approx([750 / 910, 160 / 910])


def test_shares_of_joints_are_those_of_the_squares_beyond_the_floor(machine: Machine) -> None:
    percent = 0.01 * (machine.upper - machine.lower)
    before, floor = percent * [0.0, 5.0, 2.0, 3.0, 0.0], percent * [0.0, 3.0, 2.0, 4.0, 0.0]
    runs = run_freely(machine, np.tile(before, (1, 100, 1)))

    def share(floor: np.ndarray) -> list[float]:
        joints = locate_gap(runs, before, floor, machine).joints
        return [one["share"] for one in joints.values()]

    assert share(0.0 * floor) == pytest.approx([0.0, 25 / 38, 4 / 38, 9 / 38, 0.0])
    assert share(floor) == pytest.approx([0.0, 1.0, 0.0, 0.0, 0.0])
    # Where no error is beyond its floor, all of it counts.
    assert share(9.0 * before) == pytest.approx([0.0, 25 / 38, 4 / 38, 9 / 38, 0.0])
