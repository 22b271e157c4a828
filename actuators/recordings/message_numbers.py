"""Numbers in messages by their path: `pose.x`, `position[elbow]`, `header.stamp`.

Items of a list are named by the list `name` beside it, or by their own `name`, else by their number.
A stamp is one number, in s. The layout of a ROS MultiArray says how its data lie, and is no number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

LONGEST_LIST = 256
"""Longest list of numbers that is taken for joints; longer ones are pictures and point clouds."""
LABELS = ("name", "names", "joint_names", "joint_name")
"""Fields that name the items of the lists beside them."""
TIMES = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"), ("sec", "nsec"))
"""Fields of a time: whole seconds and nanoseconds."""
NO_NUMBERS = ("layout",)
"""Fields that describe their message."""

Keys = tuple[str | int, ...]
"""Way from a message to a value in it: fields and numbers of items."""


class NumberReader:
    """Reads named numbers from the messages of one channel.

    Args:
        names: Their names.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = [*names]
        self._label_keys: list[Keys] = []
        self._ways: dict[tuple[Any, ...], list[Keys]] = {}

    def read(self, message: Any) -> list[Any] | None:
        """Return the numbers of a message, `None` for one that it lacks, or `None` where it has none of them."""
        if not self._label_keys:
            self._label_keys = list(_find_labels(message, ()))
        # names of the items of lists may differ from message to message
        labels = tuple(tuple(follow(message, keys) or ()) for keys in self._label_keys)
        if labels not in self._ways:
            leaves = dict(find_leaves(message))
            self._ways[labels] = [leaves.get(name, ("",)) for name in self.names]  # no field is ""
        values = []
        for name, keys in zip(self.names, self._ways[labels], strict=True):
            value = follow(message, keys)
            values.append(read_time(value) if name.endswith("stamp") else value)
        return values if not values or values.count(None) < len(values) else None


def find_leaves(value: Any, prefix: str = "", keys: Keys = ()) -> Iterator[tuple[str, Keys]]:
    """Yield name and way of each number in a message."""
    listed = list(_list_fields(value))
    labels = next(([*inner] for name, inner in listed if name in LABELS and _is_names(inner)), None)
    for name, inner in listed:
        path = f"{prefix}{name}"
        is_time = name.endswith("stamp") and find_time(inner) is not None
        if is_time or _is_number(inner):
            yield path, (*keys, name)
        elif name in NO_NUMBERS:
            continue
        elif _is_sequence(inner):
            yield from _find_items(inner, path, (*keys, name), labels)
        elif not isinstance(inner, (str, bytes)):
            yield from find_leaves(inner, f"{path}.", (*keys, name))


def _find_items(
    items: Any, path: str, keys: Keys, labels: list[str] | None
) -> Iterator[tuple[str, Keys]]:
    if len(items) > LONGEST_LIST:
        return
    for number, item in enumerate(items):
        label = labels[number] if labels and len(labels) == len(items) else str(number)
        own = next((text for name, text in _list_fields(item) if name in LABELS), None)
        label = own if isinstance(own, str) and own else label
        if _is_number(item):
            yield f"{path}[{label}]", (*keys, number)
        elif not isinstance(item, (str, bytes)) and not _is_sequence(item):
            yield from find_leaves(item, f"{path}[{label}].", (*keys, number))


def _find_labels(value: Any, keys: Keys) -> Iterator[Keys]:
    """Yield the ways to lists of names."""
    for name, inner in _list_fields(value):
        if name in LABELS and _is_names(inner):
            yield (*keys, name)
        elif not isinstance(inner, (str, bytes, int, float)):
            yield from _find_labels(inner, (*keys, name))


def _list_fields(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the fields of a message: of a dictionary, a dataclass or a protobuf message."""
    if isinstance(value, Mapping):
        yield from value.items()
    elif hasattr(value, "DESCRIPTOR"):
        for one in value.DESCRIPTOR.fields:
            yield one.name, getattr(value, one.name)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            if not name.startswith("__"):
                yield name, getattr(value, name)


def follow(value: Any, keys: Keys) -> Any:
    """Return the value at the end of a way, `None` where the message does not have it."""
    try:
        for key in keys:
            is_inside = isinstance(key, int) or isinstance(value, Mapping)
            value = value[key] if is_inside else getattr(value, str(key))
    except (KeyError, IndexError, TypeError, AttributeError):
        return None
    return value


def find_time(value: Any) -> tuple[Any, ...] | None:
    """Return the parts of a time: one number, or seconds and nanoseconds; `None` for no time."""
    if _is_number(value):
        return (value,)
    for whole, part in TIMES:
        parts = follow(value, (whole,)), follow(value, (part,))
        if all(map(_is_number, parts)):
            return parts
    return None


def read_time(value: Any) -> float | None:
    """Return a time in s."""
    parts = find_time(value)
    if parts is None:
        return None
    return sum(float(part) * unit_s for part, unit_s in zip(parts, (1.0, 1e-9), strict=False))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool)


def _is_sequence(value: Any) -> bool:
    return (
        hasattr(value, "__len__")
        and hasattr(value, "__getitem__")
        and not isinstance(value, (str, bytes, Mapping))
    )


def _is_names(value: Any) -> bool:
    return _is_sequence(value) and len(value) > 0 and all(isinstance(name, str) for name in value)
