"""Sizes of the named effects, as numbers of the registry, with intervals.

A row may have a form that the registry lacks, such as a limit of the speed behind the valve. The size
is then that of the registry's own form. Its proof shows how far that form goes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brokk_rl.kinematics import GRAVITY_M_S2
from brokk_rl.machine import Machine
from diagnosis.closure import Estimate
from diagnosis.effect_library import EffectType, list_shared_effects
from diagnosis.engine.decide import EffectFinding
from diagnosis.engine.evidence import FieldJoint
from diagnosis.engine.hold_laws import JitterLaw
from diagnosis.engine.holds import HeldCourse
from diagnosis.engine.joint_model import JointModel
from diagnosis.engine.rows import Row
from diagnosis.engine.side import measure_full_loads, measure_units

SIZE_STEPS = np.array([0.8, 0.88, 0.94, 1.0, 1.06, 1.14, 1.25])
"""Multiples of a size at which its likelihood is read."""
FORM_ERROR = 0.26
"""Relative error of a size that its form makes, 1 sigma, where too few cases tell it for the effect."""
FORM_ERRORS = {
    "asymmetry": 0.22,
    "backlash": 0.19,
    "compliance": 0.18,
    "creep": 0.32,
    "dead_band": 0.13,
    "dead_time": 0.17,
    "delay_jitter": 0.3,
    "flow_gain": 0.3,
    "flow_sharing": 0.28,
    "frame_loss": 0.46,
    "lag": 0.18,
    "rate_limit": 0.11,
    "sag": 0.15,
    "saturation": 0.25,
    "sensor_noise": 0.22,
    "stiction": 0.82,
    "thermal_drift": 0.17,
    "torque_limit": 0.33,
}
"""The same by effect: 196 numbers of practice and opened cases of four makes. With a make left out of the choice, the
90 % intervals hold 167 of its numbers; benchmarks/results/size_errors has them all."""
SIGMAS = 1.96


@dataclass(frozen=True)
class SizedRow:
    """An effect of the registry on one joint.

    Attributes:
        row: The row in the registry's form.
        relative: Standard error of its size over the size.
    """

    row: Row
    relative: float


def get_form_error(effect: str) -> float:
    """Return the relative error of the sizes of an effect that its form makes."""
    return FORM_ERRORS.get(effect, FORM_ERROR)


def size_finding(finding: EffectFinding, joints: Sequence[FieldJoint]) -> dict[int, SizedRow]:
    """Return the rows of an effect in the registry's form, by joint, from the joints without it."""
    model = joints[0].side.model
    plain = [row for row in model.rows if row.effect == finding.name and is_plain(row, model)]
    found = {}
    for j in finding.joints:
        some = [row for row in plain if is_possible(row, joints[j])]
        if not some:
            continue
        best = some[int(np.argmax(joints[j].score(some)))]
        row = joints[j].refine(best)
        found[j] = SizedRow(row, _estimate_error(row, joints[j]))
    return found


def fit_rows(finding: EffectFinding, joints: Sequence[FieldJoint]) -> dict[int, Row]:
    """Return the rows of a finding with sizes fitted to these joints."""
    return {j: joints[j].refine(row) for j, row in finding.rows.items()}


def is_plain(row: Row, model: JointModel) -> bool:
    """Return whether a row has a form of the registry."""
    return tuple(name for name, _, _ in row.changes) not in model.own_forms


def is_possible(row: Row, joint: FieldJoint) -> bool:
    """Return whether the registry has a row for a joint: with known masses creep and sag follow the weight."""
    names = {name for name, _, _ in row.changes}
    has_bodies = joint.side.machine.has_bodies
    is_loaded = bool(np.abs(joint.side.loads[joint.joint]).max() > 1e-3)
    if names & {"creep", "sag"}:
        return not has_bodies
    if names & {"creep_by_load", "load_both", "load_opposing", "sag_load"}:
        return has_bodies and is_loaded
    return True


def _estimate_error(row: Row, joint: FieldJoint) -> float:
    """Return the standard error of a size over the size, from the curvature of its likelihood and its form."""
    gains = joint.score([row.resize(float(factor)) for factor in SIZE_STEPS])
    curve = np.polyfit(np.log(SIZE_STEPS), gains, 2)[0]
    # A flat likelihood tells nothing: the interval then covers a factor of two.
    variance = 0.5 / max(-curve, 1.0)
    return float(np.hypot(np.sqrt(variance), get_form_error(row.effect)))


def describe_numbers(
    kind: EffectType, rows: dict[int, SizedRow], hold: HeldCourse | None, machine: Machine
) -> dict[str, dict[str, Estimate]]:
    """Return the numbers of an effect with intervals, by name and joint (or `machine`)."""
    found: dict[str, dict[str, Estimate]] = {}
    if hold is not None:
        for name, (value, relative) in describe_hold(hold, machine).items():
            factor = float(np.exp(SIGMAS * relative))
            # A share of frames is no more than all of them.
            most = np.inf if name == "jitter_s" else 1.0
            estimate = Estimate(value, (value / factor, min(value * factor, most)))
            found[name] = dict.fromkeys(machine.joint_names, estimate)
        return found
    is_shared = bool(list_shared_effects([kind]))
    for name in kind.numbers:
        sizes = {}
        for j, sized in rows.items():
            values = translate(sized.row, j, machine)
            if name in values:
                sizes[j] = (values[name], sized.relative)
        if is_shared and sizes:
            sizes = dict.fromkeys(sizes, _average_sizes(list(sizes.values())))
        for j, (value, relative) in sizes.items():
            estimate = _estimate_number(kind, name, j, value, relative)
            found.setdefault(name, {})[machine.joint_names[j]] = estimate
    return found


