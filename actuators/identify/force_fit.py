"""Inverse dynamics of joints commanded by force: mass, friction and weight by least squares.

The force is linear in mass, viscous and Coulomb friction and offset, and on a hinge in sine and cosine of
the angle as well, by which its weight changes; not in friction that depends on speed and load (BAM's M2, M3
and M5 in motion). All numbers are fitted at once: friction is never negative, so that a joint without a
kind of it gets 0.

Accelerations and speeds are derivatives of the positions after a low-pass filter without phase; force and
regressors then go through a second one, the same for both, as in Gautier, Janot and Vandanjon, "A New
Closed-Loop Output Error Method for Parameter Identification of Robot Dynamics", 2013, section II. A logged
force is averaged over each period.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.signal import butter, filtfilt

from actuators.contracts import FitTask
from actuators.identify.option_file import estimate_standard_errors, write_numbers
from actuators.models.force_drive import ForceDrive
from actuators.models.friction import LOADS, STRIBECK_SPEED, compute_dry_friction
from actuators.models.parameters import expand_per_joint
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.spec import Positive, spec

EDGE_S = 0.3
"""Time at either end of a recording that is left out: filters begin and end there."""
STANDSTILL = 0.01
"""Speed over the machine's `max_speed` below which a joint counts as standing."""
LEAST_ROWS = 20
"""Fewest rows after decimation for the numbers with standard errors."""
ALWAYS: tuple[str, ...] = ("mass_kg", "viscous_n_s_m", "coulomb_n", "offset_n")
WEIGHT: tuple[str, ...] = ("pose_sin_n", "pose_cos_n")
"""Numbers of a hinge. The weight of a sliding joint does not change over its travel."""
FRICTION: tuple[str, ...] = ("stribeck_n", "stribeck_m_s", "motor_load", "outside_load")
"""Numbers of friction that depends on speed and load. Of a sliding joint both loads are one number: a
weight that never changes does not tell them apart."""
SIGNED: tuple[str, ...] = ("offset_n", *WEIGHT)
BOUNDS = {"stribeck_m_s": (0.1, 10.0), "motor_load": (0.0, 1.0), "outside_load": (0.0, 1.0)}
"""Bounds of numbers over their sizes, that of `stribeck_m_s` is `STRIBECK_SPEED`; 0 and more for the others."""
START_SHARE, START_LOAD = 0.1, 0.05
"""Where further friction begins: a part of the Coulomb friction, and of the load."""


@spec
class ForceFit:
    """Fits `actuator=force` by inverse dynamics.

    Attributes:
        name: Name of the model in tables and of the file that it leaves, `<name>.yaml`.
        actuator: The model; its dead time is kept.
        motion_hz: Cut-off of the filter on positions, above what the joint can do.
        force_hz: Cut-off of the filter on force and regressors; rows are kept at twice its rate.
    """

    name: str
    actuator: ForceDrive
    motion_hz: float
    force_hz: Positive

    def check(self) -> None:
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
        self.actuator.build(machine, 1, torch.device("cpu"))  # refuses numbers that make no sense
        if self.motion_hz >= 0.45 / machine.period_s:
            raise ConfigError(
                f"fit.motion_hz: {self.motion_hz:g} Hz cannot be filtered at a period of {machine.period_s:g} s; lower it"
            )
        given = self.actuator.dead_time_s
        delays_s = expand_per_joint(
            machine.dead_time_s if given is None else given, machine, "fit.actuator.dead_time_s"
        )
        least = 4 * round(EDGE_S / machine.period_s)
        long = [one for one in task.recordings if one.num_samples >= least]
        if not long:
            raise RecordingError(
                f"too little data: none of {len(task.recordings)} recordings has {least * machine.period_s:g} s or more"
            )
        has_hinge = any(joint.kind == "hinge" for joint in machine.joints)
        fitted = (*ALWAYS, *(WEIGHT if has_hinge else ()), *FRICTION)
        numbers = {name: np.zeros(machine.num_joints) for name in fitted}
        errors = {name: np.full(machine.num_joints, np.nan) for name in numbers}
        for j in range(machine.num_joints):
            motions = [self._read_motion(machine, one, j, delays_s[j]) for one in long]
            found, error = fit_drive(machine, j, motions)
            for name in fitted:
                numbers[name][j] = found.get(name, 0.0)
                errors[name][j] = error.get(name, np.nan)
        return write_numbers(task.folder, self.name, self.actuator, machine, numbers, errors)

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
        away = q - 0.5 * (machine.upper[j] + machine.lower[j])
        acceleration = np.gradient(speed, period_s)
        columns = [acceleration, speed, np.sign(speed), np.ones_like(q)]
        if machine.joints[j].kind == "hinge":
            columns += [np.sin(away), np.cos(away) - 1.0]
        moves = np.abs(speed) > STANDSTILL * machine.max_speed[j]
        return DriveMotion(np.stack(columns, 1), force, moves, self.force_hz, period_s)


