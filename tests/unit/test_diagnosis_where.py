"""The share of a joint in the gap is that of its squared error beyond the floor, over its travel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gaps import recording

from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns
from diagnosis.where import locate_gap

STEPS = 100


def make_runs(machine: Machine, rmse_rad: tuple[float, ...], first: int = 100) -> WindowedRuns:
    """Returns free runs whose errors have a size by joint and change their sign from step to step."""
    row = np.arange(first, first + 10 * STEPS, STEPS)
    empty = WindowedRuns([recording(machine)], np.zeros(10, int), row, np.zeros((10, STEPS, 5)))
    sign = np.where(np.arange(STEPS) % 2, 1.0, -1.0)[:, None]
    return replace(empty, simulated=empty.measured + sign * np.array(rmse_rad))


def test_shares_are_those_of_the_squares_beyond_the_floor(machine: Machine) -> None:
    joints = machine.joints[1:4]
    travel = (machine.upper - machine.lower)[1:4]
    size_rad = 0.01 * travel * [5.0, 2.0, 3.0]
    floor_rad = 0.01 * travel * [3.0, 2.0, 4.0]
    field = make_runs(machine, (0.0, *size_rad, 0.0))
    plain = locate_gap(field, None, machine).joints
    assert [plain[one.name].share for one in joints] == pytest.approx([25 / 38, 4 / 38, 9 / 38])
    found = locate_gap(field, make_runs(machine, (0.0, *floor_rad, 0.0)), machine).joints
    assert [found[one.name].share for one in joints] == pytest.approx([1.0, 0.0, 0.0])
    assert [found[one.name].rmse for one in joints] == pytest.approx(size_rad.tolist())
    assert [found[one.name].floor for one in joints] == pytest.approx(floor_rad.tolist())


def test_without_an_excess_and_beyond_the_end_the_shares_still_add_up(machine: Machine) -> None:
    late = recording(machine).num_samples - 9 * STEPS - STEPS // 2
    field = make_runs(machine, (0.01,) * 5, late)  # the last window reaches beyond the end
    found = locate_gap(field, make_runs(machine, (0.02,) * 5), machine)
    assert sum(joint.share for joint in found.joints.values()) == pytest.approx(1.0)
    assert all(joint.rmse == pytest.approx(0.01) for joint in found.joints.values())
