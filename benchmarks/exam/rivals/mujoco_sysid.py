"""MuJoCo's `mujoco.sysid` on a case: the arm's MJCF with speed drives, Gauss-Newton over all numbers.

The toolbox gets the structure of the machine: masses and geometry, and drives that follow a valve
curve behind a dead time (its tier "custom rollout"). The reference gives the nominal numbers, the
field the present ones; their difference is the answer. Where the tool point was measured, encoders,
links and the base are fitted in a second problem.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from absl import logging as absl_logging
from case_data import (
    FIELD_STRIDE_S,
    HISTORY_S,
    REFERENCE_STRIDE_S,
    Arm,
    Change,
    Windows,
    delay_commands,
    read_windows,
)
from mujoco import rollout, sysid
from mujoco.sysid import Parameter, ParameterDict

MJCF = Path(__file__).parents[3] / "brokk_rl" / "sim" / "assets" / "brokk170.xml"
ITERATIONS = 6
"""Gauss-Newton steps; on development cases the cost changes by less than 0.1 % after five."""
STARTS = {
    "extend_gain": (1.0, 0.4, 1.8),
    "retract_gain": (1.1, 0.4, 1.8),
    "extend_band": (0.06, 0.0, 0.4),
    "retract_band": (0.06, 0.0, 0.4),
    "notch": (0.3, 0.0, 0.9),
    "level": (0.9, 0.3, 1.0),
    "lag_s": (0.1, 0.01, 0.6),
    "delay_s": (0.5, 0.2, 0.95),
    "sink": (0.002, 1e-5, 0.05),
}
"""Start and bounds of each number of a joint; bounds are several times the exam's ranges."""
DEMAND = (0.3, 0.0, 1.0)
"""The same of the flow of a joint over that of the pump."""
UNKNOWN = 1e6
"""Error of a number that the recordings do not show."""
TRACKER_M = 0.002
"""Noise of a measured tool point, m: of a total station."""
POSES = 1000
"""Poses of the kinematic problem; 17 unknowns."""


def build_spec(arm: Arm) -> mujoco.MjSpec:
    """Return the arm with speed drives, without contact."""
    spec = mujoco.MjSpec.from_file(str(MJCF))
    for geom in list(spec.geoms):
        spec.delete(geom)
    spec.option.timestep = arm.period_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for name in arm.joints:
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            dyntype=mujoco.mjtDyn.mjDYN_FILTEREXACT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        )
        spec.add_sensor(
            name=f"{name}_pos",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )
    return spec


def list_parameters(arm: Arm) -> ParameterDict:
    """Return the numbers of all joints; lag and sinking act on the spec, the others on the commands."""
    parameters = ParameterDict()

    def set_drive(spec: mujoco.MjSpec, sink: Parameter) -> None:
        for j, name in enumerate(arm.joints):
            stiffness = arm.yield_force[j] / sink.value[j]
            spec.actuator(name).gainprm[0] = stiffness
            spec.actuator(name).biasprm[2] = -stiffness

    def set_lag(spec: mujoco.MjSpec, lag: Parameter) -> None:
        for j, name in enumerate(arm.joints):
            spec.actuator(name).dynprm[0] = lag.value[j]

    modifiers = {"sink": set_drive, "lag_s": set_lag}
    count = len(arm.joints)
    for name, (start, low, high) in STARTS.items():
        full = [np.full(count, value) for value in (start, low, high)]
        parameters.add(Parameter(name, *full, modifier=modifiers.get(name)))
    parameters.add(Parameter("demand", *DEMAND))
    return parameters


def compute_speed(u: np.ndarray, value: dict[str, np.ndarray], arm: Arm) -> np.ndarray:
    """Return the speeds that commands ask for, `(W, H + K, J)` rad/s."""
    extends = u > 0
    band = np.where(extends, value["extend_band"], value["retract_band"])
    opening = np.clip((np.minimum(np.abs(u), value["level"]) - band) / (1.0 - band), 0.0, 1.0)
    flow = opening * (1.0 - value["notch"] + value["notch"] * opening)
    shared = flow / np.maximum((flow * value["demand"]).sum(-1, keepdims=True), 1.0)
    gain = np.where(extends, value["extend_gain"], value["retract_gain"])
    return np.sign(u) * gain * shared * arm.max_speed


