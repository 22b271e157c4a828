"""Inverse dynamics of joints commanded by force: mass, friction and offset by least squares.

The force is linear in mass, viscous and Coulomb friction and offset. Accelerations and speeds are
derivatives of the positions after a low-pass filter without phase; force and regressors then go through a
second one, the same for both, as in Gautier, Janot and Vandanjon, "A New Closed-Loop Output Error Method for
Parameter Identification of Robot Dynamics", 2013, section II. A logged force is averaged over each period.

Mass, viscous and Coulomb friction and offset are always fitted. The terms beyond them are tried one after
the other, by nonlinear least squares on the samples in motion. A term is taken where parts of the
recordings that it was not fitted to are predicted better by more than chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.signal import butter, filtfilt

from actuators.contracts import FitTask
from actuators.identify.option_file import estimate_standard_errors, write_numbers
from actuators.models.force_drive import ForceDrive
from actuators.models.friction import LOADS, STRIBECK_SPEED, compute_dry_friction
from actuators.models.machine_tensors import read_pose
from actuators.models.parameters import expand_per_joint
from brokk_rl.errors import ConfigError, RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import Positive, spec

EDGE_S = 0.3
"""Time at either end of a recording that is left out: filters begin and end there."""
STANDSTILL = 0.01
"""Speed over the machine's `max_speed` below which a joint counts as standing."""


@spec
class ForceFit:
    """Fits `actuator=force` by inverse dynamics.

    Attributes:
        name: Name of the model in tables and of the file that it leaves, `<name>.yaml`.
        actuator: The model; its dead time is kept.
        motion_hz: Cut-off of the filter on positions, above what the joint can do.
        force_hz: Cut-off of the filter on force and regressors; rows are kept at twice its rate.
        terms: Terms that may be taken beside mass, viscous and Coulomb friction and offset, of
            `TERMS`.
    """

    name: str
    actuator: ForceDrive
    motion_hz: float
    force_hz: Positive
    terms: tuple[str, ...]

    def check(self) -> None:
        for term in self.terms:
            if term not in TERMS:
                raise ConfigError(f"terms: '{term}' is no term; {list_choices(term, TERMS)}")
        if self.force_hz > self.motion_hz:
            raise ConfigError(
                f"force_hz: expected motion_hz={self.motion_hz} or less, got {self.force_hz}"
            )

    def fit(self, task: FitTask) -> ForceDrive:
        """Fit to all recordings; write `<name>.yaml` and `<name>.json` with standard errors.

        Raises:
            ConfigError: the machine is not commanded by torque, or sampled too slowly.
            RecordingError: the recordings are too short, or a joint never moves.
            StorageError: a file could not be written.
        """
        machine = task.machine
        if machine.interface != "torque":
            raise ConfigError(
                f"fit={self.name}: machine '{machine.name}' is commanded by {machine.interface}, not by torque"
            )
        if self.motion_hz >= 0.45 / machine.period_s:
            raise ConfigError(
                f"fit.motion_hz: {self.motion_hz:g} Hz cannot be filtered at a period of {machine.period_s:g} s; lower it"
            )
        self.actuator.build(machine, 1, torch.device("cpu"))  # refuses numbers that make no sense
        given = self.actuator.dead_time_s
        delays_s = expand_per_joint(
            machine.dead_time_s if given is None else given, machine, "fit.actuator.dead_time_s"
        )
        least = 4 * round(EDGE_S / machine.period_s)
        long = [one for one in task.recordings if one.num_samples >= least]
        found = {}
        for j, joint in enumerate(machine.joint_names):
            motions = [self._read_motion(machine, one, j, delays_s[j]) for one in long]
            found[joint] = fit_drive(machine, j, motions, self.terms)
        tried = {joint: one.tried for joint, one in found.items()}
        numbers, errors = {}, {}
        for name in dict.fromkeys(key for one in found.values() for key in one.value):
            # joints that lack a term of another one
            off = STRIBECK_SPEED * machine.max_speed * (name == "stribeck_m_s")
            pairs = zip(found.values(), off, strict=True)
            numbers[name] = np.array([one.value.get(name, none) for one, none in pairs])
            errors[name] = np.array([one.error.get(name, np.nan) for one in found.values()])
        return write_numbers(
            task.folder, self.name, self.actuator, machine, numbers, errors, terms=tried
        )

    def _read_motion(
        self, machine: Machine, recording: Recording, j: int, delay_s: float
    ) -> DriveMotion:
        """Return the motion of joint `j` in a recording."""
        period_s = machine.period_s
        q = filter_low_pass(recording.q[:, j].astype(float), 4, self.motion_hz, period_s)
        force = filter_low_pass(recording.u[:, j].astype(float), 4, self.motion_hz, period_s)
        rows = np.arange(len(q))
        # A command that is held over a period acts at its middle.
        force = np.interp(rows, rows + 0.5 + delay_s / period_s, force * machine.max_force[j])
        speed = np.gradient(q, period_s)
        edge = round(EDGE_S / period_s)
        moves = np.abs(speed) > STANDSTILL * machine.max_speed[j]
        acceleration = np.gradient(speed, period_s)
        return DriveMotion(q, speed, acceleration, force, self.force_hz, period_s, edge, moves)


