"""The rows of the table: each effect in each of its forms and sizes, as changes of a joint's numbers.

Rows outside the library stand beside it. Where one of them, or a flexible column of `generic`,
explains the field better than any effect, the cause is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.engine.joint_model import NAMES, PLACE

Change = tuple[str, str, float]
"""A number, how it changes, and by what: `add`, `scale` (times `1 + value`), or `least` (raised to it)."""


@dataclass(frozen=True)
class Row:
    """One effect in one form and size.

    Attributes:
        effect: Its name in the registry, or one of `OUTSIDE`.
        changes: Changes that make it.
        sizes: Which of the changes grow with its size; the first of them is the size.
    """

    effect: str
    changes: tuple[Change, ...]
    sizes: tuple[int, ...] = (0,)

    @property
    def size(self) -> float:
        """The size, in the unit of the first number that it changes."""
        return self.changes[self.sizes[0]][2]

    def resize(self, factor: float, shape: float = 1.0) -> Row:
        """Return the same row `factor` times as large, its other values `shape` times as large."""
        changes = []
        for place, (name, how, value) in enumerate(self.changes):
            by = factor if place in self.sizes else _limit_shape(name, shape)
            changes.append((name, how, _limit(name, value * by)))
        return Row(self.effect, tuple(changes), self.sizes)


FIXED = frozenset(
    {"catch_up", "same_way_share", "crosstalk_joint", "thermal_grows", "slip_above", "load_alone"}
)
"""Numbers that choose a form; no size of them is searched."""
CEILINGS = {"stop_ratio": 0.97, "damping": 0.7, "thermal_s": 700.0}
FLOORS = {"thermal_s": 30.0}


def _limit_shape(name: str, factor: float) -> float:
    return 1.0 if name in FIXED or name == "load_constant" else factor


def _limit(name: str, value: float) -> float:
    return float(np.clip(value, FLOORS.get(name, -np.inf), CEILINGS.get(name, np.inf)))


def change_numbers(numbers: np.ndarray, rows: Sequence[Row]) -> np.ndarray:
    """Return the numbers `(P,)` changed by each row, `(C, P)`."""
    found = np.repeat(numbers[None], len(rows), 0)
    for values, row in zip(found, rows, strict=True):
        for name, how, value in row.changes:
            place = PLACE[name]
            if how == "add":
                values[place] += value
            elif how == "scale":
                values[place] *= 1.0 + value
            else:
                values[place] = max(values[place], value)
    return found


def _spread(low: float, high: float, count: int) -> list[float]:
    return np.geomspace(low, high, count).tolist()


def _mirror(sizes: Sequence[float]) -> list[float]:
    return [sign * size for size in sizes for sign in (-1.0, 1.0)]


GAINS = _mirror((0.06, 0.1, 0.15, 0.2, 0.25, 0.32, 0.4, 0.5))
LOADS = _mirror((0.06, 0.1, 0.17, 0.25, 0.35, 0.5, 0.7))
THERMAL = _mirror((0.08, 0.15, 0.25, 0.35, 0.5))


def list_effect_rows() -> list[Row]:
    """Return the rows of the library."""
    rows = []
    for s in _spread(0.03, 0.65, 12):
        rows.append(Row("dead_time", (("delay_s", "add", s),)))
    for s in _spread(0.015, 0.25, 9):
        rows.append(Row("dead_band", (("band_out", "add", s), ("band_in", "add", s)), (0, 1)))
    for s in GAINS:
        both = (("speed_out", "scale", s), ("speed_in", "scale", s))
        rows.append(Row("flow_gain", both, (0, 1)))
        rows.append(Row("asymmetry", both[:1]))
        rows.append(Row("asymmetry", both[1:]))
    for s in _spread(0.25, 0.95, 12):
        rows.append(Row("saturation", (("stroke", "add", s),)))
    for s in _spread(0.25, 0.95, 10):
        rows.append(Row("saturation", (("top_share", "add", s),)))
    for s in _spread(0.04, 1.0, 11):
        rows.append(Row("lag", (("command_lag_s", "add", s),)))
    for s in _spread(0.04, 0.8, 9):
        rows.append(Row("lag", (("speed_lag_s", "add", s),)))
    for s in _spread(0.005, 0.14, 10):
        rows.append(Row("backlash", (("play", "add", s),)))
    for s in _spread(0.01, 0.14, 8):
        for slip in (0.008, 0.03):
            rows.append(Row("backlash", (("play", "add", s), ("play_slip", "add", slip))))
    for s in _spread(0.25, 4.0, 11):
        rows.append(Row("rate_limit", (("slope_time_s", "least", 1.0 / s),)))
    for s in _spread(0.06, 0.6, 9):
        for ratio in (0.3, 0.6, 0.85):
            changes = (("start_command", "add", s), ("stop_ratio", "add", ratio))
            rows.append(Row("stiction", changes))
    for s in _spread(0.004, 0.12, 8):
        for catch_up in (0.0, 0.5, 1.0):
            for share in (1.0, 0.4):
                changes = (
                    ("break_away", "add", s),
                    ("catch_up", "add", catch_up),
                    ("same_way_share", "add", share),
                )
                rows.append(Row("stiction", changes))
    rows += _list_load_rows()
    for s in _mirror(_spread(0.0008, 0.03, 9)):
        rows.append(Row("creep", (("creep", "add", s),)))
    for s in _mirror(_spread(0.0008, 0.05, 9)):
        rows.append(Row("creep", (("creep_by_load", "add", s),)))
    for omega in _spread(1.5, 14.0, 30):
        for damping in (0.06, 0.15, 0.35):
            rows.append(
                Row("compliance", (("omega_rad_s", "add", omega), ("damping", "add", damping)))
            )
    for omega in _spread(1.5, 14.0, 20):
        for damping in (0.1, 0.3):
            for sag in (1.0, 4.0):
                changes = (
                    ("omega_rad_s", "add", omega),
                    ("damping", "add", damping),
                    ("sag", "add", sag / omega**2),
                )
                rows.append(Row("compliance", changes))
    for s in THERMAL:
        for time_s in (40.0, 90.0, 200.0, 400.0):
            changes = (("thermal_share", "add", s), ("thermal_s", "add", time_s))
            rows.append(Row("thermal_drift", changes))
        for time_s in (60.0, 150.0, 350.0):
            changes = (
                ("thermal_share", "add", s),
                ("thermal_s", "add", time_s),
                ("thermal_grows", "add", 1.0),
            )
            rows.append(Row("thermal_drift", changes))
    for s in _spread(0.3, 2.4, 14):
        rows.append(Row("flow_sharing", (("demand_limit", "add", s),)))
    return rows


def _list_load_rows() -> list[Row]:
    rows = []
    for s in LOADS:
        rows.append(Row("load_dependence", (("load_both", "add", s),)))
    for s in (-0.7, -0.5, -0.35, -0.2, -0.1, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9):
        rows.append(Row("load_dependence", (("load_opposing", "add", s),)))
    for s in (-0.7, -0.4, -0.2, 0.1, 0.2, 0.4, 0.7):
        changes = (("load_both", "add", s), ("load_alone", "add", 3.0))
        rows.append(Row("load_dependence", changes))
    for s in (0.2, 0.4, 0.6, 0.8, 1.0, 1.3, 1.7):
        for alone in (0.0, 3.0):
            for constant in (0.0, 0.5, 0.8):
                changes = (
                    ("load_root", "add", s),
                    ("load_alone", "add", alone),
                    ("load_constant", "add", constant),
                )
                rows.append(Row("load_dependence", changes))
    return rows


OUTSIDE = ("hysteresis", "pose_pull", "cross_talk", "slow_centring", "slip", "pump_lag")
"""Causes outside the library that are simulated beside it."""


def list_outside_rows(num_joints: int) -> list[Row]:
    """Return the rows of causes outside the library."""
    rows = []
    for s in _spread(0.015, 0.2, 8):
        rows.append(Row("hysteresis", (("hysteresis", "add", s),)))
    for s in _mirror((0.03, 0.07, 0.12, 0.2, 0.3)):
        rows.append(Row("pose_pull", (("pose_pull", "add", s),)))
    for s in _mirror((0.03, 0.06, 0.12, 0.2)):
        for joint in range(num_joints):
            changes = (("crosstalk", "add", s), ("crosstalk_joint", "add", float(joint)))
            rows.append(Row("cross_talk", changes))
    for s in _spread(0.04, 1.2, 9):
        rows.append(Row("slow_centring", (("closing_lag_s", "add", s),)))
    for s in (0.1, 0.2, 0.35, 0.5):
        for above in (0.05, 0.1, 0.15):
            rows.append(Row("slip", (("slip", "add", s), ("slip_above", "add", above))))
    for s in _spread(0.06, 0.9, 9):
        rows.append(Row("pump_lag", (("pump_lag_s", "add", s),)))
    return rows


SHARED = frozenset({"flow_sharing", "pump_lag"})
"""Rows with one size for all joints."""

assert {name for row in list_effect_rows() for name, _, _ in row.changes} <= set(NAMES)
