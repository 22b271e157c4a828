"""Errors of simple rivals on the windows of the gap: standing still, and an ARX with hinges.

The ARX is cross-validated: no window is predicted by a model that was fitted to it. It gets the
recorded commands and its own predictions, as the simulator does.
Axes: `W` windows, `K` steps, `J` joints, `L` samples before the free run, `F` features.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from actuators.open_loop import FreeRunWindows
from diagnosis.free_runs import BLOCK_WINDOWS

# Chosen by hand; not searched.
FOLDS = 4
"""Cross-validation folds; blocks of windows take turns."""
HINGES = (0.15, 0.3, 0.5)
"""Commands from which a hinge rises: dead bands of valves lie between."""
MAX_LAGS = 26
"""Commands before a step that it depends on: twice the history of a policy at 20 Hz."""
MAX_PAST = 13
"""Increments before a step that it depends on."""
RIDGES = (1e-3, 3e-2, 1.0)
"""Pulls towards 0, for features of unit size, over the number of steps."""
MAX_SPEED_RATIO = 1.2
"""A step is no larger than so many times the largest measured one: a fit may be unstable."""


def measure_rivals(cut: FreeRunWindows) -> dict[str, np.ndarray | None]:
    """Return mean square errors `(W, J)` of `hold` and `arx` on windows; `None` where too few windows can be left out."""
    start = cut.q[:, cut.num_before - 1]
    arx = None
    if len(cut.q) > 1:
        arx = np.square(run_arx(cut) - cut.measured).mean(1)
    return {"hold": np.square(start[:, None] - cut.measured).mean(1), "arx": arx}


def assign_folds(num_windows: int) -> np.ndarray:
    """Return the fold of each window, `(W,)`: blocks of neighbours in turns; single windows where there are few."""
    size = max(1, min(BLOCK_WINDOWS, num_windows // FOLDS))
    return np.arange(num_windows) // size % min(FOLDS, num_windows)


def run_arx(cut: FreeRunWindows) -> np.ndarray:
    """Return free runs `(W, K, J)` of a ridge regression of steps on commands, their hinges and earlier steps.

    Each fold is predicted by a fit to the others. The pull of a fold is the one that predicts the other folds best.
    """
    fold = assign_folds(len(cut.q))
    folds = np.unique(fold)

    def run(j: int) -> np.ndarray:
        model, found = _ArxJoint.build(cut, j), np.empty(cut.measured.shape[:2])
        trials = np.empty((len(RIDGES), *cut.measured.shape[:2]))
        for out in folds:
            for number, beta in enumerate(model.fit(fold != out)):
                trials[number][fold == out] = model.run(beta, fold == out, fold != out)
        errors = np.square(trials - cut.measured[..., j]).mean(2)
        for out in folds:
            best = errors[:, fold != out].mean(1).argmin()
            found[fold == out] = trials[best][fold == out]
        return found

    return np.stack([run(j) for j in range(cut.q.shape[2])], -1)


@dataclass(frozen=True, eq=False)
class _ArxJoint:
    """Regression data of one joint.

    Attributes:
        driven: Features of the commands, `(W, K, F)`, of unit size.
        past: Steps before each step, `(W, K, P)`.
        steps: Measured steps, `(W, K)`.
        before: Steps before the free run, newest first, `(W, P)`.
        start: Position at its begin, `(W,)`.
    """

    driven: np.ndarray
    past: np.ndarray
    steps: np.ndarray
    before: np.ndarray
    start: np.ndarray
    scale: float = field(default=1.0)

    @classmethod
    def build(cls, cut: FreeRunWindows, j: int) -> _ArxJoint:
        first, count = cut.num_before, cut.measured.shape[1]
        lags, order = min(MAX_LAGS, first), min(MAX_PAST, first - 1)
        shaped = _shape_commands(cut.u[..., j].astype(float))
        driven = []
        for lag in range(1, lags + 1):
            driven.append(shaped[:, first - lag : first - lag + count])
        driven.append(np.ones((len(cut.q), count, 1)))
        columns = np.concatenate(driven, -1)
        columns = columns / np.maximum(np.sqrt(np.square(columns).mean((0, 1))), 1e-9)
        moved = np.diff(cut.q[..., j].astype(float), axis=1)  # moved[t - 1] leads to sample t
        scale = max(float(np.sqrt(np.square(moved).mean())), 1e-12)
        past = []
        for lag in range(1, order + 1):
            past.append(moved[:, first - 1 - lag : first - 1 - lag + count])
        return cls(
            columns,
            np.stack(past, -1) / scale,
            moved[:, first - 1 :] / scale,
            moved[:, first - 1 - order : first - 1][:, ::-1] / scale,
            cut.q[:, first - 1, j].astype(float),
            scale,
        )

    def fit(self, used: np.ndarray) -> list[np.ndarray]:
        """Return coefficients `(F + P,)` for each ridge, from the windows `used` `(W,)`."""
        x = np.concatenate([self.driven[used], self.past[used]], -1)
        x, y = x.reshape(-1, x.shape[-1]), self.steps[used].ravel()
        normal, right, found = x.T @ x, x.T @ y, []
        for pull in RIDGES:
            found.append(np.linalg.solve(normal + pull * len(x) * np.eye(len(normal)), right))
        return found

    def run(self, beta: np.ndarray, windows: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Return positions of free runs `(W', K)`; `used`: windows that were fitted to."""
        order = self.past.shape[-1]
        given = self.driven[windows] @ beta[: len(beta) - order]
        most = MAX_SPEED_RATIO * float(np.abs(self.steps[used]).max())
        past, weights = self.before[windows].copy(), beta[len(beta) - order :]
        steps = np.empty_like(given)
        for k in range(given.shape[1]):
            steps[:, k] = np.clip(given[:, k] + past @ weights, -most, most)
            past = np.concatenate([steps[:, k : k + 1], past[:, :-1]], 1)
        return self.start[windows, None] + self.scale * np.cumsum(steps, 1)


def _shape_commands(u: np.ndarray) -> np.ndarray:
    """Return commands and their hinges, one column a side, `(…, 2 + 2 hinges)`."""
    columns = []
    for edge in (0.0, *HINGES):
        columns += [np.maximum(u - edge, 0.0), np.maximum(-u - edge, 0.0)]
    return np.stack(columns, -1)
