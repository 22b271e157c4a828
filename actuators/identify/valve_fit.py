"""Fit of `actuators.models.valve` in seconds, joint by joint, by nonlinear least squares.

Positions hardly feed back into the speed, so the model is driven by recorded commands and, for the pose,
recorded positions. Increments of `WIDTH` samples are compared. The slopes of curves and pose are exact; those
of dead time, play and lags are differences. The pump, which joints share, takes turns with the joints.

Axes: `T` time, `J` joints, `K` knots, `M` features of the pose, `I` increments.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares

from actuators.contracts import FitTask
from actuators.identify.dead_time import AT_STOP, estimate_dead_times
from actuators.identify.option_file import write_numbers
from actuators.identify.signals import apply_play, delay_signal, lag_signal
from actuators.models.valve import PoseFeatures, ValveActuator
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel
from brokk_rl.progress import ItemProgress
from brokk_rl.record import Recording
from brokk_rl.spec import Count, Positive, spec

WIDTH = 5
"""Samples in an increment: long enough for a coarse sensor, short enough to see when a joint
starts."""
PLAYS = np.array([0.0, 0.01, 0.02, 0.035, 0.05, 0.08, 0.12])
"""Widths for which the play is computed; between them its output is interpolated."""
STIFFNESS = 4.0
"""Prior: slope of a flow curve changes by so much per root of stroke."""
POSE = 0.03
"""Prior: relative change of speed per feature of the pose."""
DEMAND = 10.0
"""Prior of the demand, in errors of an increment: without evidence a joint asks for nothing."""
FIRST_DEMAND = 0.8
"""Demand of each joint from which the search starts: a demand that is too low has no slope."""
TOGETHER = 15.0
"""Increments whose errors hang together: a speed that wanders for some seconds is no evidence for a
bend of the curve or a pose."""
SIGMA_OVER_MEDIAN = 1.4826
"""Standard deviation over the median absolute deviation of a normal distribution: 1 / 0.6745."""
STILL = 1e-10
"""Mean square of the increments of a joint that never moves, rad² or m²."""
NUM_DYNAMICS = 4
"""Dead time, play, lag of the valve, lag of the speed: the first numbers of a joint."""
START = np.array([0.0, 0.02, 0.03, 0.02])
STEPS = np.array([1e-3, 3e-3, 3e-3, 3e-3])
"""Differences for their slopes, above the grain of the samples."""


@spec
class ValveFit:
    """Fits the valve curve and all other numbers of `actuator=valve`.

    Attributes:
        name: Name of the model in tables and of the file that it leaves, `<name>.yaml`, an option
            for `actuator=@…`.
        actuator: The model; its knots are kept.
        longest_lag_s: Upper bound of each lag.
        sweeps: Turns of joints and pump.
        iterations: Least-squares evaluations a joint in each of them.
    """

    name: str
    actuator: ValveActuator
    longest_lag_s: Positive
    sweeps: Count
    iterations: Count

    def fit(self, task: FitTask) -> ValveActuator:
        """Fit to all recordings and write `<name>.yaml`; validation chooses nothing.

        Raises:
            RecordingError: a joint never moves.
            StorageError: the file could not be written.
        """
        machine = task.machine
        runs = _ValveRuns(task.recordings, machine, np.array(self.actuator.knots))
        longest_s = (machine.num_history - 2) * machine.period_s
        most = np.array([longest_s, PLAYS[-1], self.longest_lag_s, self.longest_lag_s])
        with ItemProgress(f"{self.name}: joints and pump", self.sweeps) as progress:
            for _ in range(self.sweeps):
                runs.fit_joints(most, self.iterations)
                runs.fit_demand()
                progress.advance()
        half = len(self.actuator.knots) - 1
        dynamics, curve, pose = runs.numbers
        curve = np.insert(np.maximum(curve, 0.0), [0, half], 0.0, axis=1)
        columns = {
            "dead_time_s": dynamics[:, 0],
            "play": dynamics[:, 1],
            "spool_s": dynamics[:, 2],
            "speed_s": dynamics[:, 3],
            "demand": runs.demand,
            "curve_extend": curve[:, : half + 1],
            "curve_retract": curve[:, half + 1 :],
            "pose_extend": pose[:, : pose.shape[1] // 2],
            "pose_retract": pose[:, pose.shape[1] // 2 :],
        }
        return write_numbers(task.folder, self.name, self.actuator, machine, columns, {})


class _ValveRuns:
    """Recordings as increments, and the model on them.

    Attributes:
        demand: Demand of each joint, of the pump's flow, `(J,)`.
    """

    def __init__(
        self, recordings: Sequence[Recording], machine: Machine, knots: np.ndarray
    ) -> None:
        self._machine, self._knots, self._period_s = machine, knots, machine.period_s
        # what came before a recording is not known
        self._skip = max(1, round((machine.num_history + 1.0 / machine.period_s) / WIDTH))
        used = [one for one in recordings if one.num_samples > WIDTH * (self._skip + 4)]
        if not used:
            raise RecordingError(
                f"too little data: none of the {len(recordings)} recordings lasts long enough to fit to"
            )
        features = PoseFeatures(machine, torch.device("cpu"))
        self._played: list[np.ndarray] = []
        self._pose: list[np.ndarray] = []
        for one in used:
            u = one.u.astype(float)
            # each width of `PLAYS`, `(P, T, J)`
            plays = [np.apply_along_axis(apply_play, 0, u, width) for width in PLAYS]
            self._played.append(np.stack(plays))
            self._pose.append(features.features(torch.as_tensor(one.q)).numpy().astype(float))
        way, free = [], []
        margin = AT_STOP * (machine.upper - machine.lower)
        for one in used:
            q = one.q.astype(float)
            way.append(self._sum(np.diff(q, axis=0, append=q[-1:])))
            inside = (q > machine.lower + margin) & (q < machine.upper - margin)
            free.append(self._sum(inside.astype(float)) > WIDTH - 0.5)
        self._way = np.concatenate(way).T
        self._free = np.concatenate(free).T.astype(float)
        scale = np.mean(self._way**2, 1)
        if (still := np.flatnonzero(scale < STILL)).size:
            names = ", ".join(machine.joint_names[j] for j in still)
            raise RecordingError(
                f"too little data: {names} never moves in the {len(used)} recordings to fit to"
            )
        self._noise = np.sqrt(1e-3 * scale)  # a first guess, for the priors
        self._bend = _build_bend_rows(knots) / STIFFNESS
        half, size = len(knots) - 1, features.size
        self._parts = np.cumsum([NUM_DYNAMICS, 2 * half])
        first = np.concatenate([START, knots[1:], knots[1:], np.zeros(2 * size)])
        self._x = np.tile(first, (machine.num_joints, 1))
        self.demand = np.full(machine.num_joints, FIRST_DEMAND)
        self._share = [np.ones(len(one.q)) for one in used]
        delays = estimate_dead_times(used, machine, np.random.default_rng(0))
        for row, delay in zip(self._x, delays.values(), strict=True):
            # the search counts lags as delay
            row[0] = machine.dead_time_s if delay is None else delay.value_s - START[2:].sum()

    @property
    def numbers(self) -> list[np.ndarray]:
        """Dynamics `(J, 4)`, curves `(J, 2 (K - 1))` and slopes of the pose `(J, 2 M)`."""
        return np.split(self._x, self._parts, 1)

    def fit_joints(self, most: np.ndarray, iterations: int) -> None:
        """Fit the numbers of all joints; `most`: upper bounds of the dynamics."""
        joints = range(self._machine.num_joints)
        found = map_parallel(lambda j: self._fit_joint(j, most, iterations), joints)
        for j, (x, noise) in enumerate(found):
            self._x[j], self._noise[j] = x, noise

    def _fit_joint(self, j: int, most: np.ndarray, iterations: int) -> tuple[np.ndarray, float]:
        """Return the numbers of a joint, and the error of an increment that they leave."""
        x, noise, free = self._x[j].copy(), self._noise[j], self._free[j]
        low, high = np.full(len(x), -np.inf), np.full(len(x), np.inf)
        low[:NUM_DYNAMICS], high[:NUM_DYNAMICS] = 0.0, most
        x[:NUM_DYNAMICS] = np.clip(x[:NUM_DYNAMICS], 1e-6, most - 1e-6)

        def compute_errors(x: np.ndarray) -> np.ndarray:
            _, curve, pose = np.split(x, self._parts)
            left = (self._way[j] - self._predict(j, x)) * free / noise
            return np.concatenate([left, self._bend @ curve, pose / POSE])

        def compute_slopes(x: np.ndarray) -> np.ndarray:
            here, columns = self._predict(j, x), []
            for number, step in enumerate(STEPS):
                moved = x.copy()
                moved[number] += step
                columns.append((self._predict(j, moved) - here)[:, None] / step)
            slopes = np.hstack([*columns, self._differentiate(j, x)])
            priors = np.zeros((len(self._bend) + len(x) - self._parts[1], len(x)))
            priors[: len(self._bend), slice(*self._parts)] = self._bend
            priors[len(self._bend) :, self._parts[1] :] = np.eye(len(x) - self._parts[1]) / POSE
            return np.vstack([-slopes * (free / noise)[:, None], priors])

        options: Any = {"jac": compute_slopes, "loss": "soft_l1", "x_scale": "jac"}
        options |= {"bounds": (low, high), "max_nfev": iterations}
        found = least_squares(compute_errors, x, **options).x
        left = self._way[j] - self._predict(j, found)
        # increments of a joint at rest fit anyway and would hide the typical error
        moves = np.abs(self._way[j]) > 0.1 * np.sqrt(np.mean(self._way[j] ** 2))
        typical = SIGMA_OVER_MEDIAN * np.median(np.abs(left[moves]))
        least = 1e-3 * np.sqrt(np.mean(self._way[j] ** 2))
        return found, float(np.sqrt(TOGETHER) * max(typical, least))

    def _list_parts(self, j: int, x: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield basis of the curve, slopes by the pose and factor of the pose for each recording."""
        dynamics, _, pose = np.split(x, self._parts)
        for played, features in zip(self._played, self._pose, strict=True):
            spool = self._follow(played[:, :, j], dynamics)
            out = (spool > 0)[:, None]
            sides = np.hstack([features[:, j] * out, features[:, j] * ~out])
            yield self._build_basis(spool, j), sides, np.maximum(1.0 + sides @ pose, 0.0)

    def _predict(self, j: int, x: np.ndarray) -> np.ndarray:
        """Return the increments of a joint, `(I,)`."""
        curve, found = np.split(x, self._parts)[1], []
        for (basis, _, factor), share in zip(self._list_parts(j, x), self._share, strict=True):
            found.append((basis @ curve * factor * share)[:, None])
        return self._collect(found, x[3])[:, 0]

    def _differentiate(self, j: int, x: np.ndarray) -> np.ndarray:
        """Return their slopes over curve and pose, `(I, 2 (K - 1) + 2 M)`."""
        curve, found = np.split(x, self._parts)[1], []
        for (basis, sides, factor), share in zip(self._list_parts(j, x), self._share, strict=True):
            by_curve = basis * (factor * share)[:, None]
            found.append(np.hstack([by_curve, sides * (basis @ curve * share)[:, None]]))
        return self._collect(found, x[3])

    def fit_demand(self) -> None:
        """Fit the demands on the pump by how joints slow each other."""
        joints, half = range(self._machine.num_joints), len(self._knots) - 1
        full = np.maximum(np.abs(self.numbers[1][:, [half - 1, 2 * half - 1]]), 1e-3)
        unit = self._machine.max_speed * self._period_s
        steps, opened = [], []
        for parts in zip(*(self._list_parts(j, self._x[j]) for j in joints), strict=True):
            plain = np.stack([parts[j][0] @ self.numbers[1][j] for j in joints], 1)
            steps.append(plain * np.stack([factor for _, _, factor in parts], 1))
            opened.append(np.abs(plain) / unit / np.where(plain > 0, full[:, 0], full[:, 1]))

        def compute_errors(demand: np.ndarray) -> np.ndarray:
            rows = [demand / DEMAND]
            shares = [_compute_pump_share(demand, one) for one in opened]
            for j in joints:
                moved = [(one[:, j] * by)[:, None] for one, by in zip(steps, shares, strict=True)]
                left = self._way[j] - self._collect(moved, self._x[j, 3])[:, 0]
                rows.append(left * self._free[j] / self._noise[j])
            return np.concatenate(rows)

        self.demand = least_squares(
            compute_errors, self.demand, bounds=(0.0, 2.0), diff_step=1e-3, max_nfev=12
        ).x
        self._share = [_compute_pump_share(self.demand, one) for one in opened]

    def _follow(self, played: np.ndarray, dynamics: np.ndarray) -> np.ndarray:
        """Return the spool's strokes, `(T,)`, for commands behind each of `PLAYS`."""
        dead_time_s, play, spool_s, _ = dynamics
        low = int(np.clip(np.searchsorted(PLAYS, play, side="right") - 1, 0, len(PLAYS) - 2))
        part = (play - PLAYS[low]) / (PLAYS[low + 1] - PLAYS[low])
        behind = (1.0 - part) * played[low] + part * played[low + 1]
        late = delay_signal(behind, dead_time_s / self._period_s)
        return lag_signal(late, spool_s, self._period_s)

    def _build_basis(self, spool: np.ndarray, j: int) -> np.ndarray:
        """Return signed hat functions of the spool times full step, `(T, 2 (K - 1))`."""
        knots, half, size = self._knots, len(self._knots) - 1, np.minimum(np.abs(spool), 1.0)
        cell = np.clip(np.searchsorted(knots, size, side="right") - 1, 0, half - 1)
        part = (size - knots[cell]) / (knots[cell + 1] - knots[cell])
        # the first column is that of no stroke
        hats, rows = np.zeros((len(spool), 2, half + 1)), np.arange(len(spool))
        side = np.where(spool > 0, 0, 1)
        hats[rows, side, cell], hats[rows, side, cell + 1] = 1.0 - part, part
        unit = np.sign(spool) * self._machine.max_speed[j] * self._period_s
        return hats[:, :, 1:].reshape(len(spool), -1) * unit[:, None]

    def _collect(self, parts: Sequence[np.ndarray], speed_s: float) -> np.ndarray:
        """Return the increments of steps `(T, …)` of all recordings after the lag of the speed."""
        late = [lag_signal(part, speed_s, self._period_s) for part in parts]
        return np.concatenate([self._sum(part) for part in late])

    def _sum(self, steps: np.ndarray) -> np.ndarray:
        """Sum steps `(T, …)` over `WIDTH` samples each, without the beginning, `(I, …)`."""
        count = len(steps) // WIDTH
        return steps[: count * WIDTH].reshape(count, WIDTH, *steps.shape[1:]).sum(1)[self._skip :]


def _compute_pump_share(demand: np.ndarray, opening: np.ndarray) -> np.ndarray:
    return 1.0 / np.maximum(1.0, opening @ demand)


def _build_bend_rows(knots: np.ndarray) -> np.ndarray:
    """Return the slope changes of both curves, each over the root of its stroke, as rows `(…, 2 (K - 1))`."""
    stroke = np.diff(knots)
    slopes = np.diff(np.eye(len(knots)), axis=0) / stroke[:, None]
    rows = np.diff(slopes, axis=0)[:, 1:] / np.sqrt((stroke[1:] + stroke[:-1]) / 2)[:, None]
    none = np.zeros_like(rows)
    return np.block([[rows, none], [none, rows]])
