"""Recordings as increments, and the valve model of `ValveFit` on them, for a fit in seconds.

Positions hardly feed back into the speed, so the speed is fitted as a function of commands. The
model is driven by recorded commands and, for the pose, recorded positions. Increments of `WIDTH`
samples are compared. For given dead time, play and lags the curves are a linear least-squares
problem; pose and pump follow in a few sweeps.

Axes: `T` time, `J` joints, `K` knots, `M` features of the pose, `I` increments, `P` widths of the
play.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.signal import lfilter

from actuators.models.valve import PoseFeatures
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording

WIDTH = 5
"""Samples in an increment: long enough for a coarse sensor, short enough to see when a joint
starts."""
PLAYS = np.array([0.0, 0.01, 0.02, 0.035, 0.05, 0.08, 0.12])
"""Widths for which the play is computed; between them its output is interpolated."""
STIFFNESS = 4.0
"""Prior: slope of a flow curve changes by so much per root of stroke."""
POSE = 0.03
"""Prior: relative change of speed per feature of the pose."""
TOGETHER = 15.0
"""Increments whose errors hang together: a speed that wanders for some seconds is no evidence for a
bend of the curve or a pose."""
FIRST_DEMAND = 0.55
"""Demand of each joint, of the pump's flow, from which the sweeps start. Chosen by hand; not
searched."""
SIGMA_OVER_MEDIAN = 1.4826
"""Standard deviation over the median absolute deviation of a normal distribution: 1 / 0.6745."""
STILL = 1e-10
"""Mean square of the increments of a joint that never moves, rad² or m²."""
OUTLIER = 4.0
"""Typical errors beyond which an increment counts with its size instead of its square. Chosen by
hand; not searched."""


@dataclass
class StaticFit:
    """Curves `(J, 2 (K - 1))`, pose `(J, 2, M)` and demands `(J,)`."""

    curve: np.ndarray
    pose: np.ndarray
    demand: np.ndarray


class DrivenRecording:
    """Commands and poses of a recording, and what the model makes of them.

    Args:
        recording: The recording.
        pose: Features of the pose.
        period_s: Control period.
    """

    def __init__(self, recording: Recording, pose: PoseFeatures, period_s: float) -> None:
        self._period_s = period_s
        self._played = _apply_plays(recording.u.astype(np.float64))
        self.pose = pose.features(torch.as_tensor(recording.q)).numpy().astype(np.float64)

    def spools(self, dynamics: np.ndarray) -> np.ndarray:
        """Return the spool strokes of all joints, `(T, J)`, for dynamics `(J, 4)`."""
        return np.stack([self.spool(j, row) for j, row in enumerate(dynamics)], 1)

    def spool(self, j: int, dynamics: np.ndarray) -> np.ndarray:
        """Return the spool strokes of joint `j`, `(T,)`, for dynamics `(4,)`."""
        dead_time_s, play, spool_s, _ = dynamics
        low = int(np.clip(np.searchsorted(PLAYS, play, side="right") - 1, 0, len(PLAYS) - 2))
        part = (play - PLAYS[low]) / (PLAYS[low + 1] - PLAYS[low])
        played = (1.0 - part) * self._played[low, :, j] + part * self._played[low + 1, :, j]
        delayed = delay_signal(played, dead_time_s / self._period_s)
        return lag_signal(delayed, spool_s, self._period_s)

    def factor(self, j: int, extends: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the factor of the pose on the speed of joint `j`, `(T,)`, for slopes `(J, 2, M)`."""
        sides = self.pose[:, j] @ pose[j].T
        return np.maximum(1.0 + np.where(extends, sides[:, 0], sides[:, 1]), 0.0)


