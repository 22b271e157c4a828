"""Scales of a machine: travel, speed, time and reach over those of the machine that sizes were chosen on.

Typical sizes of effects, horizons and windows were chosen by hand on `machine=brokk170`. On another
machine they follow from its own joints: half a degree of play is little on an arm that turns by 150
degrees, and all of a cylinder that moves by 50 mm.
"""

from typing import Literal

import numpy as np

from brokk_rl.machine import Machine

Scale = Literal["", "travel", "speed", "time", "reach", "force", "viscosity"]
"""Property of a joint or machine in proportion to which a number grows; empty for none."""

# machine=brokk170: medians over its joints, and its own times and lengths.
REFERENCE_TRAVEL = 2.7
"""Travel, rad."""
REFERENCE_SPEED = 0.34
"""Speed at full command, rad/s."""
REFERENCE_PERIOD_S, REFERENCE_DEAD_TIME_S = 0.05, 0.55
"""Control period, and time from command to motion."""
REFERENCE_REACH_M = 5.945
"""Lengths of all links and the tool, m."""
MAX_HORIZON_S = 5.0
"""Longest free run: errors are compared over 5 s where a machine is no faster than the reference."""


def measure_scale(machine: Machine, scale: Scale) -> np.ndarray:
    """Return the scale of each joint over that of the reference, `(J,)`, or of the machine, `(1,)`.

    A machine that is known by its joints only has a reach of 1.
    """
    if scale == "travel":
        return (machine.upper - machine.lower) / REFERENCE_TRAVEL
    if scale == "speed":
        return machine.max_speed / REFERENCE_SPEED
    if scale == "time":
        return np.array([measure_time_scale(machine)])
    if scale == "force":  # of joints commanded by torque: the reference is a drive of 1 N …
        return machine.max_force
    if scale == "viscosity":  # … at 1 m/s
        return machine.max_force / machine.max_speed
    if scale == "reach":
        return np.array([_measure_reach_m(machine) / REFERENCE_REACH_M])
    return np.ones(1)


def measure_time_scale(machine: Machine) -> float:
    """Return the response time over that of the reference.

    A machine answers a command after its dead time. What is shorter than some control periods, no
    recording shows: the longer of the two counts.
    """
    return max(machine.period_s / REFERENCE_PERIOD_S, machine.dead_time_s / REFERENCE_DEAD_TIME_S)


def choose_horizon_s(machine: Machine) -> float:
    """Return the length of free runs: nine response times, in whole control periods, 5 s at most."""
    longest_s = MAX_HORIZON_S * min(1.0, measure_time_scale(machine))
    return round(longest_s / machine.period_s) * machine.period_s


def scale_time(machine: Machine, reference_s: float) -> float:
    """Return a time that was chosen on the reference, in proportion to the response time, s."""
    return reference_s * measure_time_scale(machine)


def _measure_reach_m(machine: Machine) -> float:
    if not machine.has_bodies:
        return REFERENCE_REACH_M
    links = [[d.value for d in body.origin_m] for body in machine.bodies]
    return float(np.linalg.norm([*links, machine.tip_m.tolist()], axis=1).sum())
