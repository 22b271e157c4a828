"""Logs of messages: MCAP with JSON, protobuf or ROS 2 messages, and ROS bags.

Each topic is a table. Its columns are the numbers in its messages by their path, `pose.x`; items of
a list are named by the list `name` beside it, `position[elbow]`, or by their number. `log_time` is
the recorder's clock since the first message, `header.stamp` that of the sensor, both in s.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from actuators.recordings.log_tables import BLOCK_ROWS, LogFile, LogRun, StoredColumns, Table
from brokk_rl.errors import RecordingError

LOG_TIME = "log_time"
LONGEST_LIST = 256
"""Longest list of numbers that is taken for joints; longer ones are pictures and point clouds."""
LABELS = ("name", "names", "joint_names", "joint_name")
"""Fields that name the items of the lists beside them."""
TIMES = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"), ("sec", "nsec"))
"""Fields of a time: whole seconds and nanoseconds."""

Keys = tuple[str | int, ...]
"""Way from a message to a value in it: fields and numbers of items."""


@dataclass(slots=True)
class TopicMessage:
    """A message before it is decoded.

    Attributes:
        topic: Its topic.
        log_time_ns: Time at which it was recorded.
        decode: Returns its content.
    """

    topic: str
    log_time_ns: int
    decode: Callable[[], Any]


class MessageReader:
    """Reads numbers from the messages of one topic."""

    def __init__(self) -> None:
        self._label_keys: list[Keys] | None = None
        self._leaves: dict[tuple[Any, ...], dict[str, Keys]] = {}
        self._plans: dict[tuple[Any, ...], list[tuple[Keys, list[str | int]]]] = {}
        self._stamps: list[int] = []

    def find_numbers(self, message: Any) -> dict[str, Keys]:
        """Return the numbers in a message by their names; known from an earlier one of its kind."""
        labels = self._read_labels(message)
        if labels not in self._leaves:
            self._leaves[labels] = dict(_find_leaves(message, "", ()))
        return self._leaves[labels]

    def read(self, message: Any, names: Sequence[str]) -> list[float | None]:
        """Return the named numbers, `None` for one that this message lacks."""
        labels = self._read_labels(message)
        if labels not in self._plans:
            self._plans[labels] = _plan_reading(self.find_numbers(message), names)
            self._stamps = [at for at, name in enumerate(names) if name.endswith("stamp")]
        values: list[float | None] = []
        for parent_keys, keys in self._plans[labels]:
            parent = _follow(message, parent_keys)
            try:
                if isinstance(parent, Mapping) or isinstance(keys[0], int):
                    several = [parent[key] for key in keys]
                else:
                    several = [getattr(parent, str(key)) for key in keys]
            except (KeyError, IndexError, TypeError, AttributeError):
                several = [_follow(parent, (key,)) for key in keys]
            values += several
        for at in self._stamps:
            values[at] = _read_time(values[at])
        return values

    def _read_labels(self, message: Any) -> tuple[Any, ...]:
        """Return the names of the items of lists, which may differ from message to message."""
        if self._label_keys is None:
            self._label_keys = list(_find_labels(message, ()))
        return tuple(tuple(_follow(message, keys) or ()) for keys in self._label_keys)


def _plan_reading(
    leaves: Mapping[str, Keys], names: Sequence[str]
) -> list[tuple[Keys, list[str | int]]]:
    """Return the parents of the named numbers, each with its fields or items, in order of the names."""
    plan: list[tuple[Keys, list[str | int]]] = []
    for name in names:
        keys = leaves.get(name, ("",))  # no field has an empty name
        if plan and plan[-1][0] == keys[:-1] and type(plan[-1][1][0]) is type(keys[-1]):
            plan[-1][1].append(keys[-1])
        else:
            plan.append((keys[:-1], [keys[-1]]))
    return plan


class MessageLog(LogFile):
    """A log of messages, one table a topic."""

    @abstractmethod
    def _iterate(self, topics: Collection[str] | None) -> Iterator[TopicMessage]:
        """Yield the messages of some topics, or of all, in order of time."""

    @abstractmethod
    def _list_topics(self) -> list[str]:
        """Return the topics whose messages can be decoded."""

    def list_tables(self) -> dict[str, list[str]]:
        """Return the numbers in the first message of each topic."""
        tables: dict[str, list[str]] = {}
        waiting = set(self._guard(self._list_topics))
        for topic in sorted(waiting):
            messages = self._iterate_safely({topic})  # its file stays open while it is held
            message = next(messages, None)
            if message is None:
                continue
            names = MessageReader().find_numbers(message.decode())
            if names:
                tables[topic] = [LOG_TIME, *names]
        return tables

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the log as one run.

        Messages without any wanted number are left out: several programs may send to one topic.
        """
        readers = {topic: MessageReader() for topic in wanted}
        names = {topic: sorted(set(columns) - {LOG_TIME}) for topic, columns in wanted.items()}
        stores = {topic: StoredColumns([LOG_TIME, *several]) for topic, several in names.items()}
        rows: dict[str, list[list[float | None]]] = {topic: [] for topic in wanted}
        counts = dict.fromkeys(wanted, 0)
        begin_ns = None
        for message in self._iterate_safely(wanted):
            topic = message.topic
            # Seconds since 1970 would be rounded to 0.2 µs.
            begin_ns = message.log_time_ns if begin_ns is None else begin_ns
            if max_rows is not None and counts[topic] >= max_rows:
                if all(count >= max_rows for count in counts.values()):
                    break
                continue
            values = readers[topic].read(message.decode(), names[topic])
            if values and values.count(None) == len(values):
                continue
            rows[topic].append([(message.log_time_ns - begin_ns) * 1e-9, *values])
            counts[topic] += 1
            if len(rows[topic]) >= BLOCK_ROWS:
                _store(stores[topic], rows[topic], names[topic])
        for topic in wanted:
            _store(stores[topic], rows[topic], names[topic])
        tables = {topic: Table(store) for topic, store in stores.items()}
        yield LogRun(self.path.resolve().stem, str(self.path), tables)

    def _iterate_safely(self, topics: Collection[str]) -> Iterator[TopicMessage]:
        """Yield messages; decoding errors of the consumer and damage become a `RecordingError`."""
        count, begin_ns, last_ns = 0, 0, 0
        try:
            for message in self._iterate(topics):
                last_ns = message.log_time_ns
                begin_ns = begin_ns or last_ns
                decode = partial(self._decode, message, count, begin_ns)
                yield TopicMessage(message.topic, last_ns, decode)
                count += 1
        except RecordingError:
            raise
        except Exception as error:  # the libraries raise what they stumble over
            where = (
                f"after {count} messages, {(last_ns - begin_ns) * 1e-9:.3f} s from the first one"
            )
            raise RecordingError(
                f"{self.path}: damaged {where} ({self._explain(error)})"
            ) from error

    def _decode(self, message: TopicMessage, count: int, begin_ns: int) -> Any:
        try:
            return message.decode()
        except Exception as error:  # a decoder raises what it stumbles over
            elapsed_s = (message.log_time_ns - begin_ns) * 1e-9
            place = f"message {count}, {elapsed_s:.3f} s from the first one"
            raise RecordingError(
                f"{self.path}: {place}, topic {message.topic}: cannot be decoded ({error!r})"
            ) from error

    def _guard(self, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except RecordingError:
            raise
        except Exception as error:
            raise RecordingError(f"{self.path}: {self._explain(error)}") from error

    def _explain(self, error: Exception) -> str:
        return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


class McapLog(MessageLog):
    """An MCAP file."""

    def _list_topics(self) -> list[str]:
        from mcap.reader import make_reader

        with self.path.open("rb") as file:
            summary = make_reader(file).get_summary()
        if summary is None:
            raise RecordingError(f"{self.path}: has no summary; write it anew with `mcap recover`")
        return [channel.topic for channel in summary.channels.values()]

    def _iterate(self, topics: Collection[str] | None) -> Iterator[TopicMessage]:
        from mcap.reader import make_reader

        decoders: dict[int, Callable[[bytes], Any] | None] = {}
        with self.path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(topics):
                if channel.id not in decoders:
                    decoders[channel.id] = _find_decoder(channel.message_encoding, schema)
                decoder = decoders[channel.id]
                if decoder is not None:
                    data = message.data
                    yield TopicMessage(
                        channel.topic,
                        message.log_time,
                        lambda decoder=decoder, data=data: decoder(data),
                    )

    def _explain(self, error: Exception) -> str:
        return f"{super()._explain(error)}; {_find_damage(self.path)}"


class BagLog(MessageLog):
    """A bag of ROS 2 (a folder, or its `.db3`) or ROS 1 (`.bag`)."""

    def _open(self, stack: ExitStack) -> Any:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        # Bags from before 2023 have no definitions; messages of joints are the same in all versions.
        default = get_typestore(Stores.ROS2_HUMBLE)
        return stack.enter_context(AnyReader([self.path], default_typestore=default))

    def _list_topics(self) -> list[str]:
        with ExitStack() as stack:
            reader = self._open(stack)
            return [one.topic for one in reader.connections if one.msgtype in reader.typestore.fielddefs]  # fmt: skip

    def _iterate(self, topics: Collection[str] | None) -> Iterator[TopicMessage]:
        with ExitStack() as stack:
            reader = self._open(stack)
            chosen = [one for one in reader.connections if topics is None or one.topic in topics]
            for connection, time_ns, data in reader.messages(connections=chosen) if chosen else ():
                yield TopicMessage(
                    connection.topic,
                    time_ns,
                    lambda kind=connection.msgtype, data=data: reader.deserialize(data, kind),
                )


def _find_decoder(encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    """Return the decoder of a channel, `None` for an encoding that is not known."""
    if encoding == "json":
        return json.loads
    if encoding == "protobuf" and schema is not None:
        from mcap_protobuf.decoder import DecoderFactory

        return DecoderFactory().decoder_for(encoding, schema)
    if encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        name = schema.name if schema.name.count("/") > 1 else schema.name.replace("/", "/msg/")
        store.register(get_types_from_msg(schema.data.decode(), name))
        return lambda data: store.deserialize_cdr(data, name)
    return None


def _find_damage(path: Path) -> str:
    """Return the place to which an MCAP file can be read."""
    from mcap.stream_reader import StreamReader

    with path.open("rb") as file:
        at = 0
        try:
            for _ in StreamReader(file, emit_chunks=True, validate_crcs=False).records:
                at = file.tell()
        except Exception:
            pass
        size = file.seek(0, 2)
    if at >= size > 0:
        return "all its records are there, so a chunk is damaged inside"
    return f"whole up to byte {at} of {size}; `mcap recover` saves that part"


def _find_labels(value: Any, keys: Keys) -> Iterator[Keys]:
    """Yield the ways to lists of names."""
    for name, inner in _list_fields(value):
        if name in LABELS and _is_names(inner):
            yield (*keys, name)
        elif not isinstance(inner, (str, bytes, int, float)):
            yield from _find_labels(inner, (*keys, name))


def _find_leaves(value: Any, prefix: str, keys: Keys) -> Iterator[tuple[str, Keys]]:
    """Yield name and way of each number in a message."""
    listed = list(_list_fields(value))
    labels = next(([*inner] for name, inner in listed if name in LABELS and _is_names(inner)), None)
    for name, inner in listed:
        path = f"{prefix}{name}"
        is_time = name.endswith("stamp") and _read_time(inner) is not None
        if is_time or _is_number(inner):
            yield path, (*keys, name)
        elif _is_sequence(inner):
            yield from _find_items(inner, path, (*keys, name), labels)
        elif not isinstance(inner, (str, bytes)):
            yield from _find_leaves(inner, f"{path}.", (*keys, name))


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
            yield from _find_leaves(item, f"{path}[{label}].", (*keys, number))


def _list_fields(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the fields of a message: of a dictionary, a dataclass or a protobuf message."""
    if isinstance(value, Mapping):
        yield from value.items()
    elif is_dataclass(value):
        for one in fields(value):
            if one.name != "__msgtype__":
                yield one.name, getattr(value, one.name)
    elif hasattr(value, "DESCRIPTOR"):
        for one in value.DESCRIPTOR.fields:
            yield one.name, getattr(value, one.name)


def _follow(value: Any, keys: Keys) -> Any:
    """Return the value at the end of a way, `None` where the message does not have it."""
    try:
        for key in keys:
            is_inside = isinstance(key, int) or isinstance(value, Mapping)
            value = value[key] if is_inside else getattr(value, str(key))
    except (KeyError, IndexError, TypeError, AttributeError):
        return None
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool)


def _is_sequence(value: Any) -> bool:
    return hasattr(value, "__len__") and hasattr(value, "__getitem__") and not isinstance(value, (str, bytes, Mapping))  # fmt: skip


def _is_names(value: Any) -> bool:
    return _is_sequence(value) and len(value) > 0 and all(isinstance(name, str) for name in value)


def _read_time(value: Any) -> float | None:
    """Return a time in s: a number, or seconds and nanoseconds."""
    if _is_number(value):
        return float(value)
    for whole, part in TIMES:
        seconds, nanoseconds = _follow(value, (whole,)), _follow(value, (part,))
        if _is_number(seconds) and _is_number(nanoseconds):
            return float(seconds) + 1e-9 * float(nanoseconds)
    return None


def _store(columns: StoredColumns, rows: list[list[float | None]], names: Sequence[str]) -> None:
    """Move gathered rows into the columns."""
    if rows:
        block = np.array(rows, dtype=float)  # None becomes NaN
        for at, name in enumerate([LOG_TIME, *names]):
            columns.add(name, block[:, at])
        rows.clear()
