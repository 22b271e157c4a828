"""Reads captures, whole, damaged or cut off by a crash; those up to where they end."""

from __future__ import annotations

import errno
import logging
import mmap
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from mmap import PROT_READ
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, MessageIndex, Metadata, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap_protobuf.decoder import DecoderFactory

from brokk_rl.errors import CheckpointError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.plain_files import parse_json
from deploy.recorder.capture import FACTS
from deploy.recorder.topics import PACKAGE, TIME, decode_message

log = logging.getLogger(__name__)

MCAP_MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
"""First and last bytes of a file (mcap.dev/spec)."""
HEAD_BYTES, CHUNK_HEAD_BYTES = 9, 28
"""Of opcode and length of a record, and of the times, size and CRC with which a chunk begins."""
COMPRESSION = b"\x04\x00\x00\x00zstd"
"""What follows them in each chunk of a capture."""
MOST_CHUNK_BYTES = 1 << 28
"""Size of an opened chunk; those of a capture are flushed twice a second and hold a few MB."""


class TopicMessages:
    """Messages of a topic, in order: (t_s, values); `t_s` is monotonic time.

    Topics of numbers alone, as those of the bus, are kept by column: an hour of them takes a tenth
    of the memory of as many dictionaries.
    """

    def __init__(self) -> None:
        self._t_s = array("d")
        self._columns: dict[str, array[float]] = {}
        self._rows: list[dict[str, Any]] = []

    def add(self, t_s: float, values: dict[str, Any]) -> None:
        """Append a message."""
        numbers = all(isinstance(value, (int, float)) for value in values.values())
        if not self._t_s and numbers:
            self._columns = {name: array("d") for name in values}
        elif self._columns and not (numbers and values.keys() == self._columns.keys()):
            self._rows, self._columns = [row for _, row in self], {}
        self._t_s.append(t_s)
        if not self._columns:
            self._rows.append(values)
        for name, column in self._columns.items():
            column.append(values[name])

    @property
    def names(self) -> frozenset[str]:
        """Names of the values in the first message."""
        return frozenset(self._columns or self._rows[0])

    def series(self, name: str) -> np.ndarray:
        """Return a signal's values, `(T,)`, or those of `t_s`."""
        if name == "t_s":
            return np.array(self._t_s)
        return np.array(
            self._columns[name] if self._columns else [row[name] for row in self._rows], dtype=float
        )

    def __len__(self) -> int:
        return len(self._t_s)

    def __getitem__(self, index: int) -> tuple[float, dict[str, Any]]:
        if not self._columns:
            return self._t_s[index], self._rows[index]
        return self._t_s[index], {name: column[index] for name, column in self._columns.items()}


@dataclass
class CaptureContents:
    """Contents of a capture.

    Attributes:
        facts: Metadata of the run: `machine`, `fingerprint`, `dbc`, `started_ns`, …
        messages: By topic.
        views: Messages for viewers that were asked for, by topic, not decoded: (t_s, data).
        wall_ns: Wall-clock time of the first message.
        whole: Whether the file was closed properly.
        num_lost: Messages that are missing, as far as the file says how many it held.
        num_damaged: Places at which something could not be read.
    """

    facts: dict[str, str] = field(default_factory=dict)
    messages: dict[str, TopicMessages] = field(default_factory=dict)
    views: dict[str, list[tuple[float, bytes]]] = field(default_factory=dict)
    wall_ns: int = 0
    whole: bool = True
    num_lost: int = 0
    num_damaged: int = 0

    def check_machine(self, machine: Machine, path: Path) -> None:
        """Check that a machine made the capture at `path`.

        Raises:
            RecordingError: another one did.
        """
        try:
            machine.check_fingerprint(parse_json(self.facts["fingerprint"]), str(path))
        except (AttributeError, CheckpointError, KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"{path}: {error}") from error


def read_capture(path: Path, views: tuple[str, ...] = ()) -> CaptureContents:
    """Read the capture at `path` as far as it goes.

    Args:
        path: The capture.
        views: Topics for viewers that are wanted too.

    Raises:
        RecordingError: there is none, or not even its beginning can be read.
    """
    contents, decoder = CaptureContents(), _Decoder()
    seen: list[tuple[str, Message]] = []
    ahead_ns, waiting, facts = None, list[Message](), list[dict[str, str]]()

    def take(message: Message) -> None:
        nonlocal ahead_ns
        topic = decoder.channels[message.channel_id].topic
        values = decoder.decode(message)
        if values is not None:
            t_s = values.pop(TIME)
            contents.wall_ns = contents.wall_ns or message.log_time
            ahead_ns = message.log_time - int(t_s * 1e9) if ahead_ns is None else ahead_ns
            contents.messages.setdefault(topic, TopicMessages()).add(t_s, values)
        elif topic in views:
            seen.append((topic, message))

    for record in _iterate_records(path, contents):
        if isinstance(record, Metadata) and record.name == FACTS:
            facts.append(dict(record.metadata))
        elif isinstance(record, Schema):
            decoder.schemas[record.id] = record
        elif isinstance(record, Channel):
            decoder.channels[record.id] = record
        elif isinstance(record, Message) and record.channel_id in decoder.channels:
            take(record)
        elif isinstance(record, Message):
            waiting.append(record)
    # The definitions of a damaged chunk stand again at the end.
    for message in waiting:
        if message.channel_id in decoder.channels:
            take(message)
    # They are written several times, and have no check sum.
    contents.facts = max(facts, key=facts.count, default={})
    if not contents.facts:
        raise RecordingError(
            f"{path}: no capture of this framework, or cut off within its first second"
        )
    for topic, view in seen:
        # Viewers' messages carry the wall clock alone.
        t_s = (view.log_time - (ahead_ns or 0)) / 1e9
        contents.views.setdefault(topic, []).append((t_s, view.data))
    return contents


