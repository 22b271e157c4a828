"""Regressions of a simulator's residuals on its own motion: on the reference, and after the repair.

On the reference they give the discrepancy: errors that a tidy simulator makes wherever the machine
goes, such as a wavy flow curve or oil that warms up. It is taken off in the field before any effect
is tried (Kennedy and O'Hagan's discrepancy, linear), as far as one part of the reference predicts
another. After the repair they give clues: small ridge regressions, each on one thing that a machine
could depend on. A clue that still predicts the residuals shows a cause outside the library.
Axes: `W` windows, `I` increments, `J` joints, `E` entries (whitened increments), `F` features.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.signal import lfilter

from brokk_rl.parallel import map_parallel
from diagnosis.error_covariance import compute_loss, weigh_residuals
from diagnosis.refine import FittedSet
from diagnosis.residuals import INCREMENT_SAMPLES, Residuals, to_increments
from diagnosis.responses import fit_sizes

# Chosen by hand; not searched.
DISCREPANCY_RIDGES = (10.0, 100.0, 1000.0)
"""Pulls towards no discrepancy, in features of unit size over the noise; that which predicts best
is used."""
TURN_LAGS = 2
"""Increments before and after whose changes of speed may matter."""
SPEED_LEVELS = (0.0, 0.25, 0.5, 0.75)
"""Speeds, of full speed, about which errors may differ."""
POSITION_ORDERS = (1, 2, 3, 4)
"""Chebyshev polynomials of the position within the travel."""
MAX_FAULT_SCALE = 5.0
"""Faults are no larger than so many times the usual."""
MAX_VARIANCE_SHARE = 0.5
"""Variance of an estimate, over that of its prior, up to which recordings tell anything about a
fault."""
WARM_S = 900.0
"""Time in which oil warms up."""


def build_features(residuals: Residuals, j: int) -> np.ndarray:
    """Return features of the simulator's own motion that may predict an error of joint `j`, `(W, I, F)`."""
    way, machine = residuals.increments, residuals.simulator.machine
    full = machine.max_speed * machine.period_s * INCREMENT_SAMPLES
    own, speed = way[..., j], way / full
    middle, half = (machine.upper + machine.lower)[j] / 2, (machine.upper - machine.lower)[j] / 2
    place = np.clip((residuals.start[:, None, j] + np.cumsum(own, 1) - middle) / half, -1.0, 1.0)
    size, out = np.abs(speed[..., j]), (own > 0).astype(float)
    sides, turn = (out, 1.0 - out), np.diff(own, axis=1, prepend=own[:, :1])
    warm = 1.0 - np.exp(-residuals.simulator.running_s / WARM_S)[:, None]
    columns = [own * side for side in sides] + [np.full_like(own, 0.1 * full[j]), own * warm]
    columns += [
        own * np.maximum(1.0 - np.abs(size - level) / 0.25, 0.0) * side
        for level in SPEED_LEVELS
        for side in sides
    ]
    columns += [
        own * np.cos(order * np.arccos(place)) * side for order in POSITION_ORDERS for side in sides
    ]
    columns += [
        np.roll(turn, shift, 1) * side
        for shift in range(-TURN_LAGS, TURN_LAGS + 1)
        for side in sides
    ]
    columns += [np.abs(turn), np.abs(np.roll(turn, 1, 1)), np.sign(own) * (size < 0.1) * full[j]]
    for k in range(way.shape[2]):
        if k != j:
            other = speed[..., k]
            columns += [own * np.abs(other), full[j] * other, full[j] * np.abs(other)]
    return np.stack(columns, -1)


def fit_ridge(x: np.ndarray, z: np.ndarray, pull: float) -> np.ndarray:
    """Return coefficients `(F,)` of a robust ridge regression of `z` `(E,)` on features `(E, F)` of about unit size."""
    beta = np.zeros(x.shape[1])
    for _ in range(3):
        weighted = x * weigh_residuals(z - x @ beta)[:, None]
        beta = np.linalg.solve(weighted.T @ x + pull * np.eye(x.shape[1]), weighted.T @ z)
    return beta