class SpeedData:
    """Recordings as increments, and the model on them.

    Attributes:
        way: Increments, `(J, I)`.
        num_increments: Number of increments of each used recording.
        scale: Mean square of the increments, `(J,)`.
    """

    def __init__(
        self, recordings: Sequence[Recording], machine: Machine, knots: np.ndarray
    ) -> None:
        self.recordings, self.machine, self._knots = list(recordings), machine, knots
        self._period_s = machine.period_s
        # what came before the recording is not known
        self._skip = max(1, round((machine.num_history + 1.0 / machine.period_s) / WIDTH))
        least = WIDTH * (self._skip + 4)
        self._places = [n for n, r in enumerate(recordings) if r.num_samples > least]
        used = [recordings[n] for n in self._places]
        if not used:
            raise RecordingError(
                f"too little data: none of the {len(self.recordings)} recordings lasts long enough to fit to"
            )
        pose = PoseFeatures(machine, torch.device("cpu"))
        self._used = [DrivenRecording(recording, pose, self._period_s) for recording in used]
        self.num_increments = [len(self._increments(recording.u)) for recording in used]
        self.num_pose = pose.size
        q = [r.q.astype(np.float64) for r in used]
        way = [self._increments(np.diff(part, axis=0, append=part[-1:])) for part in q]
        self.way = np.concatenate(way).T  # (J, I)
        self._free = np.concatenate([self._at_stop(part) for part in q]).T
        self._bend = _build_bend_penalty(knots)
        self.scale = np.maximum(np.mean(self.way**2, 1), 1e-12)
        self._noise = 1e-3 * self.scale  # a first guess of the squared error, for the priors

    def check_motion(self) -> None:
        """Raise `RecordingError` where a joint never moves: nothing can be fitted to it."""
        if (still := np.flatnonzero(self.scale < STILL)).size:
            names = ", ".join(self.machine.joint_names[j] for j in still)
            raise RecordingError(
                f"too little data: {names} never moves in the {len(self._used)} recordings to fit to"
            )

    def features(
        self, j: int, dynamics: np.ndarray, known: Sequence[np.ndarray] | None = None
    ) -> np.ndarray:
        """Return increments per unit of the curve at each knot, `(I, 2 (K - 1))`.

        `known`: factors on the speed, or none.
        """
        bases = []
        for n, one in enumerate(self._used):
            basis = self._basis(one.spool(j, dynamics), j)
            bases.append(basis if known is None else basis * known[n][:, None])
        return self._collect(bases, dynamics[3])

    def factors(self, found: StaticFit, dynamics: np.ndarray) -> list[list[np.ndarray]]:
        """Return the speed factor from pose and pump, by joint and recording, each `(T,)`."""
        joints = range(self.machine.num_joints)
        factors: list[list[np.ndarray]] = [[] for _ in joints]
        for one in self._used:
            spool = one.spools(dynamics)
            plain = [self._basis(spool[:, j], j) @ found.curve[j] for j in joints]
            opening = self._measure_opening(np.stack(plain, 1), spool, found)
            share = _compute_pump_share(found.demand, opening)
            for j in joints:
                factors[j].append(one.factor(j, spool[:, j] > 0, found.pose) * share)
        return factors

    def _measure_opening(
        self, plain: np.ndarray, spool: np.ndarray, found: StaticFit
    ) -> np.ndarray:
        """Return steps without pose and pump over those at full command, `(T, J)`."""
        half = len(self._knots) - 1
        full = np.maximum(np.abs(found.curve[:, [half - 1, 2 * half - 1]]), 1e-3)
        unit = self.machine.max_speed * self._period_s
        return np.abs(plain) / unit / np.where(spool > 0, full[:, 0], full[:, 1])

    def curve(
        self,
        features: np.ndarray,
        way: np.ndarray,
        noise: float | None = None,
        free: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the curve that explains `way` `(I,)`: ridge regression to straight lines."""
        noise = 1e-3 * float(np.mean(way**2)) if noise is None else noise
        weighted = features if free is None else features * free[:, None]
        normal = weighted.T @ features + noise / STIFFNESS**2 * self._bend
        normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
        return np.linalg.solve(normal, weighted.T @ way)

    def statics(self, dynamics: np.ndarray, sweeps: int) -> StaticFit:
        """Return curves, pose and demands for given dynamics `(J, 4)`."""
        joints, half = range(self.machine.num_joints), len(self._knots) - 1
        spools = [one.spools(dynamics) for one in self._used]
        bases = [[self._basis(spool[:, j], j) for spool in spools] for j in joints]
        found = StaticFit(
            np.zeros((len(joints), 2 * half)),
            np.zeros((len(joints), 2, self.num_pose)),
            np.full(len(joints), FIRST_DEMAND),
        )
        opening = [np.abs(spool) for spool in spools]
        noise, free = self._noise.copy(), self._free.copy()
        # curve, pose and pump are each linear or small given the other two: they take turns
        for _ in range(sweeps):
            share = [_compute_pump_share(found.demand, one) for one in opening]
            flow: list[list[np.ndarray]] = []
            for j in joints:
                out, speed_s = [spool[:, j] > 0 for spool in spools], dynamics[j, 3]
                flow.append(self._fit_joint(j, bases[j], out, share, speed_s, found, noise, free))
            opening, posed = [], []
            for n, (one, spool) in enumerate(zip(self._used, spools, strict=True)):
                plain = np.stack([by_joint[n] for by_joint in flow], 1)
                opening.append(self._measure_opening(plain, spool, found))
                factor = [one.factor(j, spool[:, j] > 0, found.pose) for j in joints]
                posed.append(plain * np.stack(factor, 1))
            found.demand = self._demand(found.demand, posed, opening, dynamics, noise, free)
        return found

    def _fit_joint(
        self,
        j: int,
        basis: Sequence[np.ndarray],
        out: Sequence[np.ndarray],
        share: Sequence[np.ndarray],
        speed_s: float,
        found: StaticFit,
        noise: np.ndarray,
        free: np.ndarray,
    ) -> list[np.ndarray]:
        """Refit curve and pose of joint `j` in `found`, and its row of `noise` and `free`.

        Args:
            j: The joint.
            basis: Of each recording, `(T, 2 (K - 1))`.
            out: Whether the joint extends, `(T,)`.
            share: Part of its flow that the pump gives, `(T,)`.
            speed_s: Lag of the speed, s.
            found: Fit of all joints.
            noise: Squared error of each joint, `(J,)`.
            free: Weight of each increment, `(J, I)`.

        Returns:
            Its steps without pose and pump, of each recording, `(T,)`.
        """
        scaled = []
        for n, one in enumerate(self._used):
            scaled.append(basis[n] * (one.factor(j, out[n], found.pose) * share[n])[:, None])
        features = self._collect(scaled, speed_s)
        found.curve[j] = self.curve(features, self.way[j], noise[j], free[j])
        plain, moved, sides = [], [], []
        for n, one in enumerate(self._used):
            plain.append(basis[n] @ found.curve[j])
            moved.append((plain[n] * share[n])[:, None])
            part = moved[n] * one.pose[:, j]
            sides.append(np.hstack([part * out[n][:, None], part * ~out[n][:, None]]))
        slopes = self._collect(sides, speed_s)
        level = self._collect(moved, speed_s)[:, 0]
        weighted = slopes * free[j][:, None]
        normal = weighted.T @ slopes + noise[j] / POSE**2 * np.eye(slopes.shape[1])
        pose = np.linalg.solve(normal, weighted.T @ (self.way[j] - level))
        found.pose[j] = pose.reshape(2, -1)
        left = self.way[j] - level - slopes @ found.pose[j].ravel()
        # increments of a joint at rest fit anyway and would hide the typical error
        moves = np.abs(self.way[j]) > 0.1 * np.sqrt(self.scale[j])
        typical = SIGMA_OVER_MEDIAN * np.median(np.abs(left[moves]))
        # Huber's weights: beyond `OUTLIER` typical errors an increment counts with its size
        huber = OUTLIER * typical / np.maximum(np.abs(left), 1e-9)
        free[j] = self._free[j] * np.minimum(1.0, huber)
        noise[j] = TOGETHER * max(typical**2, 1e-6 * self.scale[j])
        return plain

    def _collect(self, parts: Sequence[np.ndarray], speed_s: float) -> np.ndarray:
        """Return the increments of steps `(T, …)` of all recordings after the lag of the speed."""
        later = [lag_signal(part, speed_s, self._period_s) for part in parts]
        return np.concatenate([self._increments(part) for part in later])

    def _demand(
        self,
        start: np.ndarray,
        posed: list[np.ndarray],
        opening: list[np.ndarray],
        dynamics: np.ndarray,
        noise: np.ndarray,
        free: np.ndarray,
    ) -> np.ndarray:
        """Return the demands on the pump that explain best how joints slow each other."""
        joints = self.machine.num_joints
        weight = np.sqrt(free / noise[:, None])
        if all((o > 0.05).sum(1).max() < 2 for o in opening):
            return np.zeros(joints)  # never two at once

        def compute_residual(demand: np.ndarray) -> np.ndarray:
            parts = []
            for factor, opened in zip(posed, opening, strict=True):
                moved = factor * _compute_pump_share(demand, opened)[:, None]
                for j in range(joints):
                    moved[:, j] = lag_signal(moved[:, j], dynamics[j, 3], self._period_s)
                parts.append(self._increments(moved))
            return ((self.way - np.concatenate(parts).T) * weight).ravel()

        starts = [start]
        if (start == start[0]).all():
            starts += [np.full(joints, level) for level in (0.3, 0.55, 0.8)]
        best = min(starts, key=lambda demand: float(np.square(compute_residual(demand)).sum()))
        best = np.clip(best, 0.0, 1.99)
        limits = {"bounds": (0.0, 2.0), "diff_step": 1e-3, "max_nfev": 12}
        return least_squares(compute_residual, best, **limits).x

    def _basis(self, spool: np.ndarray, j: int) -> np.ndarray:
        """Return signed hat functions of the spool times full step, `(T, 2 (K - 1))`."""
        knots, half, size = self._knots, len(self._knots) - 1, np.minimum(np.abs(spool), 1.0)
        cell = np.clip(np.searchsorted(knots, size, side="right") - 1, 0, half - 1)
        part = (size - knots[cell]) / (knots[cell + 1] - knots[cell])
        out, rows = np.zeros((len(spool), 2 * half)), np.arange(len(spool))
        first = np.where(spool > 0, 0, half)
        out[rows, first + cell] = part
        inner = cell > 0
        out[rows[inner], (first + cell - 1)[inner]] = 1.0 - part[inner]
        return out * (np.sign(spool) * self.machine.max_speed[j] * self._period_s)[:, None]

    def _increments(self, steps: np.ndarray) -> np.ndarray:
        """Sum steps `(T, …)` over `WIDTH` samples each, without the beginning, `(I, …)`."""
        count = len(steps) // WIDTH
        return steps[: count * WIDTH].reshape(count, WIDTH, *steps.shape[1:]).sum(1)[self._skip :]

    def _at_stop(self, q: np.ndarray) -> np.ndarray:
        """Return 1 for found away from both stops, else 0, `(I, J)`."""
        margin = 0.005 * (self.machine.upper - self.machine.lower)
        inside = (q > self.machine.lower + margin) & (q < self.machine.upper - margin)
        return (self._increments(inside.astype(np.float64)) > WIDTH - 0.5).astype(np.float64)


def delay_signal(u: np.ndarray, periods: float) -> np.ndarray:
    """Return `u` `(T,)` later by a fractional number of samples, its mean over each period."""
    whole = int(np.floor(periods + 5e-7))
    part = periods - whole
    known = np.pad(u, (whole + 1, 0), mode="edge")
    return (1.0 - part) * known[1 : len(u) + 1] + part * known[: len(u)]


def lag_signal(u: np.ndarray, time_constant_s: float, period_s: float) -> np.ndarray:
    """Return a first-order lag of `u` `(T, …)`, as it stands at the end of each period."""
    if time_constant_s < 1e-4:
        return u
    kept = np.exp(-period_s / time_constant_s)
    return lfilter([1.0 - kept], [1.0, -kept], u, axis=0, zi=kept * u[:1])[0]


def _apply_plays(u: np.ndarray) -> np.ndarray:
    """Return the play operator of each of `PLAYS` on `u` `(T, J)`, `(P, T, J)`."""
    out, now = np.empty((len(PLAYS), *u.shape)), np.repeat(u[:1], len(PLAYS), 0)
    half = PLAYS[:, None] / 2
    for t in range(len(u)):
        now = np.minimum(np.maximum(now, u[t] - half), u[t] + half)
        out[:, t] = now
    return out


def _compute_pump_share(demand: np.ndarray, opening: np.ndarray) -> np.ndarray:
    return 1.0 / np.maximum(1.0, opening @ demand)


def _build_bend_penalty(knots: np.ndarray) -> np.ndarray:
    """Return the quadratic form of slope changes, each over the root of its stroke."""
    half, rows = len(knots) - 1, []
    for first in (0, half):
        for k in range(1, half):
            before, after = knots[k] - knots[k - 1], knots[k + 1] - knots[k]
            row = np.zeros(2 * half)
            row[first + k] += 1.0 / after
            row[first + k - 1] -= 1.0 / before + 1.0 / after
            if k > 1:
                row[first + k - 2] += 1.0 / before
            rows.append(row / np.sqrt((before + after) / 2))
    return np.stack(rows).T @ np.stack(rows) if rows else np.zeros((2 * half, 2 * half))
