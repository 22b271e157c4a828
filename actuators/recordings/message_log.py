"""Logs of messages: what MCAP files and ROS bags have in common.

Each topic is a table. Its columns are the numbers in its messages by their path; see
`message_numbers`. `log_time` is the recorder's clock since the first message, `header.stamp` that of
the sensor, both in s. Messages are read by blocks of one topic.
"""

from __future__ import annotations

import re
import struct
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from actuators.recordings.log_tables import LogFile, LogRun, StoredColumns, Table
from actuators.recordings.message_numbers import DecodingError, NumberReader
from brokk_rl.errors import RecordingError

LOG_TIME = "log_time"
BLOCK_MESSAGES, BLOCK_BYTES = 4096, 8 << 20
"""Messages of a topic, and bytes of them, that are decoded at once."""


@dataclass(slots=True)
class MessageBlock:
    """Messages of one topic, in the order of the log, `N` of them.

    Attributes:
        topic: Their topic.
        reader: Reads their numbers.
        time_ns: Times at which they were recorded, `(N,)`.
        messages: Their bytes.
        place: Where they are in the file, for a message; may be empty.
    """

    topic: str
    reader: NumberReader
    time_ns: np.ndarray
    messages: list[bytes]
    place: str


class Gatherer:
    """Gathers messages of topics to blocks."""

    def __init__(self) -> None:
        self._waiting: dict[Any, tuple[list[int], list[bytes]]] = {}
        self._sizes: dict[Any, int] = {}

    def add(self, channel: Any, time_ns: int, data: bytes) -> bool:
        """Add a message; return whether its block is full."""
        times, messages = self._waiting.setdefault(channel, ([], []))
        times.append(time_ns)
        messages.append(data)
        self._sizes[channel] = self._sizes.get(channel, 0) + len(data)
        return len(times) >= BLOCK_MESSAGES or self._sizes[channel] >= BLOCK_BYTES

    def take(self, channel: Any, topic: str, reader: NumberReader) -> MessageBlock:
        """Return the messages of a channel, which begins anew."""
        times, messages = self._waiting.pop(channel)
        del self._sizes[channel]
        return MessageBlock(topic, reader, np.array(times), messages, "")

    def list_waiting(self) -> list[Any]:
        """Return the channels with messages."""
        return list(self._waiting)


class MessageLog(LogFile):
    """A log of messages, one table a topic."""

    @abstractmethod
    def _iterate(self, topics: Collection[str]) -> Iterator[MessageBlock]:
        """Yield the messages of some topics."""

    @abstractmethod
    def _list_topics(self) -> list[str]:
        """Return the topics whose messages can be decoded."""

    def list_tables(self) -> dict[str, list[str]]:
        """Return the numbers in the first message of each topic."""
        tables: dict[str, list[str]] = {}
        for topic in sorted(set(self._guard(self._list_topics))):
            blocks = self._iterate_safely({topic})  # its file stays open while it is held
            block = next(blocks, None)
            if block is None:
                continue
            try:
                names = block.reader.find_numbers(block.messages[0])
            except DecodingError as error:
                where = self._locate(block, 0, 0, int(block.time_ns[0]))
                self.report_damage(f"{where}: cannot be decoded ({error})", error)
                continue
            if names:
                tables[topic] = [LOG_TIME, *names]
        return tables

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the log as one run.

        Messages without any wanted number are left out: several programs may send to one topic.
        """
        names = {
            topic: sorted(set(columns) - {LOG_TIME}, key=_pad_numbers)
            for topic, columns in wanted.items()
        }
        stores = {topic: StoredColumns([LOG_TIME, *several]) for topic, several in names.items()}
        rows, seen = dict.fromkeys(wanted, 0), dict.fromkeys(wanted, 0)
        begin_ns = None
        for block in self._iterate_safely(wanted):
            topic = block.topic
            # Seconds since 1970 would be rounded to 0.2 µs.
            begin_ns = int(block.time_ns[0]) if begin_ns is None else begin_ns
            count = len(block.messages)
            if max_rows is not None and (count := min(count, max_rows - rows[topic])) <= 0:
                if all(several >= max_rows for several in rows.values()):
                    break
                continue
            values, present = self._read_block(block, count, names[topic], seen[topic], begin_ns)
            seen[topic] += count
            rows[topic] += int(present.sum())
            time_s = (block.time_ns[:count] - begin_ns) * 1e-9
            stores[topic].add(LOG_TIME, time_s[present])
            for at, name in enumerate(names[topic]):
                stores[topic].add(name, values[present, at])
        for store in stores.values():
            store.sort(LOG_TIME)  # several programs may send to one topic
        tables = {topic: Table(store) for topic, store in stores.items()}
        yield LogRun(self.path.resolve().stem, str(self.path), tables)

    def _read_block(
        self, block: MessageBlock, count: int, names: list[str], before: int, begin_ns: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the named numbers of the first messages of a block, and which have any."""
        values, present = np.full((count, len(names)), np.nan), np.zeros(count, dtype=bool)
        begin = end = 0
        while begin < count:
            end = end if end > begin else count
            try:
                found = block.reader.read(block.messages[begin:end], names)
                values[begin:end], present[begin:end] = found
                begin = end if end == count else end + 1  # the one between cannot be decoded
            except DecodingError as error:
                where = self._locate(block, begin + error.number, before, begin_ns)
                self.report_damage(f"{where}: cannot be decoded ({error})", error)
                end = begin + error.number
                begin = begin + 1 if end == begin else begin
        return values, present

    def _iterate_safely(self, topics: Collection[str]) -> Iterator[MessageBlock]:
        """Yield blocks; damage becomes a `RecordingError`."""
        count, begin_ns, last_ns = 0, None, 0
        try:
            for block in self._iterate(topics):
                begin_ns = int(block.time_ns[0]) if begin_ns is None else begin_ns
                last_ns = int(block.time_ns[-1])
                yield block
                count += len(block.messages)
        except RecordingError:
            raise
        except Exception as error:  # the libraries raise what they stumble over
            elapsed_s = (last_ns - (begin_ns or 0)) * 1e-9
            where = f"after {count} messages, {elapsed_s:.3f} s from the first one"
            self.report_damage(f"damaged {where} ({self._explain(error)})", error)

    def _locate(self, block: MessageBlock, number: int, before: int, begin_ns: int) -> str:
        """Return the place of a message of a block; `before` of its topic came before the block."""
        elapsed_s = (int(block.time_ns[number]) - begin_ns) * 1e-9
        return f"topic {block.topic}, message {before + number}, {elapsed_s:.3f} s from the first one{block.place}"

    def _guard(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except RecordingError:
            raise
        except Exception as error:
            raise RecordingError(f"{self.path}: {self._explain(error)}") from error

    def _explain(self, error: Exception) -> str:
        return describe(error)


def describe(error: Exception) -> str:
    """Return kind and text of an error of a library."""
    if isinstance(error, struct.error):  # its name is `error`
        return f"cut off ({error})"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _pad_numbers(name: str) -> str:
    """Return a key that puts `q[10]` after `q[2]`."""
    return re.sub(r"\d+", lambda number: number[0].zfill(9), name)
