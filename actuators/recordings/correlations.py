"""Correlations of the positions of a run with its commands, at the best lag and on one grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from actuators.recordings.advice import advise
from actuators.recordings.log_signals import Signal
from actuators.recordings.log_tables import LogRun
from brokk_rl.errors import RecordingError

LONGEST_LAG_S = 1.5
"""Longest lag from command to motion that is tried: more than twice the 0.55 s of the slowest machine known."""
NUM_LAGS = 60
GRID_ROWS = 8000
"""Rows on which pairs are compared; correlations change by less than 0.01 beyond."""
HIGH_CORRELATION, CLEAR_CORRELATION, NO_CORRELATION = 0.95, 0.8, 0.3
"""Correlations that leave a tenth, a third and nine tenths of the variance unexplained."""

MARGIN = 0.1
"""A partner that correlates better by so much contradicts a pair."""


class Correlations:
    """Commands and positions of a run on one grid, and how they follow each other.

    Attributes:
        r: Correlation at the best lag of each position, its speed or its acceleration with each command, by the
            kind of command that they follow, `(C, P)`.
    """

    def __init__(
        self, run: LogRun, commands: Sequence[Signal], positions: Sequence[Signal]
    ) -> None:
        signals = [*commands, *positions]
        begin_s = max(float(one.t_s[0]) for one in signals)
        end_s = min(float(one.t_s[-1]) for one in signals)
        if end_s <= begin_s:
            self._refuse(run, signals)
        period_s = float(np.median([np.median(np.diff(one.t_s)) for one in signals]))
        num_rows = int(np.clip((end_s - begin_s) / max(period_s, 1e-9), 2, GRID_ROWS))
        self._grid_s = np.linspace(begin_s, end_s, num_rows)
        self._period_s = float(self._grid_s[1] - self._grid_s[0])
        self._u = np.stack([np.interp(self._grid_s, one.t_s, one.values) for one in commands], 1)
        self._q = np.stack([np.interp(self._grid_s, one.t_s, one.values) for one in positions], 1)
        self._v = np.gradient(self._q, self._period_s, axis=0)
        most = min(int(LONGEST_LAG_S / self._period_s), num_rows // 4)
        self._lags = np.arange(0, most + 1, max(1, most // NUM_LAGS))
        acceleration = np.gradient(self._v, self._period_s, axis=0)
        followed = {"position": self._q, "velocity": self._v, "torque": acceleration}
        self.r = {kind: self._correlate(self._u, moved)[0] for kind, moved in followed.items()}

    def _refuse(self, run: LogRun, signals: Sequence[Signal]) -> None:
        spans = {one.table: (float(one.t_s[0]), float(one.t_s[-1])) for one in signals}
        listed = ", ".join(
            f"{table}: {begin:.12g} to {end:.12g} s" for table, (begin, end) in spans.items()
        )
        first = min(spans, key=lambda table: spans[table])
        last = max(spans, key=lambda table: spans[table])
        apart_s = spans[first][0] - spans[last][0]
        raise RecordingError(
            f"{run.where}: the clocks of its tables have no time in common ({listed}); "
            f"{advise('offset', table=last, offset_s=apart_s)}"
        )

    @property
    def size(self) -> np.ndarray:
        """Size of the correlation of each position or its speed with each command, `(C, P)`."""
        return np.maximum(np.abs(self.r["position"]), np.abs(self.r["velocity"]))

    def find_lag(self, at: int, is_target: bool) -> float:
        """Return the lag of a joint's speed behind its command, or behind its target's speed, s."""
        u = self._u[:, [at]]
        cause = np.gradient(u, self._period_s, axis=0) if is_target else u
        return float(self._correlate(cause, self._v[:, [at]])[1][0, 0])

    def fit_target(self, at: int) -> tuple[float, float]:
        """Return slope and offset of the line from targets to positions, at the best lag."""
        u, q = self._u[:, at], self._q[:, at]
        rows = round(float(self._correlate(u[:, None], q[:, None])[1][0, 0]) / self._period_s)
        u, q = u[: len(u) - rows], q[rows:]
        if np.ptp(u) == 0:
            return 0.0, 0.0
        slope, offset = np.polyfit(u, q, 1)
        return float(slope), float(offset)

    def find_lead(self, at: int) -> float:
        """Return the time by which the position leads its target, s; 0 where it does not, clearly."""
        u, q = self._u[:, [at]], self._q[:, [at]]
        behind, before = self._correlate(u, q), self._correlate(q, u)
        left, left_behind = 1.0 - abs(before[0][0, 0]), 1.0 - abs(behind[0][0, 0])
        is_leading = abs(before[0][0, 0]) >= CLEAR_CORRELATION and left < 0.3 * left_behind
        return float(before[1][0, 0]) if is_leading else 0.0

    def _correlate(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest correlations, in size, of the columns of `b` with those of `a` before them, and lags, s."""
        best = np.zeros((a.shape[1], b.shape[1]))
        lags_s = np.zeros_like(best)
        for lag in self._lags:
            x, y = a[: len(a) - lag], b[lag:]
            x, y = x - x.mean(0), y - y.mean(0)
            norm = np.linalg.norm(x, axis=0)[:, None] * np.linalg.norm(y, axis=0)
            with np.errstate(invalid="ignore", divide="ignore"):
                r = np.nan_to_num(x.T @ y / norm, nan=0.0, posinf=0.0, neginf=0.0)
            is_better = np.abs(r) > np.abs(best) + 1e-9
            best = np.where(is_better, r, best)
            lags_s = np.where(is_better, lag * self._period_s, lags_s)
        return best, lags_s


def weigh_correlation(size: float) -> float:
    """Return the log odds that a correlation of some size gives to a pair of columns."""
    if size >= CLEAR_CORRELATION:
        return 3.0 if size >= HIGH_CORRELATION else 2.0
    return -0.5 if size >= NO_CORRELATION else -4.5
