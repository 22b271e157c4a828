"""Gauss-Newton fits of actuator parameters to free runs, with standard errors.

Candidates are written into the environments of one batch, so a Jacobian by finite differences is
one simulation, and so is a set of damped steps. In one run on two busy cores, with the same data,
starts and step limit, `scipy.optimize.least_squares` (trf) and `mujoco.minimize.least_squares`
reached the same loss within 0.4 % and for `lag` the same errors of the parameters, but took 20
and 79 s against 17 s here (`lag`, 25 parameters), and 43 and 267 s against 19 s (`hydraulic`, 50
parameters): they try one step after another. So this solver is kept.

Parameters are in units of their range, `x` in [0, 1].
Axes: `C` candidates, `P` parameters, `J` joints, `W` windows, `K` steps, `D` columns of a Jacobian,
`P` times `J`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import stats

from actuators import open_loop
from brokk_rl.contracts.actuator import Actuator, ActuatorModel
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.statistics import CONFIDENCE

WORLDS = 2048
"""Free runs simulated at once: enough to keep a core busy, few enough to stay in its cache."""
STEP = 0.004
"""Finite difference, of the range: far above the rounding of float32, below the bends of dead bands
and delays."""
SECANT = 0.04
"""Difference for intervals: a time constant near 0 acts like a delay to first order, over a
hundredth of a second it does not."""
DAMPINGS = (0.0, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Levenberg-Marquardt dampings tried side by side, relative to the diagonal."""


@dataclass(frozen=True)
class _Candidates:
    """An actuator with other numbers in each environment; `values` `(N, P, J)`."""

    actuator: Actuator
    names: tuple[str, ...]
    values: np.ndarray

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ActuatorModel:
        """Return the model with the numbers written into it."""
        model = self.actuator.build(machine, num_envs, device)
        parameters = get_parameters(model, self.names)
        for p, name in enumerate(self.names):
            parameters[name].copy_(
                torch.as_tensor(self.values[:, p], dtype=torch.float32, device=device)
            )
        return model