class WindowRollout:
    """Roll-outs of the windows, as the toolbox's `custom_rollout`."""

    def __init__(self, arm: Arm, windows: Windows) -> None:
        self._arm, self._windows = arm, windows
        self._history = round(HISTORY_S / arm.period_s)

    def simulate(self, model: mujoco.MjModel, value: dict[str, np.ndarray]) -> np.ndarray:
        """Return positions at the end of each period of each window, `(W, K, J)`."""
        asked = compute_speed(self._windows.u, value, self._arm)
        asked = delay_commands(asked, value["delay_s"], self._arm.period_s)
        keep = np.exp(-self._arm.period_s / value["lag_s"])
        act = asked[:, 0]
        for k in range(self._history):
            act = asked[:, k] + (act - asked[:, k]) * keep
        count = len(asked)
        start = np.concatenate([np.zeros((count, 1)), self._windows.q[:, 0], act, act], 1)
        control = np.ascontiguousarray(asked[:, self._history :])
        data = mujoco.MjData(model)
        state, _ = rollout.rollout(model, data, start, control)
        joints = self._windows.q.shape[2]
        return state[:, :, 1 : 1 + joints]

    def compute_residual(
        self, x: np.ndarray, parameters: ParameterDict, spec: mujoco.MjSpec
    ) -> tuple[list[np.ndarray], None, None]:
        """Return the toolbox's residuals, a column for each column of `x`."""
        columns = []
        for column in x.reshape(len(x), -1).T:
            parameters.update_from_vector(column)
            model = sysid.apply_param_modifiers(parameters, spec)
            value = {name: parameters[name].value for name in [*STARTS, "demand"]}
            paths = self.simulate(model, value)
            columns.append((paths - self._windows.q[:, 1:]).ravel())
        residual = np.stack(columns, 1)
        return [residual if x.ndim > 1 else residual[:, 0]], None, None


Errors = dict[str, np.ndarray]
"""Standard error of each number, by its name."""