def learn_discrepancy(
    parts: Sequence[Residuals], field: Residuals
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the discrepancy of each part, learned on the others, and of the field, learned on all, each `(W, I, J)`.

    Joints of which no part predicts the others have none.

    Args:
        parts: The simulator against parts of the reference that it was not fitted to, with their
            noise.
        field: The simulator against the field.
    """
    found = [np.zeros_like(part.increments) for part in parts]
    of_field = np.zeros_like(field.increments)
    if len(parts) < 2:
        return found, of_field
    for part in parts:
        part.z  # noqa: B018  # made once, before other processes need it

    def learn(j: int) -> list[np.ndarray] | None:
        raw = [build_features(part, j) for part in parts]
        white = [part.whiten_joint(columns, j) for part, columns in zip(parts, raw, strict=True)]
        size = np.sqrt(np.mean(np.square(np.concatenate(white)), 0))
        by = np.where(size > 1e-9, 1.0 / np.maximum(size, 1e-9), 0.0)
        x, z = [one * by for one in white], [part.z[j] for part in parts]
        # Without any discrepancy the loss is that of the residuals: a ridge must predict better.
        best, lowest = None, sum(float(compute_loss(one)) for one in z)
        for pull in DISCREPANCY_RIDGES:
            betas, losses = [], []
            for out in range(len(parts)):
                rest = [k for k in range(len(parts)) if k != out]
                known_x = np.concatenate([x[k] for k in rest])
                known_z = np.concatenate([z[k] for k in rest])
                betas.append(fit_ridge(known_x, known_z, pull))
                losses.append(float(compute_loss(z[out] - x[out] @ betas[out])))
            total = sum(losses)
            if total < lowest:
                best, lowest = (pull, betas), total
        if best is None:
            return None
        pull, betas = best
        biases = [columns @ (beta * by) for columns, beta in zip(raw, betas, strict=True)]
        whole = fit_ridge(np.concatenate(x), np.concatenate(z), pull)
        return [*biases, build_features(field, j) @ (whole * by)]

    field.increments  # noqa: B018  # made once, before other processes need it
    for j, learned in enumerate(map_parallel(learn, range(of_field.shape[2]))):
        if learned:
            for bias, mine in zip([*found, of_field], learned, strict=True):
                bias[..., j] = mine
    return found, of_field


def estimate_fault_scales(parts: Sequence[Residuals]) -> np.ndarray:
    """Return the errors of the simulator's own numbers on the reference over the usual ones, `(P,)`, 1 at least.

    Root mean square over all joints and parts, less the variance of the estimates.
    """
    squares, chance = [], []
    for part in parts:
        for z, faults in zip(part.z, part.faults, strict=True):
            lines = MAX_FAULT_SCALE * faults
            found = fit_sizes(z, [], faults=lines)
            weighted = lines * weigh_residuals(z - found @ lines)
            slack = np.diag(np.linalg.inv(weighted @ lines.T + np.eye(len(lines))))
            # A variance near that of the prior: the recordings tell nothing about the fault.
            squares.append(np.where(slack < MAX_VARIANCE_SHARE, np.square(found), np.nan))
            chance.append(np.where(slack < MAX_VARIANCE_SHARE, slack, np.nan))
    told = np.isfinite(squares)
    excess = (np.nansum(squares, 0) - np.nansum(chance, 0)) / np.maximum(told.sum(0), 1)
    return np.clip(MAX_FAULT_SCALE * np.sqrt(np.maximum(excess, 0.0)), 1.0, MAX_FAULT_SCALE)


# Chosen by hand. CLUE_RIDGES grew from 3 values to 7; no comparison is recorded.
CLUE_RIDGES = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
"""Pulls towards nothing, in features of unit size over the noise; that which makes the errors most
likely is used."""
PAST_S = (2.0, 4.0, 8.0, 16.0)
"""Over how long work before may matter."""
MAX_STRAY = 9.0
"""A window that strays further, over what the noise lets expect, counts no more than this."""
MOVING_SHARE = 0.25
"""Share of full speed from which another joint counts as moving."""


@dataclass(frozen=True)
class SimulatedMotion:
    """A simulator's own motion, as far as errors of joint `j` could depend on it; columns are `(W, I)`."""

    residuals: Residuals
    j: int

    @cached_property
    def own(self) -> np.ndarray:
        """Increments."""
        return self.residuals.increments[..., self.j]

    @cached_property
    def slip(self) -> np.ndarray:
        """Loss of increments where motion comes a sample late."""
        q, start = self.residuals.base[..., self.j], self.residuals.start[:, None, self.j]
        return to_increments(np.diff(q, axis=1, prepend=start)[..., None], np.zeros((len(q), 1)))[
            ..., 0
        ]

    @cached_property
    def share(self) -> np.ndarray:
        """Speed of all joints over their full speed, `(W, I, J)`."""
        machine = self.residuals.simulator.machine
        return self.residuals.increments / (
            machine.max_speed * machine.period_s * INCREMENT_SAMPLES
        )

    @cached_property
    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """1 where the joint extends; where it retracts."""
        out = (self.own > 0).astype(float)
        return out, 1.0 - out

    @cached_property
    def place(self) -> np.ndarray:
        """Positions at both ends of each increment, over the travel, `(2, W, I)`."""
        machine, end = (
            self.residuals.simulator.machine,
            self.residuals.start[:, None, self.j] + np.cumsum(self.own, 1),
        )
        low, high = machine.lower[self.j], machine.upper[self.j]
        return np.clip((np.stack([end - self.own, end]) - low) / (high - low), 0.0, 1.0)

    @cached_property
    def work(self) -> np.ndarray:
        """Demand of all joints, over full speed."""
        return np.abs(self.share).sum(-1)

    def faded(self, column: np.ndarray, kept: float) -> np.ndarray:
        """Return the exponentially weighted mean of the earlier samples of a recording, across its windows."""
        runs, found = self.residuals.simulator.cut.run, np.empty_like(column)
        for run in np.unique(runs):
            mine = runs == run
            found[mine] = np.asarray(
                lfilter([0.0, 1.0 - kept], [1.0, -kept], column[mine].ravel())
            ).reshape(-1, column.shape[1])
        return found

    @cached_property
    def time(self) -> list[np.ndarray]:
        """Courses of the running time, `(W, 1)`: even, bent, to and fro, warming up."""
        at = np.linspace(-1.0, 1.0, len(self.own))[:, None]
        warm = 1.0 - np.exp(-self.residuals.simulator.running_s / WARM_S)[:, None]
        slow = [at, at**2 - 0.5, np.sin(3 * np.pi * at), np.cos(3 * np.pi * at)]
        return [*slow, (warm - warm.mean()) / max(float(warm.std()), 1e-9)]


def apply_fitted_set(residuals: Residuals, fitted: FittedSet | None) -> Residuals:
    """Return the evidence of the simulator with the effects that were found, sizes from the half that they were not fitted to."""
    if fitted is None:
        return residuals
    simulator, mean = (
        residuals.simulator,
        0.0 if residuals.mean is None else residuals.mean,
    )  # `after` has it in, errors have it out
    fixed = [*simulator.fixed, *fitted.effects()]
    return replace(residuals, simulator=replace(simulator, fixed=fixed), runs=fitted.after - mean)


def _build_start_stop(m: SimulatedMotion) -> list[np.ndarray]:
    """Start and stops, just before and after."""
    turn = np.diff(m.own, axis=1, prepend=m.own[:, :1])
    faster = np.diff(np.abs(m.own), axis=1, prepend=np.abs(m.own[:, :1])) > 0
    columns = []
    # A valve may answer a start later than a stop, and one side later than the other.
    for by in (-1, 0, 1, 2, 3):
        for when in (faster, ~faster):
            columns += [_shift_later(turn * when * side, by) for side in m.sides]
    return columns


def _build_speed_curve(m: SimulatedMotion) -> list[np.ndarray]:
    return _split_by_side(m, _build_hats(np.abs(m.share[..., m.j]), 1.0, 8))


def _build_position(m: SimulatedMotion) -> list[np.ndarray]:
    return _split_by_side(m, _build_hats(m.place.mean(0), 1.0, 10))


def _split_by_side(m: SimulatedMotion, hats: Sequence[np.ndarray]) -> list[np.ndarray]:
    columns = []
    for hat in hats:
        columns += [m.own * hat * side for side in m.sides]
    return columns


def _build_sensor_angle(m: SimulatedMotion) -> list[np.ndarray]:
    """An encoder whose error depends on where it stands."""
    columns = []
    for turns in (0.5, 1, 1.5, 2, 3, 4):
        columns += [
            np.diff(wave(2 * np.pi * turns * m.place), axis=0)[0] for wave in (np.sin, np.cos)
        ]
    return columns


def _build_other_joints(m: SimulatedMotion) -> list[np.ndarray]:
    """Motion of the other joints, and the sum of all demands."""
    full, columns = np.abs(m.own).max() + 1e-12, []
    for k in range(m.share.shape[-1]):
        if k != m.j:
            other = m.share[..., k]
            columns += [
                m.own * np.abs(other),
                m.own * (np.abs(other) > MOVING_SHARE),
                full * other,
                full * np.maximum(other, 0.0),
            ]
    # A pump at its limit slows all joints from a demand on, so the sum has hinges of its own.
    columns += [m.own * hat for hat in _build_hats(m.work, 2.0, 5)]
    return columns + [m.own * np.maximum(m.work - at, 0.0) for at in (0.5, 1.0)]


def _build_running_time(m: SimulatedMotion) -> list[np.ndarray]:
    return [m.own * course for course in m.time] + [m.own * m.time[-1] * side for side in m.sides]


def _build_drifting_delay(m: SimulatedMotion) -> list[np.ndarray]:
    return [m.slip * m.time[k] for k in (0, 1, -1)]


def _build_past_work(m: SimulatedMotion) -> list[np.ndarray]:
    """Work done just before, by all and by itself, and the direction it went."""
    machine, columns = m.residuals.simulator.machine, []
    went = np.sign(m.own) * (np.abs(m.share[..., m.j]) > 0.03)
    for past_s in PAST_S:
        kept = np.exp(-INCREMENT_SAMPLES * machine.period_s / past_s)
        tired = m.faded(np.minimum(m.work, 1.0), kept)
        own = m.faded(np.abs(m.share[..., m.j]), kept)
        # The mean would be another gain.
        columns += [m.own * (tired - tired.mean()), m.own * (own - own.mean())]
        columns.append(np.abs(m.own) * m.faded(went, kept))
    return columns


STARTS, CURVE = "how it starts and stops", "how speed follows commands"
TIME, LATER = "running time", "timing over the running time"
CLUES: Mapping[str, Callable[[SimulatedMotion], list[np.ndarray]]] = {
    STARTS: _build_start_stop,
    "its position": _build_position,
    "the angle that the sensor reads": _build_sensor_angle,
    "the other joints": _build_other_joints,
    TIME: _build_running_time,
    LATER: _build_drifting_delay,
    "what it did before": _build_past_work,
    CURVE: _build_speed_curve,
}
"""By what they are about."""
FORMS = (STARTS, CURVE)
"""Clues that explain first, one after the other, what the rest may not."""


def score_clues(residuals: Residuals, z: np.ndarray) -> np.ndarray:
    """Return the log-likelihood gain of each clue on whitened residuals `z` `(J, E)`, `(clues, J)`."""
    order = [*FORMS, *(name for name in CLUES if name not in FORMS)]

    def score(j: int) -> np.ndarray:
        motion, errors, found = SimulatedMotion(residuals, j), z[j], np.zeros(len(CLUES))
        for name in order:
            x = residuals.whiten_joint(np.stack(CLUES[name](motion), -1), j)
            size = np.sqrt(np.mean(np.square(x), 0))
            gain, left = _score_ridge(x / np.where(size > 1e-9, size, np.inf), errors)
            found[list(CLUES).index(name)] = gain
            errors = left if name in FORMS else errors
        return found

    residuals.z  # noqa: B018  # made once, before other processes need it
    return np.stack(map_parallel(score, range(len(z))), 1)


def scale_reference_gains(
    earned: np.ndarray, left_out: Sequence[np.ndarray], entries: Sequence[float]
) -> np.ndarray:
    """Return the most that clues earn on reference recordings at the length of the field, `(clues, J)`; 0 without any.

    Args:
        earned: Their gain in the field.
        left_out: The same on each part of the reference.
        entries: Length of the field over that of each part.
    """
    scaled = [one * by for one, by in zip(left_out, entries, strict=True)]
    return np.max([np.zeros_like(earned), *scaled], 0)


def measure_straying(residuals: Residuals, error: np.ndarray) -> np.ndarray:
    """Return the mean square of free-run errors over its expectation under the noise, `(J,)`.

    The ratio of each window is cut at `MAX_STRAY`.

    Args:
        residuals: Residuals of the simulator on recordings.
        error: Measured less simulated increments, `(W, I, J)`.
    """
    assert residuals.noise is not None, "noise is known by now"
    by_joint = []
    for j, noise in enumerate(residuals.noise):
        by_joint.append(noise.strayed(residuals.increments[..., j]).mean(1))
    expected = np.stack(by_joint, -1)
    if residuals.late is not None:
        expected = expected + np.square(np.cumsum(residuals.late, 2)).sum(1).mean(1)
    ratio = np.square(np.cumsum(error, 1)).mean(1) / np.maximum(expected, 1e-18)
    # A few windows that fail for another reason must not decide the mean.
    over = np.minimum(ratio, MAX_STRAY) * residuals.valid_mask
    return over.sum(0) / np.maximum(residuals.valid_mask.sum(0), 1)


def _score_ridge(x: np.ndarray, z: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the log evidence of features `(E, F)` for residuals `(E,)` by Laplace's approximation, and the new residuals."""
    best, least = 0.0, z
    for pull in CLUE_RIDGES:
        beta = fit_ridge(x, z, pull)
        left = z - x @ beta
        told = (x * weigh_residuals(left)[:, None]).T @ x / pull + np.eye(x.shape[1])
        gain = (
            float(compute_loss(z) - compute_loss(left))
            - 0.5 * pull * float(beta @ beta)
            - 0.5 * float(np.linalg.slogdet(told)[1])
        )
        best, least = (gain, left) if gain > best else (best, least)
    return best, least


def _build_hats(values: np.ndarray, high: float, count: int) -> list[np.ndarray]:
    """Return `count` + 1 tents over 0 to `high`, whose sum is 1."""
    return [
        np.maximum(1.0 - np.abs(np.minimum(values, high) / high * count - place), 0.0)
        for place in range(count + 1)
    ]


def _shift_later(column: np.ndarray, by: int) -> np.ndarray:
    """Return a column by so many increments later; 0 where a window has nothing before."""
    moved = np.roll(column, by, 1)
    moved[:, : max(by, 0)] = 0.0
    if by < 0:
        moved[:, by:] = 0.0
    return moved
