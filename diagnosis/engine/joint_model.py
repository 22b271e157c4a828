"""The model of a valve-driven joint: a table of numbers, one row each, with prior, ageing and bounds.

A joint takes commands and measured poses and gives its speed, integrated to a path. It never takes
its own measured speed. The joints therefore decouple, and a poor model cannot run away. An effect is
a change of some numbers; those that a healthy machine does not need are 0.
Priors and ageing were chosen on practice plants of two makes; docs/diagnosis.md has the figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


@dataclass(frozen=True)
class JointNumber:
    """One number of a joint.

    Attributes:
        name: Its name, with its unit where it has one.
        mean: Expected value before any recording is seen; 0 for one that healthy joints lack.
        deviation: Standard deviation of that expectation; 0: it is not fitted to the reference.
        step: Step of the finite difference.
        ageing: Standard deviation of its change between reference and field.
        lower: Smallest value.
        upper: Largest value.
    """

    name: str
    mean: float = 0.0
    deviation: float = 0.0
    step: float = 0.0
    ageing: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf


def _repeat(name: str, count: int, *values: float) -> list[JointNumber]:
    return [JointNumber(f"{name}_{i}", *values) for i in range(1, count + 1)]


NUMBERS = (
    JointNumber("delay_s", 0.35, 0.3, 0.002, 0.007, 0.0, 1.2),
    JointNumber("pilot_lag_s", 0.06, 0.06, 0.003, 0.007, 0.001, 0.6),
    JointNumber("spool_lag_s", 0.03, 0.04, 0.003, 0.007, 0.001, 0.4),
    JointNumber("band_out", 0.06, 0.05, 0.002, 0.004, 0.0, 0.4),
    JointNumber("band_in", 0.06, 0.05, 0.002, 0.004, 0.0, 0.4),
    JointNumber("speed_out", 0.3, 0.3, 0.004, 0.004, 0.01, 3.0),
    JointNumber("speed_in", 0.3, 0.3, 0.004, 0.004, 0.01, 3.0),
    JointNumber("curve_out", 0.0, 0.3, 0.02, 0.02, -1.5, 1.5),
    JointNumber("bend_out", 0.0, 0.25, 0.02, 0.02, -3.0, 3.0),
    JointNumber("curve_in", 0.0, 0.3, 0.02, 0.02, -1.5, 1.5),
    JointNumber("bend_in", 0.0, 0.25, 0.02, 0.02, -3.0, 3.0),
    JointNumber("pose_1", 0.0, 0.15, 0.01, 0.01, -2.0, 2.0),
    JointNumber("pose_2", 0.0, 0.12, 0.01, 0.01, -2.0, 2.0),
    JointNumber("pose_3", 0.0, 0.08, 0.01, 0.01, -2.0, 2.0),
    JointNumber("pose_4", 0.0, 0.08, 0.01, 0.01, -2.0, 2.0),
    *_repeat("load_out", 4, 0.0, 0.04, 0.01, 0.01, -0.5, 0.5),
    *_repeat("load_in", 4, 0.0, 0.04, 0.01, 0.01, -0.5, 0.5),
    JointNumber("motion_lag_s", 0.03, 0.04, 0.003, 0.005, 0.001, 0.4),
    JointNumber("droop", 0.0, 0.03, 0.005, 0.005, -0.2, 0.3),
    JointNumber("pump_load", 0.25, 0.1, 0.01, 0.01, 0.0, 1.5),
    JointNumber("hysteresis", 0.003, 0.006, 0.001, 0.002, 0.0, 0.3),
    JointNumber("play", 0.002, 0.004, 0.001, 0.001, 0.0, 0.2),
    JointNumber("drift", 0.0, 0.03, 0.005, 0.015, -0.3, 0.3),
    JointNumber("creep", 0.0, 0.002, 2e-4, 3e-4, -0.05, 0.05),
    JointNumber("log_closing_ratio", 0.0, 0.3, 0.02, 0.05, -1.0, 1.0),
    JointNumber("slope_time_s", 0.1, 0.15, 0.01, 0.02, 0.02, 4.0),
    # Numbers that only effects set.
    JointNumber("command_lag_s"),
    JointNumber("speed_lag_s"),
    JointNumber("stroke"),
    JointNumber("top_share"),
    JointNumber("start_command"),
    JointNumber("stop_ratio"),
    JointNumber("break_away"),
    JointNumber("catch_up"),
    JointNumber("same_way_share"),
    JointNumber("load_opposing"),
    JointNumber("load_both"),
    JointNumber("load_alone"),
    JointNumber("load_root"),
    JointNumber("load_constant"),
    JointNumber("creep_by_load"),
    JointNumber("omega_rad_s"),
    JointNumber("damping"),
    JointNumber("sag"),
    JointNumber("thermal_share"),
    JointNumber("thermal_s"),
    JointNumber("thermal_grows"),
    JointNumber("demand_limit"),
    JointNumber("pose_pull"),
    JointNumber("crosstalk"),
    JointNumber("crosstalk_joint"),
    JointNumber("closing_lag_s"),
    JointNumber("slip"),
    JointNumber("slip_above"),
    JointNumber("pump_lag_s"),
    JointNumber("play_slip"),
)

NAMES = tuple(number.name for number in NUMBERS)
PLACE = {name: place for place, name in enumerate(NAMES)}
"""Place of each number in a vector of all."""
Place = IntEnum("Place", [(name.upper(), place) for name, place in PLACE.items()])
"""The same as constants of the kernel."""
FITTED = np.array([number.deviation > 0.0 for number in NUMBERS])
NUM_FITTED = int(FITTED.sum())


def list_values(field: str) -> np.ndarray:
    """Return one field of all numbers, `(P,)`."""
    return np.array([getattr(number, field) for number in NUMBERS])
