"""Errors of a simulator's own numbers from day to day, which are no effect.

Axes: `P` numbers, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from actuators.scales import scale_time
from brokk_rl.machine import Machine

# Chosen by hand; not searched.
TIME_FAULT_S = 0.004
"""Error of a time on the reference of `actuators.scales`, s."""
TRAVEL_FAULT = 0.001
"""Error of a length or an angle, over the travel of its joint."""
NUMBER_FAULT = 0.01
"""Error of a number without a unit."""


def list_number_faults(names: Sequence[str], machine: Machine) -> np.ndarray:
    """Return one standard deviation of the error of each number on each joint, `(P, J)`.

    Args:
        names: Of the numbers; their endings tell the unit, `_s` a time, `_rad` a length or an angle.
        machine: The machine.
    """
    by_unit = {
        "_s": np.full(machine.num_joints, scale_time(machine, TIME_FAULT_S)),
        "_rad": TRAVEL_FAULT * (machine.upper - machine.lower),
    }
    rows = []
    for name in names:
        found = [fault for unit, fault in by_unit.items() if name.endswith(unit)]
        rows.append(found[0] if found else np.full(machine.num_joints, NUMBER_FAULT))
    return np.stack(rows)
