"""Logs of a CAN bus (BLF or ASC), decoded by a DBC file.

Each message of the DBC is a table with its signals and `time`, the time of the frame in s. Frames are
read and decoded by blocks: a BLF file of 1 GB holds tens of millions of them.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
from can.io.asc import ASC_MESSAGE_REGEX

from actuators.recordings.log_tables import BLOCK_ROWS, LogFile, LogRun, StoredColumns, Table
from brokk_rl import registry
from brokk_rl.errors import ConfigError, RecordingError

TIME = "time"
HEAD_FRAMES = 20000
"""Frames from the beginning in which messages are looked for: slow ones come once a second."""
WORD_BYTES = 8
"""Data of a classic frame."""
BLF_FRAME = np.dtype(
    [
        ("signature", "S4"), ("header_size", "<u2"), ("version", "<u2"), ("size", "<u4"), ("kind", "<u4"),
        ("time_unit", "<u4"), ("client", "<u2"), ("object_version", "<u2"), ("ticks", "<u8"),
        ("channel", "<u2"), ("flags", "u1"), ("length", "u1"), ("frame_id", "<u4"), ("data", "u1", (WORD_BYTES,)),
    ]
)  # fmt: skip
"""A classic frame in a BLF file, as `can.io.blf` unpacks it: object header, its version 1, CAN message."""
CLASSIC_KIND, REMOTE_FLAG, ID_BITS = 1, 0x80, 0x1FFFFFFF
ASC_BLOCK_CHARACTERS = 4 << 20
"""Characters of an ASC file whose lines are parsed at once."""
ASC_FRAME = re.compile(
    r"^[ \t]*(\d+\.\d+)[ \t]+\d+[ \t]+([0-9A-Fa-f]+[xX]?)[ \t]+[RT]x[ \t]+d[ \t]+([0-8])([ 0-9A-Fa-f]*)",
    re.MULTILINE | re.ASCII,
)
"""A line of a classic frame with data: time in s, identifier, number of bytes, the bytes and more."""
ASC_DATA = re.compile(r"[ \t][RT]x[ \t]+d[ \t]")
"""Sign of a line of a frame, whatever the rest of it has become."""
NO_BYTES = " 00" * WORD_BYTES
TICKS_OF_10_US = 1
"""Time unit of 10 µs; others are of 1 ns."""


@dataclass(frozen=True)
class FrameBlock:
    """Frames that carry data, one after another, `N` of them.

    Attributes:
        time_s: Their times, `(N,)`.
        frame_id: Their identifiers, `(N,)`.
        length: Bytes of their data, `(N,)`.
        data: The data, zero beyond its end, `(N, B)`.
    """

    time_s: np.ndarray
    frame_id: np.ndarray
    length: np.ndarray
    data: np.ndarray


class BlfBlockReader(can.BLFReader):
    """A reader that parses a container of classic frames at once, and others frame by frame."""

    def _parse_data(self, data: bytes) -> Iterator[Any]:
        frames = np.frombuffer(data, BLF_FRAME, len(data) // BLF_FRAME.itemsize)
        is_classic = (
            (frames["signature"] == b"LOBJ")
            & (frames["size"] == BLF_FRAME.itemsize)
            & (frames["version"] == 1)
            & (frames["kind"] == CLASSIC_KIND)
        )
        if not len(frames) or not is_classic.all():
            yield from super()._parse_data(data)
            return
        self._pos = len(frames) * BLF_FRAME.itemsize
        unit_s = np.where(frames["time_unit"] == TICKS_OF_10_US, 1e-5, 1e-9)
        time_s = frames["ticks"] * unit_s + self.start_timestamp
        chosen = frames["flags"] & REMOTE_FLAG == 0
        length = np.minimum(frames["length"], WORD_BYTES)
        inside = np.arange(WORD_BYTES) < length[:, None]
        content = np.where(inside, frames["data"], 0).astype(np.uint8)
        found = FrameBlock(time_s, frames["frame_id"] & ID_BITS, length, content)
        yield select_frames(found, chosen)


class AscBlockReader(can.ASCReader):
    """A reader that parses lines of classic frames by blocks, and leaves others to python-can."""

    def __iter__(self) -> Iterator[Any]:
        self._extract_header()
        file: Any = self.file
        while lines := file.readlines(ASC_BLOCK_CHARACTERS):
            found = ASC_FRAME.findall("".join(lines)) if self.base == "hex" else []
            others = lines if not found else []
            if 0 < len(found) < len(lines):
                others = [line for line in lines if not ASC_FRAME.match(line)]
            if found:
                yield parse_asc_frames(found)
            if others:
                for line in others:
                    if ASC_DATA.search(line) and not ASC_MESSAGE_REGEX.match(line.strip()):
                        raise ValueError(f"the line '{line.strip()}' is no frame")
                # python-can skips the header, whose last line this is.
                self.file = StringIO("internal events logged\n" + "".join(others))
                try:
                    yield from super().__iter__()
                finally:
                    self.file = file
            end = lines[-1].strip().lower()
            if not lines[-1].endswith("\n") and not end.startswith("end triggerblock"):
                raise ValueError(f"the last line, '{end}', is cut off")
        self.stop()


def parse_asc_frames(found: list[tuple[str, str, str, str]]) -> FrameBlock:
    """Return frames as a block: time, identifier, number and text of the bytes of each."""
    times, identifiers, lengths, texts = zip(*found, strict=True)
    numbers = {text: int(text.rstrip("xX"), 16) for text in set(identifiers)}
    length = np.array(list(map(int, lengths)))
    is_short = np.array(list(map(len, texts))) < 3 * length
    if is_short.any():
        number = int(np.argmax(is_short))
        raise ValueError(
            f"the frame at {times[number]} s has {len(texts[number]) // 3} bytes of {length[number]}"
        )
    sizes = (3 * length).tolist()
    content = [text[:size] + NO_BYTES[size:] for size, text in zip(sizes, texts, strict=True)]
    data = np.frombuffer(bytes.fromhex("".join(content)), np.uint8)
    frame_id = np.array([numbers[text] for text in identifiers])
    time_s = np.array(list(map(float, times)))
    return FrameBlock(time_s, frame_id, length, data.reshape(-1, WORD_BYTES))


def select_frames(block: FrameBlock, chosen: np.ndarray) -> FrameBlock:
    """Return some frames of a block."""
    return FrameBlock(*(getattr(block, name)[chosen] for name in FrameBlock.__dataclass_fields__))


def gather_frames(frames: list[can.Message]) -> FrameBlock:
    """Return frames as a block."""
    lengths = [len(frame.data) for frame in frames]
    widest = max(WORD_BYTES, *lengths)
    text = b"".join(bytes(frame.data).ljust(widest, b"\0") for frame in frames)
    return FrameBlock(
        np.array([frame.timestamp for frame in frames]),
        np.array([frame.arbitration_id for frame in frames]),
        np.array(lengths),
        np.frombuffer(text, np.uint8).reshape(len(frames), widest),
    )


class CanLog(LogFile):
    """A log of a CAN bus."""

    def __init__(self, path: Path, dbc: str) -> None:
        super().__init__(path)
        self._messages = {message.frame_id: message for message in load_dbc(dbc)}

    def list_tables(self) -> dict[str, list[str]]:
        """Return the signals of the messages of the DBC that the beginning of the log has."""
        seen: set[int] = set()
        count = 0
        for block in self._iterate():
            seen.update(np.unique(block.frame_id).tolist())
            count += len(block.frame_id)
            if count >= HEAD_FRAMES:
                break
        tables = {}
        for frame_id, message in self._messages.items():
            if frame_id in seen:
                tables[message.name] = [TIME, *(signal.name for signal in message.signals)]
        return tables

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the log as one run."""
        chosen = {i: m for i, m in self._messages.items() if m.name in wanted}
        names = {i: [s.name for s in m.signals if s.name in wanted[m.name]] for i, m in chosen.items()}  # fmt: skip
        stores = {i: StoredColumns([TIME, *several]) for i, several in names.items()}
        counts = dict.fromkeys(chosen, 0)
        before = 0
        for block in self._iterate():
            for at, message in chosen.items():
                rows = np.flatnonzero(block.frame_id == at)
                rows = rows[: None if max_rows is None else max_rows - counts[at]]
                if not len(rows):
                    continue
                part = select_frames(block, rows)
                values = self._decode(message, names[at], part, before + rows)
                stores[at].add(TIME, part.time_s)
                for name, column in values.items():
                    stores[at].add(name, column)
                counts[at] += len(rows)
            before += len(block.frame_id)
            if max_rows is not None and all(count >= max_rows for count in counts.values()):
                break
        tables = {chosen[at].name: Table(store) for at, store in stores.items()}
        yield LogRun(self.path.stem, str(self.path), tables)

    def _decode(
        self, message: Any, names: list[str], block: FrameBlock, numbers: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return the named signals of frames of one message; `numbers` are those of the frames."""
        if is_plain(message) and (block.length >= message.length).all():
            signals = {signal.name: signal for signal in message.signals}
            return {name: extract_signal(signals[name], block.data) for name in names}
        rows = []
        for number, time_s, length, data in zip(
            numbers, block.time_s, block.length, block.data, strict=True
        ):
            try:
                values: Any = message.decode(data[:length].tobytes(), decode_choices=False)
            except Exception as error:  # cantools and bitstruct raise what they stumble over
                raise RecordingError(
                    f"{self.path}: frame {number} at {time_s:.6f} s: is no message '{message.name}' of the DBC "
                    f"({error})"
                ) from error
            rows.append([values.get(name, np.nan) for name in names])
        return dict(zip(names, np.array(rows, dtype=float).T, strict=True))

    def _check_size(self, reader: Any) -> None:
        """Refuse a BLF file that is shorter than its header says; python-can reads it without a word."""
        stated, there = getattr(reader, "file_size", 0), self.path.stat().st_size
        if there < stated:
            self.report_damage(f"cut off at byte {there} of {stated}", None)

    def _open(self) -> Any:
        ending = self.path.suffix.lower()
        if ending == ".blf":
            return BlfBlockReader(self.path)
        return (
            AscBlockReader(self.path, encoding="utf-8")
            if ending == ".asc"
            else can.LogReader(self.path)
        )

    def _iterate(self) -> Iterator[FrameBlock]:
        """Yield the frames that carry data, by blocks."""
        count, last_s = 0, 0.0
        waiting: list[can.Message] = []
        try:
            with self._open() as reader:
                self._check_size(reader)
                frames: Iterator[Any] = iter(reader)
                for found in frames:
                    is_block = isinstance(found, FrameBlock)
                    if waiting and (is_block or len(waiting) >= BLOCK_ROWS):
                        yield gather_frames(waiting)
                        waiting = []
                    if is_block:
                        yield found
                        count += len(found.time_s)
                        last_s = float(found.time_s[-1]) if len(found.time_s) else last_s
                        continue
                    count, last_s = count + 1, found.timestamp
                    if not (found.is_error_frame or found.is_remote_frame):
                        waiting.append(found)
            if waiting:
                yield gather_frames(waiting)
        except Exception as error:  # python-can raises what its parsers stumble over
            if isinstance(error, RecordingError):
                raise
            text = (
                f"damaged after frame {count} at {last_s:.6f} s ({type(error).__name__}: {error})"
            )
            self.report_damage(text, error)
            if waiting:
                yield gather_frames(waiting)


def is_plain(message: Any) -> bool:
    """Return whether all signals of a message are whole numbers at fixed places of a classic frame."""
    return (
        message.length <= WORD_BYTES
        and not message.is_multiplexed()
        and not any(signal.is_float for signal in message.signals)
    )


def extract_signal(signal: Any, data: np.ndarray) -> np.ndarray:
    """Return a signal of a plain message from the data of its frames, `(N, 8)`; see the DBC's bit numbers."""
    is_big = signal.byte_order == "big_endian"
    # of a big-endian signal `start` is the highest bit, bits of a byte count down
    words = np.ascontiguousarray(data[:, :WORD_BYTES]).view(">u8" if is_big else "<u8")[:, 0]
    low = signal.start
    if is_big:
        low = 64 - (signal.start // 8 * 8 + 7 - signal.start % 8) - signal.length
    # the highest bit of the signal becomes that of the word, so that shifting back keeps the sign
    raised = words.astype(np.uint64) << np.uint64(64 - low - signal.length)
    kept = raised.view(np.int64) if signal.is_signed else raised
    return (kept >> kept.dtype.type(64 - signal.length)) * signal.scale + float(signal.offset)


def load_dbc(dbc: str) -> list[Any]:
    """Return the messages of a DBC file.

    Raises:
        ConfigError: It cannot be read.
    """
    path = registry.resolve_package_path(dbc)
    try:
        database: Any = cantools.database.load_file(str(path), strict=False)
    except Exception as error:  # cantools raises what its parser stumbles over
        raise ConfigError(f"dbc={dbc}: cannot be read ({error})") from error
    return list(database.messages)