def compute_errors(
    found: ParameterDict, jacobian: np.ndarray, residual: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the standard errors that the toolbox states."""
    _, halves = sysid.calculate_intervals([residual], jacobian)
    errors, begin = {}, 0
    for name, parameter in found.parameters.items():
        end = begin + parameter.size
        errors[name] = np.minimum(halves[begin:end] / 1.96, UNKNOWN)
        begin = end
    return errors


def fit_drives(
    arm: Arm, windows: Windows, start: np.ndarray | None
) -> tuple[ParameterDict, Errors]:
    """Return the numbers that `mujoco.sysid.optimize` finds for these windows, and their errors."""
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
    residual = runs.compute_residual(found.as_vector(), found.copy(), spec)[0][0]
    return found, compute_errors(found, result.jac, residual)


def fit_kinematics(arm: Arm, windows: Windows) -> tuple[ParameterDict, Errors]:
    """Return encoder zeros and scales, extra link lengths, the tilt of the base, and errors."""
    if windows.ee is None:
        raise ValueError("the tool point was not measured")
    q, seen = windows.q.reshape(-1, len(arm.joints)), windows.ee.reshape(-1, 3)
    pick = np.linspace(0, len(q) - 1, POSES).astype(int)
    q, seen = q[pick], seen[pick]
    spec = build_spec(arm)
    spec.body(f"{arm.joints[-1]}_link").add_site(name="tool", pos=arm.tip_m)
    count = len(arm.joints)
    drawn = [spec.body(f"{name}_link").pos.copy() for name in arm.joints] + [arm.tip_m]

    def set_links(changed: mujoco.MjSpec, extra: Parameter) -> None:
        for j, length in enumerate(extra.value):
            along = drawn[j + 1] * (1.0 + length / np.linalg.norm(drawn[j + 1]))
            if j + 1 < count:
                changed.body(f"{arm.joints[j + 1]}_link").pos = along
            else:
                changed.site("tool").pos = along

    def set_base(changed: mujoco.MjSpec, tilt: Parameter) -> None:
        roll, pitch = tilt.value
        turn, one, two = np.zeros(4), np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(one, np.array([0.0, 1.0, 0.0]), pitch)
        mujoco.mju_axisAngle2Quat(two, np.array([1.0, 0.0, 0.0]), roll)
        mujoco.mju_mulQuat(turn, one, two)
        changed.body("undercarriage").quat = turn

    parameters = ParameterDict()
    ones, zeros = np.ones(count), np.zeros(count)
    parameters.add(Parameter("bias_rad", zeros, zeros - 0.1, zeros + 0.1))
    parameters.add(Parameter("scale", ones, ones - 0.1, ones + 0.1))
    parameters.add(Parameter("extra_m", zeros, zeros - 0.1, zeros + 0.1, modifier=set_links))
    parameters.add(
        Parameter("tilt_rad", np.zeros(2), np.full(2, -0.15), np.full(2, 0.15), modifier=set_base)
    )

    def compute_residual(x: np.ndarray, p: ParameterDict) -> tuple[list[np.ndarray], None, None]:
        columns = []
        for column in x.reshape(len(x), -1).T:
            p.update_from_vector(column)
            model = sysid.apply_param_modifiers(p, spec)
            data, tool = mujoco.MjData(model), model.site("tool").id
            true = (q - p["bias_rad"].value) / p["scale"].value
            points = np.empty((len(q), 3))
            for k, pose in enumerate(true):
                data.qpos[:] = pose
                mujoco.mj_kinematics(model, data)
                points[k] = data.site_xpos[tool]
            # a light pull to the drawing: zero of the slew and tilt of the base are nearly alike
            errors = (points - seen).ravel() / TRACKER_M
            columns.append(np.concatenate([errors, (column - start) / spread]))
        residual = np.stack(columns, 1)
        return [residual if x.ndim > 1 else residual[:, 0]], None, None

    start = parameters.as_vector()
    spread = np.concatenate([zeros + 0.02, zeros + 0.03, zeros + 0.02, np.full(2, 0.03)])
    found, result = sysid.optimize(
        parameters, compute_residual, optimizer="mujoco", verbose=False, max_iters=ITERATIONS
    )
    residual = compute_residual(found.as_vector(), found.copy())[0][0]
    return found, compute_errors(found, result.jac, residual)


def find_changes(case: Path, arm: Arm) -> tuple[list[Change], dict[str, list[float]]]:
    """Return the changes from reference to field, and both parameter vectors."""
    absl_logging.set_verbosity(absl_logging.ERROR)
    halves = {
        "reference": read_windows(case / "reference", arm, REFERENCE_STRIDE_S),
        "field": read_windows(case / "field", arm, FIELD_STRIDE_S),
    }
    nominal, nominal_error = fit_drives(arm, halves["reference"], None)
    present, present_error = fit_drives(arm, halves["field"], nominal.as_vector())
    changes = []
    for j, joint in enumerate(arm.joints):
        was = {name: float(nominal[name].value[j]) for name in STARTS}
        now = {name: float(present[name].value[j]) for name in STARTS}
        sides = {side: now[f"{side}_gain"] / was[f"{side}_gain"] for side in ("extend", "retract")}
        both = float(np.sqrt(sides["extend"] * sides["retract"]))
        error = {
            name: float(np.hypot(nominal_error[name][j], present_error[name][j])) for name in STARTS
        }
        relative = {side: error[f"{side}_gain"] / now[f"{side}_gain"] for side in sides}
        half = 0.5 * float(np.hypot(relative["extend"], relative["retract"]))
        changes.append(Change("flow_gain", "gain", joint, both, both - 1.0, half))
        for side, ratio in sides.items():
            change = ratio / both
            changes.append(Change("asymmetry", f"{side}_gain", joint, change, change - 1.0, half))
            band = now[f"{side}_band"] - was[f"{side}_band"]
            changes.append(
                Change("dead_band", side, joint, max(band, 0.0), band, error[f"{side}_band"])
            )
        level = min(now["level"] / was["level"], 1.0)
        changes.append(Change("saturation", "level", joint, level, level - 1.0, error["level"]))
        for effect, parameter, name in (
            ("lag", "time_constant_s", "lag_s"),
            ("dead_time", "dead_time_s", "delay_s"),
            ("creep", "sink_rad_s", "sink"),
        ):
            away = now[name] - was[name]
            changes.append(Change(effect, parameter, joint, max(away, 0.0), away, error[name]))
        away = float(present["demand"].value[0] - nominal["demand"].value[0])
        value = float(present["demand"].value[0]) if away > 0 else 0.0
        wide = float(np.hypot(nominal_error["demand"][0], present_error["demand"][0]))
        changes.append(Change("flow_sharing", "demand", joint, value, away, wide))
    if halves["field"].ee is not None and np.isfinite(halves["field"].ee).all():
        changes += find_kinematic_changes(arm, halves)
    fitted = {"nominal": nominal.as_vector().tolist(), "present": present.as_vector().tolist()}
    return changes, fitted


def simulate(arm: Arm, windows: Windows, vector: list[float]) -> np.ndarray:
    """Return the free runs of a parameter vector, `(W, K, J)`."""
    parameters = list_parameters(arm)
    parameters.update_from_vector(np.array(vector))
    model = sysid.apply_param_modifiers(parameters, build_spec(arm))
    value = {name: parameters[name].value for name in [*STARTS, "demand"]}
    return WindowRollout(arm, windows).simulate(model, value)


def simulate_halves(
    arm: Arm, windows: Windows, fitted: dict[str, list[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the free runs of the simulator as built, and as fitted to the field."""
    return simulate(arm, windows, fitted["nominal"]), simulate(arm, windows, fitted["present"])


def find_kinematic_changes(arm: Arm, halves: dict[str, Windows]) -> list[Change]:
    """Return the changes of encoders, links and base."""
    was, was_error = fit_kinematics(arm, halves["reference"])
    now, now_error = fit_kinematics(arm, halves["field"])
    changes = []
    for effect, parameter, none in (
        ("encoder_bias", "bias_rad", 0.0),
        ("encoder_scale", "scale", 1.0),
        ("link_length", "extra_m", 0.0),
    ):
        for j, joint in enumerate(arm.joints):
            away = float(now[parameter].value[j] - was[parameter].value[j])
            error = float(np.hypot(was_error[parameter][j], now_error[parameter][j]))
            changes.append(Change(effect, parameter, joint, none + away, away, error))
    for k, parameter in enumerate(("roll_rad", "pitch_rad")):
        away = float(now["tilt_rad"].value[k] - was["tilt_rad"].value[k])
        error = float(np.hypot(was_error["tilt_rad"][k], now_error["tilt_rad"][k]))
        changes.append(Change("base_tilt", parameter, "machine", away, away, error))
    return changes
