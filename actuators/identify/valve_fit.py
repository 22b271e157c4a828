"""Fit of `actuators.models.valve` in seconds, by linear least squares on increments.

Positions hardly feed back into the speed, so the speed is fitted as a function of commands. The
model is driven by recorded commands and, for the pose, recorded positions. Increments of `WIDTH`
samples are compared. For given dead time, play and lags the curves are a linear least-squares
problem; pose and pump follow in a few sweeps.

Axes: `T` time, `J` joints, `K` knots, `M` features of the pose, `I` increments, `P` widths of the
play.
"""

import dataclasses
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml
from rich.progress import Progress
from scipy.optimize import least_squares
from scipy.signal import lfilter

from actuators.models.valve import PoseFeatures, ValveActuator
from brokk_rl.errors import ConfigError, RecordingError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_text
from brokk_rl.spec import spec

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
class StaticFit:
    """Curves `(J, 2 (K - 1))`, pose `(J, 2, M)` and demands `(J,)`."""

    curve: np.ndarray
    pose: np.ndarray
    demand: np.ndarray


class SpeedData:
    """Recordings as increments, and the model on them."""

    def __init__(
        self, recordings: Sequence[Recording], machine: Machine, knots: np.ndarray
    ) -> None:
        self.recordings, self.machine, self._knots = list(recordings), machine, knots
        self._period_s = machine.period_s
        # what came before the recording is not known
        self._skip = max(1, round((machine.num_history + 1.0 / machine.period_s) / WIDTH))
        used = [r for r in recordings if r.num_samples > WIDTH * (self._skip + 4)]
        if not used:
            raise RecordingError(
                f"too little data: none of the {len(self.recordings)} recordings lasts long enough to fit to"
            )
        self._u = [r.u.astype(np.float64) for r in used]
        self._played = [_apply_plays(u) for u in self._u]
        pose = PoseFeatures(machine, torch.device("cpu"))
        self._pose = [pose.features(torch.as_tensor(r.q)).numpy().astype(np.float64) for r in used]
        self.num_pose = pose.size
        q = [r.q.astype(np.float64) for r in used]
        way = [self._increments(np.diff(part, axis=0, append=part[-1:])) for part in q]
        self.way = np.concatenate(way).T  # (J, I)
        self._free = np.concatenate([self._at_stop(part) for part in q]).T
        self.scale = np.maximum(np.mean(self.way**2, 1), 1e-12)
        if (still := np.flatnonzero(self.scale < 1e-10)).size:
            names = ", ".join(machine.joint_names[j] for j in still)
            raise RecordingError(
                f"too little data: {names} never moves in the {len(used)} recordings to fit to"
            )
        self._noise = 1e-3 * self.scale  # a first guess of the squared error, for the priors
        self._bend = _build_bend_penalty(knots)

    def features(
        self, j: int, dynamics: np.ndarray, known: Sequence[np.ndarray] | None = None
    ) -> np.ndarray:
        """Return increments per unit of the curve at each knot, `(I, 2 (K - 1))`.

        `known`: factors on the speed, or none.
        """
        parts = []
        for n in range(len(self._u)):
            basis = self._basis(self._spool(n, j, dynamics), j)
            basis = basis if known is None else basis * known[n][:, None]
            parts.append(self._increments(lag_signal(basis, dynamics[3], self._period_s)))
        return np.concatenate(parts)

    def factors(self, found: StaticFit, dynamics: np.ndarray) -> list[list[np.ndarray]]:
        """Return the speed factor from pose and pump, by joint and recording, each `(T,)`."""
        joints, half = range(self.machine.num_joints), len(self._knots) - 1
        full = np.maximum(np.abs(found.curve[:, [half - 1, 2 * half - 1]]), 1e-3)
        unit = self.machine.max_speed * self._period_s
        spool = self._stack_spools(dynamics)
        plain = [
            np.stack([self._basis(s[:, j], j) @ found.curve[j] for j in joints], 1) / unit
            for s in spool
        ]
        share = [
            _compute_pump_share(found.demand, np.abs(p) / np.where(s > 0, full[:, 0], full[:, 1]))
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
        """Return the curve that explains `way` `(I,)`: ridge regression to straight lines."""
        noise = 1e-3 * float(np.mean(way**2)) if noise is None else noise
        weighted = features if free is None else features * free[:, None]
        normal = weighted.T @ features + noise / STIFFNESS**2 * self._bend
        normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
        return np.linalg.solve(normal, weighted.T @ way)

    def statics(
        self, dynamics: np.ndarray, sweeps: int, demand: np.ndarray | None = None
    ) -> StaticFit:
        """Return curves, pose and demands for given dynamics `(J, 4)`.

        `demand`: where to begin, if known.
        """
        joints, count, half = self.machine.num_joints, len(self._u), len(self._knots) - 1
        spool = self._stack_spools(dynamics)
        basis = [[self._basis(spool[n][:, j], j) for j in range(joints)] for n in range(count)]
        found = StaticFit(
            np.zeros((joints, 2 * half)),
            np.zeros((joints, 2, self.num_pose)),
            np.full(joints, 0.55) if demand is None else demand,
        )
        opening = [np.abs(s) for s in spool]
        noise, free = self._noise.copy(), self._free.copy()

        def collect(parts: list[np.ndarray], j: int) -> np.ndarray:
            return np.concatenate(
                [
                    self._increments(lag_signal(part, dynamics[j, 3], self._period_s))
                    for part in parts
                ]
            )

        for _ in range(sweeps):
            share = [_compute_pump_share(found.demand, o) for o in opening]
            flow: list[list[np.ndarray]] = []
            for j in range(joints):
                out = [s[:, j] > 0 for s in spool]
                factor = [self._factor(n, j, out[n], found.pose) for n in range(count)]
                scaled = [basis[n][j] * (factor[n] * share[n])[:, None] for n in range(count)]
                features = collect(scaled, j)
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
            posed = []
            for n, moved in enumerate(plain):
                factor = [self._factor(n, j, spool[n][:, j] > 0, found.pose) for j in range(joints)]
                posed.append(moved * np.stack(factor, 1))
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

        starts = [
            start,
            *(np.full(joints, level) for level in (0.3, 0.55, 0.8) if (start == start[0]).all()),
        ]
        best = min(starts, key=lambda demand: float(np.square(compute_residual(demand)).sum()))
        return least_squares(
            compute_residual,
            np.clip(best, 0.0, 1.99),
            bounds=(0.0, 2.0),
            diff_step=1e-3,
            max_nfev=12,
        ).x

    def _factor(self, n: int, j: int, out: np.ndarray, pose: np.ndarray) -> np.ndarray:
        features = self._pose[n][:, j]
        return np.maximum(1.0 + np.where(out, features @ pose[j, 0], features @ pose[j, 1]), 0.0)

    def _spool(self, n: int, j: int, dynamics: np.ndarray) -> np.ndarray:
        dead_time_s, play, spool_s, _ = dynamics
        low = int(np.clip(np.searchsorted(PLAYS, play, side="right") - 1, 0, len(PLAYS) - 2))
        part = (play - PLAYS[low]) / (PLAYS[low + 1] - PLAYS[low])
        played = (1.0 - part) * self._played[n][low, :, j] + part * self._played[n][low + 1, :, j]
        return lag_signal(
            delay_signal(played, dead_time_s / self._period_s), spool_s, self._period_s
        )

    def _stack_spools(self, dynamics: np.ndarray) -> list[np.ndarray]:
        """Return the spool strokes of each recording, `(T, J)`, for dynamics `(J, 4)`."""
        joints = range(self.machine.num_joints)
        return [
            np.stack([self._spool(n, j, dynamics[j]) for j in joints], 1)
            for n in range(len(self._u))
        ]

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
        """Return 1 for increments away from both stops, else 0, `(I, J)`."""
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
    out, now, half = (
        np.empty((len(PLAYS), *u.shape)),
        np.repeat(u[:1], len(PLAYS), 0),
        PLAYS[:, None] / 2,
    )
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


log = logging.getLogger(__name__)


@spec
class ValveFit:
    """Fits the valve curve and all other numbers of `actuator=valve`.

    Attributes:
        name: Name of the model in tables and of the file that it leaves, `<name>.yaml`, an option
            for `actuator=@…`.
        actuator: The model; its knots are kept.
        longest_lag_s: Upper bound of each lag.
        sweeps: Turns of curve, pose and pump.
        iterations: Steps of each of the two searches for dead time, play and lags, joint by joint;
            the second knows pose and pump.
    """

    name: str
    actuator: ValveActuator
    longest_lag_s: float
    sweeps: int
    iterations: int

    def check(self) -> None:
        if self.longest_lag_s <= 0 or min(self.sweeps, self.iterations) < 1:
            raise ConfigError("fit: longest_lag_s must be above 0, sweeps and iterations 1 or more")

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> ValveActuator:
        """Fit to all recordings and write `<name>.yaml` into `folder`; validation chooses nothing.

        Raises:
            RecordingError: a joint never moves.
            StorageError: the file could not be written.
        """
        del seed, device  # deterministic, numpy
        data = SpeedData([*train, *validation], machine, np.array(self.actuator.knots))
        dynamics = np.zeros((machine.num_joints, 4))
        with Progress(transient=True) as progress:
            rounds = [(turn, j) for turn in range(2) for j in range(machine.num_joints)]
            known: list[list[np.ndarray]] | None = None
            for turn, j in progress.track(rounds, description=f"{self.name}: dead times and lags"):
                if turn and known is None:
                    known = data.factors(data.statics(dynamics, self.sweeps), dynamics)
                dynamics[j] = self._dynamics(
                    data, j, known[j] if known else None, dynamics[j] if turn else None
                )
        fitted = self._spec(data, dynamics)
        # through JSON, which makes lists of tuples as YAML wants them
        facts = json.loads(json.dumps(dataclasses.asdict(fitted)))  # pyright: ignore[reportArgumentType]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            text = yaml.safe_dump(
                {"_target_": f"{ValveActuator.__module__}.{ValveActuator.__name__}", **facts},
                sort_keys=False,
                width=130,
            )
            write_text(
                folder / f"{self.name}.yaml",
                f"# fitted to {len(data.recordings)} recordings of {machine.name}\n{text}",
            )
        except OSError as error:
            raise StorageError(f"cannot write into {folder}: {error.strerror or error}") from error
        return fitted

    def refit(
        self, fitted: ValveActuator, machine: Machine, recordings: Sequence[Recording]
    ) -> ValveActuator:
        """Return `fitted` with curves, pose and pump refitted; the dynamics stay."""
        columns = [getattr(fitted, name) for name in ("dead_time_s", "play", "spool_s", "speed_s")]
        dynamics = np.array([[column[name] for column in columns] for name in machine.joint_names])
        assert isinstance(fitted.demand, dict), "a fitted actuator has numbers by joint"
        demand = np.array([fitted.demand[name] for name in machine.joint_names])
        return self._spec(
            SpeedData(recordings, machine, np.array(self.actuator.knots)), dynamics, demand
        )

    def _dynamics(
        self, data: SpeedData, j: int, known: Sequence[np.ndarray] | None, start: np.ndarray | None
    ) -> np.ndarray:
        """Return the dead time, play, spool lag and speed lag that explain joint `j` best.

        Args:
            data: The recordings.
            j: The joint.
            known: Factor on the speed, from pose and pump, of each recording; `None` while they are
                not known.
            start: Where the search begins; `None`: at the best dead time.
        """
        machine = data.machine
        most = np.array(
            [
                (machine.num_history - 2) * machine.period_s,
                PLAYS[-1],
                self.longest_lag_s,
                self.longest_lag_s,
            ]
        )

        def left(x: np.ndarray) -> np.ndarray:
            features = data.features(j, x, known)
            return (data.way[j] - features @ data.curve(features, data.way[j])) / np.sqrt(
                data.scale[j]
            )

        if start is None:
            delays = np.arange(0.0, most[0] + 1e-9, machine.period_s)
            losses = [
                float(np.square(left(np.array([delay, 0.01, 0.04, 0.0]))).sum()) for delay in delays
            ]
            start = np.array([delays[int(np.argmin(losses))], 0.02, 0.03, 0.02])
        inside = np.clip(start, 1e-6, most - 1e-6)
        step = np.array([0.1, 0.3, 0.3, 0.3])  # of `x_scale`: above the grain of the samples
        return least_squares(
            left,
            inside,
            bounds=(np.zeros(4), most),
            x_scale=np.array([0.02, 0.02, 0.02, 0.02]),
            diff_step=0.02 * step / np.maximum(inside, 1e-3) * 0.5,
            loss="soft_l1",
            f_scale=0.05,
            max_nfev=self.iterations,
        ).x

    def _spec(
        self, data: SpeedData, dynamics: np.ndarray, demand: np.ndarray | None = None
    ) -> ValveActuator:
        found = data.statics(
            dynamics, self.sweeps if demand is None else max(1, self.sweeps // 2), demand
        )
        names, half = data.machine.joint_names, len(self.actuator.knots) - 1

        def table(values: np.ndarray) -> dict[str, float]:
            return {name: float(f"{value:.5g}") for name, value in zip(names, values, strict=True)}

        def rows(values: np.ndarray) -> dict[str, tuple[float, ...]]:
            return {
                name: tuple(float(f"{v:.5g}") for v in row)
                for name, row in zip(names, values, strict=True)
            }

        zero = np.zeros((len(names), 1))
        return dataclasses.replace(  # pyright: ignore[reportArgumentType]
            self.actuator,  # pyright: ignore[reportArgumentType]
            dead_time_s=table(dynamics[:, 0]),
            play=table(dynamics[:, 1]),
            spool_s=table(dynamics[:, 2]),
            speed_s=table(dynamics[:, 3]),
            demand=table(found.demand),
            curve_extend=rows(np.hstack([zero, np.maximum(found.curve[:, :half], 0.0)])),
            curve_retract=rows(np.hstack([zero, np.maximum(found.curve[:, half:], 0.0)])),
            pose_extend=rows(found.pose[:, 0]),
            pose_retract=rows(found.pose[:, 1]),
        )
