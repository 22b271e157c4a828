"""Numbers of ROS messages, read by blocks.

Bytes of a message have no tags: lengths of its texts and lists say where each number lies. Messages
with the same lengths are rows of one table of bytes, and a number is a column of it. A driver sends
the same layout again and again, so it is found once.

ROS 2 has CDR (OMG's Common Data Representation, version 1): numbers lie at multiples of their size.
ROS 1 has the same without gaps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from actuators.recordings.message_numbers import (
    LABELS,
    LONGEST_LIST,
    DecodingError,
    Keys,
    Place,
    find_leaves,
    find_time,
    follow,
)

CDR_HEAD = 4
"""Bytes before the content of a message of ROS 2; the second one says the order of the bytes."""
LENGTH_BYTES = 4
KINDS = {
    "byte": "i1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
KEPT_LAYOUTS = 16
"""Layouts of one size that are kept; a message that fits none of them is walked through."""

Definitions = Mapping[str, tuple[Any, Any]]
"""Constants and fields of each type of message, as rosbags parses them."""


@dataclass(frozen=True)
class Layout:
    """Places of numbers in messages of one size.

    Attributes:
        fixed: First and last byte (exclusive) of what says the layout: lengths, and names of joints.
        template: A message that has it, `(B,)`.
        content: Content of the template with a `Place` for each number.
        numbers: Way to each number by its name.
    """

    fixed: tuple[tuple[int, int], ...]
    template: np.ndarray
    content: Mapping[str, Any]
    numbers: Mapping[str, Keys]

    def match(self, table: np.ndarray) -> np.ndarray:
        """Return which rows of `(N, B)` have this layout, `(N,)`."""
        fits = np.ones(len(table), dtype=bool)
        for begin, end in self.fixed:
            fits &= (table[:, begin:end] == self.template[begin:end]).all(1)
        return fits

    def read(self, table: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """Return the named numbers, `(N, K)`; NaN for one that the layout lacks."""
        values = np.full((len(table), len(names)), np.nan)
        for at, name in enumerate(names):
            if name in self.numbers:
                parts = find_time(follow(self.content, self.numbers[name])) or ()
                columns = [_read_column(table, part) for part in parts]
                values[:, at] = columns[0] if len(columns) == 1 else columns[0] + 1e-9 * columns[1]
        return values


def _read_column(table: np.ndarray, place: Place) -> np.ndarray:
    kind = np.dtype(place.kind)
    content = table[:, place.byte : place.byte + kind.itemsize]
    return np.ascontiguousarray(content).view(kind)[:, 0].astype(float)


class RosReader:
    """Reads messages of one type; see `NumberReader`.

    Args:
        definitions: Fields of the type and of those in it.
        kind: Its name, `sensor_msgs/msg/JointState`.
        is_ros1: Whether ROS 1 wrote them.
    """

    def __init__(self, definitions: Definitions, kind: str, is_ros1: bool) -> None:
        self._definitions, self._kind, self._is_ros1 = definitions, kind, is_ros1
        self._layouts: dict[int, list[Layout]] = {}

    def find_numbers(self, data: bytes) -> Mapping[str, Keys]:
        """Return the numbers in a message by their names; see `NumberReader`."""
        return self._walk(data, 0).numbers

    def read(
        self, messages: Sequence[bytes], names: Sequence[str]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the named numbers of messages; see `NumberReader`."""
        values = np.full((len(messages), len(names)), np.nan)
        present = np.zeros(len(messages), dtype=bool)
        sizes = np.array([len(data) for data in messages])
        for size in np.unique(sizes).tolist():
            left = np.flatnonzero(sizes == size)
            table = np.frombuffer(b"".join([messages[i] for i in left.tolist()]), np.uint8)
            table = table.reshape(len(left), size)
            known = self._layouts.setdefault(size, [])
            tried = 0
            while len(left):
                if tried == len(known):
                    known.append(self._walk(messages[left[0]], int(left[0])))
                layout = known[tried]
                fits = layout.match(table)
                values[left[fits]] = layout.read(table[fits], names)
                present[left[fits]] = not names or any(name in layout.numbers for name in names)
                left, table, tried = left[~fits], table[~fits], tried + 1
            del known[:-KEPT_LAYOUTS]
        return values, present

    def _walk(self, data: bytes, number: int) -> Layout:
        try:
            walk = _Walk(self._definitions, data, self._is_ros1)
            content = walk.read_fields(self._kind)
        except (ValueError, IndexError, KeyError) as error:
            raise DecodingError(number, error) from error
        template = np.frombuffer(data, np.uint8)
        return Layout(walk.list_fixed(), template, content, dict(find_leaves(content)))


