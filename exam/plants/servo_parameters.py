"""Parameters of one arm of position servos, drawn from a seed; effects as changes of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.changes import Change, FaultSizes, PlantParameters, apply_changes
from exam.plants.valve_parameters import CHANGES as VALVE_CHANGES

MAKES = ("bristle", "dry")
"""Friction of a make: bristles that bend before they slip (LuGre), or dry friction of MuJoCo with a
Stribeck part."""

RANGES = {
    "stiffness": (24.0, 40.0),  # Nm/rad: the weight of the arm then bends it by 10 to 20 mrad
    "firmware_damping": (0.5, 1.1),  # Nm s/rad
    "stall_n_m": (2.6, 3.3),  # STS3215: 2.94 Nm at 12 V
    "no_load_rad_s": (4.6, 5.6),  # the same servo: 4.7 rad/s
    "coulomb_n_m": (0.04, 0.08),  # its published frictionloss: 0.052
    "viscous": (0.1, 0.3),  # Nm s/rad
    "static_ratio": (1.2, 1.7),  # friction at rest over that in motion
    "stribeck_rad_s": (0.05, 0.15),
    "presliding_rad": (0.002, 0.004),  # bend of the bristles before they slip
    "noise_rad": (0.0002, 0.0004),
}
"""Range of each parameter, uniform and by joint; chosen by hand where no source stands."""

NUISANCES = {
    "load_friction": (0.02, 0.06),  # of the torque through the gear: BAM's load-dependent term
    "cogging_n_m": (0.005, 0.015),  # torque ripple over the angle
    "dead_zone_rad": (0.0005, 0.0015),  # width of the firmware's zone without torque
    "wander": (0.05, 0.10),  # standard deviation of the slow change of friction, of itself
    "supply_drop": (0.01, 0.03),  # loss of voltage at full duty of all joints
}
"""The same for nuisances that the library has no model of; all scale with the roughness."""
COUNT_RAD = 2.0 * np.pi / 4096
"""Step of the servos' encoder: twelve bits over a turn."""
ZERO_WITHOUT_FAULT = (
    "jitter_s", "loss", "filter_s", "stroke_s", "added_friction_n_m", "added_viscous", "added_armature", "pull_n_m",
    "extra_noise_rad", "outside_severity",
)  # fmt: skip
"""Parameters that are 0 in an arm without faults."""


def draw_servos(machine: Machine, seed: int, roughness: float) -> tuple[str, PlantParameters]:
    """Return make and parameters of the arm with this seed; `roughness` scales its nuisances."""
    generator = np.random.default_rng([seed, *b"servos"])
    make, count = MAKES[int(generator.integers(len(MAKES)))], machine.num_joints
    found = {name: generator.uniform(*span, count) for name, span in RANGES.items()}
    for name, span in NUISANCES.items():
        found[name] = roughness * generator.uniform(*span, count)
    found["supply_drop"] = np.full(count, found["supply_drop"][0])  # one supply
    found["cogging_phase"] = generator.uniform(0.0, 2.0 * np.pi, count)
    found["transport_s"] = np.full(count, generator.uniform(0.03, 0.06))  # one bus
    # time steps between two of the firmware's loop
    found["ticks"] = np.full(count, float(generator.integers(1, 4)))
    found["step_rad"] = np.full(count, COUNT_RAD)
    found["duty_cap"] = np.ones(count)
    found |= {name: np.zeros(count) for name in ZERO_WITHOUT_FAULT}
    return make, found


def _add_lag(n: PlantParameters, size: FaultSizes) -> None:
    """Add the firmware's smoothing of targets: two equal stages with the same mean delay."""
    n["filter_s"] = n["filter_s"] + 0.5 * size["time_constant_s"]


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
    "lag": _add_lag,
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


def change_servos(
    numbers: PlantParameters, faults: Mapping[str, FaultSizes], machine: Machine
) -> PlantParameters:
    """Return the parameters of an arm with faults; raises as `apply_changes`."""
    # as `diagnosis.mjcf.plant` counts: an error of 5 % of the travel, and full speed
    full_n_m = 0.05 * numbers["stiffness"] * (machine.upper - machine.lower)
    known = numbers | {"full_n_m": full_n_m, "full_rad_s": machine.max_speed}
    return apply_changes(known, faults, FAULTS, "an arm of exam_plants=servos")
