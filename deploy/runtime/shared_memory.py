"""Memory that the processes of the loop share: slots with the newest record, and pipes to the log.

No process waits for another: a writer overwrites, a reader takes the newest record, and a full pipe
counts the data that it drops. All of it is anonymous memory (memfd) that lives as long as a process
maps it, so a killed process leaves nothing behind.
"""

from __future__ import annotations

import mmap
import os
import struct
import typing
import zlib
from collections.abc import Iterator
from dataclasses import fields
from enum import Enum
from typing import Annotated, Any, Generic, TypeVar

import numpy as np

HEAD = struct.Struct("<Q")
"""Number of records written so far, in front of the two records of a slot."""
CHECKSUM_BYTES = 4
"""Of the CRC-32 behind each record."""
ALIGNMENT_BYTES = 8
"""Records begin at multiples of it, so that numpy reads them in place."""
READ_ATTEMPTS = 5
"""A reader that is overtaken more often was as good as stopped. Chosen by hand: bus and policy
write every 10 and 50 ms, and a read takes microseconds."""
TEXT = "U64"
"""Type of a text in a record: 64 characters, enough for a name."""
LENGTH_BYTES = 4
"""Of the length in front of each entry of a pipe."""


class AnonymousMemory:
    """Memory that child processes inherit; pickling passes on the number of its file.

    Args:
        name: For people who look into `/proc`.
        size: Bytes.
    """

    def __init__(self, name: str, size: int) -> None:
        self.name, self.size = name, size
        self.fd = os.memfd_create(f"brokk_{name}")
        os.ftruncate(self.fd, size)
        self.bytes = _map_memory(self.fd, size)

    def __getstate__(self) -> tuple[str, int, int]:
        return self.name, self.size, self.fd

    def __setstate__(self, state: tuple[str, int, int]) -> None:
        self.name, self.size, self.fd = state
        self.bytes = _map_memory(self.fd, self.size)

    def close(self) -> None:
        """Unmap the memory and close its file."""
        self.bytes.close()
        os.close(self.fd)


def _map_memory(fd: int, size: int) -> mmap.mmap:
    # Populate all pages at once: a page fault costs no cycle later, and a soak test does not take
    # the faults for a leak.
    return mmap.mmap(fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)


