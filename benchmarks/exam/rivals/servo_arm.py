"""The arm of position servos as rivals simulate it: targets in force, and the weight on each joint.

Axes: `W` windows, `K` control periods of a window, `T` time steps of a window, `J` joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from case_data import Arm, Change, Windows

MJCF = Path(__file__).parents[3] / "exam" / "plants" / "so101_arm.xml"
"""The arm with its true lengths and masses."""
FIELD_STRIDE_S, REFERENCE_STRIDE_S = 10.0, 40.0
"""Distance of windows, s. Half of the field is used, and as much of the reference."""

EFFECTS = {
    "dead_time": "dead_time_s",
    "lag": "time_constant_s",
    "rate_limit": "stroke_s",
    "backlash": "gap_rad",
    "sag": "sag_rad",
}
"""Effects of the exam that some rival has a number for, and the name of that number."""
Numbers = dict[str, np.ndarray]
"""A number of each joint by the name of its effect, `(J,)`."""


def list_changes(arm: Arm, was: Numbers, now: Numbers, errors: Numbers | None) -> list[Change]:
    """Return the changes of all effects' numbers from reference to field.

    Args:
        arm: The arm.
        was: By effect, as fitted to the reference.
        now: As fitted to the field.
        errors: Standard errors of the changes where the rival states them.
    """
    changes = []
    for effect in was:
        for j, joint in enumerate(arm.joints):
            away = float(now[effect][j] - was[effect][j])
            value = away if effect == "sag" else max(away, 0.0)
            error = 1.0 if errors is None else float(errors[effect][j])
            changes.append(Change(effect, EFFECTS[effect], joint, value, away, error))
    return changes


@dataclass(frozen=True)
class JointPaths:
    """Windows as single joints that move along the recorded path.

    Attributes:
        step_s: Time step, s.
        targets: Targets from `HISTORY_S` before a window to its end, `(W, H + T, J)` rad.
        q: Positions at the start, `(W, J)` rad.
        speed: Speeds at the start, `(W, J)` rad/s.
        inertia: Diagonal of the mass matrix without armature, `(W, T, J)` kg m^2.
        weight: Torque that the weight asks of the drive, `(W, T, J)` N m.
    """

    step_s: float
    targets: np.ndarray
    q: np.ndarray
    speed: np.ndarray
    inertia: np.ndarray
    weight: np.ndarray

    @property
    def history(self) -> int:
        """Time steps before a window begins."""
        return self.targets.shape[1] - self.inertia.shape[1]


def list_targets(windows: Windows, arm: Arm, steps: int) -> np.ndarray:
    """Return the targets of windows, rad, each held over `steps` time steps of a control period."""
    return np.repeat(arm.middle + arm.half_travel * windows.u, steps, 1)


def measure_speed(windows: Windows, arm: Arm) -> np.ndarray:
    """Return speeds at the start of windows, `(W, J)` rad/s, over two control periods."""
    return (windows.q[:, 2] - windows.q[:, 0]) / (2.0 * arm.period_s)


def trace_joints(windows: Windows, arm: Arm, steps: int) -> JointPaths:
    """Return the windows joint by joint, `steps` time steps a control period."""
    spec = mujoco.MjSpec.from_file(str(MJCF))
    for joint in spec.joints:
        joint.armature = 0.0
    model = spec.compile()
    data = mujoco.MjData(model)
    dofs = [model.joint(name).dofadr[0] for name in arm.joints]
    places = [model.joint(name).qposadr[0] for name in arm.joints]
    rows = windows.q[:, :-1].reshape(-1, len(arm.joints))
    inertia, weight = np.empty_like(rows), np.empty_like(rows)
    full = np.empty((model.nv, model.nv))
    for k, pose in enumerate(rows):
        data.qpos[places] = pose
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fullM(model, data, full)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        inertia[k], weight[k] = full[dofs, dofs], data.qfrc_bias[dofs]
    shape = windows.q[:, :-1].shape
    return JointPaths(
        step_s=arm.period_s / steps,
        targets=list_targets(windows, arm, steps),
        q=windows.q[:, 0],
        speed=measure_speed(windows, arm),
        inertia=np.repeat(inertia.reshape(shape), steps, 1),
        weight=np.repeat(weight.reshape(shape), steps, 1),
    )
