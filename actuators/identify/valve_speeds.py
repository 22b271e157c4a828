"""Speeds as a function of commands: what recordings say about valve curves, pose and pump for given dead times, play and lags.

Axes: `T` time, `J` joints, `K` knots, `M` features of the pose, `I` increments, `P` widths of the
play.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.signal import lfilter

from actuators.models.valve import Pose
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


@dataclass
class Statics:
    """Curves `(J, 2 (K - 1))`, pose `(J, 2, M)` and demands `(J,)`."""

    curve: np.ndarray
    pose: np.ndarray
    demand: np.ndarray


class Speeds:
    """Recordings as increments, and the model on them."""

    def __init__(
        self, recordings: Sequence[Recording], machine: Machine, knots: np.ndarray
    ) -> None:
        self.recordings, self.machine, self._knots = list(recordings), machine, knots
        self._period_s = machine.period_s
        self._skip = max(
            1, round((machine.num_history + 1.0 / machine.period_s) / WIDTH)
        )  # what came before is not known
        used = [r for r in recordings if r.num_samples > WIDTH * (self._skip + 4)]
        if not used:
            raise RecordingError(
                f"too little data: none of the {len(self.recordings)} recordings lasts long enough to fit to"
            )
        self._u = [r.u.astype(np.float64) for r in used]
        self._played = [_played(u) for u in self._u]
        pose = Pose(machine, torch.device("cpu"))
        self._pose = [pose.features(torch.as_tensor(r.q)).numpy().astype(np.float64) for r in used]
        self.num_pose = pose.size
        way = [
            self._increments(np.diff(r.q.astype(np.float64), axis=0, append=r.q[-1:])) for r in used
        ]
        self.way = np.concatenate(way).T  # (J, I)
        self._free = np.concatenate([self._at_stop(r.q.astype(np.float64)) for r in used]).T
        self.scale = np.maximum(np.mean(self.way**2, 1), 1e-12)
        if (still := np.flatnonzero(self.scale < 1e-10)).size:
            names = ", ".join(machine.joint_names[j] for j in still)
            raise RecordingError(
                f"too little data: {names} never moves in the {len(used)} recordings to fit to"
            )
        self._noise = 1e-3 * self.scale  # a first guess of the squared error, for the priors
        self._bend = _bend(knots)

    def features(
        self, j: int, dynamics: np.ndarray, known: Sequence[np.ndarray] | None = None
    ) -> np.ndarray:
        """Returns increments per unit of the curve at each knot, `(I, 2 (K - 1))`, with factors `known` on the speed or none."""
        parts = []
        for n in range(len(self._u)):
            basis = self._basis(self._spool(n, j, dynamics), j)
            basis = basis if known is None else basis * known[n][:, None]
            parts.append(self._increments(lagged(basis, dynamics[3], self._period_s)))
        return np.concatenate(parts)

    def factors(self, found: Statics, dynamics: np.ndarray) -> list[list[np.ndarray]]:
        """Returns the factor on the speed from pose and pump, by joint and recording, each `(T,)`."""
        joints, half = range(self.machine.num_joints), len(self._knots) - 1
        full = np.maximum(np.abs(found.curve[:, [half - 1, 2 * half - 1]]), 1e-3)
        unit = self.machine.max_speed * self._period_s
        spool = [
            np.stack([self._spool(n, j, dynamics[j]) for j in joints], 1)
            for n in range(len(self._u))
        ]
        plain = [
            np.stack([self._basis(s[:, j], j) @ found.curve[j] for j in joints], 1) / unit
            for s in spool
        ]
        share = [
            _share(found.demand, np.abs(p) / np.where(s > 0, full[:, 0], full[:, 1]))
            for p, s in zip(plain, spool, strict=True)
        ]
        return [
            [
                self._factor(n, j, spool[n][:, j] > 0, found.pose) * share[n]
                for n in range(len(self._u))
            ]
            for j in joints
        ]

    def curve(
        self,
        features: np.ndarray,
        way: np.ndarray,
        noise: float | None = None,
        free: np.ndarray | None = None,
    ) -> np.ndarray:
        """Returns the curve that explains `way` `(I,)`, by ridge regression toward straight lines."""
        noise = 1e-3 * float(np.mean(way**2)) if noise is None else noise
        weighted = features if free is None else features * free[:, None]
        normal = weighted.T @ features + noise / STIFFNESS**2 * self._bend
        normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
        return np.linalg.solve(normal, weighted.T @ way)

    def statics(
        self, dynamics: np.ndarray, sweeps: int, demand: np.ndarray | None = None
    ) -> Statics:
        """Returns curves, pose and demands for given dynamics `(J, 4)`, beginning at `demand` where it is known."""
        joints, count, half = self.machine.num_joints, len(self._u), len(self._knots) - 1
        spool = [
            np.stack([self._spool(n, j, dynamics[j]) for j in range(joints)], 1)
            for n in range(count)
        ]
        basis = [[self._basis(spool[n][:, j], j) for j in range(joints)] for n in range(count)]
        found = Statics(
            np.zeros((joints, 2 * half)),
            np.zeros((joints, 2, self.num_pose)),
            np.full(joints, 0.55) if demand is None else demand,
        )
        opening = [np.abs(s) for s in spool]
        noise, free = self._noise.copy(), self._free.copy()

        def collect(parts: list[np.ndarray], j: int) -> np.ndarray:
            return np.concatenate(
                [self._increments(lagged(part, dynamics[j, 3], self._period_s)) for part in parts]
            )

        for _ in range(sweeps):
            share = [_share(found.demand, o) for o in opening]
            flow: list[list[np.ndarray]] = []
            for j in range(joints):
                out = [s[:, j] > 0 for s in spool]
                factor = [self._factor(n, j, out[n], found.pose) for n in range(count)]
                features = collect(
                    [basis[n][j] * (factor[n] * share[n])[:, None] for n in range(count)], j
                )
                found.curve[j] = self.curve(features, self.way[j], noise[j], free[j])
                plain = [basis[n][j] @ found.curve[j] for n in range(count)]
                parts = [(plain[n] * share[n])[:, None] * self._pose[n][:, j] for n in range(count)]
                sides = [
                    np.hstack([p * o[:, None], p * ~o[:, None]])
                    for p, o in zip(parts, out, strict=True)
                ]
                slopes = collect(sides, j)
                level = collect([(plain[n] * share[n])[:, None] for n in range(count)], j)[:, 0]
                weighted = slopes * free[j][:, None]
                normal = weighted.T @ slopes + noise[j] / POSE**2 * np.eye(slopes.shape[1])
                found.pose[j] = np.linalg.solve(normal, weighted.T @ (self.way[j] - level)).reshape(
                    2, -1
                )
                left = self.way[j] - level - slopes @ found.pose[j].ravel()
                typical = 1.4826 * np.median(
                    np.abs(left[np.abs(self.way[j]) > 0.1 * np.sqrt(self.scale[j])])
                )
                free[j] = self._free[j] * np.minimum(
                    1.0, 4.0 * typical / np.maximum(np.abs(left), 1e-9)
                )
                noise[j] = TOGETHER * max(typical**2, 1e-6 * self.scale[j])
                flow.append(plain)
            full = np.maximum(np.abs(found.curve[:, [half - 1, 2 * half - 1]]), 1e-3)
            unit = self.machine.max_speed * self._period_s
            plain = [np.stack([flow[j][n] for j in range(joints)], 1) for n in range(count)]
            opening = [
                np.abs(p) / unit / np.where(s > 0, full[:, 0], full[:, 1])
                for p, s in zip(plain, spool, strict=True)
            ]
            posed = [
                np.stack(
                    [
                        plain[n][:, j] * self._factor(n, j, spool[n][:, j] > 0, found.pose)
                        for j in range(joints)
                    ],
                    1,
                )
                for n in range(count)
            ]
            found.demand = self._demand(found.demand, posed, opening, dynamics, noise, free)
        return found

    def _demand(
        self,
        start: np.ndarray,
        posed: list[np.ndarray],
        opening: list[np.ndarray],
        dynamics: np.ndarray,
        noise: np.ndarray,
        free: np.ndarray,
    ) -> np.ndarray:
        """Returns the demands on the pump that explain best how joints slow each other."""
        joints = self.machine.num_joints
        weight = np.sqrt(free / noise[:, None])
        if all((o > 0.05).sum(1).max() < 2 for o in opening):
            return np.zeros(joints)  # never two at once

        def left(demand: np.ndarray) -> np.ndarray:
            moved = [p * _share(demand, o)[:, None] for p, o in zip(posed, opening, strict=True)]
            ways = np.concatenate(
                [
                    self._increments(
                        np.stack(
                            [
                                lagged(m[:, j], dynamics[j, 3], self._period_s)
                                for j in range(joints)
                            ],
                            1,
                        )
                    )
                    for m in moved
                ]
            )
            return ((self.way - ways.T) * weight).ravel()

        starts = [
            start,
            *(np.full(joints, level) for level in (0.3, 0.55, 0.8) if (start == start[0]).all()),
        ]
        best = min(starts, key=lambda demand: float(np.square(left(demand)).sum()))
        return least_squares(
            left, np.clip(best, 0.0, 1.99), bounds=(0.0, 2.0), diff_step=1e-3, max_nfev=12
        ).x

    def _factor(self, n: int, j: int, out: np.ndarray, pose: np.ndarray) -> np.ndarray:
        features = self._pose[n][:, j]
        return np.maximum(1.0 + np.where(out, features @ pose[j, 0], features @ pose[j, 1]), 0.0)

    def _spool(self, n: int, j: int, dynamics: np.ndarray) -> np.ndarray:
        dead_time_s, play, spool_s, _ = dynamics
        low = int(np.clip(np.searchsorted(PLAYS, play, side="right") - 1, 0, len(PLAYS) - 2))
        part = (play - PLAYS[low]) / (PLAYS[low + 1] - PLAYS[low])
        played = (1.0 - part) * self._played[n][low, :, j] + part * self._played[n][low + 1, :, j]
        return lagged(delayed(played, dead_time_s / self._period_s), spool_s, self._period_s)

    def _basis(self, spool: np.ndarray, j: int) -> np.ndarray:
        """Returns hat functions of the spool times the way in a period at full speed, signed, `(T, 2 (K - 1))`."""
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
        """Sums steps `(T, …)` over `WIDTH` samples each, without the beginning, `(I, …)`."""
        count = len(steps) // WIDTH
        return steps[: count * WIDTH].reshape(count, WIDTH, *steps.shape[1:]).sum(1)[self._skip :]

    def _at_stop(self, q: np.ndarray) -> np.ndarray:
        """Returns 1 for increments away from both stops, else 0, `(I, J)`."""
        margin = 0.005 * (self.machine.upper - self.machine.lower)
        inside = (q > self.machine.lower + margin) & (q < self.machine.upper - margin)
        return (self._increments(inside.astype(np.float64)) > WIDTH - 0.5).astype(np.float64)


def delayed(u: np.ndarray, periods: float) -> np.ndarray:
    """Returns `u` `(T,)` later by a fractional number of samples, its mean over each period."""
    whole = int(np.floor(periods + 5e-7))
    part = periods - whole
    known = np.pad(u, (whole + 1, 0), mode="edge")
    return (1.0 - part) * known[1 : len(u) + 1] + part * known[: len(u)]


def lagged(u: np.ndarray, time_constant_s: float, period_s: float) -> np.ndarray:
    """Returns a first-order lag of `u` `(T, …)`, as it stands at the end of each period."""
    if time_constant_s < 1e-4:
        return u
    kept = np.exp(-period_s / time_constant_s)
    return lfilter([1.0 - kept], [1.0, -kept], u, axis=0, zi=kept * u[:1])[0]


def _played(u: np.ndarray) -> np.ndarray:
    """Returns the play operator of each of `PLAYS` on `u` `(T, J)`, `(P, T, J)`."""
    out, now, half = (
        np.empty((len(PLAYS), *u.shape)),
        np.repeat(u[:1], len(PLAYS), 0),
        PLAYS[:, None] / 2,
    )
    for t in range(len(u)):
        now = np.minimum(np.maximum(now, u[t] - half), u[t] + half)
        out[:, t] = now
    return out


def _share(demand: np.ndarray, opening: np.ndarray) -> np.ndarray:
    return 1.0 / np.maximum(1.0, opening @ demand)


def _bend(knots: np.ndarray) -> np.ndarray:
    """Returns the quadratic form of the changes of slope of both curves, each change over the root of its stroke."""
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
