"""Numbers in messages by their path: `pose.x`, `position[elbow]`, `header.stamp`.

Items of a list are named by the list `name` beside it, or by their own `name`, else by their number.
A stamp is one number, in s. The layout of a ROS MultiArray says how its data lie, and is no number.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

LONGEST_LIST = 256
"""Longest list of numbers that is taken for joints; longer ones are pictures and point clouds."""
LABELS = ("name", "names", "joint_names", "joint_name")
"""Fields that name the items of the lists beside them."""
TIMES = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"), ("sec", "nsec"))
"""Fields of a time: whole seconds and nanoseconds."""
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[Nn]a[Nn]")
"""A number as text."""
NO_NUMBERS = ("layout", *LABELS)
"""Fields that describe their message; names of joints may be digits."""


def list_numbers(message: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Yield path and value of each number in a message.

    Args:
        message: A dictionary, a dataclass or a protobuf message.
        path: Path of the message itself, with its point.
    """
    fields = dict(_list_fields(message))
    labels = next((fields[name] for name in LABELS if _is_names(fields.get(name))), None)
    for name, value in fields.items():
        if name in NO_NUMBERS:
            continue
        time_s = read_time(value) if name.endswith("stamp") else None
        if time_s is not None:
            yield f"{path}{name}", time_s
        elif (number := read_number(value)) is not None:
            yield f"{path}{name}", number
        elif _is_sequence(value):
            yield from _list_items(value, f"{path}{name}", labels)
        else:
            yield from list_numbers(value, f"{path}{name}.")


def _list_items(
    items: Sequence[Any], path: str, labels: Sequence[str] | None
) -> Iterator[tuple[str, float]]:
    if len(items) > LONGEST_LIST:
        return
    for at, item in enumerate(items):
        label = labels[at] if labels and len(labels) == len(items) else str(at)
        number = read_number(item)
        if number is not None:
            yield f"{path}[{label}]", number
        elif not _is_sequence(item):
            own = [text for name, text in _list_fields(item) if name in LABELS and text]
            label = own[0] if own and isinstance(own[0], str) else label
            yield from list_numbers(item, f"{path}[{label}].")


def _list_fields(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the fields of a message; text and numbers have none."""
    if isinstance(value, Mapping):
        yield from value.items()
    elif hasattr(value, "DESCRIPTOR"):
        for one in value.DESCRIPTOR.fields:
            yield one.name, getattr(value, one.name)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            if not name.startswith("__"):
                yield name, getattr(value, name)


def read_time(value: Any) -> float | None:
    """Return a time in s: a number, or seconds and nanoseconds; `None` for no time."""
    fields = dict(_list_fields(value))
    for whole, part in TIMES:
        seconds, nanos = read_number(fields.get(whole)), read_number(fields.get(part))
        if seconds is not None and nanos is not None:
            return seconds + 1e-9 * nanos
    return read_number(value)


def read_number(value: Any) -> float | None:
    """Return a number, also one that is written as text; `None` for anything else."""
    if isinstance(value, str) and NUMBER.fullmatch(value):
        return float(value)
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return float(value) if is_number else None


def _is_sequence(value: Any) -> bool:
    is_list = hasattr(value, "__len__") and hasattr(value, "__getitem__")
    return is_list and not isinstance(value, (str, bytes, Mapping))


def _is_names(value: Any) -> bool:
    return _is_sequence(value) and len(value) > 0 and all(isinstance(name, str) for name in value)
