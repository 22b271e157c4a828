"""MCAP files with JSON, protobuf or ROS messages, read by chunks."""

from __future__ import annotations

import json
import struct
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from actuators.recordings.message_log import Gatherer, MessageBlock, MessageLog, describe
from actuators.recordings.message_numbers import NumberReader, ObjectReader
from brokk_rl.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
"""Begin of an MCAP file."""
RECORD_HEAD = struct.Struct("<BQ")
"""Kind of an MCAP record and size of what follows."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, number, log time and time of publication of an MCAP message."""
ROS_ENCODINGS = (("cdr", "ros2msg"), ("cdr", "ros2idl"), ("ros1", "ros1msg"))
"""Encodings of message and schema that `RosReader` reads."""


class McapLog(MessageLog):
    """An MCAP file.

    Its index says which chunks hold wanted topics; a file without an index is read from its begin.
    """

    def _list_topics(self) -> list[str]:
        with self.path.open("rb") as file:
            summary = _read_summary(file)
            if summary is not None:
                return [channel.topic for channel in summary.channels.values()]
            channels = _McapChannels(None)
            try:
                for byte, record in self._read_all_records(file):
                    self._take_record(channels, byte, record)
            except RecordingError:
                raise
            except Exception as error:  # the library raises what it stumbles over
                self.report_damage(self._explain(error), error)
            return [topic for topic, _ in channels.known.values()]

    def _iterate(self, topics: Collection[str]) -> Iterator[MessageBlock]:
        channels, gatherer = _McapChannels(topics), Gatherer()
        with self.path.open("rb") as file:
            summary = _read_summary(file)
            records = self._read_all_records(file)
            if summary is not None and summary.chunk_indexes:
                records = self._read_indexed_records(file, summary, channels)
            for byte, record in records:
                for channel_id, (times, messages) in self._take_record(
                    channels, byte, record
                ).items():
                    topic, reader = channels.known[channel_id]
                    if isinstance(record, Chunk):
                        time_ns = np.array(times, dtype=np.int64)
                        place = f", in the chunk at byte {byte}"
                        yield MessageBlock(topic, reader, time_ns, messages, place)
                    elif gatherer.add(channel_id, times[0], messages[0]):
                        yield gatherer.take(channel_id, topic, reader)
            for channel_id in gatherer.list_waiting():
                yield gatherer.take(channel_id, *channels.known[channel_id])

    def _take_record(
        self, channels: _McapChannels, byte: int, record: Any
    ) -> dict[int, tuple[list[int], list[bytes]]]:
        """Return times and messages of a record by channel; note the channels that it has."""
        if isinstance(record, Chunk):
            try:
                return _split_chunk(record, channels)
            except Exception as error:  # decompressors raise what they stumble over
                self.report_damage(f"chunk at byte {byte}: {describe(error)}", error)
        elif isinstance(record, Message) and record.channel_id in channels.known:
            return {record.channel_id: ([record.log_time], [record.data])}
        elif isinstance(record, (Schema, Channel)):
            channels.add(record)
        return {}

    def _read_indexed_records(
        self, file: IO[bytes], summary: Any, channels: _McapChannels
    ) -> Iterator[tuple[int, Any]]:
        """Yield the channels, then the chunks with wanted ones, each with its byte in the file."""
        for record in (*summary.schemas.values(), *summary.channels.values()):
            yield 0, record
        for index in sorted(summary.chunk_indexes, key=lambda one: one.chunk_start_offset):
            inside = index.message_index_offsets  # may be left out
            if inside and channels.known.keys().isdisjoint(inside):
                continue
            file.seek(index.chunk_start_offset + RECORD_HEAD.size)
            content = file.read(index.chunk_length - RECORD_HEAD.size)
            try:
                chunk = Chunk.read(ReadDataStream(BytesIO(content)))
            except Exception as error:  # the library raises what it stumbles over
                self.report_damage(
                    f"chunk at byte {index.chunk_start_offset}: {describe(error)}", error
                )
                continue
            yield index.chunk_start_offset, chunk

    def _read_all_records(self, file: IO[bytes]) -> Iterator[tuple[int, Any]]:
        """Yield all records in their order, each with its byte in the file."""
        file.seek(0)
        byte = 0
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            yield byte, record
            byte = file.tell()

    def _explain(self, error: Exception) -> str:
        return f"{describe(error)}; {_find_damage(self.path)}"


