"""Speed curves of a plant that is known: what was put in is read off, with its interval."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from axis import PLANT, driven, make_axis
from composed import option

from actuators.effects.command import DeadBand, Saturation
from actuators.effects.speed import Asymmetry, FlowGain, Lag
from brokk_rl.contracts.actuator import Effect
from brokk_rl.extensions import load_part
from brokk_rl.machine import Dimension, Machine
from diagnosis import effect_library
from diagnosis.baseline import compare_simulator, fit_covariances
from diagnosis.refine import build_held_set, drop_effects, list_subsets
from diagnosis.residuals import Residuals
from diagnosis.responses import choose_rays
from diagnosis.shown_effects import compute_sizes, keep_shown_numbers, propose_effects
from diagnosis.speed_curves import SpeedCurves, change_curve, measure_curves, serialize_curves

LAG = Lag(joints="all", time_constant_s=0.3)


@pytest.fixture(scope="module")
def axis(machine: Machine) -> Machine:
    return make_axis(machine)


def measured(axis: Machine, effects: dict[str, Effect]) -> SpeedCurves:
    """Returns the curves of the plant with effects beside those of the plant as it was."""
    recordings = driven(axis, effects, 3, 120.0, 5)
    field = compare_simulator(PLANT, [(one, 0.0) for one in recordings], axis, 0)
    return measure_curves(field, [], axis, load_part("curve_fit"), np.random.default_rng(0))


@pytest.fixture(scope="module")
def unchanged(axis: Machine) -> SpeedCurves:
    return measured(axis, {})


def test_a_curve_is_cut_shifted_and_scaled_in_this_order() -> None:
    knots = np.linspace(0.0, 1.0, 11)
    straight = np.concatenate([knots[1:], 0.5 * knots[1:]])
    changed = change_curve(straight, knots, np.array([0.2, 0.0, 0.8, 2.0, 1.0]))
    extend, retract = changed[:10], changed[10:]
    assert extend[1] == 0.0, "a command of 0.2 opens nothing"
    assert extend[4] == pytest.approx(2.0 * (0.5 - 0.2) / 0.8)
    assert extend[9] == extend[7] == pytest.approx(2.0 * (0.8 - 0.2) / 0.8)
    assert retract[3] == pytest.approx(0.2) and retract[9] == pytest.approx(0.4)


def test_dead_band_saturation_and_gains_are_read_off_with_their_intervals(axis: Machine) -> None:
    put: dict[str, Effect] = {
        "dead_band": DeadBand(joints="all", extend=0.3, retract=0.15),
        "saturation": Saturation(joints="all", level=0.7),
        "asymmetry": Asymmetry(joints="all", extend_gain=1.6, retract_gain=1.2),
    }
    one = measured(axis, put).joints["q3"]
    found = one.estimates()
    truth = {
        "dead_band_extend": 0.3,
        "dead_band_retract": 0.15,
        "saturation": 0.7,
        "extend_gain": 1.6,
        "retract_gain": 1.2,
    }
    for name, value in truth.items():
        estimate = found[name]
        assert estimate is not None, name
        assert estimate.mean == pytest.approx(value, rel=0.1), name
        low, high = estimate.ci95
        assert low - 0.02 < value < high + 0.02 and high - low < 0.5 * value, name


def _far(value_rad: float) -> Dimension:
    return Dimension(value=value_rad, source="of this test", confidence="high")


@pytest.fixture(scope="module")
def wide(axis: Machine) -> Machine:
    """The axis with travel for minutes of motion one way."""
    joint = dataclasses.replace(axis.joints[0], lower=_far(-200.0), upper=_far(200.0))
    return dataclasses.replace(axis, joints=(joint,))


@pytest.mark.parametrize("returns_s", [0.0, 25.0])
def test_a_side_that_is_hardly_commanded_shows_no_effect(wide: Machine, returns_s: float) -> None:
    """Nothing holds the curve of such a side, in the sample or in the draws that lack its only block."""
    put: dict[str, Effect] = {"dead_band": DeadBand(joints="all", extend=0.3, retract=0.3)}
    recordings = driven(wide, put, 3, 120.0, 5, least=0.0)
    if returns_s:
        recordings += driven(wide, put, 1, returns_s, 6)
    field = compare_simulator(PLANT, [(one, 0.0) for one in recordings], wide, 0)
    curves = measure_curves(field, [], wide, load_part("curve_fit"), np.random.default_rng(0))
    found = curves.joints["q3"].estimates()
    assert found["dead_band_retract"] is None and found["retract_gain"] is None
    extend = found["dead_band_extend"]
    assert extend is not None and extend.mean == pytest.approx(0.3, abs=0.03)
    (shown,) = propose_effects(curves, effect_library.load_effects(wide), wide)
    assert shown["dead_band"]["retract"] == 0.0


def test_a_curve_that_did_not_change_shows_no_effect(axis: Machine, unchanged: SpeedCurves) -> None:
    assert propose_effects(unchanged, effect_library.load_effects(axis), axis) == [{}]


def test_equal_gains_are_one_effect_and_a_lag_is_another(axis: Machine) -> None:
    kinds = effect_library.load_effects(axis)
    curves = measured(axis, {"flow_gain": FlowGain(joints="all", gain=0.7), "lag": LAG})
    (found,) = propose_effects(curves, kinds, axis)
    assert {"flow_gain", "lag"} <= set(found) <= {"flow_gain", "lag", "dead_time"}
    assert found["flow_gain"]["gain"] == pytest.approx(0.7, abs=0.03)
    # Two lags in series begin like a short delay: their sum is told, not each.
    later_s = found.get("dead_time", {"dead_time_s": 0.0})["dead_time_s"]
    assert found["lag"]["time_constant_s"] + later_s == pytest.approx(0.3, abs=0.03)
    (fewer,) = propose_effects(curves, [kind for kind in kinds if kind.name != "lag"], axis)
    assert "lag" not in fewer, "an effect that is not in the library is not proposed"


def test_numbers_become_sizes_along_the_rays_of_an_effect(axis: Machine) -> None:
    kinds = {kind.name: kind for kind in effect_library.load_effects(axis)}
    rays = choose_rays(kinds["dead_band"])
    sizes = dict(
        zip(
            (ray.name for ray in rays),
            compute_sizes(rays, {"extend": 0.12, "retract": 0.0}, 0),
            strict=True,
        )
    )
    assert sizes == {
        "extend": pytest.approx(0.12 / kinds["dead_band"].size_on("extend", 0)),
        "retract": 0.0,
    }


def test_curves_are_written_as_plain_numbers(unchanged: SpeedCurves) -> None:
    found = serialize_curves(unchanged)
    one = found["joints"]["q3"]
    speed, low, high = (np.array(one["measured"]["extend"][k]) for k in ("speed", "low", "high"))
    assert len(found["knots"]) == len(speed) and (low <= speed).all() and (speed <= high).all()
    # the plant's own dead band of 0.07 and gain of 0.9
    assert speed[-1] == pytest.approx(0.9, abs=0.05) and speed[1] == pytest.approx(0.0, abs=0.02)


@pytest.fixture(scope="module")
def banded(axis: Machine) -> Residuals:
    """The plant's simulator against the plant with a dead band, its noise fitted."""
    put: dict[str, Effect] = {"dead_band": DeadBand(joints="all", extend=0.3, retract=0.3)}
    recordings = driven(axis, put, 2, 60.0, 5)
    field = compare_simulator(PLANT, [(one, 0.0) for one in recordings], axis, 0)
    return dataclasses.replace(field.residuals, noise=fit_covariances([field], axis))


