"""Noise, sizes and sets of effects, against data that are made with known answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from actuators.models.valve import PoseFeatures
from brokk_rl.gravity import Gravity
from brokk_rl.machine import Machine
from diagnosis import effect_library, gap, nonadditive_refit
from diagnosis.error_covariance import ErrorCovariance, compute_loss, fit_noise, join_windows
from diagnosis.residuals import INCREMENT_SAMPLES, build_rays, to_increments
from diagnosis.responses import Response, choose_rays, fit_faults, fit_sizes, score_responses
from diagnosis.search import SubsetTable, bind_shared_sizes, choose_set


def motion(random: np.random.Generator, rows: int = 80, steps: int = 60) -> np.ndarray:
    """Returns increments of a joint that moves in levels, `(B, S)`."""
    return np.repeat(random.uniform(-0.05, 0.05, (rows, steps // 6)), 6, 1)


def test_errors_of_a_wandering_speed_are_white_after_division_by_their_noise() -> None:
    random, truth = (
        np.random.default_rng(0),
        ErrorCovariance(sensor=4e-4, change=0.04, wander=0.05, memory=15.0),
    )
    way = motion(random)
    error = np.stack(
        [np.linalg.cholesky(c) @ random.standard_normal(len(c)) for c in truth.covariance(way)]
    )
    z = (truth.whitener(way) @ error[..., None])[..., 0]
    assert z.std() == pytest.approx(1.0, abs=0.03)
    assert abs(np.corrcoef(z[:, :-1].ravel(), z[:, 1:].ravel())[0, 1]) < 0.05
    found = fit_noise(error, way)
    assert found.sensor == pytest.approx(truth.sensor, rel=0.2)
    assert found.wander == pytest.approx(truth.wander, rel=0.25)


def test_recordings_of_two_and_three_windows_are_joined_alike() -> None:
    two, three, four = (np.arange(20.0 * n).reshape(n, 20) for n in (2, 3, 4))
    np.testing.assert_array_equal(join_windows([two, three]), three.reshape(1, 60))
    np.testing.assert_array_equal(join_windows([three, four])[1], four[:3].ravel())
    np.testing.assert_array_equal(join_windows([two[:1], two])[0], two.ravel())


def test_what_a_coarse_reading_adds_to_one_increment_it_takes_from_the_next() -> None:
    random, truth = (
        np.random.default_rng(9),
        ErrorCovariance(sensor=1e-4, change=0.0, wander=0.0, memory=10.0, reading=2e-3),
    )
    error = np.diff(truth.reading * random.standard_normal((4000, 13)), axis=1)
    covariance = truth.covariance(np.zeros((1, 12)))[0]
    np.testing.assert_allclose(np.cov(error.T), covariance, atol=6e-7)
    # the position after a minute is no less sure than after a second
    np.testing.assert_allclose(
        truth.strayed(np.zeros((1, 12)))[0],
        2 * truth.reading**2 + 1e-8 * np.arange(1, 13),
        rtol=1e-9,
    )


def test_increments_add_up_to_the_way_since_the_start() -> None:
    random = np.random.default_rng(1)
    paths, start = random.standard_normal((2, 3, 20, 1)), random.standard_normal((3, 1))
    found = to_increments(paths, start)
    assert found.shape == (2, 3, 20 // INCREMENT_SAMPLES, 1)
    np.testing.assert_allclose(found.sum(2), paths[:, :, -1] - start, atol=1e-12)


def joint(
    z: np.ndarray, shapes: dict[str, list[Response]], faults: list[np.ndarray] | None = None
) -> SubsetTable:
    block = np.arange(len(z)) // 80
    return SubsetTable(fit_faults(z, faults or []), shapes, block)


def line(column: np.ndarray) -> Response:
    """An effect that grows in proportion."""
    sizes = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    return Response(sizes, sizes[:, None] * column)


def bend(column: np.ndarray) -> Response:
    """An effect that only begins half way."""
    sizes = np.array([0.0, 0.5, 1.0, 2.0])
    return Response(sizes, np.maximum(sizes - 0.5, 0.0)[:, None] * column)


def test_the_size_of_an_effect_is_found_though_it_does_not_grow_in_proportion() -> None:
    random = np.random.default_rng(2)
    column = 2.0 * random.standard_normal(800)
    z = 0.7 * column + random.standard_normal(800)  # size 1.2: (1.2 - 0.5) = 0.7
    assert fit_sizes(z, [bend(column)])[0] == pytest.approx(1.2, abs=0.06)


def test_what_an_effect_earns_is_its_bayes_factor() -> None:
    random = np.random.default_rng(3)
    column = 0.3 * random.standard_normal(400)
    for size in (0.0, 0.6):
        z = size * column + random.standard_normal(400)
        fine = np.linspace(-2.0, 2.0, 4001)
        likely = -compute_loss(z[:, None] - fine * column[:, None], 0) + compute_loss(z)
        # Over the prior of the size.
        whole = np.trapezoid(np.exp(likely - 0.5 * fine**2) / np.sqrt(2.0 * np.pi), fine)
        assert score_responses(fit_faults(z, []), [line(column)])[0].sum() == pytest.approx(
            np.log(whole), abs=0.25
        )


def test_an_effect_that_is_not_there_earns_less_than_nothing() -> None:
    random, gains = np.random.default_rng(3), []
    for _ in range(40):
        z, column = random.standard_normal(800), random.standard_normal(800)
        gains.append(score_responses(fit_faults(z, []), [line(column)])[0].sum())
    assert np.mean(gains) < -1.0 and np.max(gains) < 2.0


def test_what_begins_at_a_threshold_is_found_beside_another() -> None:
    random = np.random.default_rng(12)
    a, b = 2.0 * random.standard_normal((2, 800))
    # Size 0.66 of the second, 0.7 of which is below its threshold.
    z = 0.8 * a + 0.16 * 6.0 * b + random.standard_normal(800)
    table = joint(z, {"a": [line(a)], "b": [bend(6.0 * b)]})
    both, alone = (
        table.score(frozenset("ab")),
        [table.score(frozenset(name)).total for name in "ab"],
    )
    assert both.total > max(alone) + 50.0
    assert both.sizes["b"][0] == pytest.approx(0.66, abs=0.03) and both.sizes["a"][
        0
    ] == pytest.approx(0.8, abs=0.05)


def test_a_pair_is_found_of_which_neither_pays_alone() -> None:
    random = np.random.default_rng(4)
    a, b, c = random.standard_normal((3, 1600))
    b = a * 0.999 + b * np.sqrt(1 - 0.999**2)  # nearly the same: only their difference shows
    z = 12.0 * (a - b) + random.standard_normal(1600)
    shapes = {"a": [line(8.0 * a)], "b": [line(8.0 * b)], "c": [line(c)]}
    table = joint(z, shapes)
    table.explore(dict.fromkeys(shapes, 5.0), 3)
    chosen = choose_set([table], lambda j, subset: 5.0 * len(subset), 5.0, 0.03)
    assert table.score(frozenset("a")).total < 20.0 and table.score(frozenset("b")).total < 20.0
    assert chosen.names == {"a", "b"}


def test_a_fault_of_the_simulator_itself_is_no_evidence_for_an_effect_like_it() -> None:
    random = np.random.default_rng(5)
    column = random.standard_normal(1600)
    z = 0.25 * column + random.standard_normal(1600)
    free, excused = joint(z, {"a": [line(column)]}), joint(z, {"a": [line(column)]}, [0.1 * column])
    assert free.score(frozenset("a")).total > 30.0
    assert excused.score(frozenset("a")).total < 8.0


def test_two_joints_with_the_same_cause_get_one_name_where_another_would_hardly_earn_more() -> None:
    random = np.random.default_rng(6)
    columns = random.standard_normal((2, 1600))
    near = columns + 0.05 * random.standard_normal(columns.shape)
    z = columns + random.standard_normal(columns.shape)
    tables = []
    for j, (own, like) in enumerate(zip(columns, near, strict=True)):
        # On the second joint b is a little nearer to the truth.
        names = ("a", "b") if j == 0 else ("b", "a")
        tables.append(joint(z[j], {names[0]: [line(own)], names[1]: [line(like)]}))
        tables[-1].explore({"a": 5.0, "b": 5.0}, 3)
    chosen = choose_set(tables, lambda j, subset: 5.0 * len(subset), 2.0, 0.1)
    assert len(chosen.names) == 1 and all(chosen.subsets)


def test_an_effect_with_one_cause_for_all_joints_is_not_found_on_one_of_many() -> None:
    random = np.random.default_rng(7)
    columns = random.standard_normal((4, 800))
    z = random.standard_normal(columns.shape)
    z[0] += 0.35 * columns[0]
    tables = [joint(z[j], {"clock": [line(columns[j])]}) for j in range(4)]
    for table in tables:
        table.explore({"clock": 5.0}, 3)
    price = {"price": lambda j, subset: 5.0 * len(subset), "name_price": 5.0, "share": 0.03}
    assert choose_set(tables, **price).names == {"clock"}
    assert not choose_set(tables, **price, shared=frozenset({"clock"}), partial=30.0).names


def test_a_cause_that_all_joints_share_may_earn_little_on_each() -> None:
    random = np.random.default_rng(9)
    columns = random.standard_normal((5, 400))
    z = 0.25 * columns + random.standard_normal(columns.shape)
    tables = [joint(z[j], {"clock": [line(columns[j])]}) for j in range(5)]
    for table in tables:
        table.explore({"clock": 0.0}, 3)
    apart = choose_set(tables, lambda j, subset: 12.0 * len(subset), 12.0, 0.03, least=12.0)
    together = choose_set(
        tables,
        lambda j, subset: 0.0,
        12.0,
        0.03,
        shared=frozenset({"clock"}),
        partial=16.0,
        least=12.0,
    )
    assert len(frozenset().union(*apart.subsets)) == 0 or not all(apart.subsets)
    assert together.subsets == (frozenset({"clock"}),) * 5


def test_a_cause_that_all_joints_share_gets_the_size_that_most_of_them_have(
    machine: Machine,
) -> None:
    # The fourth joint has another effect too.
    random, sizes = (np.random.default_rng(10), (0.5, 0.55, 0.45, 2.0, 0.5))
    columns = random.standard_normal((5, 800))
    tables = [
        joint(size * x + random.standard_normal(800), {"clock_offset": [line(x)]})
        for size, x in zip(sizes, columns, strict=True)
    ]
    (kind,) = effect_library.load_effects(machine, ("clock_offset",))
    grown = {"clock_offset": build_rays(kind)}
    ways, shapes = bind_shared_sizes(
        frozenset(grown), tables, grown, [table.shapes for table in tables]
    )
    (way,) = ways["clock_offset"]
    assert way.is_tied and way.sizes[1] == pytest.approx(0.5, abs=0.1) and way.sizes[-1] < 0.8
    for mine, column in zip(shapes, columns, strict=True):
        np.testing.assert_allclose(
            mine["clock_offset"][0].at(float(way.sizes[1]))[0], way.sizes[1] * column, atol=1e-9
        )


def test_shares_of_effects_that_pay_only_together_are_equal_and_add_up() -> None:
    value = {frozenset(): 0.0, frozenset("a"): 0.0, frozenset("b"): 0.35, frozenset("ab"): 0.53}
    found = gap.compute_shapley(["a", "b"], lambda names: value[names])
    assert found["a"] == pytest.approx(0.09) and found["b"] == pytest.approx(0.44)
    assert sum(found.values()) == pytest.approx(0.53)


def test_the_weight_of_a_planar_arm_by_sums_of_angles_is_that_of_the_mechanics(
    machine: Machine,
) -> None:
    pose = PoseFeatures(machine, torch.device("cpu"))
    lower, upper = (
        torch.as_tensor(side, dtype=torch.float32) for side in (machine.lower, machine.upper)
    )
    q = lower + (upper - lower) * torch.rand(50, 5, generator=torch.Generator().manual_seed(9))
    force = torch.tensor([body.yield_force.value for body in machine.bodies])
    weight = Gravity(machine, torch.device("cpu")).load(q) / force
    torch.testing.assert_close(pose.features(q)[..., 0], weight.float(), atol=1e-3, rtol=1e-3)


def test_of_two_effects_that_are_alike_one_stays() -> None:
    random = np.random.default_rng(21)
    a = 2.0 * random.standard_normal(800)
    z = 1.0 * a + random.standard_normal(800)
    table = joint(
        z,
        {
            "a": [line(a)],
            "b": [line(a * 0.98 + 0.02 * random.standard_normal(800))],
            "c": [line(random.standard_normal(800))],
        },
    )
    kept = nonadditive_refit.drop_unneeded(
        [table], [frozenset("abc")], lambda j, subset: 4.0 * len(subset), 5.0
    )
    assert len(kept[0]) == 1 and kept[0] <= frozenset("ab")
    assert nonadditive_refit.drop_unneeded(
        [table], [frozenset("c")], lambda j, subset: 4.0 * len(subset), 5.0
    ) == (frozenset(),)


def test_an_effect_that_rings_is_simulated_at_sizes_so_close_that_those_between_are_in_step(
    machine: Machine,
) -> None:
    kind = next(kind for kind in effect_library.load_effects(machine) if kind.name == "compliance")
    number, t_s = kind.numbers["ringing_s"], np.arange(0.0, 1.5, machine.period_s)

    def ringing(sizes: np.ndarray) -> np.ndarray:
        w = 2.0 * np.pi / (number.typical * sizes[:, None])
        return np.exp(-0.12 * w * t_s) * np.sin(w * t_s)

    def in_step(sizes: np.ndarray) -> float:
        # What is shorter than four samples cannot be seen to ring.
        between = np.sqrt(sizes[1:] * sizes[:-1])
        seen = number.typical * between > 4 * machine.period_s
        told = (ringing(sizes)[1:] + ringing(sizes)[:-1]) / 2.0
        return min(
            np.corrcoef(a, b)[0, 1] for a, b in zip(told[seen], ringing(between)[seen], strict=True)
        )

    (found,), (coarse,) = choose_rays(kind), build_rays(kind)
    assert in_step(found.sizes[found.sizes > 0.0]) > 0.95
    assert in_step(coarse.sizes[coarse.sizes > 0.0]) < 0.8
