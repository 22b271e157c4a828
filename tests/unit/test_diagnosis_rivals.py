"""Rivals: worked errors, machines that they can learn, and no window predicted by its own fit."""

from __future__ import annotations

import numpy as np

from actuators.open_loop import FreeRunWindows
from diagnosis import rivals
from diagnosis.rivals import assign_folds, measure_rivals

BEFORE, STEPS = 33, 100


def driven(windows: int, dead_band: float, seed: int = 0, noise: float = 1e-4) -> FreeRunWindows:
    """Returns windows of one joint that follows its command, beyond a dead band, nine samples later."""
    draw, length = np.random.default_rng(seed), BEFORE + STEPS
    u = np.repeat(draw.uniform(-1.0, 1.0, (windows, length // 19 + 1)), 19, 1)[:, : length - 1]
    beyond = np.sign(u) * np.maximum(np.abs(u) - dead_band, 0.0)
    step = 0.02 * np.pad(beyond, ((0, 0), (9, 0)))[:, : length - 1]
    q = np.cumsum(np.pad(step, ((0, 0), (1, 0))), 1)
    q = q + noise * draw.standard_normal(q.shape)
    run = np.zeros(windows)
    return FreeRunWindows(u[..., None], q[..., None], run, 13, BEFORE)


def rmse(squares: np.ndarray | None) -> float:
    return float(np.sqrt(squares.mean()))


def test_standing_still_errs_by_the_distance_from_the_start() -> None:
    q = np.zeros((2, BEFORE + STEPS, 1))
    q[:, BEFORE:, 0] = np.array([[0.3], [0.1]])  # one step aside, for good
    cut = FreeRunWindows(np.zeros((2, BEFORE + STEPS - 1, 1)), q, np.zeros(2), 13, BEFORE)
    found = measure_rivals(cut)["hold"]
    np.testing.assert_allclose(found, [[0.09], [0.01]])


def test_a_dead_band_is_learned_with_hinges() -> None:
    cut = driven(40, 0.3)
    found = measure_rivals(cut)
    assert rmse(found["arx"]) < 0.05 * rmse(found["hold"])


def test_no_window_is_predicted_by_a_fit_to_it() -> None:
    cut = driven(32, 0.2)
    changed = driven(32, 0.2)
    changed.q[5, BEFORE:] += np.linspace(0.0, 0.5, STEPS)[:, None]
    first, second = (rivals.run_arx(one) for one in (cut, changed))
    fold = assign_folds(32)
    same = fold == fold[5]
    # its own positions after the start do not matter to its fold; those of other folds change
    np.testing.assert_allclose(first[same], second[same], atol=2e-3)
    assert np.abs(first[~same] - second[~same]).max() > 1e-3


def test_one_window_leaves_none_to_fit() -> None:
    found = measure_rivals(driven(1, 0.0))
    assert found["hold"] is not None and found["arx"] is None
