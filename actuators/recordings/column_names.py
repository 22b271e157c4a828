"""Names of columns read as words: role, quantity, unit and joint."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

Role = Literal["command", "measured"]
Quantity = Literal["position", "velocity", "effort", "unknown"]

TIME_WORDS = {
    "t",
    "time",
    "timestamp",
    "stamp",
    "clock",
    "sec",
    "seconds",
    "nanosec",
    "epoch",
    "ts",
    "datetime",
    "date",
    "zeit",
    "zeitstempel",
}
COMMAND_WORDS = {
    "u", "cmd", "cmds", "command", "commands", "commanded", "control", "ctrl", "action", "actions", "target", "targets",
    "goal", "setpoint", "sp", "desired", "des", "ref", "reference", "demand", "request", "valve", "flow", "pwm", "duty", "soll",
}  # fmt: skip
MEASURED_WORDS = {
    "q", "state", "states", "actual", "act", "meas", "measured", "ms", "feedback", "fb", "obs", "observation", "encoder",
    "enc", "present", "status", "sensor", "ist",
}  # fmt: skip
TARGET_WORDS = {
    "target",
    "targets",
    "goal",
    "setpoint",
    "sp",
    "desired",
    "des",
    "ref",
    "reference",
    "soll",
}
"""Words for commands that are positions unless another word says velocity or effort."""
QUANTITY_WORDS: dict[Quantity, set[str]] = {
    "position": {"q", "pos", "position", "positions", "angle", "angles", "length", "stroke", "ms", "ticks", "counts"},
    "velocity": {"qd", "dq", "vel", "vels", "velocity", "velocities", "speed", "speeds", "rate"},
    "effort": {
        "tau", "torque", "torques", "effort", "efforts", "load", "loads", "current", "force", "pressure", "temp",
        "temperature", "voltage", "kp", "kd", "stiffness", "damping",
    },
}  # fmt: skip
UNITS = {
    "rad": ("rad", 1.0), "rads": ("rad", 1.0), "radians": ("rad", 1.0), "deg": ("rad", 0.017453292519943295),
    "degree": ("rad", 0.017453292519943295), "degrees": ("rad", 0.017453292519943295), "rev": ("rad", 6.283185307179586),
    "m": ("m", 1.0), "metre": ("m", 1.0), "cm": ("m", 0.01), "mm": ("m", 0.001),
}  # fmt: skip
"""Unit of the recording, and its number for one of the log."""
TIME_UNITS = {
    "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "usec": 1e-6, "ns": 1e-9, "nsec": 1e-9,
    "nanosec": 1e-9,
}  # fmt: skip
"""Seconds for one of a unit."""
FILLER_WORDS = {
    "joint", "joints", "motor", "motors", "data", "value", "values", "raw", "real", "header", "robot", "main", "percent",
    "pct", "norm",
}  # fmt: skip
"""Words that name no joint."""


@dataclass(frozen=True)
class ColumnName:
    """A column's name read as words.

    Attributes:
        table: Its table.
        column: Its name in the table.
        role: What the words say; `None` where they say nothing.
        quantity: The same.
        unit: Unit of a position, a key of `UNITS`; `None` where none is named.
        joint: Remaining words joined by `_`; may be empty or a number.
    """

    table: str
    column: str
    role: Role | None
    quantity: Quantity
    unit: str | None
    joint: str


def read_speed_unit(column: str) -> float | None:
    """Return rad/s or m/s for one of a column whose name ends in a unit of speed, such as `rad_s`; else `None`."""
    *_, unit, second = ["", "", *split_words(column)]
    return UNITS[unit][1] if unit in UNITS and second == "s" else None


def read_unit(text: str) -> tuple[str, float] | None:
    """Return the unit of the recording and its number for one of the log, of `deg` or `0.00153 rad`; else `None`."""
    number, _, name = text.rpartition(" ")
    if name not in UNITS:
        return None
    try:
        factor = float(number or 1.0)
    except ValueError:
        return None
    unit, scale = UNITS[name]
    return (unit, factor * scale) if 0.0 < abs(factor) < math.inf else None


def split_words(text: str) -> list[str]:
    """Return the words of a name in lower case: `Boom Cmd`, `boomCmd` and `boom_cmd` are the same."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", text)
    return [word for word in re.split(r"[^a-z0-9]+", spaced.lower()) if word]


def read_column_name(table: str, column: str) -> ColumnName:
    """Return what the words of a column's name say, those of its table where it says nothing."""
    outer, words = split_words(table), split_words(column)
    if len(words) == 1 and (numbered := re.fullmatch(r"([a-z]+)(\d+)", words[0])):
        words = [numbered[1], numbered[2]]  # `u1` and `q1` are of joint 1
    role = _find_role(words) or _find_role(outer)
    quantity = _find_quantity(words)
    if quantity == "unknown":
        quantity = _find_quantity(outer)
    unit = next((word for word in reversed(words) if word in UNITS), None)
    if read_speed_unit(column) is not None:  # `rad_s` is rad/s
        words, quantity, unit = words[:-2], "velocity", None
    roles = COMMAND_WORDS | MEASURED_WORDS | set().union(*QUANTITY_WORDS.values())
    known = roles | FILLER_WORDS | set(UNITS)
    left = [word for word in words if word not in known]
    return ColumnName(table, column, role, quantity, unit, "_".join(left))


def _find_role(words: list[str]) -> Role | None:
    """Return the role; a word for commands counts more: `target q` is a command."""
    if any(word in COMMAND_WORDS for word in words):
        return "command"
    return "measured" if any(word in MEASURED_WORDS for word in words) else None


def _find_quantity(words: list[str]) -> Quantity:
    for quantity in ("effort", "velocity", "position"):
        if any(word in QUANTITY_WORDS[quantity] for word in words):
            return quantity
    return "position" if any(word in TARGET_WORDS for word in words) else "unknown"


def name_joint(text: str) -> str:
    """Return a name for a joint that a file name and a column may hold."""
    if not text:
        return "joint"
    return f"joint_{text}" if text[0].isdigit() else text
