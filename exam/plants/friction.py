"""Friction of seals and pins in an exam's plants."""

from __future__ import annotations

import numpy as np

STILL = 0.015
"""Speed, of full speed, below which friction grows with speed: no chatter at the time steps
used."""


def rubbing(speed: np.ndarray, dry: np.ndarray, viscous: np.ndarray) -> np.ndarray:
    """Returns friction force over speed: a dry part that is smooth through zero, and a viscous one."""
    return dry / np.sqrt(speed * speed + STILL * STILL) + viscous
