"""After PACE's paper (arXiv 2509.06342), on a case: CMA-ES with a simulator in the loop.

PACE itself needs Isaac Lab and an NVIDIA GPU. Kept of it: armature, viscous friction, static
friction and encoder bias of each joint, one delay in whole simulation steps, `cmaes` with sigma 0.5
from the middle of the bounds, the squared error of positions, and the mean of the last generation
as the answer. Adapted: speed drives behind the valve curve of the reference take the place of
position drives with known gains; joints do not push each other; free runs of 5 s take the place of
a whole run, since a speed drive does not pull a position back; 64 candidates in place of 4,096.
"""

from __future__ import annotations

from pathlib import Path

import cmaes
import mujoco_sysid
import numpy as np
from absl import logging as absl_logging
from case_data import (
    FIELD_STRIDE_S,
    HISTORY_S,
    REFERENCE_STRIDE_S,
    Arm,
    Change,
    Windows,
    read_windows,
)

CANDIDATES, GENERATIONS, SIGMA = 64, 110, 0.5
STEPS = 4
"""Simulation steps of a control period: 12.5 ms."""
WARM_UP = 10
"""Control periods simulated before a window begins, for the speed at its start."""
NO_LOAD = 1.3
"""No-load speed of the drive over the reference's: viscous friction can fall below the reference's."""
BOUNDS = {
    "armature": (0.01, 0.8),  # over the gain of the drive, s
    "viscous": (0.0, 1.0),  # over the gain of the drive
    "friction": (0.0, 0.25),  # over the gain of the drive, of full speed
    "bias": (-0.1, 0.1),  # rad, as PACE has it
}
DELAY_STEPS = (-8.0, 20.0)
"""Delay beyond the reference's, simulation steps."""


class SpeedDrives:
    """Free runs of all windows for many candidates at once, `(P, W, J)`."""

    def __init__(self, arm: Arm, windows: Windows, nominal: dict[str, np.ndarray]) -> None:
        self._windows, self._dt_s = windows, arm.period_s / STEPS
        self._max_speed = arm.max_speed
        asked = NO_LOAD * mujoco_sysid.compute_speed(windows.u, nominal, arm)
        fine = np.repeat(asked, STEPS, 1)
        late = np.round(nominal["delay_s"] / self._dt_s).astype(int)
        rows = np.arange(fine.shape[1])
        self._asked = np.empty_like(fine)
        for j, steps in enumerate(late):
            self._asked[:, :, j] = fine[:, np.clip(rows - steps, 0, None), j]

    def simulate(self, value: dict[str, np.ndarray], delay: np.ndarray) -> np.ndarray:
        """Return positions at the end of each period, `(P, W, K, J)`.

        Args:
            value: Numbers of `BOUNDS`, `(P, J)`.
            delay: Whole simulation steps, `(P,)`.
        """
        windows = self._windows
        loss = 1.0 + value["viscous"][:, None]
        keep = np.exp(-self._dt_s * loss / value["armature"][:, None])
        drag = (1.0 - keep) / loss
        dry = drag * value["friction"][:, None] * self._max_speed
        speed = np.zeros((len(delay), *windows.q[:, 0].shape))
        bias = value["bias"][:, None]
        q = np.broadcast_to(windows.q[:, 0] + bias, speed.shape).copy()
        count = windows.q.shape[1] - 1
        paths = np.empty((len(delay), windows.q.shape[0], count, windows.q.shape[2]))
        history = round(HISTORY_S / (self._dt_s * STEPS))
        last = self._asked.shape[1] - 1
        for k in range(history - WARM_UP, history + count):
            for i in range(STEPS):
                row = np.clip(k * STEPS + i - delay, 0, last)
                asked = self._asked[:, row].transpose(1, 0, 2)
                free = keep * speed + drag * asked
                speed = np.sign(free) * np.maximum(np.abs(free) - dry, 0.0)
                if k >= history:
                    q += self._dt_s * speed
            if k >= history:
                paths[:, :, k - history] = q
        return paths - bias[:, :, None]


