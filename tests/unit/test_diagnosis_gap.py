"""The gap against the floor under the field's own motion: worked numbers, and intervals that are real ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gaps import reach

from brokk_rl.machine import Machine
from diagnosis import attribution, bootstrap, motion_floor
from diagnosis.attribution import EffectAttribution, judge_edit
from diagnosis.closure import Estimate, Gap, read_gap, serialize_estimate
from diagnosis.error_covariance import ErrorCovariance
from diagnosis.gap import NO_FLOOR, NO_MOTION
from diagnosis.motion_floor import LeftOutErrors


def test_what_is_closed_and_what_was_foretold_are_told_apart(machine: Machine) -> None:
    seen = reach(machine, before=0.030, after=0.012, own=0.009, floor=0.002)
    found, foretold = seen.gap(), seen.foretold()
    assert found.closed and foretold
    # the noise expects the same in field and reference, so that the floor is the error there
    assert found.floor == pytest.approx(0.002)
    assert found.closed.mean == pytest.approx(18 / 28) and foretold.mean == pytest.approx(21 / 28)
    assert found.joints["q3"].closed == pytest.approx(18 / 28)
    assert found.joints["q3"].share == pytest.approx(0.6)
    assert found.reduced and found.reduced.mean == pytest.approx(0.6)
    assert seen.beyond() == list(machine.joint_names)  # 12 is far beyond 2
    assert reach(machine, 0.030, 0.0022, 0.0022, 0.002).beyond() == []


def test_intervals_cover_windows_of_field_and_reference(machine: Machine) -> None:
    found = reach(machine, 0.030, 0.012, 0.009, 0.010, scatter=0.3).gap(named=True)
    assert found.closed and found.reduced
    low, high = found.closed.ci95
    assert low < found.closed.mean < high and high - low > 0.02
    # error before and after scatter together: the reduction is the same in each window
    assert found.reduced.ci95 == pytest.approx((0.6, 0.6)) and not found.reduced.has_interval


def test_one_window_has_no_interval(machine: Machine) -> None:
    found = reach(machine, 0.030, 0.012, 0.009, 0.002, scatter=0.3, windows=1).gap(named=True)
    assert found.closed and not found.closed.has_interval
    assert serialize_estimate(found.closed)["ci95"] is None


def test_the_floor_grows_with_the_motion_of_the_field() -> None:
    wander = ErrorCovariance(sensor=1e-9, change=0.0, wander=0.1, memory=1e9)
    tame, fast = (np.full((3, 4, 1), size) for size in (0.01, 0.04))
    # a gain that is off by a tenth for good: positions 0.1 times the way, 1, 2, 3, 4 increments
    expected = 0.01 * 0.01**2 * (1 + 4 + 9 + 16) / 4
    assert motion_floor.expect_squares([wander], tame)[:, 0] == pytest.approx(expected)
    known = LeftOutErrors(
        np.full((8, 1), 2.0 * expected), np.full((8, 1), expected), np.ones((8, 1))
    )
    weights = np.full((1, 3), 1 / 3)
    draws = motion_floor.draw_floor(known, [wander], fast, weights, np.random.default_rng(0))
    assert draws[0, 0] == pytest.approx(2.0 * 16.0 * expected)


def test_a_window_that_fails_does_not_decide_the_floor() -> None:
    actual = np.array([[1.0], [1.0], [1.0], [1000.0]])
    known = LeftOutErrors(actual, np.ones((4, 1)), np.ones((4, 1)))
    assert known.draw_ratios(np.full((1, 4), 0.25))[0, 0] == pytest.approx((3 + 9) / 4)


def test_no_share_is_told_only_with_a_reason(machine: Machine) -> None:
    below = reach(machine, 0.010, 0.009, 0.009, 0.012).gap(named=True)
    assert below.closed is None and "0.01" in below.closed_reason and "0.012" in below.closed_reason
    assert below.reduced and below.reduced.mean == pytest.approx(0.1)
    above = reach(machine, 0.0123, 0.012, 0.012, 0.012).gap(named=True)
    assert above.closed and not above.closed_reason  # 2.5 % above the floor is a gap
    same = reach(machine, 0.030, 0.030, 0.030, 0.002)
    assert same.gap(named=True).closed is None and same.gap(named=True).closed_reason == NO_MOTION
    nothing = same.gap(named=False).closed
    assert nothing and nothing.mean == 0.0 and not nothing.has_interval
    bare = reach(machine, 0.030, 0.012, 0.009, 0.002)
    bare.base.left_out = []  # pyright: ignore[reportAttributeAccessIssue]
    assert bare.gap(named=True).closed is None and bare.gap(named=True).closed_reason == NO_FLOOR


def test_a_flexible_model_of_the_field_is_the_floor_itself(machine: Machine) -> None:
    seen = reach(machine, 0.030, 0.012, 0.009, 0.005)
    seen.base.is_flexible = True  # pyright: ignore[reportAttributeAccessIssue]
    seen.base.left_out[0].residuals.increments = np.ones((40, 2, 5))  # pyright: ignore[reportAttributeAccessIssue]
    assert seen.gap().floor == pytest.approx(0.005) and seen.gap().floor_of == "flexible model"


def test_the_error_over_the_reference_is_kept_apart(machine: Machine) -> None:
    found = reach(machine, 0.030, 0.012, 0.009, 0.002).measure_reference()
    assert found and found["rmse_rad"] == pytest.approx(0.002)
    assert found["joints"]["q1"] == pytest.approx(0.002)


@pytest.mark.parametrize("num_windows", [2, 5, 16, 50])
def test_draws_use_every_window_alike(num_windows: int) -> None:
    weights = bootstrap.draw_weights(num_windows, np.random.default_rng(0))
    assert weights.shape == (1 + bootstrap.NUM_DRAWS, num_windows)
    np.testing.assert_allclose(weights.sum(1), 1.0)
    np.testing.assert_allclose(weights[0], 1.0 / num_windows)
    assert weights[1:].std(0).min() > 0
    np.testing.assert_allclose(weights[1:].mean(0), 1.0 / num_windows, rtol=0.15)
    if num_windows == 50:  # blocks of four: neighbours are drawn together
        pairs = np.corrcoef(weights[1:].T)
        assert pairs[10, 11] > 0.5 > abs(pairs[10, 20])


def test_a_gap_is_read_as_it_was_written() -> None:
    found = Gap(
        0.03, 0.01, 0.005, Estimate(0.8, (0.7, 0.9)), reduced=Estimate(0.67, (0.6, 0.7)),
        closed_reason="",
    )  # fmt: skip
    assert read_gap(found.to_json()) == found
    early = {key: value for key, value in found.to_json().items() if key not in ("reduced", "closed_reason")}  # fmt: skip
    again = read_gap(early)
    assert again.reduction.mean == pytest.approx(2 / 3) and not again.reduction.has_interval
    told = replace(found, closed=None, closed_reason="no floor")
    assert read_gap(told.to_json()) == told
    assert serialize_estimate(Estimate(1.0, (0.5, 1.5), at_bound=True))["at_bound"] is True


def test_an_edit_identifies_an_effect_that_nothing_replaces() -> None:
    part = Estimate(0.4, (0.3, 0.5))
    assert judge_edit(part, Estimate(0.4, (0.3, 0.5))) == (pytest.approx(1.0), True)
    assert judge_edit(part, Estimate(0.2, (0.1, 0.3))) == (pytest.approx(0.5), True)
    assert not judge_edit(part, Estimate(0.19, (0.1, 0.3)))[1]  # another effect replaces it
    assert not judge_edit(part, Estimate(0.4, (-0.01, 0.9)))[1]  # by chance
    assert not judge_edit(part, Estimate(0.4, (0.4, 0.4)))[1]  # no interval
    assert judge_edit(Estimate(-0.1, (-0.2, 0.0)), Estimate(0.1, (0.05, 0.2))) == (0.0, False)


@dataclass(frozen=True, eq=False)
class Parts(EffectAttribution):
    """Two chosen effects beside a detected one, each with free runs of a known error."""

    runs: Callable[[frozenset[str]], np.ndarray]

    @property
    def detected(self) -> list[str]:
        return ["scale"]

    def _run_detected(self, names: frozenset[str]) -> np.ndarray:
        return self.runs(names)

    def _run_chosen(self, names: frozenset[str]) -> np.ndarray:
        return self.runs(names | {"scale"})

    def _run_without(self, name: str) -> np.ndarray:
        return self.runs(frozenset({"scale", "lag", "play"}) - {name})


def test_parts_add_up_to_what_all_effects_close(machine: Machine) -> None:
    seen = reach(machine, before=0.030, after=0.012, own=0.009, floor=0.002, scatter=0.2)
    error = {"": 0.030, "scale": 0.027, "lag,scale": 0.020, "play,scale": 0.026, "lag,play,scale": 0.012,
             "lag,play": 0.015}  # fmt: skip
    unit = seen.after / 0.012
    chosen: Any = SimpleNamespace(chosen=SimpleNamespace(names=frozenset({"lag", "play"})))
    parts = Parts(chosen, seen, lambda some: error[",".join(sorted(some))] * unit).measure_parts()
    closed = seen.gap(named=True).closed
    assert closed is not None
    told = {name: part.closed.mean for name, part in parts.items() if part.closed}
    assert sum(told.values()) == pytest.approx(closed.mean)
    assert sum(part.reduced.mean for part in parts.values()) == pytest.approx(0.6)
    # of lag: (27 - 20 + 26 - 12) / 2 = 10.5; of play: (27 - 26 + 20 - 12) / 2 = 4.5; of scale: 3
    assert parts["lag"].reduced.mean == pytest.approx(10.5 / 30)
    assert parts["play"].reduced.mean == pytest.approx(4.5 / 30)
    assert parts["scale"].reduced.mean == pytest.approx(3 / 30)
    # without lag the error is that of play: 26, 14 more than 12
    assert parts["lag"].rise.mean == pytest.approx(14 / 30)
    assert parts["lag"].restored == pytest.approx(14 / 10.5)
    assert parts["scale"].rise.mean == pytest.approx(3 / 30)
    for part in parts.values():
        assert part.closed is not None and part.closed.has_interval


def test_the_least_share_of_an_edit_is_a_half() -> None:
    assert attribution.MIN_RESTORED == 0.5
