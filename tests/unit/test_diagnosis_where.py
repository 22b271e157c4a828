"""A planted error is found where it was put, parts add up to all of it, and chance alone is seldom taken for a gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.free_runs import WindowedRuns
from diagnosis.regimes import REGIMES, label_recordings, label_regimes, shift_by_dead_time
from diagnosis.where import locate_gap, trace_to_origin

PERIOD_S = 0.05
STEPS = 100


def recordings(machine: Machine, count: int, seed: int) -> list[Recording]:
    """Returns recordings of 60 s in which joints move at random levels with rests, one at a time."""
    rng, found = np.random.default_rng(seed), []
    for number in range(count):
        u = np.zeros((1200, 5), dtype=np.float32)
        for begin in range(0, 1200, 40):
            u[begin : begin + 40, rng.integers(5)] = rng.choice([-0.6, -0.2, 0.0, 0.2, 0.6])
        q = machine.home + np.zeros_like(u)
        metadata = {
            "run": f"{seed}-{number}",
            "created": f"2026-11-20T10:{number:02d}:00.000+00:00",
        }
        found.append(
            Recording(
                machine="brokk170",
                joints=machine.joint_names,
                units=("rad",) * 5,
                rate_hz=20.0,
                t_s=np.arange(1200) * PERIOD_S,
                u=u,
                q=q.astype(np.float32),
                metadata=metadata,
            )
        )
    return found


def runs(machine: Machine, count: int, seed: int, size: float = 0.0003) -> WindowedRuns:
    """Returns free runs through `recordings` whose errors are random walks."""
    every = recordings(machine, count, seed)
    row = np.tile(np.arange(100, 1100, STEPS), count)
    source = np.repeat(np.arange(count), 10)
    walk = size * np.random.default_rng(seed + 1000).standard_normal((len(row), STEPS, 5)).cumsum(1)
    empty = WindowedRuns(every, source, row, walk)
    return replace(empty, simulated=empty.measured + walk)


def planted(
    base: WindowedRuns, machine: Machine, joint: int, regime: str, speed: float
) -> WindowedRuns:
    """Returns free runs in which one joint is simulated too fast, by `speed` rad/s, in one regime."""
    label = base.cut(label_recordings(base.recordings, machine))
    added = np.zeros_like(base.simulated)
    added[..., joint] = np.cumsum(
        (label[..., joint] == REGIMES.index(regime)) * speed * PERIOD_S, 1
    )
    return replace(base, simulated=base.simulated + added)


@pytest.mark.parametrize(
    "regime",
    [
        "at small commands",
        "at larger commands, alone",
        "after a reversal",
        "at rest",
        "just after stops",
    ],
)
def test_an_error_that_arises_in_one_regime_of_one_joint_is_found_there(
    machine: Machine, regime: str
) -> None:
    field = planted(runs(machine, 6, 0), machine, 2, regime, 0.05)
    found = locate_gap(field, runs(machine, 12, 1), machine)
    assert found.joints["q3"].share > 0.9
    first = found.regimes[0]
    assert (first.joint, first.regime) == ("q3", regime)
    assert first.share > 0.85


def test_two_errors_share_the_gap_as_their_squares_do(machine: Machine) -> None:
    quiet = runs(machine, 4, 0, size=0.0)
    one, other = (
        planted(quiet, machine, joint, "at larger commands, alone", speed)
        for joint, speed in ((1, 0.02), (3, 0.04))
    )
    both = replace(quiet, simulated=one.simulated + other.simulated - quiet.simulated)
    squares = [np.nansum(runs.error**2) for runs in (one, other)]
    # With a floor, one standard error of chance would be taken off.
    found = locate_gap(both, None, machine)
    assert found.joints["q2"].share == pytest.approx(squares[0] / sum(squares))
    assert found.joints["q4"].share == pytest.approx(squares[1] / sum(squares))
    parts = {(one.joint, one.regime): one.share for one in found.regimes}
    assert parts["q4", "at larger commands, alone"] == pytest.approx(found.joints["q4"].share)


@pytest.mark.parametrize("has_floor", [True, False])
def test_the_shares_add_up_to_the_whole(machine: Machine, has_floor: bool) -> None:
    field = planted(runs(machine, 6, 0), machine, 2, "at small commands", 0.05)
    field = replace(field, row=field.row + 30)  # the last windows reach beyond the end
    found = locate_gap(field, runs(machine, 12, 1) if has_floor else None, machine)
    assert sum(joint.share for joint in found.joints.values()) == pytest.approx(1.0)
    parts = [one.share for one in found.regimes if one.joint == "q3"]
    assert sum(parts) == pytest.approx(found.joints["q3"].share) and min(parts) > 0.0
    assert has_floor or len({one.joint for one in found.regimes}) == 5


def test_an_error_is_traced_to_the_samples_that_added_to_it() -> None:
    error = np.array([0.0, 1.0, 1.0, 3.0, 2.0]).reshape(1, 5, 1)
    label = np.array([0, 0, 1, 1, 0]).reshape(1, 5, 1)
    parts = trace_to_origin(error, label, 2)
    assert parts[0, 0, :, 0].tolist() == [0.0, 1.0, 1.0, 1.0, 0.0]
    assert parts[1, 0, :, 0].tolist() == [0.0, 0.0, 0.0, 2.0, 2.0]
    assert (parts * error).sum((1, 2, 3)).tolist() == [5.0, 10.0]  # of 1 + 1 + 9 + 4


def test_each_sample_has_the_regime_that_its_command_makes(machine: Machine) -> None:
    u = np.zeros((200, 5))
    u[20:60, 2], u[60:80, 2], u[80:120, 2], u[160:200, 2] = 0.2, 0.6, -0.6, -0.6
    u[100:110, 3] = 0.6
    q = np.tile(machine.home, (200, 1))
    names = np.array(REGIMES)[label_regimes(u, q, machine, 20.0)]
    assert (
        names[10, 2] == "at rest"
        and names[22, 2] == "at starts"
        and names[40, 2] == "at small commands"
        and names[70, 2] == "at larger commands, alone"
    )
    assert (
        names[85, 2] == "after a reversal"
        and names[105, 2] == "while several joints move"
        and names[115, 2] == "at larger commands, alone"
    )
    assert (
        names[122, 2] == "just after stops"
        and names[150, 2] == "at rest"
        and names[165, 2] == "at starts"
    )
    q[:, 2] = machine.upper[2] - 0.01
    names = np.array(REGIMES)[label_regimes(u, q, machine, 20.0)]
    assert names[85, 2] == "near an end stop" and names[150, 2] == "at rest"


def test_the_command_in_force_is_that_of_a_dead_time_before() -> None:
    u = np.arange(20.0)[:, None] / 20.0
    assert shift_by_dead_time(u, 0.5, PERIOD_S)[:, 0].tolist() == [0.0] * 11 + u[:9, 0].tolist()


def test_chance_alone_is_seldom_taken_for_a_gap(machine: Machine) -> None:
    alarms = 0
    for seed in range(20):
        found = locate_gap(runs(machine, 6, seed), runs(machine, 12, 100 + seed), machine)
        alarms += bool(found.regimes)
    assert alarms <= 4  # 5 % are nominal; five of 20 or more would be a chance of 1 in 390