def fit_drives(drives: SpeedDrives, windows: Windows) -> np.ndarray:
    """Return the mean of the last generation: numbers of `BOUNDS` by joint, then the delay."""
    joints = windows.q.shape[2]
    low = np.concatenate([np.full(joints, low) for low, _ in BOUNDS.values()] + [[DELAY_STEPS[0]]])
    high = np.concatenate(
        [np.full(joints, high) for _, high in BOUNDS.values()] + [[DELAY_STEPS[1]]]
    )
    unit = np.tile([-1.0, 1.0], (len(low), 1))
    search = cmaes.CMA(np.zeros(len(low)), SIGMA, bounds=unit, seed=0, population_size=CANDIDATES)

    def scale(x: np.ndarray) -> np.ndarray:
        return low + (x + 1.0) / 2.0 * (high - low)

    for _ in range(GENERATIONS):
        asked = np.stack([search.ask() for _ in range(CANDIDATES)])
        errors = simulate_vectors(drives, scale(asked)) - windows.q[:, 1:]
        costs = np.square(errors).sum((1, 2, 3))
        search.tell(list(zip(asked, costs.tolist(), strict=True)))
        if search.should_stop():
            break
    return scale(search.mean)


def simulate_vectors(drives: SpeedDrives, vectors: np.ndarray) -> np.ndarray:
    """Return the free runs of parameter vectors, `(P, 4 J + 1)`."""
    parts = np.split(vectors[:, :-1], len(BOUNDS), axis=1)
    return drives.simulate(
        dict(zip(BOUNDS, parts, strict=True)), np.round(vectors[:, -1]).astype(int)
    )


def find_changes(case: Path, arm: Arm) -> tuple[list[Change], dict[str, list[float]]]:
    """Return the changes from reference to field; the valve curve and the fitted vector."""
    absl_logging.set_verbosity(absl_logging.ERROR)
    reference = read_windows(case / "reference", arm, REFERENCE_STRIDE_S)
    field = read_windows(case / "field", arm, FIELD_STRIDE_S)
    # the valve curve is what the simulator was built with: the reference's
    fitted, _ = mujoco_sysid.fit_drives(arm, reference, None)
    nominal = {name: fitted[name].value for name in [*mujoco_sysid.STARTS, "demand"]}
    found = fit_drives(SpeedDrives(arm, field, nominal), field)
    armature, viscous, friction, bias = np.split(found[:-1], len(BOUNDS))
    changes = []
    for j, joint in enumerate(arm.joints):
        gain = NO_LOAD / (1.0 + viscous[j])
        changes.append(Change("flow_gain", "gain", joint, gain, gain - 1.0, 1.0))
        away = armature[j] / (1.0 + viscous[j]) - nominal["lag_s"][j]
        changes.append(Change("lag", "time_constant_s", joint, max(away, 0.0), away, 1.0))
        sides = 0.5 * (nominal["extend_gain"][j] + nominal["retract_gain"][j])
        band = friction[j] / (NO_LOAD * sides)
        for side in ("extend", "retract"):
            changes.append(Change("dead_band", side, joint, band, band, 1.0))
        away = float(round(found[-1])) * arm.period_s / STEPS
        changes.append(Change("dead_time", "dead_time_s", joint, max(away, 0.0), away, 1.0))
        changes.append(Change("encoder_bias", "bias_rad", joint, bias[j], bias[j], 1.0))
    return changes, {"nominal": fitted.as_vector().tolist(), "present": found.tolist()}


def simulate_halves(
    arm: Arm, windows: Windows, fitted: dict[str, list[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the free runs of the simulator as built, and as fitted to the field."""
    parameters = mujoco_sysid.list_parameters(arm)
    parameters.update_from_vector(np.array(fitted["nominal"]))
    nominal = {name: parameters[name].value.copy() for name in [*mujoco_sysid.STARTS, "demand"]}
    before = mujoco_sysid.simulate(arm, windows, fitted["nominal"])
    drives = SpeedDrives(arm, windows, nominal)
    return before, simulate_vectors(drives, np.array(fitted["present"])[None])[0]
