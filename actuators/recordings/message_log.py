"""Logs of messages: MCAP files and ROS bags.

Each topic is a table. Its columns are the numbers in its messages by their path: `pose.x`,
`position[elbow]`, `header.stamp`. Items of a list are named by the list `name` beside it, or by their own
`name`, else by their number. A stamp is one number, in s. The layout of a ROS MultiArray says how its data
lie, and is no number. `log_time` is the recorder's clock since the first message, `header.stamp` that of
the sensor, both in s. A topic that several programs send, each on a channel of its own, is one table
for each; the later ones have their channel in their name: `/joint_states@2`. A message need not have all
columns.
"""

from __future__ import annotations

import json
import math
import struct
from abc import abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from actuators.recordings.cells import read_number
from actuators.recordings.log_tables import LogFile, Table
from brokk_rl.errors import RecordingError

LONGEST_LIST = 256
"""Longest list of numbers that is taken for joints; longer ones are pictures and point clouds."""
LABELS = ("name", "names", "joint_names", "joint_name")
"""Fields that name the items of the lists beside them."""
TIMES = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"), ("sec", "nsec"))
"""Fields of a time: whole seconds and nanoseconds."""
NO_NUMBERS = ("layout", *LABELS)
"""Fields that describe their message; names of joints may be digits."""


Numbers = dict[str, float]
"""Numbers of a message by their path."""


class LoggedMessage(NamedTuple):
    """A message as it lies in a log.

    Attributes:
        table: Its topic, with the channel where several have it.
        time_ns: Time at which it was recorded.
        decode: Returns its content.
    """

    table: str
    time_ns: int
    decode: Callable[[], Any]


class MessageLog(LogFile):
    """A log of messages, one table a topic."""

    clock = "log_time"
    """Column of the time since the first message, s."""
    units: Mapping[str, Mapping[str, str]] = {}
    """Units that the log states, by table and column."""

    @abstractmethod
    def _iterate(self) -> Iterator[LoggedMessage]:
        """Yield the messages in the order of the log."""

    def read_tables(self, max_rows: int | None) -> dict[str, Table]:
        """Return the numbers of each topic."""
        columns: dict[str, dict[str, array[float]]] = {}
        for table, numbers in self._read_messages(max_rows):
            known = columns.setdefault(table, {self.clock: array("d")})
            count = len(known[self.clock])
            for name in numbers:
                if name not in known:
                    known[name] = array("d", [math.nan]) * count
            for name, values in known.items():
                values.append(numbers.get(name, math.nan))
        tables = {}
        for table, known in sorted(columns.items()):
            # several programs may send to one topic
            order = np.argsort(known[self.clock], kind="stable")
            several = {name: np.array(values)[order] for name, values in known.items()}
            tables[table] = Table(several, self.units.get(table, {}), self.clock, is_sparse=True)
        return tables

    def _read_messages(self, most: int | None) -> Iterator[tuple[str, Numbers]]:
        """Yield table and numbers of each message that has some, with the time since the first message in s.

        Args:
            most: Messages of each table that are decoded; `None` for all.
        """
        counts = Counter[str]()
        begin_ns, elapsed_s = None, 0.0
        try:
            for table, time_ns, decode in self._iterate():
                begin_ns = time_ns if begin_ns is None else begin_ns
                elapsed_s = (time_ns - begin_ns) * 1e-9
                numbers: Numbers = {}
                if most is None or counts[table] < most:
                    try:
                        numbers = dict(list_numbers(decode()))
                    except Exception as error:  # decoders raise what they stumble over
                        place = f"topic {table}, message {counts[table]}, {elapsed_s:.3f} s"
                        text = f"{place} from the first one: cannot be decoded ({describe(error)})"
                        self.report_damage(text, error)
                counts[table] += 1
                if numbers:
                    yield table, {self.clock: elapsed_s, **numbers}
        except RecordingError:
            raise
        except Exception as error:  # the libraries raise what they stumble over
            where = f"after {counts.total()} messages, {elapsed_s:.3f} s from the first one"
            self.report_damage(f"damaged {where} ({describe(error)})", error)


