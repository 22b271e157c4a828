"""What is left is traced to what it depends on; probabilities and intervals are as wide as answers were wrong."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from actuators.open_loop import FreeRunWindows
from brokk_rl.contracts.actuator import Actuator
from brokk_rl.errors import ConfigError
from brokk_rl.extensions import load_part
from brokk_rl.machine import Machine
from diagnosis import calibration, decision, residual_model
from diagnosis.detection import DetectionResult
from diagnosis.effect_library import EffectSimulator
from diagnosis.error_covariance import ErrorCovariance
from diagnosis.refine import FittedSet
from diagnosis.request import Penalties, ProbabilityModel
from diagnosis.residuals import INCREMENT_SAMPLES, Residuals
from diagnosis.search import EffectSet


@pytest.fixture
def weights() -> ProbabilityModel:
    return load_part("certainty")


def moving(
    machine: Machine, random: np.random.Generator, windows: int = 60, steps: int = 20
) -> Residuals:
    """Returns a simulator's motion in levels, whose errors have a noise of 1."""
    full = machine.max_speed * machine.period_s * INCREMENT_SAMPLES
    way = (
        np.repeat(random.uniform(-0.4, 0.4, (windows, steps // 5, machine.num_joints)), 5, 1) * full
    )
    middle, travel = (machine.lower + machine.upper) / 2, machine.upper - machine.lower
    start = middle + random.uniform(-0.4, 0.4, (windows, machine.num_joints)) * travel
    cut = SimpleNamespace(
        run=np.repeat(["first", "second"], [windows // 2, windows - windows // 2])
    )
    simulator = SimpleNamespace(
        machine=machine, running_s=np.linspace(0.0, 1800.0, windows), cut=cut
    )
    white = {"whiten_joint": lambda columns, j: columns.reshape(-1, columns.shape[-1])}
    base = start[:, None] + np.cumsum(np.repeat(way, INCREMENT_SAMPLES, 1) / INCREMENT_SAMPLES, 1)
    return cast(
        Residuals,
        SimpleNamespace(
            increments=way, base=base, start=start, simulator=simulator, z=None, **white
        ),
    )


@pytest.mark.parametrize(
    ("clue", "error"),
    [
        ("its position", lambda m: m.own * m.sides[0] * np.maximum(0.0, m.place.mean(0) - 0.6)),
        (
            "the angle that the sensor reads",
            lambda m: np.diff(np.sin(6 * np.pi * m.place), axis=0)[0],
        ),
        ("the other joints", lambda m: np.maximum(m.share[..., 3], 0.0)),
        ("running time", lambda m: m.own * m.time[-1]),
        ("timing over the running time", lambda m: m.slip * m.time[0]),
        ("what it did before", lambda m: m.own * m.faded(np.minimum(m.work, 1.0), 0.94)),
        (residual_model.STARTS, lambda m: np.diff(m.own, axis=1, prepend=m.own[:, :1])),
        (
            residual_model.CURVE,
            lambda m: np.sign(m.own) * np.maximum(np.abs(m.share[..., m.j]) - 0.2, 0.0),
        ),
    ],
)
def test_what_is_left_is_traced_to_what_it_depends_on(
    machine: Machine, clue: str, error: residual_model.Callable
) -> None:
    random = np.random.default_rng(0)
    residuals = moving(machine, random)
    motion = residual_model.SimulatedMotion(residuals, 2)
    column, own = error(motion).ravel(), motion.own.ravel()
    # Another gain is form.
    column = column if clue in residual_model.FORMS else column - own * (own @ column) / (own @ own)
    z = random.standard_normal((machine.num_joints, column.size))
    z[2] += 0.5 * column / column.std()
    earned = residual_model.score_clues(residuals, z)
    best = list(residual_model.CLUES)[int(earned[:, 2].argmax())]
    assert best == clue and earned[:, 2].max() > 30.0
    assert np.delete(earned, 2, 1).max() < 6.0, "chance earns little on the other joints"


def test_work_is_remembered_from_window_to_window_of_a_recording_and_no_further(
    machine: Machine,
) -> None:
    # Two windows a recording.
    motion = residual_model.SimulatedMotion(moving(machine, np.random.default_rng(6), windows=4), 2)
    worked = np.zeros((4, 20))
    worked[0, 19] = 1.0
    found = motion.faded(worked, 0.5)
    # Half is new, and half of that is kept.
    np.testing.assert_allclose(found[1], 0.5 ** np.arange(1, 21), rtol=1e-12)
    assert not found[[0, 2, 3]].any()


def test_what_is_left_is_judged_by_the_motion_that_is_left(machine: Machine) -> None:
    # a dead band halves all speeds: errors of 5 % of what is left are 2.5 % of what was simulated
    # before
    random, noise = (
        np.random.default_rng(7),
        ErrorCovariance(sensor=1e-5, change=0.0, wander=0.05, memory=0.01),
    )
    windows, joints = 120, machine.num_joints
    way = (
        np.repeat(random.uniform(0.02, 0.05, (windows, 20, joints)), INCREMENT_SAMPLES, 1)
        / INCREMENT_SAMPLES
    )
    before, start = np.cumsum(way, 1), np.zeros((windows, joints))
    steady = np.repeat(0.05 * random.standard_normal((windows, 20, joints)), INCREMENT_SAMPLES, 1)
    measured = 0.5 * np.cumsum(way * (1.0 + steady), 1)
    q = np.concatenate([start[:, None], measured], 1)
    cut = FreeRunWindows(np.zeros((windows, 100, joints)), q, np.repeat("one", windows), 1, 1)
    simulator = EffectSimulator(cast(Actuator, None), machine, cut, np.zeros(windows), 0)
    residuals = Residuals(
        simulator, [noise] * joints, np.ones((windows, joints), dtype=bool), runs=before
    )
    none = np.zeros((0, joints))
    fitted = FittedSet(
        [], none.astype(bool), none, none[None], 0.5 * before, 0.5 * before, residuals.z, none
    )
    left = residual_model.apply_fitted_set(residuals, fitted)
    np.testing.assert_allclose(left.z.std(1), 1.0, atol=0.06)
    np.testing.assert_allclose(residual_model.measure_straying(left, left.error), 1.0, atol=0.25)
    assert residuals.whiten(left.error[None]).std() == pytest.approx(0.5, abs=0.03)
    assert residual_model.apply_fitted_set(residuals, None) is residuals


def test_free_runs_stray_as_far_as_their_noise_says() -> None:
    random, noise = (
        np.random.default_rng(1),
        ErrorCovariance(sensor=1e-3, change=0.03, wander=0.05, memory=12.0),
    )
    way = np.repeat(random.uniform(-0.05, 0.05, (1, 4)), 5, 1)
    root = np.linalg.cholesky(noise.covariance(way)[0])
    drawn = np.cumsum(random.standard_normal((20_000, way.shape[1])) @ root.T, 1)
    np.testing.assert_allclose(noise.strayed(way)[0], drawn.var(0), rtol=0.06)


def test_the_error_of_a_form_is_added_to_that_of_a_size() -> None:
    low, size, high = calibration.widen_interval(
        np.array([0.5 - 1.96 * 0.03, 0.5, 0.5 + 1.96 * 0.03]), 0.08
    )
    # 3, 4, 5
    assert (
        size == 0.5
        and high - size == pytest.approx(1.96 * 0.05)
        and size - low == pytest.approx(1.96 * 0.05)
    )


def found(subsets: tuple[str, ...], others: tuple[str, ...] = ()) -> DetectionResult:
    """Returns effects by joint, named by a letter each, and what sensors, frames and tool points show."""
    fields = {field.name: None for field in dataclasses.fields(DetectionResult)}
    chosen = EffectSet(tuple(frozenset(one) for one in subsets), 50.0)
    shown = [
        SimpleNamespace(kind=SimpleNamespace(name=name, stage="kinematics")) for name in others
    ]
    return DetectionResult(**cast(dict, {**fields, "chosen": chosen, "detected": shown}))


def test_what_was_named_only_beside_another_goes_with_it(
    monkeypatch: pytest.MonkeyPatch, weights: ProbabilityModel
) -> None:
    beside = {
        frozenset("abc"): {"a": 0.9, "b": 0.6, "c": 0.4},
        frozenset("ab"): {"a": 0.9, "b": 0.2},
        frozenset("de"): {"d": 0.45, "e": 0.4},
        frozenset("d"): {"d": 0.3},
    }
    monkeypatch.setattr(
        decision,
        "compute_effect_probabilities",
        lambda found, *_: beside.get(found.chosen.names, {"a": 0.9}),
    )

    def kept(subsets: tuple[str, ...]) -> tuple[set[str], ...]:
        return tuple(
            set(one)
            for one in decision.drop_unlikely_effects(
                found(subsets), cast(Penalties, None), weights
            ).chosen.subsets
        )

    assert kept(("ab", "c", "")) == ({"a"}, set(), set())
    assert kept(("de", "d")) == ({"d"}, {"d"}), "the most probable one stays"


def test_no_answer_is_surer_than_answers_can_tell(weights: ProbabilityModel) -> None:
    sure = calibration.collect_effect_signs(margin=1e6, adds=1.0, size=1.0, names=1, outside=-6.0)
    assert calibration.compute_probability({**weights.right, "margin": 5.0}, sure) == pytest.approx(
        1.0 / (1.0 + np.exp(-6.0))
    )


def test_a_missing_or_unknown_sign_is_named(weights: ProbabilityModel) -> None:
    with pytest.raises(ConfigError, match="expected a number for margin"):
        dataclasses.replace(weights, right={"constant": 0.0, "outside": 0.0})
    with pytest.raises(ConfigError, match="'margins' is no sign"):
        dataclasses.replace(weights, right={**weights.right, "margins": 0.0})


def test_the_form_of_an_effect_takes_the_place_of_that_of_its_stage(
    weights: ProbabilityModel,
) -> None:
    own = dataclasses.replace(weights, form_of_effect={"lag": 0.5})
    assert own.get_form_error("lag", "actuation") == 0.5
    assert own.get_form_error("dead_band", "actuation") == weights.form["actuation"]


def test_a_negative_form_is_refused_by_name(weights: ProbabilityModel) -> None:
    with pytest.raises(ConfigError, match=r"certainty.form_of_effect.lag: expected 0 or more"):
        dataclasses.replace(weights, form_of_effect={"lag": -0.1})
