"""MuJoCo's `mujoco.sysid` on an arm of position servos: its MJCF, Gauss-Newton over all numbers.

The parameters are those of MuJoCo Playground's identification of the SO-101 (tasks/sysid/so101):
stiffness, damping, friction and armature of each joint. Beside them stand what MuJoCo's drives have
as well: a limit of the torque, a lag of the target, a constant torque, and a delay of the targets.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from absl import logging as absl_logging
from case_data import HISTORY_S, Arm, Change, Windows, delay_commands, read_windows
from mujoco import rollout, sysid
from mujoco.sysid import Parameter, ParameterDict
from servo_arm import (
    FIELD_STRIDE_S,
    MJCF,
    REFERENCE_STRIDE_S,
    Numbers,
    list_changes,
    list_targets,
    measure_speed,
)

ITERATIONS = 5
"""Gauss-Newton steps."""
RIDGE, TINY = 1e-9, 1e-12
"""Added to the scaled information: a drive that never saturates shows nothing of its limit."""
STEPS = 2
"""Time steps of a control period: 10 ms, with an integrator that is implicit in the damping."""
STARTS = {
    "stiffness": (30.0, 15.0, 45.0),  # Nm/rad
    "damping": (1.0, 0.05, 6.0),  # Nm s/rad
    "friction": (0.1, 0.001, 1.5),  # Nm
    "armature": (0.03, 0.002, 0.3),  # kg m^2
    "limit": (3.0, 0.3, 6.0),  # Nm
    "lag_s": (0.015, 0.005, 0.4),
    "pull": (0.0, -2.0, 2.0),  # Nm
    "delay_s": (0.05, 0.0, 0.3),
}
"""Start and bounds of each number of a joint."""


def build_spec(arm: Arm) -> mujoco.MjSpec:
    """Return the arm with position drives."""
    spec = mujoco.MjSpec.from_file(str(MJCF))
    spec.option.timestep = arm.period_s / STEPS
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in arm.joints:
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            dyntype=mujoco.mjtDyn.mjDYN_FILTEREXACT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            forcelimited=True,
        )
    return spec


def list_parameters(arm: Arm) -> ParameterDict:
    """Return the numbers of all joints; the delay acts on the targets, the others on the spec."""
    parameters, count = ParameterDict(), len(arm.joints)

    def set_numbers(name: str, parameter: Parameter, spec: mujoco.MjSpec) -> None:
        for j, joint in enumerate(arm.joints):
            drive, value = spec.actuator(joint), parameter.value[j]
            if name == "stiffness":
                drive.gainprm[0], drive.biasprm[1] = value, -value
            elif name == "damping":
                spec.joint(joint).damping[0] = value
            elif name == "friction":
                spec.joint(joint).frictionloss = value
            elif name == "armature":
                spec.joint(joint).armature = value
            elif name == "limit":
                drive.forcerange = [-value, value]
            elif name == "lag_s":
                drive.dynprm[0] = value
            elif name == "pull":
                drive.biasprm[0] = value

    for name, (start, low, high) in STARTS.items():
        full = [np.full(count, value) for value in (start, low, high)]

        def modify(spec: mujoco.MjSpec, parameter: Parameter, name: str = name) -> None:
            set_numbers(name, parameter, spec)

        parameters.add(Parameter(name, *full, modifier=None if name == "delay_s" else modify))
    return parameters


class WindowRollout:
    """Roll-outs of the windows, as the toolbox's `custom_rollout`."""

    def __init__(self, arm: Arm, windows: Windows) -> None:
        self._step_s = arm.period_s / STEPS
        self._q, self._speed = windows.q, measure_speed(windows, arm)
        self._targets = list_targets(windows, arm, STEPS)
        self._history = round(HISTORY_S / arm.period_s) * STEPS

    def simulate(self, model: mujoco.MjModel, value: dict[str, np.ndarray]) -> np.ndarray:
        """Return positions at the end of each period of each window, `(W, K, J)`."""
        late = delay_commands(self._targets, value["delay_s"], self._step_s)
        keep = np.exp(-self._step_s / value["lag_s"])
        act = late[:, 0]
        for k in range(self._history):
            act = late[:, k] + (act - late[:, k]) * keep
        count, joints = len(late), late.shape[2]
        start = np.concatenate([np.zeros((count, 1)), self._q[:, 0], self._speed, act], 1)
        control = np.ascontiguousarray(late[:, self._history :])
        state, _ = rollout.rollout(model, mujoco.MjData(model), start, control)
        return np.asarray(state)[:, STEPS - 1 :: STEPS, 1 : 1 + joints]

    def compute_residual(
        self, x: np.ndarray, parameters: ParameterDict, spec: mujoco.MjSpec
    ) -> tuple[list[np.ndarray], None, None]:
        """Return the toolbox's residuals, a column for each column of `x`."""
        columns = []
        for column in x.reshape(len(x), -1).T:
            parameters.update_from_vector(column)
            model = sysid.apply_param_modifiers(parameters, spec)
            value = {name: parameters[name].value for name in STARTS}
            columns.append((self.simulate(model, value) - self._q[:, 1:]).ravel())
        residual = np.stack(columns, 1)
        return [residual if x.ndim > 1 else residual[:, 0]], None, None


