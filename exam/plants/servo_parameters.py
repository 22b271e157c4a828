"""Numbers of an arm of position servos: what only a fault changes, and effects as changes of them."""

from __future__ import annotations

import numpy as np

from exam.plants.changes import Change, FaultSizes, PlantParameters
from exam.plants.valve_parameters import CHANGES as VALVE_CHANGES

MAKES = ("bristle", "dry")
"""Friction of a make: bristles that bend before they slip (LuGre), or dry friction of MuJoCo with a
Stribeck part."""

COUNT_RAD = 2.0 * np.pi / 4096
"""Step of the servos' encoder: twelve bits over a turn."""
NEUTRAL = dict.fromkeys(
    (
        "jitter_s", "loss", "filter_s", "stroke_s", "added_friction_n_m", "added_viscous", "added_armature", "pull_n_m",
        "extra_noise_rad",
    ),
    0.0,
) | {"step_rad": COUNT_RAD, "duty_cap": 1.0}  # fmt: skip
"""Numbers that only a fault changes, as an arm without faults has them."""


def _add_backlash(n: PlantParameters, size: FaultSizes) -> None:
    """Add friction that the loop's stiffness does not overcome within half the gap.

    The encoder sits behind the gear: play before it leaves no error at rest, friction does.
    """
    n["added_friction_n_m"] = n["added_friction_n_m"] + 0.5 * n["stiffness"] * size["gap_rad"]


def _add_sag(n: PlantParameters, size: FaultSizes) -> None:
    """Add the pull of a cable that bends the loop by the sag in the middle of the travel."""
    n["pull_n_m"] = n["pull_n_m"] - n["stiffness"] * size["sag_rad"]


def _add_joint_friction(n: PlantParameters, size: FaultSizes) -> None:
    n["added_friction_n_m"] = n["added_friction_n_m"] + size["part"] * n["full_n_m"]


def _add_joint_damping(n: PlantParameters, size: FaultSizes) -> None:
    n["added_viscous"] = n["added_viscous"] + size["part"] * n["full_n_m"] / n["full_rad_s"]


def _add_torque_limit(n: PlantParameters, size: FaultSizes) -> None:
    """Cap the motor's duty, as firmware does: back EMF and its own damping lie within the cap."""
    limit_n_m = n["full_n_m"] / np.maximum(size["shortage"], 1e-9)
    n["duty_cap"] = np.minimum(n["duty_cap"], limit_n_m / n["stall_n_m"])


LIKE_VALVES = ("dead_time", "delay_jitter", "frame_loss", "rate_limit", "sensor_noise")
"""Effects that change the same parameters as on a valve: of the bus, of the slope of targets, of
readings."""
FAULTS: dict[str, Change] = {
    **{name: VALVE_CHANGES[name] for name in LIKE_VALVES},
    "lag": (("filter_s", np.add, "time_constant_s"),),
    "backlash": _add_backlash,
    "sag": _add_sag,
    "quantisation": (("step_rad", np.maximum, "step_rad"),),
    "torque_limit": _add_torque_limit,
    "joint_friction": _add_joint_friction,
    "joint_damping": _add_joint_damping,
    "joint_armature": (("added_armature", np.add, "part"),),
    "drive_gain": (("stiffness", np.multiply, "gain"),),
}
"""Change of the parameters by effect. The last four are effects on numbers of an MJCF file: only a
candidate that diagnoses such a simulator can name them."""