class Slot:
    """The newest record of one writer, for any number of readers.

    Two records are written in turn; the number of the newest is put in front last. A reader that
    was overtaken reads again, and so does one that met a writer killed half-way (the checksum
    tells). The older record is always whole.

    Args:
        name: Of the slot.
        fields: numpy dtype of the record.
    """

    def __init__(self, name: str, fields: np.dtype) -> None:
        self.fields = fields
        size = fields.itemsize + CHECKSUM_BYTES
        self._stride = -(-size // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
        self.memory = AnonymousMemory(name, HEAD.size + 2 * self._stride)
        self._number = 0

    def write(self, record: np.ndarray) -> None:
        """Make `record`, of shape `()` and the slot's fields, the newest."""
        data = record.tobytes()
        number = self._number + 1
        at, end = self._offset(number), self._offset(number) + len(data)
        self.memory.bytes[at:end] = data
        checksum = zlib.crc32(data).to_bytes(CHECKSUM_BYTES, "little")
        self.memory.bytes[end : end + CHECKSUM_BYTES] = checksum
        self.memory.bytes[: HEAD.size] = HEAD.pack(number)
        self._number = number

    def read(self) -> np.ndarray | None:
        """Return a copy of the newest record, of shape `()`; `None` before the first."""
        for _ in range(READ_ATTEMPTS):
            number = self.number
            if number == 0:
                return None
            at = self._offset(number)
            data = self.memory.bytes[at : at + self.fields.itemsize + CHECKSUM_BYTES]
            record, checksum = data[:-CHECKSUM_BYTES], data[-CHECKSUM_BYTES:]
            if zlib.crc32(record) == int.from_bytes(checksum, "little"):
                return np.frombuffer(record, self.fields)[0]
        return None

    @property
    def number(self) -> int:
        """Number of records written so far; shows without reading whether there is a new one."""
        return HEAD.unpack(self.memory.bytes[: HEAD.size])[0]

    def peek(self, field: str) -> Any | None:
        """Return one number of the newest record, `None` before the first.

        For a look at the time of a record that takes long to read. Unlike `read` it does not notice
        a writer that overtakes it: take no value from here that has to fit the rest.
        """
        if (number := self.number) == 0:
            return None
        at = self._offset(number)
        return np.frombuffer(self.memory.bytes, self.fields, 1, at)[field][0].item()

    def new(self) -> Any:
        """Return an empty record of the slot's fields."""
        return np.zeros((), self.fields)

    def _offset(self, number: int) -> int:
        return HEAD.size + (number % 2) * self._stride


Joints = Annotated[np.ndarray, "J"]
"""Field of a record: one number a joint."""
Axes = Annotated[np.ndarray, 4]
"""Field of a record: one number for each of the four lever axes."""
Point = Annotated[np.ndarray, 3]
"""Field of a record: a point or direction."""
R = TypeVar("R")


class RecordLayout(Generic[R]):
    """Packs a dataclass into a numpy record, and unpacks it.

    Its fields are `float`, `bool`, `int`, a short text, an enumeration (stored as the member's
    position), or an array (`Joints`, `Axes`, `Point`).

    Args:
        kind: The dataclass.
        num_joints: Length of `Joints`.
    """

    def __init__(self, kind: type[R], num_joints: int) -> None:
        self._kind = kind
        self._members: dict[str, tuple[Enum, ...]] = {}
        layout = []
        hints = typing.get_type_hints(kind, include_extras=True)
        for one in fields(kind):  # type: ignore[arg-type]
            hint = hints[one.name]
            if typing.get_origin(hint) is Annotated:
                length = hint.__metadata__[0]
                layout.append((one.name, float, (num_joints if length == "J" else length,)))
            elif issubclass(hint, Enum):
                self._members[one.name] = tuple(hint)
                layout.append((one.name, np.int8))
            else:
                layout.append((one.name, TEXT if hint is str else np.dtype(hint)))
        self.fields = np.dtype(layout)

    def pack(self, record: R) -> np.ndarray:
        """Return `record` as a numpy record of shape `()`."""
        values = dict(vars(record))
        for name, members in self._members.items():
            values[name] = members.index(values[name])
        packed = np.zeros((), self.fields)
        packed[()] = tuple(values.values())
        return packed

    def unpack(self, packed: np.ndarray) -> R:
        """Return the dataclass that `packed` holds."""
        names = self.fields.names or ()
        values: dict[str, Any] = dict(zip(names, packed.item(), strict=True))
        for name, members in self._members.items():
            values[name] = members[values[name]]
        return self._kind(**values)

    def new(self) -> R:
        """Return a record of zeros, `False`, and the first member of each enumeration."""
        return self.unpack(np.zeros((), self.fields))


class RecordSlot(Slot, Generic[R]):
    """A slot whose record is a dataclass, written and read as such; see `RecordLayout`.

    Args:
        name: Of the slot.
        kind: The dataclass.
        num_joints: Of the machine.
    """

    def __init__(self, name: str, kind: type[R], num_joints: int) -> None:
        self._layout = RecordLayout(kind, num_joints)
        super().__init__(name, self._layout.fields)

    def write(self, record: R) -> None:
        """Make `record` the newest."""
        super().write(self._layout.pack(record))

    def read(self) -> R | None:
        """Return the newest record; `None` before the first."""
        packed = super().read()
        return None if packed is None else self._layout.unpack(packed)

    def new(self) -> R:
        """Return an empty record; see `RecordLayout.new`."""
        return self._layout.new()


class Pipe:
    """Bytes from one writer to one reader, in order; dropped and counted where the reader is slow.

    Args:
        name: Of the pipe.
        size: Bytes; minutes of log, so that a slow disk costs nothing.
    """

    _HEADER = struct.Struct("<QQQ")  # written, read, dropped

    def __init__(self, name: str, size: int) -> None:
        self._size = size
        self.memory = AnonymousMemory(name, self._HEADER.size + size)

    def put(self, data: bytes) -> bool:
        """Append `data`; return whether there was room."""
        written, read = self._get(0), self._get(1)
        if written + LENGTH_BYTES + len(data) - read > self._size:
            self._set(2, self._get(2) + 1)
            return False
        self._copy_in(written, len(data).to_bytes(LENGTH_BYTES, "little") + data)
        # the count comes last: a reader never sees an entry that is not whole
        self._set(0, written + LENGTH_BYTES + len(data))
        return True

    def take(self) -> Iterator[bytes]:
        """Yield and remove the waiting entries, oldest first."""
        written, read = self._get(0), self._get(1)
        while read < written:
            length = int.from_bytes(self._copy_out(read, LENGTH_BYTES), "little")
            data = self._copy_out(read + LENGTH_BYTES, length)
            read += LENGTH_BYTES + length
            self._set(1, read)
            yield data

    @property
    def dropped(self) -> int:
        """Entries that found no room."""
        return self._get(2)

    @property
    def waiting(self) -> int:
        """Number of bytes that wait to be taken."""
        return self._get(0) - self._get(1)

    def _get(self, index: int) -> int:
        return HEAD.unpack_from(self.memory.bytes, 8 * index)[0]

    def _set(self, index: int, value: int) -> None:
        self.memory.bytes[8 * index : 8 * index + 8] = HEAD.pack(value)

    def _copy_in(self, at: int, data: bytes) -> None:
        # the memory is a ring: an entry may run over its end and go on at its beginning
        start, base = at % self._size, self._HEADER.size
        first = min(len(data), self._size - start)
        self.memory.bytes[base + start : base + start + first] = data[:first]
        self.memory.bytes[base : base + len(data) - first] = data[first:]

    def _copy_out(self, at: int, length: int) -> bytes:
        start, base = at % self._size, self._HEADER.size
        first = min(length, self._size - start)
        return (
            self.memory.bytes[base + start : base + start + first]
            + self.memory.bytes[base : base + length - first]
        )