@dataclass(frozen=True, eq=False)
class DriveMotion:
    """Motion of a joint in one recording, and what its motor did.

    Attributes:
        regressors: What the linear numbers `ALWAYS`, and `WEIGHT` on a hinge, are multiplied by, `(T, F)`.
        force: Forces of the motor, N or Nm, `(T,)`.
        moves: Whether the joint moves, `(T,)` bool. Other samples are left out: where a joint stands,
            friction is any force up to its largest.
        force_hz: Cut-off of the filter on forces.
        period_s: Control period.
    """

    regressors: np.ndarray
    force: np.ndarray
    moves: np.ndarray
    force_hz: float
    period_s: float

    def filter(self, values: np.ndarray) -> np.ndarray:
        """Return values `(T, …)` in motion, without their faster parts, at twice the rate of the cut-off, `(R, …)`."""
        values = values * (self.moves if values.ndim == 1 else self.moves[:, None])
        edge = round(EDGE_S / self.period_s)
        inside = slice(edge, -edge, max(1, round(0.5 / (self.force_hz * self.period_s))))
        return filter_low_pass(values, 2, self.force_hz, self.period_s)[inside]

    def filter_friction(self, numbers: dict[str, float], max_force: float) -> np.ndarray:
        """Return the dry friction beyond Coulomb's at all rows, N or Nm, `(R,)`."""
        value = {name: torch.tensor(0.0) for name in ("coulomb_n", *LOADS)}
        value["stribeck_power"] = torch.tensor(1.0)
        value |= {name: torch.tensor(numbers[name], dtype=torch.float64) for name in FRICTION[:3]}
        outside = numbers.get("outside_load", numbers["motor_load"])
        value["outside_load"] = torch.tensor(outside, dtype=torch.float64)
        linear = (*ALWAYS, *WEIGHT)[: self.regressors.shape[1]]
        weight = self.regressors[:, 3:] @ [numbers[name] for name in linear[3:]]
        speed, motor = torch.from_numpy(self.regressors[:, 1]), torch.from_numpy(self.force)
        full = torch.tensor(max_force, dtype=torch.float64)
        dry = compute_dry_friction(value, speed, motor, torch.from_numpy(weight), full)
        return self.filter(self.regressors[:, 2] * dry.numpy())


def filter_low_pass(values: np.ndarray, order: int, cut_hz: float, period_s: float) -> np.ndarray:
    """Return `values` without their faster parts and without a delay; time is the first axis."""
    coefficients: Any = butter(order, 2.0 * cut_hz * period_s)
    numerator, denominator = coefficients
    return np.ascontiguousarray(filtfilt(numerator, denominator, values, axis=0))


def fit_drive(
    machine: Machine, j: int, motions: Sequence[DriveMotion]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the numbers of joint `j` that predict the force of its motor, and their standard errors.

    Raises:
        RecordingError: the recordings are too short, or the motion does not tell the numbers.
    """
    joint, max_force = machine.joint_names[j], float(machine.max_force[j])
    regressors = np.concatenate([one.filter(one.regressors) for one in motions])
    forces = [one.filter(one.force) for one in motions]
    force = np.concatenate(forces)
    if len(force) < LEAST_ROWS:
        raise RecordingError(
            f"too little data: {len(force)} rows of joint {joint} after filtering, {LEAST_ROWS} or more are needed"
        )
    size = np.sqrt(np.square(regressors).mean(0))
    if (size < 1e-12).any():
        raise RecordingError(f"joint {joint} never moves: nothing tells its mass and friction")
    start, _, rank, _ = np.linalg.lstsq(regressors / size, force, rcond=1e-6)
    if rank < len(size):
        raise RecordingError(
            f"joint {joint}: its motion does not tell mass, friction and weight apart; record accelerations both ways"
        )
    linear = (*ALWAYS, *WEIGHT)[: len(size)]
    names = (*linear, *(FRICTION if len(linear) > len(ALWAYS) else FRICTION[:3]))
    mean_force = float(np.sqrt(np.square(force).mean()))
    sizes = dict.fromkeys(names, 1.0) | dict(zip(linear, mean_force / size, strict=True))
    sizes |= {"stribeck_n": mean_force, "stribeck_m_s": STRIBECK_SPEED * machine.max_speed[j]}
    begin = dict.fromkeys(names, START_LOAD) | dict(zip(linear, start / size, strict=True))
    begin["stribeck_n"] = START_SHARE * abs(begin["coulomb_n"])
    begin["stribeck_m_s"] = sizes["stribeck_m_s"]
    bounds = dict.fromkeys(names, (0.0, np.inf)) | dict.fromkeys(SIGNED, (-np.inf, np.inf)) | BOUNDS
    scale = np.array([sizes[name] for name in names])
    low, high = np.array([bounds[name] for name in names]).T * scale

    def compute_errors(x: np.ndarray) -> np.ndarray:
        numbers = dict(zip(names, x.tolist(), strict=True))
        friction = [one.filter_friction(numbers, max_force) for one in motions]
        return regressors @ x[: len(linear)] + np.concatenate(friction) - force

    x0 = np.clip([begin[name] for name in names], low + 1e-9 * scale, high)
    x = least_squares(compute_errors, x0, bounds=(low, high), x_scale=scale).x
    error = estimate_standard_errors(compute_errors, x, 1e-4 * scale, [len(one) for one in forces])
    found = dict(zip(names, x.tolist(), strict=True))
    errors = dict(zip(names, error.tolist(), strict=True))
    if "outside_load" not in found:
        found["outside_load"] = found["motor_load"]
        errors["outside_load"] = errors["motor_load"]
    return found, errors
