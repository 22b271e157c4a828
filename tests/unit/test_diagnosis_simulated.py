"""The engine that simulates every hypothesis, against SciPy, brute force and plants written apart from it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from composed import MACHINE
from gaps import diagnose
from motion import make_recording
from scipy.signal import lsim
from scipy.special import rel_entr
from scipy.stats import multivariate_normal

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import effect_library, gates
from diagnosis.case import GapCase
from diagnosis.engine import baseline, holds, sizes
from diagnosis.engine.baseline import fit_reference, linearise
from diagnosis.engine.coverage import find_covered, measure_uncovered
from diagnosis.engine.decide import Decider
from diagnosis.engine.hold_laws import HoldLaw, JitterLaw, LossLaw
from diagnosis.engine.measure import Motion, fit_variance
from diagnosis.engine.nuisance import Projection
from diagnosis.engine.rows import Row
from diagnosis.engine.side import Side, measure_full_loads, stack_side
from diagnosis.engine.valve import VALVE
from diagnosis.geometry import TOOL_COLUMNS
from diagnosis.reference_diagnosis import measure_clock_shift
from diagnosis.repair_proof import EngineProof

RATE_HZ = 20.0


TWO_JOINTS = replace(MACHINE, joints=MACHINE.joints[2:4], exclusive=(), levers=(), name="two")
"""A machine of two arms."""


def make_commands(seconds: float, seed: int) -> np.ndarray:
    """Return levels that two joints hold for some seconds each, `(T, 2)`."""
    generator = np.random.default_rng(seed)
    rows = round(seconds * RATE_HZ)
    u = np.zeros((rows, 2))
    for j in range(2):
        at, sign = 0, 1.0
        while at < rows:
            held = generator.integers(20, 60)
            is_off = generator.random() < 0.3
            u[at : at + held, j] = 0.0 if is_off else sign * generator.uniform(0.2, 1.0)
            at, sign = at + held, -sign
    return u


def move(u: np.ndarray, delay_s: float, gain: float, seed: int) -> np.ndarray:
    """Return positions of a plant of its own kind: delayed command, dead band, first-order speed, `(T, 2)`."""
    generator = np.random.default_rng(seed)
    late = round(delay_s * RATE_HZ)
    command = np.concatenate([np.zeros((late, 2)), u[: len(u) - late]])
    wanted = np.sign(command) * np.maximum(np.abs(command) - 0.08, 0.0) / 0.92
    speed, q = np.zeros(2), np.zeros(2)
    found = np.zeros_like(u)
    for k, row in enumerate(wanted):
        found[k] = q
        speed = speed + (1.0 - np.exp(-1.0 / RATE_HZ / 0.12)) * (row * (0.25, 0.3) - speed)
        q = q + gain * speed / RATE_HZ
    return found + generator.normal(0.0, 5e-4, found.shape)


def record(machine: Machine, u: np.ndarray, q: np.ndarray) -> Recording:
    """Return commands and positions as a recording."""
    middle = 0.5 * (machine.lower + machine.upper)
    return make_recording(machine, u, middle + 0.5 * (q - q.mean(0)))


def make_case(
    machine: Machine, delay_s: Sequence[float] = (0.3, 0.3), gain: Sequence[float] = (1.0, 1.0)
) -> GapCase:
    """Return a case whose field may have other delays and gains of each joint than 0.3 s and 1."""
    reference, field = [], []
    for seed in range(4):
        u = make_commands(100.0, seed)
        reference.append(record(machine, u, move(u, 0.3, 1.0, seed)))
    for seed in (10, 11):
        u = make_commands(90.0, seed)
        every = [move(u, delay_s[j], gain[j], seed)[:, j] for j in range(2)]
        field.append(record(machine, u, np.stack(every, 1)))
    return GapCase(machine, reference, field)


def make_side(u: np.ndarray) -> Side:
    """Return a side with these commands and no motion."""
    return stack_side([record(TWO_JOINTS, u, np.zeros_like(u))], TWO_JOINTS)


def pure_numbers(**values: float) -> np.ndarray:
    """Return numbers of a joint that follows its command at once, but for `values`."""
    numbers = np.zeros(len(VALVE.numbers))
    for name, value in ({"speed_out": 1.0, "speed_in": 1.0} | values).items():
        numbers[VALVE.place[name]] = value
    return numbers


LAG_SYSTEM = ([1.0], [0.4, 1.0, 0.0])  # 1 / s (0.4 s + 1)
RINGING = {"ringing_s": 2.0 * np.pi, "damping": 0.2}
RINGING_SYSTEM = ([1.0], [1.0, 0.4, 1.0, 0.0])


@pytest.mark.parametrize(
    ("numbers", "system"), [({"speed_lag_s": 0.4}, LAG_SYSTEM), (RINGING, RINGING_SYSTEM)]
)
def test_a_late_joint_is_that_of_scipy(numbers: Any, system: Any) -> None:
    u = make_commands(20.0, 0)
    path = make_side(u).simulate(0, pure_numbers(delay_s=0.3, **numbers))[0]
    # SciPy integrates path' = v under commands held over each period.
    fine = 10
    t = np.arange(len(u) * fine) / (RATE_HZ * fine)
    held = np.repeat(u[:, 0], fine)
    late = np.concatenate([np.zeros(round(0.3 * RATE_HZ * fine)), held])[: len(held)]
    _, expected, _ = lsim(system, late, t, interp=False)
    # Two steps a period integrate the lag; their mean lies half a step beside the exact one.
    assert np.abs(path - expected[::fine, ...].ravel()).max() < 0.02


@pytest.mark.parametrize("level", [1.0, 0.25])
def test_an_orifice_delays_by_the_root_of_the_command(level: float) -> None:
    """A chamber with p' = sqrt(u - p) / T follows a step to u with a mean delay of 2/3 T sqrt(u)."""
    side = make_side(np.repeat([[0.0, 0.0], [level, level]], [20, 80], 0))
    paths = side.simulate(0, np.stack([pure_numbers(), pure_numbers(filling_s=0.4)]))
    assert (paths[0, -1] - paths[1, -1]) / level == pytest.approx(0.4 * level**0.5, abs=0.02)


