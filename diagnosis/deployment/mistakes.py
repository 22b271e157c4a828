"""Mistakes of deployment code that can spoil values wherever they pass, as tables.

Axes: `T` rows, `C` columns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Spoil = Callable[[np.ndarray, float, np.ndarray], np.ndarray]
"""Makes wrong values of right ones `(T, C)`, by a number, with the unit of each column `(C,)`."""


@dataclass(frozen=True)
class Mistake:
    """A mistake that code may make wherever values pass.

    Attributes:
        kind: Kind of mistake.
        text: The mistake in words; `{field}` stands for the place, `{value}` for the number.
        spoil: Makes wrong values of right ones.
        values: Numbers to try; one of no meaning where there is no number.
        parameter: Name of the number, with its unit; empty where it is not told.
        is_continuous: The number is refined between those of `values`.
    """

    kind: str
    text: str
    spoil: Spoil
    values: tuple[float, ...] = (0.0,)
    parameter: str = ""
    is_continuous: bool = False


def scale(values: np.ndarray, factor: float, unit: np.ndarray) -> np.ndarray:
    """Return values times a factor."""
    return factor * values


def shift(values: np.ndarray, offset: float, unit: np.ndarray) -> np.ndarray:
    """Return values with an offset in the unit of each column."""
    return values + offset * unit


def shift_command(values: np.ndarray, offset: float, unit: np.ndarray) -> np.ndarray:
    """Return commands with an offset, within full command."""
    return (values + offset).clip(-1.0, 1.0)


def clip(values: np.ndarray, bound: float, unit: np.ndarray) -> np.ndarray:
    """Return values clipped at plus and minus a bound."""
    return values.clip(-bound, bound)


def delay(values: np.ndarray, periods: float, unit: np.ndarray) -> np.ndarray:
    """Return values that are whole rows late; the first row stands before. Fewer than 0: early."""
    return values[np.clip(np.arange(len(values)) - int(periods), 0, len(values) - 1)]


def freeze(values: np.ndarray, row: float, unit: np.ndarray) -> np.ndarray:
    """Return values that stay as they are from a row on."""
    return values[np.minimum(np.arange(len(values)), int(row))]


def smooth(values: np.ndarray, weight: float, unit: np.ndarray) -> np.ndarray:
    """Return values behind a first-order low-pass; `weight` is that of the newest value."""
    smoothed = values.copy()
    for row in range(1, len(values)):
        smoothed[row] = weight * values[row] + (1.0 - weight) * smoothed[row - 1]
    return smoothed


def make_hold(every: int) -> Mistake:
    """Return the mistake that values are refreshed only every few rows, at any phase."""

    def hold(values: np.ndarray, phase: float, unit: np.ndarray) -> np.ndarray:
        rows = np.arange(len(values))
        return values[np.maximum(rows - (rows - int(phase)) % every, 0)]

    phases = tuple(float(phase) for phase in range(every))
    return Mistake("rate", f"{{field}} is refreshed every {every} periods only", hold, phases)


# Numbers at which a search begins were chosen by hand: it is refined between them.
MAX_DELAY = 12
"""Longest delay that is tried, rows; half a second at 20 Hz is more than a history's dead time."""
DELAYS = tuple(float(number) for number in range(1, MAX_DELAY + 1))
LEVELS = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85, 1.0, 1.5, 2.0, 3.0)
FACTORS = (-2.0, -0.5, 0.1, 0.25, 0.5, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0, 3.0, 10.0)
OFFSETS_STD = (-2.0, -1.0, -0.5, -0.2, -0.08, 0.08, 0.2, 0.5, 1.0, 2.0)
OFFSETS_COMMAND = (-0.3, -0.1, -0.03, 0.03, 0.1, 0.3)
SMOOTHING = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
SHIFTS_M = (
    -1.5,
    -1.0,
    -0.7,
    -0.5,
    -0.3,
    -0.2,
    -0.1,
    -0.05,
    0.05,
    0.1,
    0.2,
    0.3,
    0.5,
    0.7,
    1.0,
    1.5,
)
ANGLES_RAD = tuple(np.deg2rad([*range(-165, 0, 15), -4, 4, *range(15, 181, 15)]))

SIGN = Mistake("sign", "{field} has the wrong sign", scale, (-1.0,))
ON_COLUMNS = (
    SIGN,
    Mistake("scale", "{field} is multiplied by {value}", scale, FACTORS, "factor", True),
    Mistake("stale", "{field} is always zero", scale, (0.0,)),
)
ON_SIGNALS = (
    *ON_COLUMNS,
    Mistake("scale", "{field} is in degrees for radians", scale, (180.0 / np.pi,)),
    Mistake("scale", "{field} is in radians for degrees", scale, (np.pi / 180.0,)),
    Mistake("scale", "{field} is in thousandths for units", scale, (1000.0,)),
    Mistake("scale", "{field} is in units for thousandths", scale, (0.001,)),
    Mistake("scale", "{field} is in hundredths for units", scale, (100.0,)),
    Mistake("default_pose", "{value} standard deviations are added to {field}", shift, OFFSETS_STD, "offset_std", True),
)  # fmt: skip
ON_COMMANDS = (
    *ON_COLUMNS,
    Mistake("clip", "{field} is clipped at ±{value}", clip, LEVELS[:6], "bound", True),
    Mistake("default_pose", "{value} is added to {field}", shift_command, OFFSETS_COMMAND, "offset", True),
)  # fmt: skip
LATE = Mistake("delay", "{field} is {value} periods old", delay, DELAYS, "periods")
ON_ROWS = (
    LATE,
    *map(make_hold, range(2, 6)),
    Mistake("filter", "{field} is low-pass filtered, newest weighs {value}", smooth, SMOOTHING, "weight", True),
)  # fmt: skip
EARLY = Mistake("delay", "{field} is a period too new", delay, (-1.0,))


def make_turn(axis: int) -> Spoil:
    """Return the turn of points `(T, 3)` about axis 0, 1 or 2 by an angle."""
    one, other = (axis + 1) % 3, (axis + 2) % 3

    def turn(points: np.ndarray, angle_rad: float, unit: np.ndarray) -> np.ndarray:
        turned = points.copy()
        cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        turned[:, one] = cos * points[:, one] - sin * points[:, other]
        turned[:, other] = sin * points[:, one] + cos * points[:, other]
        return turned

    return turn
