"""Reads and recovers captures, whole or cut off by a crash; those up to where they end."""

from __future__ import annotations

import json
import logging
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

import can
import numpy as np
from can.io.blf import BLFReader
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from brokk_rl.errors import RecordingError
from brokk_rl.progress import track_items
from brokk_rl.record import find_files
from brokk_rl.spec import spec
from deploy.recorder.capture import FACTS, DurableBlfWriter
from deploy.recorder.topics import PACKAGE, TIME, decode_message, load_message_class

log = logging.getLogger(__name__)


class TopicMessages(Sequence[tuple[float, dict[str, Any]]]):
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

    @overload
    def __getitem__(self, index: int) -> tuple[float, dict[str, Any]]: ...
    @overload
    def __getitem__(self, index: slice) -> list[tuple[float, dict[str, Any]]]: ...
    def __getitem__(
        self, index: int | slice
    ) -> tuple[float, dict[str, Any]] | list[tuple[float, dict[str, Any]]]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
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
    """

    facts: dict[str, str] = field(default_factory=dict)
    messages: dict[str, TopicMessages] = field(default_factory=dict)
    views: dict[str, list[tuple[float, bytes]]] = field(default_factory=dict)
    wall_ns: int = 0
    whole: bool = True


def read_capture(path: Path, views: tuple[str, ...] = ()) -> CaptureContents:
    """Read the capture at `path` as far as it goes.

    Args:
        path: The capture.
        views: Topics for viewers that are wanted too.

    Raises:
        RecordingError: there is none, or not even its beginning can be read.
    """
    contents, decoder, ahead_ns = CaptureContents(whole=is_whole(path)), _Decoder(), None
    seen: list[tuple[str, Message]] = []
    for record in _iterate_records(path):
        if isinstance(record, Metadata) and record.name == FACTS:
            contents.facts = dict(record.metadata)
        elif isinstance(record, Schema):
            decoder.schemas[record.id] = record
        elif isinstance(record, Channel):
            decoder.channels[record.id] = record
        elif isinstance(record, Message):
            topic = decoder.channels[record.channel_id].topic
            values = decoder.decode(record)
            if values is not None:
                t_s = values.pop(TIME)
                contents.wall_ns = contents.wall_ns or record.log_time
                ahead_ns = record.log_time - int(t_s * 1e9) if ahead_ns is None else ahead_ns
                contents.messages.setdefault(topic, TopicMessages()).add(t_s, values)
            elif topic in views:
                seen.append((topic, record))
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
    """Decodes messages of this framework: protobuf, and JSON of captures of before."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._classes: dict[int, Any] = {}

    def decode(self, message: Message) -> dict[str, Any] | None:
        """Return its values; `None` for a message that is meant for viewers."""
        channel = self.channels[message.channel_id]
        if channel.message_encoding == "json":
            return json.loads(message.data)
        schema = self.schemas[channel.schema_id]
        if not schema.name.startswith(f"{PACKAGE}."):
            return None
        if schema.id not in self._classes:
            self._classes[schema.id] = load_message_class(schema.name, schema.data)
        return decode_message(self._classes[schema.id].FromString(message.data))


def is_whole(path: Path) -> bool:
    """Return whether the capture at `path` was closed properly."""
    try:
        with path.open("rb") as file:
            return make_reader(file).get_summary() is not None
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such capture") from error
    except (McapError, OSError, ValueError):
        return False


def recover_mcap(path: Path, out: Path) -> int:
    """Write the readable part of a cut-off capture as a whole one; return its number of messages.

    Raises:
        RecordingError: nothing can be read.
    """
    count, schemas, channels = 0, {0: 0}, {}
    part = out.with_name(f".{out.name}.part")
    with part.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="brokk", library="brokk-rl")
        for record in _iterate_records(path):
            if isinstance(record, Schema):
                schemas.setdefault(
                    record.id, writer.register_schema(record.name, record.encoding, record.data)
                )
            elif isinstance(record, Channel) and record.id not in channels:
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id]
                )
            elif isinstance(record, Message):
                writer.add_message(
                    channels[record.channel_id],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
                count += 1
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, dict(record.metadata))
            elif isinstance(record, Attachment):
                writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
        writer.finish()
    if not count:
        part.unlink()
        raise RecordingError(f"{path}: not a single message can be read")
    part.replace(out)
    return count


def recover_blf(path: Path, out: Path) -> int:
    """Write the readable part of a cut-off BLF as a whole one; return its number of frames."""
    part, count = out.with_name(f".{out.name}.part"), 0
    writer = DurableBlfWriter(part)
    try:
        for message in iterate_blf_frames(path):
            writer.on_message_received(message)
            count += 1
    finally:
        writer.stop()
    part.replace(out)
    return count


def iterate_blf_frames(path: Path) -> Iterator[can.Message]:
    """Yield the frames of a BLF as far as it can be read."""
    try:
        with BLFReader(path) as reader:
            yield from reader
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: no such log") from error
    except Exception as error:  # a container that was cut off fails in zlib, struct or the parser
        log.warning("%s: ends before its end (%s)", path, error)


def _iterate_records(path: Path) -> Iterator[Any]:
    """Yield records as far as the file can be read; chunks are opened."""
    try:
        file = path.open("rb")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    with file:
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True).records
        while True:
            try:
                record = next(reader)
                inner = (
                    breakup_chunk(record, validate_crc=True)
                    if isinstance(record, Chunk)
                    else [record]
                )
            except StopIteration:
                return
            except Exception as error:  # a cut-off file fails wherever it was cut
                log.warning("%s: ends before its end (%s: %s)", path, type(error).__name__, error)
                return
            yield from inner


KINDS = {".mcap": recover_mcap, ".blf": recover_blf}


@spec
class CaptureRecovery:
    """Captures to recover.

    Attributes:
        input: Glob, or list of globs, of `.mcap` and `.blf` files; others are left out.
    """

    input: str | tuple[str, ...]

    def run(self, folder: Path) -> None:
        """Write each recovered file under its own name, led by that of its folder, into `folder`.

        Raises:
            RecordingError: nothing matches, two would have the same name, or nothing can be read of
                one.
        """
        candidates = find_files(self.input, "capture")
        paths = [path for path in candidates if path.suffix in KINDS]
        if not paths:
            raise RecordingError(
                f"recover.input: {candidates[0]} is neither .mcap nor .blf, nor is anything else that matches"
            )
        names = [f"{path.resolve().parent.name}_{path.name}" for path in paths]
        if len(set(names)) < len(names):
            raise RecordingError(
                "recover.input: two captures lie in folders of the same name; recover one after the other"
            )
        for path, name in track_items(list(zip(paths, names, strict=True)), "recovering"):
            count = KINDS[path.suffix](path, folder / name)
            log.info("%s: %d messages recovered into %s", path, count, folder / name)