def test_a_delay_acts_by_each_part_of_a_step() -> None:
    """At a steady speed v, each further 5 ms cost 5 ms v; a step of the simulation lasts 25 ms."""
    side = make_side(np.repeat([[0.0, 0.0], [0.6, 0.6]], [20, 80], 0))
    delays_s = 0.3 + 0.005 * np.arange(11)
    numbers = np.repeat(VALVE.list_values("mean")[None], len(delays_s), 0)
    numbers[:, VALVE.place["delay_s"]] = delays_s
    paths = side.simulate(0, numbers)
    speed = (paths[0, -1] - paths[0, -2]) * RATE_HZ
    expected = paths[0, -1] - speed * (delays_s - 0.3)
    assert paths[:, -1] == pytest.approx(expected, abs=1e-4)


def test_a_joint_moves_faster_or_slower_while_another_one_is_open() -> None:
    u = np.full((300, 2), 0.5)
    u[:, 1] = np.repeat([0.0, 0.5, -0.5], 100)
    side = make_side(u)
    numbers = pure_numbers(others_out_1=0.2, others_out_2=-0.1)
    side.ask_others([numbers, pure_numbers()])
    path = side.simulate(0, numbers)[0]
    ways = [np.ptp(path[first : first + 61]) for first in (20, 120, 220)]
    # Over 3 s half the command goes 1.5 units: alone, with the other one out, and with it in.
    assert ways == pytest.approx([1.5, 1.8, 1.35], rel=0.01)


def test_a_joint_waits_until_the_pump_bears_its_load() -> None:
    """A pump with a lag of 0.2 s, worked by hand for a load of twice its margin.

    It rises to 3 margins as 3 (1 - exp(-t / 0.2 s)). Behind 2 margins the speed grows with the rest of the pressure
    and is full at 2.71, so that a full command loses the integral of 1 - (pressure - 2) / 0.71 up to there:
    0.3187 s. Without a load the pressure rises to 1 margin from 0 on, and 0.0989 s are lost. A step of the
    model, 25 ms, has the pressure of its end all along, so that one step less is lost.
    """
    side = make_side(np.repeat([[0.0, 0.0], [1.0, 0.0]], [40, 120], 0))
    heavy = pure_numbers(pump_lag_s=0.2, pump_weight=2.0)
    none = side.simulate(0, pure_numbers())[0, -1]
    for load, lost_s in ((-1.0, 0.3187), (1.0, 0.0989), (0.0, 0.0989)):
        side = replace(side, loads=np.full_like(side.loads, 0.25 * load))
        lost = none - side.simulate(0, heavy)[0, -1]  # at 1 unit a second
        assert lost == pytest.approx(lost_s - 0.025, abs=0.0125)


