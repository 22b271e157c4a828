"""After PACE's paper (arXiv 2509.06342), on an arm of position servos: CMA-ES, simulator in the loop.

PACE itself needs Isaac Lab and an NVIDIA GPU. Kept of it: armature, viscous friction, static
friction and encoder bias of each joint, one delay in whole simulation steps, a motor whose torque
falls with its speed, `cmaes` with sigma 0.5 from the middle of the bounds, the squared error of
positions, and the mean of the last generation as the answer. The encoder's bias enters start, drive
and error as in its source (leggedrobotics/pace-sim2real 0.2). Adapted: stiffness and damping of the
drives, which PACE takes as known, are those that `mujoco.sysid` fits to the reference; each joint
moves by itself under the weight of the recorded pose; 64 candidates in place of 4,096.
"""

from __future__ import annotations

from pathlib import Path

import cmaes
import numpy as np
import servo_sysid
from case_data import Arm, Change, Windows, read_windows
from servo_arm import (
    FIELD_STRIDE_S,
    REFERENCE_STRIDE_S,
    JointPaths,
    Numbers,
    list_changes,
    trace_joints,
)

CANDIDATES, GENERATIONS, SIGMA = 64, 120, 0.5
STEPS = 4
"""Simulation steps of a control period: 5 ms."""
STALL_N_M, NO_LOAD_RAD_S = 2.94, 4.7
"""The motor's data sheet: Feetech STS3215 at 12 V."""
KNOWN_DAMPING = 0.5
"""Damping gain of the drive over all damping of the reference: viscous friction is the rest."""
BOUNDS = {
    "armature": (0.001, 0.1),  # kg m^2
    "viscous": (0.0, 2.0),  # Nm s/rad
    "friction": (0.0, 1.2),  # Nm
    "bias": (-0.05, 0.05),  # rad
}
DELAY_STEPS = (0.0, 40.0)
"""Simulation steps: up to 0.2 s."""


class PositionDrives:
    """Free runs of all windows for many candidates at once, `(P, W, J)`.

    Args:
        paths: The windows.
        gains: `stiffness` and `damping` of the drives, `(J,)`.
    """

    def __init__(self, paths: JointPaths, gains: dict[str, np.ndarray]) -> None:
        self._paths, self._gains = paths, gains

    def simulate(self, vectors: np.ndarray) -> np.ndarray:
        """Return positions at the end of each period, `(P, W, K, J)`, of vectors `(P, 4 J + 1)`."""
        paths, gains, dt_s = self._paths, self._gains, self._paths.step_s
        parts = np.split(vectors[:, :-1], len(BOUNDS), axis=1)
        armature, viscous, friction, bias = (part[:, None] for part in parts)
        delay = np.round(vectors[:, -1]).astype(int)
        q = paths.q + bias
        speed = np.broadcast_to(paths.speed, q.shape)
        steps = paths.inertia.shape[1]
        found = np.empty((len(vectors), len(paths.q), steps // STEPS, q.shape[2]))
        for k in range(steps):
            target = paths.targets[:, paths.history + k - delay].swapaxes(0, 1)
            torque = gains["stiffness"] * (target - q - bias) - gains["damping"] * speed
            room = STALL_N_M * speed / NO_LOAD_RAD_S
            torque = np.clip(
                torque,
                np.clip(-STALL_N_M - room, -STALL_N_M, 0.0),
                np.clip(STALL_N_M - room, 0.0, STALL_N_M),
            )
            gain = dt_s / (paths.inertia[:, k] + armature)
            free = speed + gain * (torque - paths.weight[:, k])
            # friction at the end of the step: it stops the joint, and never turns it round
            free = np.sign(free) * np.maximum(np.abs(free) - gain * friction, 0.0)
            speed = free / (1.0 + gain * viscous)
            q = q + dt_s * speed
            if k % STEPS == STEPS - 1:
                found[:, :, k // STEPS] = q
        return found - bias[:, :, None]


def fit_drives(drives: PositionDrives, windows: Windows) -> np.ndarray:
    """Return the mean of the last generation: numbers of `BOUNDS` by joint, then the delay."""
    joints = windows.q.shape[2]
    bounds = np.array([span for span in BOUNDS.values() for _ in range(joints)] + [DELAY_STEPS])
    low, high = bounds.T
    unit = np.tile([-1.0, 1.0], (len(low), 1))
    search = cmaes.CMA(np.zeros(len(low)), SIGMA, bounds=unit, seed=0, population_size=CANDIDATES)

    def scale(x: np.ndarray) -> np.ndarray:
        return low + (x + 1.0) / 2.0 * (high - low)

    for _ in range(GENERATIONS):
        asked = np.stack([search.ask() for _ in range(CANDIDATES)])
        costs = np.square(drives.simulate(scale(asked)) - windows.q[:, 1:]).sum((1, 2, 3))
        search.tell(list(zip(asked, costs.tolist(), strict=True)))
        if search.should_stop():
            break
    return scale(search.mean)


def measure_effects(vector: np.ndarray, gains: dict[str, np.ndarray], step_s: float) -> Numbers:
    """Return the numbers of effects that a parameter vector amounts to."""
    _, viscous, friction, bias = np.split(vector[:-1], len(BOUNDS))
    return {
        "dead_time": np.full(len(bias), round(vector[-1]) * step_s),
        "lag": viscous / gains["stiffness"],
        "backlash": 2.0 * friction / gains["stiffness"],
        "sag": 2.0
        * bias,  # it enters the drive and the error: the reading comes to rest twice as far away
    }


def read_gains(vector: np.ndarray) -> dict[str, np.ndarray]:
    """Return stiffness and damping of the drives by the fit of `servo_sysid` to the reference."""
    value = dict(zip(servo_sysid.STARTS, np.split(vector, len(servo_sysid.STARTS)), strict=True))
    return {"stiffness": value["stiffness"], "damping": KNOWN_DAMPING * value["damping"]}


def find_changes(case: Path, arm: Arm) -> tuple[list[Change], dict[str, list[float]]]:
    """Return the changes from reference to field, the drives' gains and both fitted vectors."""
    reference = read_windows(case / "reference", arm, REFERENCE_STRIDE_S)
    field = read_windows(case / "field", arm, FIELD_STRIDE_S)
    drives, _ = servo_sysid.fit_drives(arm, reference, None)
    gains, fitted = read_gains(drives), {"drives": drives.tolist()}
    numbers = []
    for name, windows in (("nominal", reference), ("present", field)):
        vector = fit_drives(PositionDrives(trace_joints(windows, arm, STEPS), gains), windows)
        numbers.append(measure_effects(vector, gains, arm.period_s / STEPS))
        fitted[name] = vector.tolist()
    return list_changes(arm, *numbers, errors=None), fitted


def simulate_halves(
    arm: Arm, windows: Windows, fitted: dict[str, list[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the free runs of the simulator as built, and as fitted to the field."""
    gains = read_gains(np.array(fitted["drives"]))
    drives = PositionDrives(trace_joints(windows, arm, STEPS), gains)
    before, after = drives.simulate(np.array([fitted["nominal"], fitted["present"]]))
    return before, after
