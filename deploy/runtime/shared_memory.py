"""What the processes of the loop share: slots that hold the newest value, and pipes to the log.

Nobody ever waits for anybody: a writer overwrites, a reader takes what is there, and a full pipe
counts what it had to drop. All of it is anonymous memory (memfd) that lives as long as a process
has it, so nothing is left behind by a killed one.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

HEAD = struct.Struct("<Q")


class AnonymousMemory:
    """Anonymous memory that child processes inherit; pickling passes on the number of its file.

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
        """Lets go of it."""
        self.bytes.close()
        os.close(self.fd)


def _map_memory(fd: int, size: int) -> mmap.mmap:
    # with all of its pages: what is there from the beginning costs no cycle later, and does not
    # look like growth
    return mmap.mmap(fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)


class Slot:
    """The newest record of one writer, for any number of readers.

    Two records are written in turn and the number of the newest is put in front last. A reader that
    was overtaken, or that met a writer killed in the middle (the checksum tells), reads again; the
    older record always is whole.

    Args:
        name: Of the slot.
        fields: numpy dtype of the record.
    """

    def __init__(self, name: str, fields: np.dtype) -> None:
        self.fields = fields
        self._stride = -(-(fields.itemsize + 4) // 8) * 8
        self.memory = AnonymousMemory(name, HEAD.size + 2 * self._stride)
        self._number = 0

    def write(self, record: np.ndarray) -> None:
        """Makes `record`, of shape `()` and the slot's fields, the newest."""
        data = record.tobytes()
        number = self._number + 1
        at = HEAD.size + (number % 2) * self._stride
        self.memory.bytes[at : at + len(data)] = data
        self.memory.bytes[at + len(data) : at + len(data) + 4] = zlib.crc32(data).to_bytes(
            4, "little"
        )
        self.memory.bytes[: HEAD.size] = HEAD.pack(number)
        self._number = number

    def read(self) -> np.ndarray | None:
        """Returns a copy of the newest record, of shape `()`; `None` before the first."""
        for _ in range(5):
            (number,) = HEAD.unpack(self.memory.bytes[: HEAD.size])
            if number == 0:
                return None
            at = HEAD.size + (number % 2) * self._stride
            data = self.memory.bytes[at : at + self.fields.itemsize + 4]
            if zlib.crc32(data[:-4]) == int.from_bytes(data[-4:], "little"):
                return np.frombuffer(data[:-4], self.fields)[0]
        return None  # overtaken five times: the reader was as good as stopped, and says that nothing fresh is there

    @property
    def number(self) -> int:
        """How many records were written so far: whether there is a new one, without reading it."""
        return HEAD.unpack(self.memory.bytes[: HEAD.size])[0]

    def peek(self, field: str) -> Any | None:
        """Returns one number of the newest record, `None` before the first: for a look at the time of what takes long to read.

        Unlike `read` it does not notice a writer that overtakes it: take nothing from here that has
        to fit the rest.
        """
        if (number := self.number) == 0:
            return None
        at = HEAD.size + (number % 2) * self._stride
        return np.frombuffer(self.memory.bytes, self.fields, 1, at)[field][0].item()

    def new(self) -> Any:
        """Returns an empty record of the slot's fields."""
        return np.zeros((), self.fields)


class Pipe:
    """Bytes from one writer to one reader, in order, dropped and counted where the reader is too slow.

    Args:
        name: Of the pipe.
        size: Bytes; minutes of log, so that a slow disk costs nothing.
    """

    _HEADER = struct.Struct("<QQQ")  # written, read, dropped

    def __init__(self, name: str, size: int) -> None:
        self._size = size
        self.memory = AnonymousMemory(name, self._HEADER.size + size)

    def put(self, data: bytes) -> bool:
        """Appends `data`; says whether there was room."""
        written, read = self._number(0), self._number(1)
        if written + 4 + len(data) - read > self._size:
            self._set(2, self._number(2) + 1)
            return False
        self._copy_in(written, len(data).to_bytes(4, "little") + data)
        self._set(0, written + 4 + len(data))
        return True

    def take(self) -> Iterator[bytes]:
        """Yields what has come, oldest first."""
        written, read = self._number(0), self._number(1)
        while read < written:
            length = int.from_bytes(self._copy_out(read, 4), "little")
            data = self._copy_out(read + 4, length)
            read += 4 + length
            self._set(1, read)
            yield data

    @property
    def dropped(self) -> int:
        """Records that found no room."""
        return self._number(2)

    @property
    def waiting(self) -> int:
        """Bytes that nobody has taken yet."""
        return self._number(0) - self._number(1)

    def _number(self, index: int) -> int:
        return HEAD.unpack_from(self.memory.bytes, 8 * index)[0]

    def _set(self, index: int, value: int) -> None:
        self.memory.bytes[8 * index : 8 * index + 8] = HEAD.pack(value)

    def _copy_in(self, at: int, data: bytes) -> None:
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
