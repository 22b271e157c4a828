"""States of MuJoCo C in worlds of Warp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import warp as wp


def copy_state(
    model: mujoco.MjModel, data: mujoco.MjData, fields: Sequence[str], worlds: Any, world: int
) -> None:
    """Writes fields of `data` into one of the worlds, and completes `data` by a forward pass."""
    for name in fields:
        value = wp.to_torch(wp.array(getattr(data, name), dtype=float, device="cpu"))
        wp.to_torch(getattr(worlds, name))[world] = value
    mujoco.mj_forward(model, data)