def measure_effects(vector: np.ndarray) -> Numbers:
    """Return the numbers of effects that a parameter vector amounts to.

    A lag is that of the target and of the loop. Twice the friction over the stiffness is the width in
    which a joint stays behind, and a constant torque over the stiffness bends it away.
    """
    value = dict(zip(STARTS, np.split(vector, len(STARTS)), strict=True))
    return {
        "dead_time": value["delay_s"],
        "lag": value["lag_s"] + value["damping"] / value["stiffness"],
        "backlash": 2.0 * value["friction"] / value["stiffness"],
        "sag": -value["pull"] / value["stiffness"],
    }


def measure_errors(vector: np.ndarray, jacobian: np.ndarray, residual: np.ndarray) -> Numbers:
    """Return standard errors of the numbers of effects, by the covariance at the optimum.

    The toolbox states errors of single parameters. Friction and stiffness of a joint without weight
    can only be told as a ratio, so the error of the ratio is propagated.
    """
    information = jacobian.T @ jacobian
    scale = np.sqrt(np.diag(information)) + TINY
    scaled = information / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
    variance = residual @ residual / (residual.size - len(scale))
    covariance = variance * np.linalg.inv(scaled) / np.outer(scale, scale)
    slopes: dict[str, list[np.ndarray]] = {name: [] for name in measure_effects(vector)}
    for i, number in enumerate(vector):
        step = 1e-4 * abs(number) + 1e-6
        up, down = (vector + sign * step * (np.arange(len(vector)) == i) for sign in (1.0, -1.0))
        above, below = measure_effects(up), measure_effects(down)
        for name in slopes:
            slopes[name].append((above[name] - below[name]) / (2.0 * step))
    errors = {}
    for name, columns in slopes.items():
        slope = np.stack(columns, 1)
        errors[name] = np.sqrt(np.einsum("ji,ik,jk->j", slope, covariance, slope))
    return errors


def fit_drives(arm: Arm, windows: Windows, start: np.ndarray | None) -> tuple[np.ndarray, Numbers]:
    """Return the numbers that `mujoco.sysid.optimize` finds, and errors of those of effects."""
    absl_logging.set_verbosity(absl_logging.ERROR)
    spec, parameters = build_spec(arm), list_parameters(arm)
    if start is not None:
        parameters.update_from_vector(start)
        parameters.move_off_bounds()
    runs = WindowRollout(arm, windows)
    found, result = sysid.optimize(
        parameters,
        lambda x, p: runs.compute_residual(x, p, spec),
        optimizer="mujoco",
        verbose=False,
        max_iters=ITERATIONS,
    )
    vector = found.as_vector()
    residual = runs.compute_residual(vector, found.copy(), spec)[0][0]
    return vector, measure_errors(vector, result.jac, residual)


def find_changes(case: Path, arm: Arm) -> tuple[list[Change], dict[str, list[float]]]:
    """Return the changes from reference to field, and both parameter vectors."""
    reference = read_windows(case / "reference", arm, REFERENCE_STRIDE_S)
    nominal, nominal_error = fit_drives(arm, reference, None)
    field = read_windows(case / "field", arm, FIELD_STRIDE_S)
    present, present_error = fit_drives(arm, field, nominal)
    errors = {name: np.hypot(nominal_error[name], present_error[name]) for name in nominal_error}
    changes = list_changes(arm, measure_effects(nominal), measure_effects(present), errors)
    return changes, {"nominal": nominal.tolist(), "present": present.tolist()}


def simulate(arm: Arm, windows: Windows, vector: list[float]) -> np.ndarray:
    """Return the free runs of a parameter vector, `(W, K, J)`."""
    parameters = list_parameters(arm)
    parameters.update_from_vector(np.array(vector))
    model = sysid.apply_param_modifiers(parameters, build_spec(arm))
    value = {name: parameters[name].value for name in STARTS}
    return WindowRollout(arm, windows).simulate(model, value)


def simulate_halves(
    arm: Arm, windows: Windows, fitted: dict[str, list[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the free runs of the simulator as built, and as fitted to the field."""
    return simulate(arm, windows, fitted["nominal"]), simulate(arm, windows, fitted["present"])
