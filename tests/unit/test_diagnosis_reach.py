"""Units of errors, parts of effects, and large effects fitted together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from composed import option

from actuators.effects.command import DeadBand, Saturation
from actuators.effects.composition import ActuatorWithEffects
from actuators.models.lag import FirstOrderLag
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis import baseline, bootstrap, effect_library, gap, refine
from diagnosis.case import GapCase
from diagnosis.error_covariance import ErrorCovariance
from diagnosis.residuals import build_rays

CPU = torch.device("cpu")
LINEAR = FirstOrderLag(
    dead_time_s=0.0,
    dead_band_extend=0.0,
    dead_band_retract=0.0,
    gain=1.0,
    time_constant_s=0.0,
    spread={},
)


def test_errors_in_metres_and_radians_are_taken_over_the_travel(machine: Machine) -> None:
    slide = replace(machine.joints[0], kind="slide", lower=replace(machine.joints[0].lower, value=0.0),
                    upper=replace(machine.joints[0].upper, value=0.1), home=0.05)  # fmt: skip
    hinge = replace(machine.joints[1], lower=replace(machine.joints[1].lower, value=-1.0),
                    upper=replace(machine.joints[1].upper, value=1.0), home=0.0)  # fmt: skip
    mixed = replace(machine, mjcf=None, tool_m=None, joints=(slide, hinge), exclusive=(), levers=())
    paths = np.zeros((1, 2, 2))
    paths[..., 0], paths[..., 1] = 0.01, 0.2  # a tenth of the travel each
    assert gap.choose_unit(mixed) == "travel" and gap.choose_unit(machine) == "rad"
    squares = gap.compute_joint_squares(paths, np.zeros((1, 2, 2)))
    assert gap.combine_joints(squares, mixed)[0] == pytest.approx(0.1)


def test_the_part_of_an_effect_has_an_interval() -> None:
    value = {frozenset(): np.zeros(3), frozenset("a"): np.array([0.5, 0.4, 0.6]), frozenset("b"): np.array([0.2, 0.1, 0.3]),
             frozenset("ab"): np.array([0.9, 0.8, 1.0])}  # fmt: skip
    found = {
        name: bootstrap.summarise_draws(values)
        for name, values in gap.compute_shapley(["a", "b"], lambda some: value[some]).items()
    }
    # (0.5 + 0.7) / 2, (0.2 + 0.4) / 2.
    assert found["a"].mean == pytest.approx(0.6) and found["b"].mean == pytest.approx(0.3)
    assert found["a"].ci95[0] < 0.6 < found["a"].ci95[1]


@pytest.fixture(scope="module")
def axis(machine: Machine) -> Machine:
    joint = replace(machine.joints[2], body=None)
    return replace(
        machine, name="axis", mjcf=None, tool_m=None, joints=(joint,), exclusive=(), levers=()
    )


def driven(machine: Machine, seed: int, dead_band: float = 0.35, gentle: bool = False) -> Recording:
    """Returns two minutes of an axis with a dead band and a saturation at 0.7 under random levels.

    `gentle`: these are beyond 0.6 only in the middle of every other 20 s.
    """
    effects = {
        "dead_band": DeadBand(joints="all", extend=dead_band, retract=dead_band),
        "saturation": Saturation(joints="all", level=0.7),
    }
    model, random = (
        ActuatorWithEffects(actuator=LINEAR, effects=effects).build(machine, 1, CPU),
        np.random.default_rng(seed),
    )
    history = History(
        q=torch.zeros(1, machine.num_history, 1), u=torch.zeros(1, machine.num_history, 1)
    )
    history.reset(
        torch.ones(1, dtype=torch.bool), torch.as_tensor(machine.home, dtype=torch.float32)[None]
    )
    u, q, level, left = [], [], 0.0, 0
    for k in range(round(120 / machine.period_s)):
        if left == 0:
            most = 0.6 if gentle and not 26.0 < k * machine.period_s % 40.0 < 36.0 else 1.0
            level, left = random.uniform(-most, most), int(random.integers(10, 50))
        here = float(history.q[0, -1, 0])
        level = (
            -abs(level)
            if here > machine.upper[0] - 0.3
            else abs(level)
            if here < machine.lower[0] + 0.3
            else level
        )
        left -= 1
        u.append(level)
        q.append(here + 2e-4 * random.standard_normal())
        history.push_u(torch.full((1, 1), level))
        before = history.q[:, -1].clone()
        history.push_q(
            before + (model.step(history) - before) * (1.0 + 0.01 * random.standard_normal())
        )
    return Recording(
        machine=machine.name, joints=machine.joint_names, units=("rad",), rate_hz=20.0, t_s=np.arange(len(u)) * 0.05,
        u=np.array(u, np.float32)[:, None], q=np.array(q, np.float32)[:, None], metadata={"run": str(seed)},
    )  # fmt: skip


def test_a_dead_band_and_a_saturation_far_beyond_the_typical_are_fitted_together(
    axis: Machine, tmp_path: Path
) -> None:
    case = GapCase(axis, [], [driven(axis, seed) for seed in (1, 2)])
    base = baseline.accept_simulator(case, LINEAR, option("fit", "valve"), tmp_path, 0, CPU)
    assert base.is_flexible and base.left_out  # the floor is that of a flexible model
    residuals = base.field.residuals
    ways = {
        kind.name: build_rays(kind)
        for kind in effect_library.load_effects(axis, ["dead_band", "saturation"])
    }
    all_rays = [ray for name in sorted(ways) for ray in ways[name]]
    # A dead band of 0.15, as a search that adds effects up would begin with.
    known = np.array([[2.5], [2.5], [0.0]])
    sizes = refine.search_sizes(
        residuals, all_rays, np.ones((3, 1), bool), known, np.random.default_rng(0)
    )
    start = [{"dead_band": sizes[:2, 0], "saturation": sizes[2:, 0]}]
    found = refine.fit_set(residuals, [frozenset(ways)], ways, start)
    extend, retract, saturation = found.sizes[:, 0] * [0.06, 0.06, -0.25] + [0.0, 0.0, 1.0]
    assert extend == pytest.approx(0.35, abs=0.02) and retract == pytest.approx(0.35, abs=0.02)
    assert saturation == pytest.approx(0.7, abs=0.03)
    measured = residuals.simulator.cut.measured
    assert np.std(found.after - measured) < 0.15 * np.std(residuals.base - measured)


def test_a_half_of_the_recordings_that_says_nothing_of_a_size_does_not_deny_it(
    axis: Machine,
) -> None:
    held = baseline.compare_simulator(LINEAR, [(driven(axis, 3, 0.0, gentle=True), 0.0)], axis, 0)
    residuals = replace(
        held.residuals, noise=[ErrorCovariance(sensor=4e-4, change=0.01, wander=0.01, memory=10.0)]
    )
    told = [float(np.square(residuals.z[:, residuals.fold == half]).mean()) for half in (0, 1)]
    assert 10.0 * min(told) < max(told)  # the saturation shows in one half only
    ways = {
        kind.name: build_rays(kind) for kind in effect_library.load_effects(axis, ["saturation"])
    }
    found = refine.fit_set(residuals, [frozenset(ways)], ways, [{"saturation": np.array([1.0])}])
    np.testing.assert_allclose(found.halves[:, 0, 0], (1.0 - 0.7) / 0.25, atol=0.1)
    assert np.square(found.z).mean() < 0.2 * np.square(residuals.z).mean()