class _Decoder:
    """Decodes messages of this framework."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._factory = DecoderFactory()

    def decode(self, message: Message) -> dict[str, Any] | None:
        """Return its values; `None` for a message that is meant for viewers."""
        schema = self.schemas[self.channels[message.channel_id].schema_id]
        decode = self._factory.decoder_for("protobuf", schema)
        if decode is None or not schema.name.startswith(f"{PACKAGE}."):
            return None
        return decode_message(decode(message.data))


def _iterate_records(path: Path, contents: CaptureContents) -> Iterator[Any]:
    """Yield the records of a capture; what is damaged is left out and counted in `contents`.

    A record that cannot be read costs what follows up to the next chunk, and a chunk its messages.

    Raises:
        RecordingError: the file cannot be read.
    """
    try:
        if not path.is_file():
            raise FileNotFoundError(errno.ENOENT, "no such capture, or no plain one")
        if path.stat().st_size == 0:
            return
        # A link is followed; a pipe or a device was refused.
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, prot=PROT_READ) as data:
            contents.whole = data[-MAGIC_SIZE:] == MCAP_MAGIC
            yield from _scan(data, contents)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read ({error})") from error
    if not contents.whole:
        log.warning("%s: ends before its end", path)
    if contents.num_damaged:
        text = "%s: damaged in %d places, at least %d messages are lost"
        log.warning(text, path, contents.num_damaged, contents.num_lost)


def _scan(data: mmap.mmap, contents: CaptureContents) -> Iterator[Any]:
    at, count, is_hidden = MAGIC_SIZE, 0, False
    following = _find_chunk(data, at)
    while at < len(data) - MAGIC_SIZE * contents.whole:
        if following <= at:
            following = _find_chunk(data, at + 1)
        record, end = _read_record(data, at)
        if isinstance(record, Chunk):
            inner = _open_chunk(record)
            is_hidden = inner is None
            contents.num_damaged += is_hidden
            for one in inner or ():
                count += isinstance(one, Message)
                yield one
        elif isinstance(record, MessageIndex) and is_hidden:
            contents.num_lost += len(record.records)
        elif isinstance(record, Statistics):
            # A wrong opcode may turn a chunk into a record of another kind.
            contents.num_lost = max(contents.num_lost, record.message_count - count)
            contents.num_damaged = max(contents.num_damaged, int(contents.num_lost > 0))
        elif record is not None:
            yield record
        # A wrong length leads to where no record begins, or beyond the next chunk.
        if record is None or end > following:
            contents.num_damaged += contents.whole or following < len(data)
            end = following
        at = end


def _find_chunk(data: mmap.mmap, at: int) -> int:
    """Return where the next chunk begins, or the end of the file."""
    offset = HEAD_BYTES + CHUNK_HEAD_BYTES
    begin = at - 1
    while (begin := data.find(COMPRESSION, begin + offset + 1) - offset) >= at:
        if data[begin] == Opcode.CHUNK:
            return begin
    return len(data)


def _read_record(data: mmap.mmap, at: int) -> tuple[Any | None, int]:
    """Return the record that begins at `at`, `None` where it cannot be read, and where it ends."""
    end = at + HEAD_BYTES + int.from_bytes(data[at + 1 : at + HEAD_BYTES], "little")
    if end > len(data):
        return None, end
    reader = StreamReader(BytesIO(data[at:end]), skip_magic=True, emit_chunks=True)
    try:
        return next(reader.records), end
    except Exception:  # damage may raise whatever the parser meets first
        return None, end


def _open_chunk(chunk: Chunk) -> list[Any] | None:
    """Return the records of a chunk, `None` where it is damaged."""
    try:
        # The size that the compressed data themselves announce: memory is taken for all of it.
        size = chunk.uncompressed_size
        if chunk.compression == "zstd":
            size = max(size, zstandard.frame_content_size(chunk.data))
        if size > MOST_CHUNK_BYTES:
            log.warning("a chunk claims %d MB, more than any of a capture", size >> 20)
            return None
        return breakup_chunk(chunk, validate_crc=True)
    except Exception:  # as above
        return None
