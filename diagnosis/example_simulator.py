"""A simulator in ten lines: the default of `actuator=own`, and a pattern for one of your own."""

import numpy as np

PERIOD_S = 0.05
TIME_CONSTANT_S = 0.2
"""A heavy joint reaches two thirds of its commanded speed in this time. Chosen by hand."""


def step(state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return the state one control period later: speeds follow their command by a first-order lag.

    Args:
        state: Positions, then speeds, `(…, 2 J)`.
        command: Commanded speeds, rad/s or m/s, `(…, J)`.
    """
    q, speed = np.split(state, 2, axis=-1)
    decay = np.exp(-PERIOD_S / TIME_CONSTANT_S)
    moved = command * PERIOD_S + (speed - command) * TIME_CONSTANT_S * (1.0 - decay)
    return np.concatenate([q + moved, command + (speed - command) * decay], axis=-1)
