"""Inverse dynamics of joints commanded by force: mass, friction and offset by least squares.

The force is linear in mass, viscous and Coulomb friction and offset. Accelerations and speeds are
derivatives of the positions after a low-pass filter without phase; force and regressors then go through a
second one, the same for both, as in Gautier, Janot and Vandanjon, "A New Closed-Loop Output Error Method for
Parameter Identification of Robot Dynamics", 2013, section II. A logged force is averaged over each period.
"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from scipy.signal import butter, filtfilt

from actuators.models.force_drive import ForceDrive
from brokk_rl.errors import ConfigError, RecordingError, StorageError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_json, write_text
from brokk_rl.spec import spec

NAMES = ("mass_kg", "viscous_n_s_m", "coulomb_n", "offset_n")
EDGE_S = 0.3
"""Time at either end of a recording that is left out: filters begin and end there."""
LEAST_ROWS = 20
"""Fewest rows after decimation for four numbers with standard errors."""


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
    force_hz: float

    def check(self) -> None:
        if not 0.0 < self.force_hz <= self.motion_hz:
            raise ConfigError(
                f"fit: expected 0 < force_hz <= motion_hz, got {self.force_hz} and {self.motion_hz}"
            )

    def fit(
        self,
        machine: Machine,
        train: Sequence[Recording],
        validation: Sequence[Recording],
        folder: Path,
        seed: int,
        device: torch.device,
    ) -> ForceDrive:
        """Fit to all recordings; write `<name>.yaml` and `<name>.json` with standard errors.

        Raises:
            ConfigError: the machine is not commanded by torque, or sampled too slowly.
            RecordingError: the recordings are too short, or a joint never moves.
            StorageError: a file could not be written.
        """
        del seed, device  # deterministic, numpy
        if machine.interface != "torque":
            raise ConfigError(
                f"fit={self.name}: machine '{machine.name}' is commanded by {machine.interface}, not by torque"
            )
        if self.motion_hz >= 0.45 / machine.period_s:
            raise ConfigError(
                f"fit.motion_hz: {self.motion_hz:g} Hz cannot be filtered at a period of {machine.period_s:g} s; lower it"
            )
        self.actuator.build(machine, 1, torch.device("cpu"))  # refuses numbers that make no sense
        dead_time_s = self.actuator.dead_time_s
        given = machine.dead_time_s if dead_time_s is None else dead_time_s
        values: dict[str, dict[str, float]] = {name: {} for name in NAMES}
        told: dict[str, dict[str, dict[str, float]]] = {name: {} for name in NAMES}
        for j, joint in enumerate(machine.joint_names):
            delay_s = given[joint] if isinstance(given, dict) else given
            found, error = self._fit_joint(machine, [*train, *validation], j, delay_s)
            for name, value, deviation in zip(NAMES, found, error, strict=True):
                values[name][joint] = float(f"{value:.5g}")
                told[name][joint] = {"value": float(value), "standard_error": float(deviation)}
        fitted = dataclasses.replace(self.actuator, **values)  # pyright: ignore[reportArgumentType]
        facts = json.loads(json.dumps(dataclasses.asdict(fitted)))  # pyright: ignore[reportArgumentType]
        target = f"{ForceDrive.__module__}.{ForceDrive.__name__}"
        text = yaml.safe_dump({"_target_": target, **facts}, sort_keys=False, width=130)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_text(folder / f"{self.name}.yaml", f"# fitted to {machine.name}\n{text}")
            write_json(folder / f"{self.name}.json", {"schema": 1, "parameters": told})
        except OSError as error:
            raise StorageError(f"cannot write into {folder}: {error.strerror or error}") from error
        return fitted

    def _fit_joint(
        self, machine: Machine, recordings: Sequence[Recording], j: int, delay_s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers `NAMES` of joint `j` and their standard errors."""
        parts, forces = [], []
        for recording in recordings:
            rows = self._build_rows(machine, recording, j, delay_s)
            if rows is not None:
                parts.append(rows[0])
                forces.append(rows[1])
        name = machine.joint_names[j]
        if not parts or sum(map(len, parts)) < LEAST_ROWS:
            raise RecordingError(
                f"too little data: {sum(map(len, parts))} rows of joint {name} after filtering, {LEAST_ROWS} or more are needed"
            )
        x, y = np.concatenate(parts), np.concatenate(forces)
        size = np.sqrt(np.square(x).mean(0))
        if (size[:3] < 1e-12).any():
            raise RecordingError(f"joint {name} never moves: nothing tells its mass and friction")
        found, _, rank, _ = np.linalg.lstsq(x / size, y, rcond=1e-6)
        if rank < len(NAMES):
            raise RecordingError(
                f"joint {name}: its motion does not tell mass, friction and offset apart; record accelerations both ways"
            )
        left = y - (x / size) @ found
        variance = np.square(left).sum() / (len(y) - len(NAMES))
        covariance = variance * np.linalg.inv((x / size).T @ (x / size))
        return found / size, np.sqrt(np.diag(covariance)) / size

    def _build_rows(
        self, machine: Machine, recording: Recording, j: int, delay_s: float
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return regressors `(R, 4)` and forces `(R,)` of a recording; `None` for a short one."""
        period_s, edge = machine.period_s, round(EDGE_S / machine.period_s)
        if recording.num_samples < 4 * edge:
            return None
        q = _filter_low_pass(recording.q[:, j].astype(float), 4, self.motion_hz, period_s)
        force = _filter_low_pass(recording.u[:, j].astype(float), 4, self.motion_hz, period_s)
        force = force * machine.max_force[j]
        rows = np.arange(len(q))
        # A command that is held over a period acts at its middle.
        force = np.interp(rows, rows + 0.5 + delay_s / period_s, force)
        speed = np.gradient(q, period_s)
        columns = [np.gradient(speed, period_s), speed, np.sign(speed), np.ones_like(speed)]
        inside = slice(edge, -edge, max(1, round(0.5 / (self.force_hz * period_s))))
        x = _filter_low_pass(np.stack(columns, 1), 2, self.force_hz, period_s)
        return x[inside], _filter_low_pass(force, 2, self.force_hz, period_s)[inside]


def _filter_low_pass(values: np.ndarray, order: int, cut_hz: float, period_s: float) -> np.ndarray:
    """Return `values` without their faster parts and without a delay; time is the first axis."""
    coefficients: Any = butter(order, 2.0 * cut_hz * period_s)
    numerator, denominator = coefficients
    return filtfilt(numerator, denominator, values, axis=0)