@pytest.mark.parametrize(("speed", "lost_s"), [(1.0, 0.0575), (-0.5, 0.1386), (0.2, 3.0)])
def test_a_joint_that_sticks_is_broken_away_by_pressure(speed: float, lost_s: float) -> None:
    """Oil that leaks lets the pressure rise as v (1 - exp(-t / 0.2 s)), up to 0.25; the joint then loses 0.05."""
    u = np.repeat([[0.0, 0.0], [speed, 0.0]] * 3, [20, 60, 20, 60, 20, 0], 0)
    path = make_side(u).simulate(0, pure_numbers(breakaway=0.25, building_s=0.2))[0]
    moved = 2.0 * (3.0 - lost_s) * (speed - 0.05 * np.sign(speed))
    assert path[-1] == pytest.approx(moved, abs=0.04)


def test_a_pump_that_was_always_small_and_slow_to_start_is_found() -> None:
    places = [VALVE.place[name] for name in ("pump_load", "pump_lag_s", "pump_weight")]
    numbers = VALVE.list_values("mean")
    numbers[places] = [0.8, 0.4, 2.0]
    side = make_side(np.clip(2.0 * make_commands(120.0, 3), -1.0, 1.0))
    side = replace(side, loads=np.full_like(side.loads, -0.25))
    side.ask_others([numbers, numbers])
    side.q = np.stack([side.simulate(j, numbers)[0] for j in (0, 1)], 1).astype(float)
    for one in fit_reference(side):
        assert one.numbers[places] == pytest.approx([0.8, 0.4, 2.0], rel=0.1)