ALWAYS: tuple[str, ...] = ("mass_kg", "viscous_n_s_m", "coulomb_n", "offset_n")
LINEAR: tuple[str, ...] = (*ALWAYS, "pose_sin_n", "pose_cos_n")
TERMS: dict[str, tuple[str, ...]] = {
    "pose": ("pose_sin_n", "pose_cos_n"),
    "stribeck": ("stribeck_n", "stribeck_m_s"),
    "load": ("motor_load",),
    "direction": ("outside_load",),
}
"""Numbers of each term. Without the first they are those of BAM's models M2, M3 and M5 in motion."""
NEEDS = {"direction": {"pose", "load"}}
"""Terms without which another is not tried. A weight that never changes tells no direction."""
FITTED_LOADS = ("motor_load", "outside_load")
"""The second one equals the first until it is fitted itself."""
NEUTRAL = dict.fromkeys((*LINEAR, "stribeck_n", *LOADS), 0.0) | {
    "stribeck_m_s": 1.0,
    "stribeck_power": 1.0,
}
"""Numbers of terms that are not taken."""
LEAST_ROWS = 20
"""Fewest rows after decimation for four numbers with standard errors."""
MAX_SAMPLES = 40_000
"""Samples of a joint from which terms are fitted, whole recordings evenly taken: more take minutes."""
NUM_FOLDS = 8
"""Parts of each recording of which one at a time is withheld."""
LEAST_SCORE = 2.0
"""Standard errors by which a term must lower the squared error on withheld parts."""
LEAST_SHARE = 0.1
"""Part of the squared error on withheld parts that a term must take away. By hand: on the linear drive EMPS
a weight over the travel takes 0.03, and its authors publish none; true terms take 0.3 and more."""
FOLD_STEPS = 5
"""Evaluations of a fit without one part; it begins at the fit to all parts, which is near."""
BOUNDS = dict.fromkeys(FITTED_LOADS, (0.0, 1.0)) | {"stribeck_m_s": (0.1, 10.0)}
BOUNDS |= dict.fromkeys(("offset_n", "pose_sin_n", "pose_cos_n"), (-np.inf, np.inf))
"""Bounds of numbers over their sizes, that of `stribeck_m_s` is `STRIBECK_SPEED`; 0 and more for the others."""


@dataclass(frozen=True, eq=False)
class DriveMotion:
    """Motion of a joint in one recording, and what its motor did.

    Attributes:
        q: Positions, `(T,)`.
        speed: Speeds.
        acceleration: Accelerations.
        force: Forces of the motor, N or Nm.
        force_hz: Cut-off of the filter on forces.
        period_s: Control period.
        edge: Samples at either end that are left out.
        moves: Whether the joint moves, `(T,)` bool. Other samples are left out: where a joint stands,
            friction is any force up to its largest.
    """

    q: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    force: np.ndarray
    force_hz: float
    period_s: float
    edge: int
    moves: np.ndarray

    def filter(self, values: np.ndarray) -> np.ndarray:
        """Return values `(T, …)` in motion, without their faster parts, at twice the rate of the cut-off, `(R, …)`."""
        values = values * (self.moves if values.ndim == 1 else self.moves[:, None])
        inside = slice(self.edge, -self.edge, max(1, round(0.5 / (self.force_hz * self.period_s))))
        return filter_low_pass(values, 2, self.force_hz, self.period_s)[inside]


def filter_low_pass(values: np.ndarray, order: int, cut_hz: float, period_s: float) -> np.ndarray:
    """Return `values` without their faster parts and without a delay; time is the first axis."""
    coefficients: Any = butter(order, 2.0 * cut_hz * period_s)
    numerator, denominator = coefficients
    return np.ascontiguousarray(filtfilt(numerator, denominator, values, axis=0))