def get_parameters(model: ActuatorModel, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
    """Return the numbers that can be set.

    Raises:
        ConfigError: the model has none, or not these.
    """
    parameters: dict[str, torch.Tensor] | None = getattr(model, "parameters", None)
    if parameters is None:
        raise ConfigError(
            f"fit.actuator: {type(model).__name__} has no numbers to fit (no `parameters`); choose lag or hydraulic"
        )
    for name in names:
        if name not in parameters:
            raise ConfigError(
                f"fit.free: '{name}' is no number of {type(model).__name__}; {list_choices(name, parameters)}"
            )
    return parameters


class CandidateRuns:
    """Errors of free runs as a function of the free numbers.

    Args:
        actuator: Gives all numbers that are not free.
        free: Lower and upper bound by name.
        machine: The machine.
        cut: Windows.
        active: Which joints each window says something about, `(W, J)`; the others neither count
            nor are varied there.
        device: Where to simulate.
    """

    def __init__(
        self,
        actuator: Actuator,
        free: Mapping[str, tuple[float, float]],
        machine: Machine,
        cut: open_loop.FreeRunWindows,
        active: np.ndarray,
        device: torch.device,
    ) -> None:
        self._actuator, self._machine, self._device = actuator, machine, device
        self.names, self.cut, self.active = tuple(free), cut, active
        self._low, self._high = np.array([free[name] for name in self.names]).T[:, :, None]
        self._ahead = np.arange(1, cut.measured.shape[1] + 1)[:, None] * machine.period_s

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the numbers, in their own units, at `x` `(…, P, J)`."""
        return self._low + (self._high - self._low) * x

    def errors(self, x: np.ndarray, window: np.ndarray) -> np.ndarray:
        """Return scaled errors for each row of `x` `(C, P, J)`.

        The errors are predicted less measured positions, over the root of time and of `K`. So an
        error that grows with the root of time counts the same early and late, and sums of squares
        over `K` are means over time.

        Args:
            x: Candidates.
            window: Window of each, `(C,)`.

        Returns:
            `(C, K, J)`, zero where a joint is not active.
        """
        found = np.empty((len(x), *self.cut.measured.shape[1:]), dtype=np.float32)
        for start in range(0, len(x), WORLDS):
            rows = window[start : start + WORLDS]
            part = replace(self.cut, u=self.cut.u[rows], q=self.cut.q[rows], run=self.cut.run[rows])
            values = self.values(x[start : start + WORLDS])
            path = open_loop.roll_out(
                _Candidates(self._actuator, self.names, values), self._machine, part, self._device
            )
            scaled = (path - part.measured) / np.sqrt(self._ahead * len(self._ahead))
            found[start : start + WORLDS] = np.where(self.active[rows][:, None], scaled, 0.0)
        return found

    def squares(self, x: np.ndarray, windows: np.ndarray | None = None) -> np.ndarray:
        """Return mean square errors over time, `(C, W, J)`, of candidates `x` `(C, P, J)`.

        `windows` limits the windows; `None`: all.
        """
        windows = np.arange(len(self.active)) if windows is None else windows
        count = len(windows)
        error = self.errors(np.repeat(x, count, 0), np.tile(windows, len(x)))
        return np.square(error, dtype=np.float64).sum(1).reshape(len(x), count, -1)

    def end_rmse(self, x: np.ndarray) -> list[float | None]:
        """Return RMS errors at the windows' end, rad or m, at `x` `(P, J)`.

        `None` for a joint that is never active.
        """
        steps = self.cut.measured.shape[1]
        windows = np.arange(len(self.active))
        last = self.errors(np.repeat(x[None], len(windows), 0), windows)[:, -1]
        square = np.square(last, dtype=np.float64).sum(0) * steps * self._ahead[-1]
        rmse = []
        for s, n in zip(square, self.active.sum(0), strict=True):
            rmse.append(float(np.sqrt(s / n)) if n else None)
        return rmse

    def jacobian(self, x: np.ndarray, size: float = STEP) -> tuple[np.ndarray, np.ndarray]:
        """Return errors `(W, K, J)` at `x` `(P, J)` and derivatives `(W, K, J, D)`.

        The derivatives are finite differences of `size`. Joints do not influence each other, so one
        free run of a window serves a number of all joints at once.
        """
        num, joints = x.shape
        step = np.where(x + size <= 1.0, size, -size)
        varied = np.repeat(x[None], num, 0)
        numbers = np.arange(num)
        varied[numbers, numbers] += step
        base, told = np.arange(len(self.active)), np.flatnonzero(self.active.any(1))
        candidates = np.concatenate(
            [np.repeat(x[None], len(base), 0), np.repeat(varied, len(told), 0)]
        )
        error = self.errors(candidates, np.concatenate([base, np.tile(told, num)]))
        error, moved = error[: len(base)], error[len(base) :]
        slopes = np.zeros((*error.shape, num, joints), dtype=np.float32)
        each = np.arange(joints)
        for p, paths in enumerate(moved.reshape(num, len(told), *error.shape[1:])):
            for w, path in zip(told, paths, strict=True):
                slopes[w][:, each, p, each] = (path - error[w]) / step[p]
        return error, slopes.reshape(*error.shape, num * joints)


@dataclass(frozen=True)
class SoftL1Loss:
    """Soft-L1 loss of each window's mean square: an outlier counts with its size only.

    Attributes:
        scale: Mean square beyond which a window counts with its root, `(J,)`.
    """

    scale: np.ndarray

    @classmethod
    def around(cls, squares: np.ndarray, active: np.ndarray, robust: float) -> "SoftL1Loss":
        """Return the loss with scale `robust` times the median error of `squares` `(W, J)`."""
        typical = []
        for column, rows in zip(squares.T, active.T, strict=True):
            typical.append(np.median(column[rows]) if rows.any() else 0.0)
        return cls(np.maximum(robust**2 * np.array(typical), 1e-14))

    def weights(self, squares: np.ndarray) -> np.ndarray:
        """Return the weight of each window's square, shape of `squares` `(…, J)`.

        It includes the scale, so that joints compare.
        """
        return 1.0 / (np.sqrt(1.0 + squares / self.scale) * self.scale)

    def total(self, squares: np.ndarray) -> np.ndarray:
        """Return the loss of each joint, `(…, J)`, summed over the windows (axis -2)."""
        return 2.0 * (np.sqrt(1.0 + squares / self.scale) - 1.0).sum(-2)


def take_step(runs: CandidateRuns, x: np.ndarray, robust: float) -> tuple[np.ndarray, float]:
    """Return the best of several damped Gauss-Newton steps from `x` `(P, J)`.

    Also returns the relative fall of the loss.

    Each joint takes its own best step.
    """
    error, slopes = runs.jacobian(x)
    squares = np.square(error, dtype=np.float64).sum(1)
    loss = SoftL1Loss.around(squares, runs.active, robust)
    root = np.sqrt(loss.weights(squares))[:, None, :]
    flat = (slopes * root[..., None]).reshape(-1, x.size).astype(np.float64)
    gradient, curvature = flat.T @ (error * root).reshape(-1), flat.T @ flat
    inward = ~(((x <= 0.0).ravel() & (gradient > 0.0)) | ((x >= 1.0).ravel() & (gradient < 0.0)))
    trials = [x]
    for damping in DAMPINGS:
        step = np.zeros(x.size)
        within = curvature[np.ix_(inward, inward)]
        damped = within + np.diag(damping * np.diag(within) + 1e-9 * (1.0 + np.trace(within)))
        step[inward] = -np.linalg.solve(damped, gradient[inward])
        trials.append(np.clip(x + step.reshape(x.shape), 0.0, 1.0))
    totals = loss.total(runs.squares(np.stack(trials)))  # (C, J)
    best = totals.argmin(0)
    gain = (totals[0] - totals.min(0)) / np.maximum(totals[0], 1e-12)
    return np.stack([trials[c][:, j] for j, c in enumerate(best)], 1), float(gain.max())


@dataclass(frozen=True)
class ParameterUncertainty:
    """Standard errors, intervals and correlations of the parameters, in units of their ranges.

    Attributes:
        deviation: Standard error, `(P, J)`.
        half: Half width of the 95 % interval, `(P, J)`.
        correlation: Of the estimates, `(D, D)`.
        runs: Number of independent runs for each joint, `(J,)`.
    """

    deviation: np.ndarray
    half: np.ndarray
    correlation: np.ndarray
    runs: np.ndarray


def estimate_uncertainty(runs: CandidateRuns, x: np.ndarray, robust: float) -> ParameterUncertainty:
    """Return standard errors at the fitted `x` `(P, J)`, by the sandwich over whole runs.

    The errors of a model that is not quite right are no white noise: the spread of the runs' own
    gradients says how far a number would move with other runs (Liang and Zeger 1986). It is never
    taken for less than white errors would give, and a parameter that the data do not determine
    keeps its range as standard error.
    """
    error, slopes = runs.jacobian(x, SECANT)
    squares = np.square(error, dtype=np.float64).sum(1)
    weights = SoftL1Loss.around(squares, runs.active, robust).weights(squares)
    flat = slopes.astype(np.float64)
    scores = np.einsum("wkjd,wkj,wj->wd", flat, error, weights, optimize=True)
    root = (flat * np.sqrt(weights)[:, None, :, None]).reshape(-1, x.size)
    samples = int(runs.active.sum()) * error.shape[1]
    variance = max(float((weights * squares).sum()) / max(1, samples - x.size), 1e-12)
    inverse = np.linalg.inv(root.T @ root / variance + np.eye(x.size))
    names = np.unique(runs.cut.run)
    by_run = np.stack([scores[runs.cut.run == name].sum(0) for name in names]) / variance
    factor = len(names) / max(1, len(names) - 1)
    sandwich = inverse @ (factor * by_run.T @ by_run) @ inverse
    count = np.array([len(np.unique(runs.cut.run[rows])) for rows in runs.active.T])
    deviation = np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse))).reshape(x.shape)
    spread = np.sqrt(np.diag(inverse))
    quantile = stats.t.ppf(0.5 + CONFIDENCE / 2, np.maximum(1, count - 1))
    return ParameterUncertainty(
        deviation, deviation * quantile, inverse / np.outer(spread, spread), count
    )