class _Walk:
    """Goes through a message once, from field to field."""

    def __init__(self, definitions: Definitions, data: bytes, is_ros1: bool) -> None:
        self._definitions, self._data, self._is_ros1 = definitions, data, is_ros1
        self._begin = 0 if is_ros1 else CDR_HEAD
        self._at = self._begin
        self._fixed = [(0, self._begin)]
        if not is_ros1 and (len(data) < CDR_HEAD or data[0] != 0 or data[1] > 1):
            raise ValueError(
                f"begins with the bytes {data[:CDR_HEAD].hex(' ')}, expected 00 00 or 00 01"
            )
        self._order = "<" if is_ros1 or data[1] else ">"

    def list_fixed(self) -> tuple[tuple[int, int], ...]:
        """Return the bytes that say the layout, neighbours joined."""
        joined: list[tuple[int, int]] = []
        for begin, end in self._fixed:
            if joined and begin == joined[-1][1]:  # not across filling bytes, which may be anything
                joined[-1] = (joined[-1][0], end)
            else:
                joined.append((begin, end))
        return tuple(joined)

    def read_fields(self, kind: str) -> dict[str, Any]:
        """Return the fields of a message, a `Place` for each number."""
        content = {}
        for name, described in self._definitions[kind][1]:
            content[name] = self._read(described, name in LABELS)
        return content

    def _read(self, described: Any, is_label: bool) -> Any:
        node, about = described
        if node == Nodetype.NAME:
            return self.read_fields(about)
        if node == Nodetype.BASE:
            return self._read_text(is_label) if about[0] == "string" else self._skip(about[0], 1)[0]
        inner, length = about
        if node == Nodetype.SEQUENCE:
            length = self._read_length()
            if length > len(self._data):
                raise ValueError(
                    f"a list of {length} items in a message of {len(self._data)} bytes"
                )
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return self._skip(inner[1][0], length)
        return [self._read(inner, is_label) for _ in range(length)]

    def _skip(self, kind: str, length: int) -> list[Any]:
        """Return the places of numbers; none where there are too many, `False` for what is no number."""
        if not length:
            return []
        dtype = np.dtype(self._order + KINDS.get(kind, "i1"))
        begin = self._advance(dtype.itemsize, length * dtype.itemsize)
        if length > LONGEST_LIST:
            return []
        if kind not in KINDS:
            return [False] * length
        return [Place(begin + k * dtype.itemsize, dtype.str) for k in range(length)]

    def _read_length(self) -> int:
        begin = self._advance(LENGTH_BYTES, LENGTH_BYTES)
        self._fixed.append((begin, self._at))
        return int.from_bytes(
            self._data[begin : self._at], "little" if self._order == "<" else "big"
        )

    def _read_text(self, is_label: bool) -> str:
        length = self._read_length()
        begin = self._advance(1, length)
        if is_label:
            self._fixed.append((begin, self._at))
        return self._data[begin : self._at].rstrip(b"\0").decode(errors="replace")

    def _advance(self, alignment: int, size: int) -> int:
        """Return where the next `size` bytes begin, and go behind them."""
        if not self._is_ros1:
            self._at += (self._begin - self._at) % alignment
        begin, self._at = self._at, self._at + size
        if self._at > len(self._data):
            raise ValueError(f"has {len(self._data)} bytes, its fields need {self._at} or more")
        return begin