@dataclass(frozen=True)
class DriveNumbers:
    """Numbers of a joint.

    Attributes:
        value: By name.
        error: Standard errors.
        tried: Terms in the order in which they were tried: whether each is taken, the part of the squared
            error that it takes away where it is fitted (`fitted_share`), and where that is enough, on
            withheld parts (`withheld_share`) with its standard error.
    """

    value: dict[str, float]
    error: dict[str, float]
    tried: list[dict[str, Any]]


def fit_drive(
    machine: Machine, j: int, motions: Sequence[DriveMotion], terms: Sequence[str]
) -> DriveNumbers:
    """Return the numbers of joint `j` that predict the force of its motor.

    Args:
        machine: The machine.
        j: The joint.
        motions: Its recordings.
        terms: Terms of `TERMS` that may be taken.

    Raises:
        RecordingError: the recordings are too short, or the joint never moves.
    """
    whole = [replace(one, moves=np.ones_like(one.moves)) for one in motions]
    fit = _JointRegression(machine, j, whole)
    found = fit.solve(ALWAYS, fit.start())
    tried: list[dict[str, Any]] = []
    samples = sum(len(one.q) for one in motions)
    few = motions[:: max(1, round(samples / MAX_SAMPLES))]
    if terms and sum(one.moves.sum() for one in few) > 0:
        moving = _JointRegression(machine, j, few)
        names = _choose_terms(moving, terms, tried)
        if names != ALWAYS:
            fit, found = moving, moving.solve(names, moving.start() | found)
    error = fit.estimate_errors(found)
    for told in (found, error):
        if "motor_load" in told:
            told.setdefault("outside_load", told["motor_load"])
    return DriveNumbers(found, error, tried)


def _choose_terms(
    fit: _JointRegression, terms: Sequence[str], tried: list[dict[str, Any]]
) -> tuple[str, ...]:
    """Return the names with the terms that withheld parts speak for, the best first; append to `tried`."""
    names, taken = ALWAYS, set[str]()
    known = fit.solve(names, fit.start())
    before = fit.withhold(known)
    while True:
        best: tuple[float, str, dict[str, float], np.ndarray] | None = None
        for term in terms:
            if term in taken or not NEEDS.get(term, set()) <= taken:
                continue
            found = fit.solve((*names, *TERMS[term]), {**fit.start(), **known})
            fitted_share = 1.0 - fit.measure(found) / fit.measure(known)
            row: dict[str, Any] = {"term": term, "taken": False, "fitted_share": fitted_share}
            tried.append(row)
            if row["fitted_share"] < LEAST_SHARE:
                continue
            after = fit.withhold(found)
            less = (before - after) / before.sum()
            share, error = float(less.sum()), float(np.sqrt(len(less)) * less.std(ddof=1))
            row |= {"withheld_share": share, "standard_error": error}
            if share > max(LEAST_SHARE, LEAST_SCORE * error) and (best is None or share > best[0]):
                best = share, term, found, after
        if best is None:
            return names
        _, term, known, before = best
        next(row for row in reversed(tried) if row["term"] == term)["taken"] = True
        taken.add(term)
        names = (*names, *TERMS[term])


