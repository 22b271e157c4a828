"""Role, quantity, unit and joint of a column, read from the words of its name."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import yaml

Role = Literal["command", "measured"]
Quantity = Literal["position", "velocity", "torque", "unknown"]


WORDS: dict[str, frozenset[str]] = {}
"""Words of names by what they say; see `words.yaml`."""
for _kind, _text in yaml.safe_load(Path(__file__).with_name("words.yaml").read_text()).items():
    WORDS[_kind] = frozenset(_text.split())
QUANTITIES: tuple[Quantity, ...] = ("torque", "velocity", "position")
"""The first one with a word in a name is its quantity."""
DEG = math.pi / 180.0
UNITS = {
    **dict.fromkeys(("rad", "rads", "radians"), ("rad", 1.0)),
    **dict.fromkeys(("deg", "degree", "degrees", "grad", "°"), ("rad", DEG)),
    **dict.fromkeys(("m", "metre", "meter"), ("m", 1.0)),
    **dict.fromkeys(("rev", "revs", "turn", "turns"), ("rad", math.tau)),
    **dict.fromkeys(("gon", "gons"), ("rad", math.pi / 200.0)),
    "mrad": ("rad", 0.001),
    "cm": ("m", 0.01),
    "mm": ("m", 0.001),
    "inch": ("m", 0.0254),
}
"""Unit of the recording, and its number for one of the log."""
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "micros"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanosec"), 1e-9),
    "min": 60.0,
}
"""Seconds for one of a unit."""
SI_NAMES = ({"q"}, {"qpos"}, {"dof"}, {"joint", "states"})
"""Words of programs whose positions are in rad or m: libfranka, MuJoCo, Isaac, ROS."""
EFFORT_UNITS = ("nm", "n", "a", "v", "bar")
ROLE_WORDS = frozenset().union(*(WORDS[kind] for kind in ("command", "measured", *QUANTITIES)))
"""Words of role and quantity."""
UNIT_SUFFIX = re.compile(r"^(.*?)\s*[\[({<]\s*([^\[\](){}<>]*?)\s*[\])}>]\s*$")
"""A name with a unit in brackets behind it."""
UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})


@dataclass(frozen=True)
class ColumnName:
    """A column's name read as words.

    Attributes:
        column: Its name in its table.
        role: What the words say; `None` where they say nothing.
        quantity: The same.
        unit: Unit of a position, a key of `UNITS`; `None` where none is named.
        joint: Remaining words joined by `_`; may be empty or a number.
        source: Those of its table.
        speed_unit: rad/s or m/s for one of the column, where its name has a unit of speed.
        unknown_unit: Text in brackets behind it that is no known unit.
        is_si: The words are those of a program that logs rad or m.
    """

    column: str
    role: Role | None
    quantity: Quantity
    unit: str | None
    joint: str
    source: str
    speed_unit: float | None
    unknown_unit: str | None
    is_si: bool

    @property
    def key(self) -> str:
        """Name of its joint without the signs that people set differently."""
        return self.joint.replace("_", "")


def is_unit(text: str) -> bool:
    """Return whether a text is the name of a unit, perhaps in brackets."""
    plain = text.strip("[](){}<> ").lower()
    numerator, _, rest = plain.partition("/")
    is_rate = numerator in UNITS and rest in ("s", "s^2", "s²", "min")
    return is_rate or plain in UNITS or plain in TIME_UNITS or plain in WORDS["other_units"]


def split_unit(column: str) -> tuple[str, str | None]:
    """Return a name and the unit in brackets behind it; an index or the name of an item is none."""
    found = UNIT_SUFFIX.fullmatch(column)
    if found and is_unit(found[2]) and not (found[2].isdigit() and column.endswith("]")):
        return found[1], found[2].lower()
    return column, None


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
    spaced = re.sub(r"([a-z0-9äöüß])([A-ZÄÖÜ])", r"\1 \2", text)
    return [word for word in re.split(r"[^a-z0-9äöüßµ°]+", spaced.lower()) if word]


def read_words(column: str) -> list[str]:
    """Return the words of a column's name without its unit."""
    return split_words(split_unit(column)[0])


def read_column_name(table: str, column: str, unit: str | None = None) -> ColumnName:
    """Return what the words of a column's name say, those of its table where it says nothing.

    Args:
        table: Its table.
        column: Its name in the table.
        unit: Unit that the log states beside the name.
    """
    plain, in_brackets = split_unit(column)
    outer, words = split_words(table), _split_numbers(split_words(plain))
    stated = (unit or in_brackets or "").lower()
    if not stated:
        stated = next((word for word in reversed(words) if word in UNITS), "")
        if len(words) > 1 and words[-2] in UNITS and words[-1] == "s":  # of a speed, `rad_s`
            stated, words = f"{words[-2]}/s", words[:-2]
    bracketed = UNIT_SUFFIX.fullmatch(column)
    if column.endswith("]") and not re.search(r"\s\[", column):
        bracketed = None  # an index, or the name of an item
    quantity = _find_quantity(words)
    if quantity == "unknown":
        quantity = _find_quantity(outer)
    length, _, second = stated.partition("/")
    speed_unit = UNITS[length][1] if length in UNITS and second == "s" else None
    if speed_unit is not None:
        quantity = "velocity"
    elif quantity == "unknown" and stated in UNITS:
        quantity = "position"
    elif quantity == "unknown" and stated in EFFORT_UNITS:
        quantity = "torque"
    is_si = any(name <= {*words, *outer} for name in SI_NAMES)
    known = ROLE_WORDS | WORDS["filler"] | UNITS.keys() | ({"d"} if "q" in words else set())
    joint, source = ("_".join(one for one in each if one not in known) for each in (words, outer))
    return ColumnName(
        column, _find_role(words) or _find_role(outer), quantity, stated if stated in UNITS else None,
        joint, source, speed_unit, unit or (bracketed and bracketed[2]), is_si,
    )  # fmt: skip


def _split_numbers(words: list[str]) -> list[str]:
    """Return the words with a number apart that names a joint: `u1` and `AxisSetPos1` are of joint 1, `u_q1` is of q1."""
    found = []
    for place, word in enumerate(words):
        numbered = re.fullmatch(r"([a-z]+)(\d+)", word)
        is_apart = len(words) == 1
        if numbered is not None and numbered[1] in ROLE_WORDS:
            is_apart |= place == 0 or len(numbered[1]) > 1
        found += numbered.groups() if numbered and is_apart else [word]
    return found


def _find_role(words: list[str]) -> Role | None:
    """Return the role; a word for commands counts more: `target q` and libfranka's `q_d` are commands, `enc_u` is none."""
    is_desired = "d" in words and not {"q", "dq", "tau"}.isdisjoint(words)
    measured = WORDS["measured"]
    is_measured = not (measured - {"q"}).isdisjoint(words)
    commands = WORDS["command"] - {"u"} if is_measured else WORDS["command"]
    if is_desired or not commands.isdisjoint(words):
        return "command"
    return None if measured.isdisjoint(words) else "measured"


def _find_quantity(words: list[str]) -> Quantity:
    for quantity in QUANTITIES:
        if not WORDS[quantity].isdisjoint(words):
            return quantity
    return "unknown" if WORDS["target"].isdisjoint(words) else "position"


def name_joint(text: str) -> str:
    """Return a name for a joint that a file name and a column may hold."""
    plain = re.sub(r"\W+", "_", text.translate(UMLAUTS)).strip("_")
    if not plain:
        return "joint"
    return f"joint_{plain}" if plain[0].isdigit() else plain
