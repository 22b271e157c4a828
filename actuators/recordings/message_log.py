"""Logs of messages: MCAP files and ROS bags.

Each topic is a table. Its columns are the numbers in its messages by their path: `pose.x`,
`position[elbow]`, `header.stamp`. Items of a list are named by the list `name` beside it, or by their own
`name`, else by their number. A stamp is one number, in s. The layout of a ROS MultiArray says how its data
lie, and is no number. `log_time` is the recorder's clock since the first message, `header.stamp` that of
the sensor, both in s. A topic that several programs send, each on a channel of its own, is one table
for each: `/joint_states@2`. A message need not have all columns.
"""

from __future__ import annotations

import json
import math
import struct
from abc import abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import IO, Any, NamedTuple

import numpy as np

from actuators.recordings.cells import read_number
from actuators.recordings.log_tables import LogFile, Table, Wanted
from brokk_rl.errors import RecordingError

HEAD_MESSAGES = 200
"""Messages of a topic from which its columns are listed: two sources may alternate on it."""
HEAD_S = 5.0
"""Time from the first message within which all sources of a topic send one."""
HEAD_UNLISTED = 65536
"""Messages in the first of which topics are looked for in a log that does not list them."""


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
        data: Its bytes.
        decode: Returns its content.
        place: Where it is in the file, for a message; may be empty.
    """

    table: str
    time_ns: int
    data: bytes
    decode: Callable[[bytes], Any]
    place: str


class MessageLog(LogFile):
    """A log of messages, one table a topic."""

    clock = "log_time"
    """Column of the time since the first message, s."""

    @abstractmethod
    def _iterate(self, tables: Collection[str] | None) -> Iterator[LoggedMessage]:
        """Yield the messages of some tables, or all, in the order of the log."""

    def _list_known(self) -> set[str]:
        """Return the tables that the log lists itself; empty where it lists none."""
        return set()

    def _list_units(self, table: str) -> Mapping[str, str]:
        """Return the units that the log states for the columns of a table."""
        return {}

    def _list_numbers(self, content: Any) -> dict[str, float]:
        """Return the numbers of a decoded message by their path."""
        return dict(list_numbers(content))

    def list_tables(self) -> dict[str, list[str]]:
        """Return the numbers in the first messages of each topic."""
        known = self._list_known()
        found: dict[str, dict[str, float]] = {}
        messages = self._read_messages(None, HEAD_MESSAGES)
        for number, (table, elapsed_s, numbers) in enumerate(messages):
            found.setdefault(table, {}).update(numbers)
            is_all = known <= found.keys() if known else number > HEAD_UNLISTED
            if is_all and elapsed_s > HEAD_S:
                break
        return {table: [self.clock, *found[table]] for table in sorted(found) if found[table]}

    def read_tables(self, wanted: Wanted | None, max_rows: int | None) -> dict[str, Table]:
        """Return the needed numbers of each topic; messages without any of them are left out."""
        wanted = self.list_tables() if wanted is None else wanted
        names = {table: [one for one in wanted[table] if one != self.clock] for table in wanted}
        rows = {table: array("d") for table in wanted}
        counts = dict.fromkeys(wanted, 0)
        for table, elapsed_s, numbers in self._read_messages(wanted, max_rows):
            values = [numbers.get(name, math.nan) for name in names[table]]
            if not names[table] or not numbers.keys().isdisjoint(names[table]):
                rows[table].extend((elapsed_s, *values))
                counts[table] += 1
            if max_rows is not None and min(counts.values()) >= max_rows:
                break
        tables = {}
        for table, several in names.items():
            numbers = np.array(rows[table]).reshape(-1, 1 + len(several))
            # several programs may send to one topic
            numbers = numbers[np.argsort(numbers[:, 0], kind="stable")]
            columns = dict(zip([self.clock, *several], numbers.T, strict=True))
            tables[table] = Table(columns, self._list_units(table), self.clock, is_sparse=True)
        return tables

    def _read_messages(
        self, tables: Collection[str] | None, most: int | None
    ) -> Iterator[tuple[str, float, Numbers]]:
        """Yield table, time since the first message in s, and numbers of each message.

        Args:
            tables: Tables to read; `None` for all.
            most: Messages of each table of which the numbers are read; `None` for all.
        """
        counts = Counter[str]()
        begin_ns, elapsed_s = None, 0.0
        try:
            for message in self._iterate(tables):
                begin_ns = message.time_ns if begin_ns is None else begin_ns
                elapsed_s = (message.time_ns - begin_ns) * 1e-9
                counts[message.table] += 1
                numbers: dict[str, float] = {}
                if most is None or counts[message.table] <= most:
                    numbers = self._read_message(message, counts[message.table] - 1, elapsed_s)
                yield message.table, elapsed_s, numbers
        except RecordingError:
            raise
        except Exception as error:  # the libraries raise what they stumble over
            where = f"after {counts.total()} messages, {elapsed_s:.3f} s from the first one"
            self.report_damage(f"damaged {where} ({describe(error)})", error)

    def _read_message(self, message: LoggedMessage, number: int, elapsed_s: float) -> Numbers:
        """Return the numbers of a message, none of a damaged one that is left out."""
        try:
            return self._list_numbers(message.decode(message.data))
        except Exception as error:  # decoders raise what they stumble over
            self.report_damage(
                f"topic {message.table}, message {number}, {elapsed_s:.3f} s from the first one{message.place}: "
                f"cannot be decoded ({describe(error)})",
                error,
            )
            return {}


class BagLog(MessageLog):
    """A bag of ROS 2 (a folder, or its `.db3`) or ROS 1 (`.bag`)."""

    def _iterate(self, tables: Collection[str] | None) -> Iterator[LoggedMessage]:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

        try:
            # Bags from before 2023 have no definitions; messages of joints are the same in all versions.
            with AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
                names = name_tables({one.id: one.topic for one in bag.connections})
                chosen = []
                for one in bag.connections:
                    is_known = one.msgtype in bag.typestore.fielddefs
                    if is_known and (tables is None or names[one.id] in tables):
                        chosen.append(one)
                for connection, time_ns, data in bag.messages(connections=chosen) if chosen else ():
                    kind = connection.msgtype
                    decode = lambda raw, kind=kind: bag.deserialize(raw, kind)  # noqa: E731
                    yield LoggedMessage(names[connection.id], time_ns, data, decode, "")
        except AnyReaderError as error:
            self.refuse(describe(error), error)


class McapLog(MessageLog):
    """An MCAP file with JSON, protobuf or ROS messages."""

    def _list_known(self) -> set[str]:
        with self.path.open("rb") as file:
            return {*_name_channels(file).values()}

    def _iterate(self, tables: Collection[str] | None) -> Iterator[LoggedMessage]:
        from mcap.records import Channel, Message, Schema

        schemas: dict[int, Any] = {}
        decoders: dict[int, Callable[[bytes], Any] | None] = {}
        with self.path.open("rb") as file:
            names = _name_channels(file)
            for place, record in self._read_records(file):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.id not in decoders:
                    names.setdefault(record.id, record.topic)
                    if tables is None or names[record.id] in tables:
                        schema = schemas.get(record.schema_id)
                        decoders[record.id] = _find_decoder(record.message_encoding, schema)
                elif isinstance(record, Message) and (decode := decoders.get(record.channel_id)):
                    table = names[record.channel_id]
                    yield LoggedMessage(table, record.log_time, record.data, decode, place)

    def _read_records(self, file: IO[bytes]) -> Iterator[tuple[str, Any]]:
        """Yield all records, those in chunks too, each with its place."""
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        file.seek(0)
        byte = 0
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            if isinstance(record, Chunk):
                place = f", in the chunk at byte {byte}"
                try:
                    inside = breakup_chunk(record, validate_crc=True)
                except Exception as error:  # decompressors raise what they stumble over
                    self.report_damage(f"chunk at byte {byte}: {describe(error)}", error)
                    inside = []
                for one in inside:
                    yield place, one
            else:
                yield "", record
            byte = file.tell()


def name_tables(topics: Mapping[int, str]) -> dict[int, str]:
    """Return the name of each channel's table: its topic, with the channel where several have it."""
    counts = Counter(topics.values())
    return {key: topic if counts[topic] == 1 else f"{topic}@{key}" for key, topic in topics.items()}


def describe(error: Exception) -> str:
    """Return kind and text of an error of a library."""
    if isinstance(error, struct.error):  # its name is `error`
        return f"cut off ({error})"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _name_channels(file: IO[bytes]) -> dict[int, str]:
    """Return the table of each channel that the summary of an MCAP file lists, none where it is missing or damaged."""
    from mcap.reader import make_reader

    try:
        summary = make_reader(file, validate_crcs=True).get_summary()
    except Exception:  # the library raises what it stumbles over
        return {}
    channels = summary.channels if summary is not None else {}
    return name_tables({key: one.topic for key, one in channels.items()})


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


def _is_sequence(value: Any) -> bool:
    is_list = hasattr(value, "__len__") and hasattr(value, "__getitem__")
    return is_list and not isinstance(value, (str, bytes, Mapping))


def _is_names(value: Any) -> bool:
    return _is_sequence(value) and len(value) > 0 and all(isinstance(name, str) for name in value)