class BagLog(MessageLog):
    """A bag of ROS 2 (a folder, or its `.db3`) or ROS 1 (`.bag`)."""

    def _iterate(self) -> Iterator[LoggedMessage]:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

        try:
            # Bags from before 2023 have no definitions; messages of joints are the same in all versions.
            with AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
                names: dict[int, str] = {}
                chosen = []
                for one in bag.connections:
                    add_table(names, one.id, one.topic)
                    if one.msgtype in bag.typestore.fielddefs:
                        chosen.append(one)
                for connection, time_ns, data in bag.messages(connections=chosen) if chosen else ():
                    decode = partial(bag.deserialize, data, connection.msgtype)
                    yield LoggedMessage(names[connection.id], time_ns, decode)
        except AnyReaderError as error:
            self.refuse(describe(error), error)


class McapLog(MessageLog):
    """An MCAP file with JSON, protobuf or ROS messages."""

    def _iterate(self) -> Iterator[LoggedMessage]:
        from mcap.records import Channel, Message, Schema

        schemas: dict[int, Any] = {}
        names: dict[int, str] = {}
        decoders: dict[int, Callable[[bytes], Any] | None] = {}
        for record in self._read_records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.id not in names:
                add_table(names, record.id, record.topic)
                schema = schemas.get(record.schema_id)
                decoders[record.id] = _find_decoder(record.message_encoding, schema)
            elif isinstance(record, Message) and (decode := decoders.get(record.channel_id)):
                table = names[record.channel_id]
                yield LoggedMessage(table, record.log_time, partial(decode, record.data))

    def _read_records(self) -> Iterator[Any]:
        """Yield all records, those in chunks too."""
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        with self.path.open("rb") as file:
            byte = 0
            for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
                inside = [record]
                if isinstance(record, Chunk):
                    try:
                        inside = breakup_chunk(record, validate_crc=True)
                    except Exception as error:  # decompressors raise what they stumble over
                        self.report_damage(f"chunk at byte {byte}: {describe(error)}", error)
                yield from inside
                byte = file.tell()


def add_table(names: dict[int, str], channel: int, topic: str) -> None:
    """Add the table of a channel to those by channel: its topic, with the channel where an earlier one has that."""
    names[channel] = f"{topic}@{channel}" if topic in names.values() else topic


def describe(error: Exception) -> str:
    """Return kind and text of an error of a library."""
    if isinstance(error, struct.error):  # its name is `error`
        return f"cut off ({error})"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _find_decoder(encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    """Return the decoder of a channel, `None` for an encoding that is not known."""
    if encoding == "json":
        return json.loads
    if schema is None:
        return None
    if encoding == "protobuf":
        from mcap_protobuf.decoder import DecoderFactory

        return DecoderFactory().decoder_for(encoding, schema)
    if (encoding, schema.encoding) in (("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg")):
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        name = schema.name if schema.name.count("/") > 1 else schema.name.replace("/", "/msg/")
        text, is_idl = schema.data.decode(), schema.encoding == "ros2idl"
        own = get_types_from_idl(text) if is_idl else get_types_from_msg(text, name)
        store = get_typestore(Stores.EMPTY)
        # some writers leave out the definition of a time
        store.register({**get_typestore(Stores.ROS2_HUMBLE).fielddefs, **own})
        read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
        return lambda data: read(data, name)
    return None


def list_numbers(message: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Yield path and value of each number in a message.

    Args:
        message: A dictionary, a dataclass or a protobuf message.
        path: Path of the message itself, with its point.
    """
    fields = dict(_list_fields(message))
    labels = next((fields[name] for name in LABELS if _is_names(fields.get(name))), ())
    for name, value in fields.items():
        if name in NO_NUMBERS:
            continue
        number = read_time(value) if name.endswith("stamp") else read_number(value)
        if number is not None:
            yield f"{path}{name}", number
        elif not _is_sequence(value):
            yield from list_numbers(value, f"{path}{name}.")
        elif len(value) <= LONGEST_LIST:
            names = labels if len(labels) == len(value) else range(len(value))
            for label, item in zip(names, value, strict=True):
                yield from _list_item(item, f"{path}{name}", label)


def _list_item(item: Any, path: str, label: object) -> Iterator[tuple[str, float]]:
    """Yield the numbers of an item of a list, which is named by its own label, else by the given one."""
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


def _is_sequence(value: Any) -> bool:
    is_list = hasattr(value, "__len__") and hasattr(value, "__getitem__")
    return is_list and not isinstance(value, (str, bytes, Mapping))


def _is_names(value: Any) -> bool:
    return _is_sequence(value) and len(value) > 0 and all(isinstance(name, str) for name in value)
