"""What the 3D scene of the page needs besides positions: the machine's links, once, and the way that the tool has to go."""

from __future__ import annotations

from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from deploy.page.protocol import Vector

ABOVE_M, BELOW_M = 0.3, 0.1
"""From where over the rim the tool goes straight down, and how deep it has to go: 0.10 m in the
hole is the task's success."""
BESIDE_M = 0.05
"""Distance to the axis of the borehole up to which the tool is over it."""


def geometry(machine: Machine) -> dict[str, Any] | None:
    """Returns what the page needs to draw the machine, as plain data; `None` where it is known by its joints only."""
    if not machine.has_bodies:
        return None
    links = [
        {
            "kind": joint.kind,
            "axis": list(body.axis),
            "origin_m": [dimension.value for dimension in body.origin_m],
        }
        for joint, body in zip(machine.joints, machine.bodies, strict=True)
    ]
    return {"links": links, "tip_m": machine.tip_m.tolist()}


def approach(tip_m: np.ndarray, center_m: np.ndarray, axis: np.ndarray) -> tuple[Vector, ...]:
    """Returns the way of the tip to a point over the rim of a borehole, then along its axis into it, in the base frame.

    This is where the tool has to go, not what the policy will do: that also depends on who moves
    the levers.

    Args:
        tip_m: Tip of the tool, `(3,)`.
        center_m: Centre of the rim, `(3,)`.
        axis: Unit vector out of the hole, `(3,)`.
    """
    off_m = tip_m - center_m
    is_over = (
        float(off_m @ axis) < ABOVE_M and float(np.linalg.norm(np.cross(off_m, axis))) < BESIDE_M
    )
    way = (
        (tip_m, center_m - BELOW_M * axis)
        if is_over
        else (tip_m, center_m + ABOVE_M * axis, center_m - BELOW_M * axis)
    )
    return tuple((float(x), float(y), float(z)) for x, y, z in way)