def test_numbers_of_a_curve_stand_where_they_leave_less_error(
    axis: Machine, banded: Residuals
) -> None:
    (kind,) = effect_library.load_effects(axis, ["dead_band"])
    rays, shapes = {"dead_band": choose_rays(kind)}, [{"dead_band": []}]
    right = [{"dead_band": {"extend": 0.3, "retract": 0.3}}]
    kept = keep_shown_numbers(banded, right, rays, shapes, None)
    assert kept is not None and kept.held == {0} and list_subsets(kept) == ({"dead_band"},)
    size = 0.3 / kind.size_on("extend", 0)
    assert kept.sizes[:, 0] == pytest.approx([size, size]), "nothing is fitted"
    measured = banded.simulator.cut.measured
    left = [np.sqrt(np.mean(np.square(one - measured))) for one in (kept.after, banded.base)]
    assert left[0] < 0.3 * left[1]
    # the set that holds them already is not improved, and wrong numbers improve nothing
    assert keep_shown_numbers(banded, right, rays, shapes, kept) is None
    wrong = [{"dead_band": {"extend": 0.85, "retract": 0.85}}]
    assert keep_shown_numbers(banded, wrong, rays, shapes, kept) is None


def test_held_joints_keep_their_sizes_when_an_effect_goes(axis: Machine, banded: Residuals) -> None:
    kinds = {one.name: one for one in effect_library.load_effects(axis, ["dead_band", "lag"])}
    rays = {name: choose_rays(kind) for name, kind in kinds.items()}
    sizes = [{"dead_band": np.array([1.0, 2.0]), "lag": np.array([0.5])}]
    fitted = build_held_set(banded, rays, sizes, None, frozenset({0}))
    kept = drop_effects(banded, rays, fitted, [frozenset({"dead_band"})])
    assert kept.sizes[:, 0] == pytest.approx([1.0, 2.0]) and kept.held == {0}
    free = drop_effects(
        banded, rays, dataclasses.replace(fitted, held=frozenset()), [frozenset({"dead_band"})]
    )
    assert np.abs(free.sizes[:, 0] - [1.0, 2.0]).max() > 0.5, "else sizes are fitted anew"


def test_a_simulator_without_numbers_of_its_own_is_wrong_in_its_speeds_only(
    axis: Machine, banded: Residuals
) -> None:
    """`faults` of a servo that follows at once: the speed of either side."""
    simulator = dataclasses.replace(banded.simulator, base=option("actuator", "ideal"))
    plain = dataclasses.replace(banded, simulator=simulator)
    assert plain.faults.shape == (1, 2, plain.z.shape[1])
