"""A planted error is found where it was put, parts add up to all of it, and chance alone is seldom taken for a gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.error_growth import measure_growth
from diagnosis.free_runs import WindowedRuns
from diagnosis.permutation_test import FALSE_DISCOVERY_RATE, adjust_p_values, compute_excess_p
from diagnosis.regimes import REGIMES, label_loads, label_regimes, shift_by_dead_time
from diagnosis.where import GapLocation, locate_gap, trace_to_origin

PERIOD_S = 0.05
DELAY_S = 0.5
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
    label = base.cut(
        [
            label_regimes(
                shift_by_dead_time(r.u, np.full(5, DELAY_S), PERIOD_S), r.q, machine, 20.0
            )
            for r in base.recordings
        ]
    )
    added = np.zeros_like(base.simulated)
    added[..., joint] = np.cumsum(
        (label[..., joint] == REGIMES.index(regime)) * speed * PERIOD_S, 1
    )
    return replace(base, simulated=base.simulated + added)


def located(field: WindowedRuns, reference: WindowedRuns | None, machine: Machine) -> GapLocation:
    return locate_gap(field, reference, machine, np.full(5, DELAY_S), np.random.default_rng(0))


@pytest.mark.parametrize("regime", ["creep", "cruise", "after a reversal", "hold", "stop"])
def test_an_error_that_arises_in_one_regime_of_one_joint_is_found_there(
    machine: Machine, regime: str
) -> None:
    found = located(
        planted(runs(machine, 6, 0), machine, 2, regime, 0.05), runs(machine, 12, 1), machine
    )
    assert found.joints["q3"].gap > 0.9 and found.joints["q3"].is_sure and found.has_gap
    first = found.largest()[0]
    assert (first.joint, first.category) == ("q3", regime)
    assert first.gap > 0.85 and first.is_sure


def test_two_errors_share_the_gap_as_their_squares_do(machine: Machine) -> None:
    quiet = runs(machine, 4, 0, size=0.0)
    one, other = (
        planted(quiet, machine, joint, "cruise", speed) for joint, speed in ((1, 0.02), (3, 0.04))
    )
    both = replace(quiet, simulated=one.simulated + other.simulated - quiet.simulated)
    squares = [np.nansum(runs.error**2) for runs in (one, other)]
    # With a floor, one standard error of chance would be taken off.
    found = located(both, None, machine)
    assert found.joints["q2"].gap == pytest.approx(squares[0] / sum(squares))
    assert found.joints["q4"].gap == pytest.approx(squares[1] / sum(squares))
    parts = {(p.joint, p.category): p.gap for p in found.parts["regime"]}
    assert parts["q4", "cruise"] == pytest.approx(found.joints["q4"].gap)


@pytest.mark.parametrize("has_floor", [True, False])
def test_every_way_of_sorting_adds_up_to_the_whole(machine: Machine, has_floor: bool) -> None:
    field = planted(runs(machine, 6, 0), machine, 2, "creep", 0.05)
    field = replace(field, row=field.row + 30)  # the last windows reach beyond the end
    found = located(field, runs(machine, 12, 1) if has_floor else None, machine)
    assert set(found.parts) == {
        "regime",
        "direction",
        "load",
        "frequency",
        "running time",
        "recording",
    }
    for name, parts in found.parts.items():
        assert sum(part.error for part in parts) == pytest.approx(1.0), name
        assert sum(part.gap for part in parts) == pytest.approx(1.0), name
        assert all(part.gap >= 0.0 for part in parts)
    assert sum(joint.error for joint in found.joints.values()) == pytest.approx(1.0)
    assert found.has_gap
    assert all(
        (part.p is None) == (not has_floor) or part.time == 0.0 for part in found.parts["regime"]
    )


def test_an_error_is_traced_to_the_samples_that_added_to_it() -> None:
    error = np.array([0.0, 1.0, 1.0, 3.0, 2.0]).reshape(1, 5, 1)
    label = np.array([0, 0, 1, 1, 0]).reshape(1, 5, 1)
    parts = trace_to_origin(error, label, 2)
    assert parts[0, 0, :, 0].tolist() == [0.0, 1.0, 1.0, 1.0, 0.0]
    assert parts[1, 0, :, 0].tolist() == [0.0, 0.0, 0.0, 2.0, 2.0]
    assert (parts * error).sum((1, 2, 3)).tolist() == [5.0, 10.0]  # of 1 + 1 + 9 + 4


def test_a_slow_and_a_fast_error_lie_in_their_bands(machine: Machine) -> None:
    quiet = runs(machine, 2, 0, size=0.0)
    t_s = np.arange(STEPS) * PERIOD_S
    wave = np.zeros_like(quiet.simulated)
    wave[..., 0] = 0.01 * np.sin(2 * np.pi * 0.6 * t_s) + 0.02 * np.sin(2 * np.pi * 4.0 * t_s)
    found = located(replace(quiet, simulated=quiet.simulated + wave), None, machine).totals(
        "frequency"
    )
    assert found["0.3 to 1 Hz"] == pytest.approx(0.2, abs=1e-6)
    assert found["above 3 Hz"] == pytest.approx(0.8, abs=1e-6)


def test_each_sample_has_the_regime_that_its_command_makes(machine: Machine) -> None:
    u = np.zeros((200, 5))
    u[20:60, 2], u[60:80, 2], u[80:120, 2], u[160:200, 2] = 0.2, 0.6, -0.6, -0.6
    u[100:110, 3] = 0.6
    q = np.tile(machine.home, (200, 1))
    names = np.array(REGIMES)[label_regimes(u, q, machine, 20.0)]
    assert (
        names[10, 2] == "hold"
        and names[22, 2] == "start"
        and names[40, 2] == "creep"
        and names[70, 2] == "cruise"
    )
    assert (
        names[85, 2] == "after a reversal"
        and names[105, 2] == "several joints at once"
        and names[115, 2] == "cruise"
    )
    assert names[122, 2] == "stop" and names[150, 2] == "hold" and names[165, 2] == "start"
    q[:, 2] = machine.upper[2] - 0.01
    names = np.array(REGIMES)[label_regimes(u, q, machine, 20.0)]
    assert names[85, 2] == "near an end stop" and names[150, 2] == "hold"


def test_the_command_in_force_is_that_of_a_dead_time_before() -> None:
    u = np.arange(20.0)[:, None] / 20.0
    assert (
        shift_by_dead_time(u, np.array([0.5]), PERIOD_S)[:, 0].tolist()
        == [0.0] * 11 + u[:9, 0].tolist()
    )


def test_lifting_and_lowering_are_told_by_the_weight(machine: Machine) -> None:
    acting = np.tile([[0.5], [-0.5], [0.0]], (1, 5))
    label = label_loads(acting, np.tile(machine.home, (3, 1)), machine)
    assert label[:, 0].tolist() == [1, 1, 0]  # slewing carries nothing
    assert label[:, 1].tolist() == [3, 2, 0]  # q2 + lowers the boom


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        (lambda t: 0.02 + 0.0 * t, "flat"),
        (lambda t: 0.02 * np.minimum(t / 0.4, 1.0), "step"),
        (lambda t: 0.01 * t, "linear"),
        (lambda t: 0.01 * t**2, "quadratic"),
    ],
)
def test_growth_says_what_kind_of_error_it_is(machine: Machine, shape, expected: str) -> None:
    quiet = runs(machine, 2, 0, size=0.0)
    sign = np.where(np.arange(quiet.num_windows) % 2, 1.0, -1.0)[:, None, None]
    error = sign * shape(PERIOD_S * np.arange(1, STEPS + 1))[None, :, None]
    found = measure_growth(replace(quiet, simulated=quiet.simulated + error), None, machine, None)[
        "q1"
    ]
    assert found.reading == expected
    assert found.horizon_s == pytest.approx((0.05, 0.5, 2.0, 5.0))
    assert found.rmse == pytest.approx([float(shape(t)) for t in (0.05, 0.5, 2.0, 5.0)], rel=1e-4)


def test_chance_alone_is_seldom_taken_for_a_gap() -> None:
    generator, alarms, trials = np.random.default_rng(0), 0, 200
    for _ in range(trials):
        blocks = generator.chisquare(8, (18, 12))  # heavy tails, twelve cells
        p = compute_excess_p(
            (blocks[:6], np.ones((6, 12))), (blocks[6:], np.ones((12, 12))), generator
        )
        alarms += bool((adjust_p_values(p) <= FALSE_DISCOVERY_RATE).any())
    # 5 % are nominal; of 200 trials 19 or more would be a chance of 1 in 500
    assert alarms < 19


def test_p_is_that_of_all_ways_to_swap_sides() -> None:
    # of the 20 ways to choose 3 of 6 blocks, only the one seen is so extreme
    sums = np.array([[5.0], [6.0], [7.0], [1.0], [2.0], [3.0]])
    p = compute_excess_p(
        (sums[:3], np.ones((3, 1))), (sums[3:], np.ones((3, 1))), np.random.default_rng(0)
    )
    assert p[0] == pytest.approx(1 / 20, abs=0.015)
    nowhere = compute_excess_p(
        (sums[:3], np.zeros((3, 1))), (sums[3:], np.ones((3, 1))), np.random.default_rng(0)
    )
    assert np.isnan(nowhere[0])