def _average_sizes(sizes: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the mean of sizes, weighed by their relative errors, and the smallest of these: forms err alike."""
    values = np.array([value for value, _ in sizes])
    errors = np.array([relative for _, relative in sizes])
    weights = errors**-2.0
    return float(weights @ values / weights.sum()), float(errors.min())


def _estimate_number(
    kind: EffectType, name: str, joint: int, value: float, relative: float
) -> Estimate:
    """Return a number with its 95 % interval, within the bounds of the registry."""
    none = kind.numbers[name].none
    off = 0.0 if none is None else none
    ends = off + (value - off) * np.exp(SIGMAS * relative * np.array([-1.0, 1.0]))
    least, most = (float(side[joint if len(side) > 1 else 0]) for side in kind.limits(name))
    low, mean, high = np.clip(np.sort([*ends, value]), least, most).tolist()
    at_bound = bool(np.isclose(mean, least) or np.isclose(mean, most)) and mean != off
    return Estimate(mean, (low, high), at_bound)


def translate(row: Row, joint: int, machine: Machine) -> dict[str, float]:
    """Return a row as numbers of the registry's effect."""
    values = {name: value for name, _, value in row.changes}
    unit = float(measure_units(machine)[joint])
    effect = row.effect
    if effect == "dead_time":
        return {"dead_time_s": values["delay_s"]}
    if effect == "dead_band":
        return {"extend": values["band_out"], "retract": values["band_in"]}
    if effect == "flow_gain":
        return {"gain": 1.0 + values["speed_out"]}
    if effect == "damping":
        return {"factor": 1.0 + values["damping_ratio"]}
    if effect == "asymmetry":
        return {
            "extend_gain": 1.0 + values.get("speed_out", 0.0),
            "retract_gain": 1.0 + values.get("speed_in", 0.0),
        }
    if effect == "saturation":
        return {"level": next(iter(values.values()))}
    if effect == "lag":
        stages = [values[name] for name in values if name.endswith("_lag_s")]
        return {"time_constant_s": sum(stages)}
    if effect == "backlash":
        # Friction holds a target on either side.
        width = 2.0 * values["dry"] if "dry" in values else next(iter(values.values()))
        return {"gap_rad": width * unit}
    if effect == "sag" and "sag" in values:
        return {"sag_rad": values["sag"] * unit, "sag_slope": values.get("sag_pose_1", 0.0)}
    if effect == "torque_limit":
        return {name: values[name] for name in ("shortage", "firmware_damping")}
    if effect == "rate_limit":
        return {"stroke_s": values["slope_time_s"]}
    if effect == "stiction":
        start = values["start_command"]
        return {"start": start, "stop": start * values["stop_ratio"]}
    if effect == "compliance":
        return {"ringing_s": values["ringing_s"], "damping": values["damping"]}
    if effect == "thermal_drift":
        side = "change" if "thermal_grows" in values else "cold_change"
        return {side: values["thermal_share"], "time_s": values["thermal_s"]}
    if effect == "flow_sharing":
        # The engine counts flow over that of the joint's own full speed, here 0.3 units a second.
        return {"demand": 1.0 / values["demand_limit"]}
    if effect == "creep" and "creep" in values:
        return {"drift_rad_s": values["creep"] * unit}
    # Weight over the yield force, at the stretched arm.
    force = machine.bodies[joint].yield_force.value
    share = float(measure_full_loads(machine)[joint]) * GRAVITY_M_S2 / force
    if effect == "sag":
        return {"load_rad": values["sag_load"] * unit / share}
    if effect == "creep":
        return {"sink_rad_s": abs(values["creep_by_load"]) * unit / share}
    # To first order the square root of the registry halves the sensitivity.
    lowering = 1.0 if "load_both" in values else 0.0
    return {"sensitivity": 2.0 * next(iter(values.values())) / share, "lowering": lowering}


def describe_hold(hold: HeldCourse, machine: Machine) -> dict[str, tuple[float, float]]:
    """Return the numbers of held commands from their course, each with its standard error over it.

    A delay is seen where commands change, so each sample counts by the square of that change.
    """
    if isinstance(hold.law, JitterLaw):
        mean_s = float(hold.weights @ hold.delays) * machine.period_s
        # Delays are uniform from none to the longest.
        return {"jitter_s": (2.0 * mean_s, get_form_error("delay_jitter"))}
    num_seen = 1.0 / max(float(np.square(hold.weights).sum()), 1e-12)
    share = hold.law.probability
    spread = np.sqrt((1.0 - share) / (share * num_seen))
    relative = float(np.hypot(spread, get_form_error("frame_loss")))
    persistence = hold.law.persistence
    return {"probability": (share, relative), "persistence": (persistence, relative)}