class _JointRegression:
    """The force of one joint in its recordings, as a function of the drive's numbers; arguments of `fit_drive`."""

    def __init__(self, machine: Machine, j: int, motions: Sequence[DriveMotion]) -> None:
        self._motions, name = motions, machine.joint_names[j]
        self._max_speed = float(machine.max_speed[j])
        slides = torch.tensor(machine.joints[j].kind == "slide")
        middle = torch.tensor(0.5 * (machine.upper[j] + machine.lower[j]))
        half = torch.tensor(0.5 * (machine.upper[j] - machine.lower[j]))
        columns, forces, folds = [np.zeros((0, len(LINEAR)))], [np.zeros(0)], [np.zeros(0, int)]
        self._poses = []
        for one in motions:
            sin, cos = read_pose(torch.from_numpy(one.q), middle, half, slides)
            self._poses.append((sin.numpy(), cos.numpy() - 1.0))
            sign, ones = np.sign(one.speed), np.ones_like(one.q)
            own = [one.acceleration, one.speed, sign, ones, *self._poses[-1]]
            columns.append(one.filter(np.stack(own, 1)))
            forces.append(one.filter(one.force))
            folds.append(np.arange(len(forces[-1])) * NUM_FOLDS // max(1, len(forces[-1])))
        self._x, self._y = np.concatenate(columns), np.concatenate(forces)
        self._fold, self._lengths = np.concatenate(folds), [len(one) for one in forces]
        if len(self._y) < LEAST_ROWS:
            raise RecordingError(
                f"too little data: {len(self._y)} rows of joint {name} after filtering, {LEAST_ROWS} or more are needed"
            )
        always = self._x[:, : len(ALWAYS)]
        size = np.sqrt(np.square(always).mean(0))
        if (size[:3] < 1e-12).any():
            raise RecordingError(f"joint {name} never moves: nothing tells its mass and friction")
        found, _, rank, _ = np.linalg.lstsq(always / size, self._y, rcond=1e-6)
        if rank < len(ALWAYS):
            raise RecordingError(
                f"joint {name}: its motion does not tell mass, friction and offset apart; record accelerations both ways"
            )
        self._least_squares = dict(zip(ALWAYS, (found / size).tolist(), strict=True))
        force = float(np.sqrt(np.square(self._y).mean()))
        sizes = np.append(force / size, [force, force])
        self._size = dict(zip(LINEAR, sizes.tolist(), strict=True))
        self._size |= {"stribeck_n": force, "stribeck_m_s": STRIBECK_SPEED * self._max_speed}
        self._full = torch.tensor(float(machine.max_force[j]), dtype=torch.float64)
        self._size |= dict.fromkeys(FITTED_LOADS, 1.0)

    def start(self) -> dict[str, float]:
        """Return numbers to begin at: those by linear least squares, a tenth of the friction for other terms."""
        some = 0.1 * abs(self._least_squares["coulomb_n"])
        found = dict.fromkeys(("pose_sin_n", "pose_cos_n"), 0.0)
        found |= {"stribeck_n": some, "stribeck_m_s": self._size["stribeck_m_s"]}
        return found | dict.fromkeys(FITTED_LOADS, 0.05) | self._least_squares

    def solve(
        self,
        names: Sequence[str],
        start: dict[str, float],
        rows: np.ndarray | None = None,
        steps: int | None = None,
    ) -> dict[str, float]:
        """Return the numbers `names` that fit `rows` best, by nonlinear least squares within their bounds."""
        use = slice(None) if rows is None else rows
        size = np.array([self._size[name] for name in names])
        low, high = np.array([BOUNDS.get(name, (0.0, np.inf)) for name in names]).T * size
        found = least_squares(
            lambda x: self._predict(dict(zip(names, x, strict=True)))[use] - self._y[use],
            np.clip([start[name] for name in names], low + 1e-9 * size, high),
            bounds=(low, high),
            x_scale=size,
            max_nfev=steps,
        )
        return dict(zip(names, found.x.tolist(), strict=True))

    def withhold(self, found: dict[str, float]) -> np.ndarray:
        """Return the squared error on each part that the same numbers, fitted without it, leave, `(NUM_FOLDS,)`."""
        errors = []
        for fold in range(NUM_FOLDS):
            apart = self._fold == fold
            without = self.solve(tuple(found), found, ~apart, FOLD_STEPS)
            errors.append(np.square(self._predict(without) - self._y)[apart].sum())
        return np.array(errors)

    def measure(self, found: dict[str, float]) -> float:
        """Return the squared error on all rows."""
        return float(np.square(self._predict(found) - self._y).sum())

    def estimate_errors(self, found: dict[str, float]) -> dict[str, float]:
        """Return the standard errors of the numbers."""
        names = tuple(found)
        errors = estimate_standard_errors(
            lambda x: self._predict(dict(zip(names, x, strict=True))) - self._y,
            np.array([*found.values()]),
            1e-4 * np.array([self._size[name] for name in names]),
            self._lengths,
        )
        return dict(zip(names, errors.tolist(), strict=True))

    def _predict(self, numbers: dict[str, float]) -> np.ndarray:
        """Return the force of the motor at all rows, N or Nm."""
        linear = self._x @ [numbers.get(name, 0.0) for name in LINEAR]
        return linear if numbers.keys() <= set(LINEAR) else linear + self._filter_dry(numbers)

    def _filter_dry(self, numbers: dict[str, float]) -> np.ndarray:
        """Return the dry friction beyond Coulomb's at all rows."""
        given = {**NEUTRAL, **numbers, "coulomb_n": 0.0}
        given["outside_load"] = numbers.get("outside_load", given["motor_load"])
        value = {name: torch.tensor(one, dtype=torch.float64) for name, one in given.items()}
        parts = []
        for motion, (sin, cos) in zip(self._motions, self._poses, strict=True):
            weight = given["offset_n"] + given["pose_sin_n"] * sin + given["pose_cos_n"] * cos
            speed, motor = torch.from_numpy(motion.speed), torch.from_numpy(motion.force)
            dry = compute_dry_friction(value, speed, motor, torch.from_numpy(weight), self._full)
            parts.append(motion.filter(np.sign(motion.speed) * dry.numpy()))
        return np.concatenate(parts)