def test_numbers_without_a_part_are_no_step_too_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slopes far too small, as where friction lets go, make steps far too long."""
    side = stack_side(make_case(TWO_JOINTS).reference, TWO_JOINTS)
    told = [one.spread for one in fit_reference(side)]

    def flatten(*given: Any) -> tuple[np.ndarray, np.ndarray]:
        increments, slopes = linearise(*given)
        return increments, 0.02 * slopes

    monkeypatch.setattr(baseline, "linearise", flatten)
    for one, spread in zip(fit_reference(side), told, strict=True):
        assert one.spread == pytest.approx(spread, rel=0.25)


def test_the_nuisance_is_a_covariance() -> None:
    generator = np.random.default_rng(0)
    columns, residual = generator.normal(size=(3, 12)), generator.normal(size=12)
    spread = 1.7
    projection = Projection(columns, spread)
    covariance = spread * np.eye(12) + columns.T @ columns
    exact = residual @ np.linalg.solve(covariance, residual)
    assert projection.measure_squares(residual)[0] == pytest.approx(exact, rel=1e-5)
    others = generator.normal(size=(2, 12))
    products = others @ np.linalg.solve(covariance, np.stack([residual, *others]).T)
    assert projection.multiply(others, np.stack([residual, *others])) == pytest.approx(products)
    log_likelihood = multivariate_normal(cov=covariance).logpdf(residual)
    own = -0.5 * (exact + projection.log_determinant + 12 * np.log(2.0 * np.pi * spread))
    assert own == pytest.approx(log_likelihood)


def test_the_variance_of_increments_is_that_of_what_was_drawn() -> None:
    generator = np.random.default_rng(4)
    motion = Motion(*generator.uniform(0.0, 2.0, (2, 40_000)))
    expected = motion.stack() @ np.array([0.4, 0.0, 0.5, 0.0, 0.2])
    increments = generator.normal(0.0, np.sqrt(expected))
    found = fit_variance(increments, motion, np.ones(len(increments), bool))
    assert motion.stack() @ found == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(("number", "lowering"), [("load_both", 1.0), ("load_opposing", 0.0)])
def test_dependence_on_weight_is_told_per_yield_force(number: str, lowering: float) -> None:
    found = sizes.translate(Row("load_dependence", ((number, "add", 0.05),)), 1, MACHINE)
    share = 9.81 * measure_full_loads(MACHINE)[1] / MACHINE.bodies[1].yield_force.value
    assert found == pytest.approx({"sensitivity": 2 * 0.05 / share, "lowering": lowering}, rel=1e-3)


LOSS = ((0.97, 0.03, 0, 0), (0.27, 0, 0.73, 0), (0.27, 0, 0, 0.73), (0.27, 0, 0, 0))
JITTER = ((5, 23, 0, 0), (5, 10, 13, 0), (5, 10, 10, 3), (5, 10, 10, 3))
"""Chances times 28: delays are uniform up to 2.8 samples, rounded to whole ones, and grow by one sample at most."""


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (LossLaw(0.03, 0.73), np.array(LOSS)),
        (JitterLaw(0.14), np.array(JITTER) / 28.0),
        (JitterLaw(0.07, 2), np.array(JITTER)[[1, 2, 2, 2]] / 28.0),
    ],
)
def test_delays_follow_each_other_by_their_law(law: HoldLaw, expected: np.ndarray) -> None:
    np.testing.assert_allclose(law.list_chances(4, 0.05), expected, atol=1e-12)


@pytest.mark.parametrize("law", [0, 1])
@pytest.mark.parametrize(("place", "power"), [(0, 0.3), (1, 1.0)])
def test_mean_courses_are_those_of_all_paths(law: int, place: int, power: float) -> None:
    laws = (LossLaw(0.1, 0.7), JitterLaw(0.09))
    every = np.stack([one.list_chances(3, 0.05) for one in laws])
    chances = every[law]
    paths = [path for path in product(range(3), repeat=6) if path[0] == 0]
    prior = np.array([chances[path[:-1], path[1:]].prod() for path in paths])
    likelihood = np.random.default_rng(2).normal(0.0, 2.0, (6, 3))
    likelihood[0, 1:] = -1e9  # no command is late at the beginning
    told = power * (likelihood - likelihood[:, :1])
    weights = prior * np.exp([told[np.arange(6), path].sum() for path in paths])
    posterior = weights / weights.sum()
    course = holds.average_courses(likelihood, every, [0.3, 1.0])[law][place]
    np.testing.assert_allclose(course.delays, posterior @ np.array(paths), atol=1e-9)
    counts = [posterior @ (np.array(paths) == delay).sum(1) for delay in range(3)]
    np.testing.assert_allclose(course.counts, counts, atol=1e-9)
    assert course.evidence == pytest.approx(np.log(weights.sum()))
    assert course.cost == pytest.approx(rel_entr(posterior, prior).sum())
    # Evidence far beyond what numbers can hold leaves a whole course.
    sure = holds.average_courses(1e4 * likelihood, every, [power])[law][0]
    assert sure.counts.sum() == pytest.approx(6.0) and sure.cost >= 0.0


def test_losses_are_fitted_where_a_third_of_the_samples_tells_them() -> None:
    generator = np.random.default_rng(3)
    delays = [0]
    for chance in generator.uniform(size=40_000):
        delays.append(delays[-1] + 1 if chance < 0.03 + 0.7 * (delays[-1] > 0) else 0)
    bank = np.where(np.arange(30) == np.array(delays)[:, None], 0.0, -8.0)
    bank[generator.uniform(size=len(delays)) > 1 / 3] = 0.0
    law = holds.fit_loss_law(bank, LossLaw(0.1, 0.4), 0.05)
    assert law.probability == pytest.approx(0.1, abs=0.01)
    assert law.persistence == pytest.approx(0.7, abs=0.03)
    held = holds.HeldCourse(law, 1.0, np.array(delays), (1.0,), 0.0, np.array([0.01] * 100))
    (kind,) = effect_library.load_effects(MACHINE, ("frame_loss",))
    assert sizes.describe_numbers(kind, {}, held, MACHINE)["persistence"]["q1"].ci95[1] == 1.0
    late = replace(held, law=JitterLaw(0.1), delays=np.full(100, 1.6))
    assert sizes.describe_hold(late, MACHINE)["jitter_s"][0] == pytest.approx(2.0 * 1.6 * 0.05)


def test_an_unchanged_machine_has_no_effect() -> None:
    answer = diagnose(make_case(TWO_JOINTS))
    assert answer.verdict == "none"


@pytest.mark.parametrize(
    ("changes", "effect", "joints", "number", "size"),
    [
        ({"delay_s": (0.3, 0.45)}, "dead_time", ("q4",), "dead_time_s", 0.15),
        ({"delay_s": (0.45, 0.45)}, "dead_time", ("q3", "q4"), "dead_time_s", 0.15),
        ({"gain": (1.0, 0.8)}, "flow_gain", ("q4",), "gain", 0.8),
    ],
)
def test_a_changed_joint_is_named_sized_and_proven(
    changes: Any, effect: str, joints: Any, number: str, size: float
) -> None:
    answer = diagnose(make_case(TWO_JOINTS, **changes))
    assert [(one.effect, one.joints) for one in answer.selected] == [(effect, joints)]
    estimate = answer.selected[0].parameters[number]["q4"]
    assert estimate.mean == pytest.approx(size, rel=0.1)
    assert estimate.ci95[0] <= size <= estimate.ci95[1]
    assert answer.gap and answer.gap.closed
    assert answer.gap.closed.mean > 0.8
    assert answer.selected[0].identified


@pytest.mark.parametrize("at_stops", [True, False])
def test_lost_frames_hold_stops_back_as_well_as_starts(at_stops: bool) -> None:
    case = make_case(TWO_JOINTS)
    for seed, one in zip((10, 11), case.field, strict=True):
        received = np.random.default_rng(seed).random(len(one.u)) < 0.4
        held = one.u[np.maximum.accumulate(np.where(received, np.arange(len(one.u)), 0))]
        if not at_stops:
            held = np.where(np.abs(held) > np.abs(one.u), one.u, held)
        one.q[:] = record(TWO_JOINTS, one.u, move(held, 0.3, 1.0, seed)).q
    named = {one.effect for one in diagnose(case).selected}
    assert bool(named & {"frame_loss", "delay_jitter"}) == at_stops


@pytest.mark.parametrize("group", ["rest", "starts"])
def test_what_follows_the_time_at_rest_is_told_as_unknown(group: str) -> None:
    """A valve that stays ajar behind a motion, and one that sticks after a rest."""
    field = []
    for seed in (10, 11):
        u = make_commands(90.0, seed)
        driven = u.copy()
        rested_s = np.zeros(len(u))
        for k in range(1, len(u)):
            is_still = u[k, 1] == 0.0
            rested_s[k] = rested_s[k - 1] + 1.0 / RATE_HZ if is_still else 0.0
            if group == "starts" and rested_s[k - 1] and not is_still:
                driven[k : k + 10, 1] = 0.0
        q = move(driven, 0.3, 1.0, seed)
        if group == "rest":
            sinks = 0.1 * np.exp(-rested_s / 0.7) * (rested_s > 0.0)
            q[6:, 1] -= np.cumsum(sinks[:-6]) / RATE_HZ
        field.append(record(TWO_JOINTS, u, q))
    answer = diagnose(replace(make_case(TWO_JOINTS), field=field))
    assert answer.verdict == "unknown"
    assert answer.more["evidence"]["generic"]["group"] == group


def test_commands_that_the_reference_lacks_do_not_count() -> None:
    slow = np.stack(2 * [np.linspace(-0.4, 0.4, 400)], 1)
    known = slow.copy()
    known[200:210] += 0.1
    reference = make_side(known)
    assert find_covered(reference, make_side(1.49 * slow)).all()
    assert not find_covered(reference, make_side(1.51 * slow))[:, [0, -1]].any()
    # A jump is faster than any motion of the reference; its response lasts for half a second behind the dead time.
    u = slow.copy()
    u[200:210, 1] += 0.3
    side = make_side(u)
    expected = np.ones((2, 400), dtype=bool)
    # Rates are taken over two samples, here and where it jumps back.
    width = round((TWO_JOINTS.dead_time_s + 0.5) * RATE_HZ)
    expected[1, 200 : 210 + 1 + width] = False
    covered = find_covered(reference, side)
    assert np.array_equal(covered, expected)
    # One joint moves outside of what is covered, the other one always.
    side.q[:] = np.linspace(0.0, 1.0, 400)[:, None]
    parts = measure_uncovered(side, covered)
    assert parts == pytest.approx([0.0, 0.5 * (~expected[1]).mean()], abs=0.01)
    failed = gates.judge_coverage(parts + 0.5, TWO_JOINTS)
    assert not failed.passed and "q4" in failed.text


def test_a_joint_without_weight_that_drifts_is_told_as_unknown() -> None:
    joints = (MACHINE.joints[0], MACHINE.joints[2])
    pair = replace(MACHINE, joints=joints, exclusive=(), levers=(), name="two")
    case = make_case(pair)
    for recording in case.field:
        recording.q[:, 0] += 0.004 * recording.t_s
    answer = diagnose(case)
    assert answer.verdict == "unknown"
    assert "in_library" in [gate.name for gate in answer.gates if not gate.passed]


@pytest.mark.parametrize("step_rad", [0.004, 0.04])
def test_a_coarse_sensor_is_named_with_its_step(step_rad: float) -> None:
    case = make_case(TWO_JOINTS)
    for one in case.field:
        one.q[:] = np.round(one.q / step_rad) * step_rad
    answer = diagnose(case)
    found = {one.effect: one.parameters["step_rad"] for one in answer.selected}
    assert found.keys() == {"quantisation"}
    for one in found["quantisation"].values():
        assert one.mean == pytest.approx(step_rad, rel=0.01)


@pytest.mark.parametrize("late_s", [0.0, 0.03])
def test_encoders_that_lag_behind_a_tool_tracker_show_their_clock(late_s: float) -> None:
    generator = np.random.default_rng(0)
    t_s = np.arange(4000) / RATE_HZ
    middle = 0.5 * (MACHINE.lower + MACHINE.upper)
    half = 0.2 * (MACHINE.upper - MACHINE.lower)
    rates = 2.0 * np.pi * np.array([0.05, 0.07, 0.09, 0.11, 0.13])

    def place(at_s: np.ndarray) -> np.ndarray:
        return middle + half * np.sin(at_s[:, None] * rates)

    # The tracker sees an arm whose third encoder is wrong by half a degree.
    true = place(t_s) + np.array([0.0, 0.0, 0.009, 0.0, 0.0])
    tip = Kinematics(MACHINE).pose(torch.as_tensor(true, dtype=torch.float32)).tip_in_base_m
    seen = tip.numpy() + generator.normal(0.0, 0.0015, (len(t_s), 3))
    columns = dict(zip(TOOL_COLUMNS, seen.T, strict=True))
    shown = make_recording(MACHINE, np.zeros_like(true), place(t_s - late_s), extra=columns)
    assert measure_clock_shift([shown], MACHINE) == pytest.approx(late_s, abs=0.002)


def test_a_late_clock_is_told_once_and_beside_other_effects() -> None:
    case = make_case(TWO_JOINTS, (0.4, 0.4), (1.0, 0.8))
    sides = (stack_side(side, TWO_JOINTS) for side in (case.reference, case.field))
    decider = Decider(*sides, np.zeros(2), clock_late_s=0.1)
    named = [(one.name, one.joints) for one in decider.decide().named]
    # The engine calls a late clock a dead time of all joints.
    assert named == [("dead_time", (0, 1)), ("flow_gain", (1,))]


def test_a_simulator_worse_than_standing_still_fails_its_gate() -> None:
    # The second joint goes the other way: a simulator without this errs by twice its motion.
    case = make_case(TWO_JOINTS, gain=(1.0, -1.0))
    sides = (stack_side(side, TWO_JOINTS) for side in (case.reference, case.field))
    proof = EngineProof(case, Decider(*sides, np.zeros(2)), [], np.random.default_rng(0))
    assert [one.passed for one in proof.judge()] == [True, False]
    assert diagnose(case).verdict == "unknown"


def test_form_errors_are_those_of_sizes_that_were_stated_and_known() -> None:
    path = Path(__file__).parents[2] / "benchmarks/results/size_errors/rows.json"
    table = json.loads(path.read_text())
    rows = pd.DataFrame(table["rows"], columns=table["columns"])

    def measure_rest(some: pd.DataFrame) -> float:
        return float(np.mean(some.log_ratio**2) - np.mean(some.own_error**2))

    assert np.sqrt(measure_rest(rows)) == pytest.approx(sizes.FORM_ERROR, abs=0.01)
    for effect, some in rows.groupby("effect"):
        share = len(some) / (len(some) + 3.0)
        own = max(measure_rest(some), 0.03**2)
        expected = np.sqrt(share * own + (1.0 - share) * sizes.FORM_ERROR**2)
        assert sizes.get_form_error(str(effect)) == pytest.approx(expected, abs=0.01), effect