class _McapChannels:
    """Schemas and channels that were met; `known` has topic and reader of the wanted ones."""

    def __init__(self, topics: Collection[str] | None) -> None:
        self._topics = topics
        self._schemas: dict[int, Any] = {}
        self.known: dict[int, tuple[str, NumberReader]] = {}

    def add(self, record: Schema | Channel) -> None:
        """Note a schema or a channel."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif record.id not in self.known and (self._topics is None or record.topic in self._topics):
            reader = _find_reader(record.message_encoding, self._schemas.get(record.schema_id))
            if reader is not None:
                self.known[record.id] = (record.topic, reader)


def _read_summary(file: IO[bytes]) -> Any:
    """Return the summary of an MCAP file, `None` where it is missing or damaged."""
    try:
        summary = make_reader(file, validate_crcs=True).get_summary()
    except Exception:  # the library raises what it stumbles over
        return None
    return summary if summary is not None and summary.channels else None


def _split_chunk(chunk: Chunk, channels: _McapChannels) -> dict[int, tuple[list[int], list[bytes]]]:
    """Return times and messages of the known channels in a chunk."""
    stream, end = get_chunk_data_stream(chunk, validate_crc=True)
    data = stream.read(end)
    if end != chunk.uncompressed_size:
        raise ValueError(f"{end} bytes, its head says {chunk.uncompressed_size}")
    found: dict[int, tuple[list[int], list[bytes]]] = {}
    at = 0
    while at < end:
        kind, size = RECORD_HEAD.unpack_from(data, at)
        at += RECORD_HEAD.size
        if at + size > end:
            raise ValueError(f"a record of {size} bytes where {end - at} are left")
        if kind == Opcode.MESSAGE:
            channel_id, _, time_ns, _ = MESSAGE_HEAD.unpack_from(data, at)
            if channel_id in channels.known:
                times, messages = found.setdefault(channel_id, ([], []))
                times.append(time_ns)
                messages.append(data[at + MESSAGE_HEAD.size : at + size])
        elif kind in (Opcode.SCHEMA, Opcode.CHANNEL):
            parse = Schema.read if kind == Opcode.SCHEMA else Channel.read
            channels.add(parse(ReadDataStream(BytesIO(data[at : at + size]))))
        at += size
    return found


def _find_reader(encoding: str, schema: Any) -> NumberReader | None:
    """Return the reader of a channel, `None` for an encoding that is not known."""
    if encoding == "json":
        return ObjectReader(json.loads)
    if encoding == "protobuf" and schema is not None:
        from mcap_protobuf.decoder import DecoderFactory

        decode = DecoderFactory().decoder_for(encoding, schema)
        return None if decode is None else ObjectReader(decode)
    if schema is not None and (encoding, schema.encoding) in ROS_ENCODINGS:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        from actuators.recordings.ros_layout import RosReader

        name = schema.name if schema.name.count("/") > 1 else schema.name.replace("/", "/msg/")
        text = schema.data.decode()
        own = get_types_from_idl(text) if schema.encoding == "ros2idl" else get_types_from_msg(text, name)  # fmt: skip
        # some writers leave out the definition of a time
        definitions = {**get_typestore(Stores.ROS2_HUMBLE).fielddefs, **own}
        return RosReader(definitions, name, encoding == "ros1")
    return None


def _find_damage(path: Path) -> str:
    """Return the place to which an MCAP file can be read."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return "it does not begin as an MCAP file does"
        file.seek(0)
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
