"""Logs of a CAN bus (BLF, ASC, TRC, candump), decoded by a DBC file.

Each message of the DBC is a table with its signals and `time`, the time of the frame in s. A message is
known by its number and its kind, 11-bit or 29-bit. Signals of one page of a multiplexed message are
missing in the rows of the others. Frames are read and decoded by blocks.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np

from actuators.recordings.advice import advise
from actuators.recordings.log_tables import LogFile, LogRun, Table
from brokk_rl import registry
from brokk_rl.errors import ConfigError, RecordingError

TIME = "time"
HEAD_FRAMES = 20000
"""Frames from the beginning in which messages are looked for: slow ones come once a second."""
BLOCK_FRAMES = 65536
WORD_BYTES = 8
"""Data of a classic frame."""
BLF_FRAME = np.dtype(
    [
        ("signature", "S4"),
        ("header_size", "<u2"),
        ("version", "<u2"),
        ("size", "<u4"),
        ("kind", "<u4"),
        ("time_unit", "<u4"),
        ("client", "<u2"),
        ("object_version", "<u2"),
        ("ticks", "<u8"),
        ("channel", "<u2"),
        ("flags", "u1"),
        ("length", "u1"),
        ("frame_id", "<u4"),
        ("data", "u1", (WORD_BYTES,)),
    ]
)
"""A classic frame in a BLF file, as `can.io.blf` unpacks it: object header, its version 1, CAN message."""
CLASSIC_KIND, REMOTE_FLAG, ID_BITS = 1, 0x80, 0x1FFFFFFF
EXTENDED = 1 << 31
"""Bit of an identifier that has 29 bits, as in BLF and DBC files."""
TICKS_OF_10_US = 1
"""Time unit of 10 µs; others are of 1 ns."""
PRINTED_LINE = re.compile(
    r"^\s*\(([-\d:. ]+)\)\s+(\S+)\s+([0-9A-Fa-f]+)\s+\[\d+\]((?:\s+[0-9A-Fa-f]{2})*).*$"
)


@dataclass(frozen=True)
class FrameBlock:
    """Frames that carry data, one after another, `N` of them.

    Attributes:
        time_s: Their times, `(N,)`.
        frame_id: Their identifiers, with `EXTENDED` for one of 29 bits, `(N,)`.
        channel: Channels of the recorder, `(N,)`.
        length: Bytes of their data, `(N,)`.
        data: The data, zero beyond its end, `(N, B)`.
    """

    time_s: np.ndarray
    frame_id: np.ndarray
    channel: np.ndarray
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
        length = np.minimum(frames["length"], WORD_BYTES)
        inside = np.arange(WORD_BYTES) < length[:, None]
        content = np.where(inside, frames["data"], 0).astype(np.uint8)
        frame_id = frames["frame_id"] & np.uint32(ID_BITS | EXTENDED)
        channel = frames["channel"].astype(int) - 1  # python-can counts from 0
        found = FrameBlock(time_s, frame_id.astype(np.int64), channel, length, content)
        yield select_frames(found, frames["flags"] & REMOTE_FLAG == 0)


def select_frames(block: FrameBlock, chosen: np.ndarray) -> FrameBlock:
    """Return some frames of a block."""
    return FrameBlock(*(getattr(block, one.name)[chosen] for one in fields(FrameBlock)))


def gather_frames(frames: list[can.Message]) -> FrameBlock:
    """Return frames as a block."""
    lengths = [len(frame.data) for frame in frames]
    widest = max(WORD_BYTES, *lengths)
    text = b"".join(bytes(frame.data).ljust(widest, b"\0") for frame in frames)
    names = {name: at for at, name in enumerate(sorted({str(frame.channel) for frame in frames}))}
    channels = []
    for frame in frames:
        text_of_number = re.search(r"\d+$", str(frame.channel))
        channels.append(int(text_of_number[0]) if text_of_number else names[str(frame.channel)])
    return FrameBlock(
        np.array([frame.timestamp for frame in frames]),
        np.array(
            [frame.arbitration_id | (EXTENDED if frame.is_extended_id else 0) for frame in frames]
        ),
        np.array(channels),
        np.array(lengths),
        np.frombuffer(text, np.uint8).reshape(len(frames), widest),
    )


class CanLog(LogFile):
    """A log of a CAN bus.

    Args:
        path: The file.
        dbc: Its DBC file.
        channel: Channel of the recorder to read; `None` for all, where no message comes on two.
    """

    def __init__(self, path: Path, dbc: str, channel: int | None = None) -> None:
        super().__init__(path)
        self._channel = channel
        self._messages = {}
        for message in load_dbc(dbc):
            self._messages[message.frame_id | (EXTENDED if message.is_extended_frame else 0)] = (
                message
            )

    def list_tables(self) -> dict[str, list[str]]:
        """Return the signals of the messages of the DBC that the beginning of the log has."""
        seen: dict[int, set[int]] = {}
        count = 0
        for block in self._iterate():
            pairs = np.unique(np.stack([block.frame_id, block.channel], 1), axis=0)
            for frame_id, channel in pairs.tolist():
                seen.setdefault(frame_id, set()).add(channel)
            count += len(block.frame_id)
            if count >= HEAD_FRAMES:
                break
        tables = {}
        for frame_id, message in self._messages.items():
            channels = sorted(seen.get(frame_id, ()))
            if len(channels) > 1:
                self._refuse_channels(message.name, channels)
            if channels:
                tables[message.name] = [TIME, *(signal.name for signal in message.signals)]
        if not tables:
            ids = ", ".join(
                f"0x{one & ID_BITS:X}{'x' if one & EXTENDED else ''}" for one in sorted(seen)[:8]
            )
            raise RecordingError(
                f"{self.path}: no message of the DBC is in this log; its identifiers are {ids or 'none'}"
            )
        return tables

    def read_runs(
        self, wanted: Mapping[str, Collection[str]], max_rows: int | None
    ) -> Iterator[LogRun]:
        """Yield the log as one run."""
        chosen = {i: m for i, m in self._messages.items() if m.name in wanted}
        names: dict[int, list[str]] = {}
        for at, message in chosen.items():
            names[at] = [
                signal.name for signal in message.signals if signal.name in wanted[message.name]
            ]
        parts: dict[int, list[list[np.ndarray]]] = {at: [] for at in chosen}
        counts, before = dict.fromkeys(chosen, 0), 0
        for block in self._iterate():
            for at, message in chosen.items():
                rows = np.flatnonzero(block.frame_id == at)
                rows = rows[: None if max_rows is None else max_rows - counts[at]]
                if len(rows):
                    part = select_frames(block, rows)
                    channels = np.unique(part.channel)
                    if len(channels) > 1:
                        self._refuse_channels(message.name, channels.tolist())
                    values = self._decode(message, names[at], part, before + rows)
                    parts[at].append([part.time_s, *values])
                    counts[at] += len(rows)
            before += len(block.frame_id)
            if max_rows is not None and all(count >= max_rows for count in counts.values()):
                break
        tables = {}
        for at, message in chosen.items():
            blocks = parts[at] or [[np.empty(0)] * (1 + len(names[at]))]
            values = [np.concatenate(column) for column in zip(*blocks, strict=True)]
            columns = dict(zip([TIME, *names[at]], values, strict=True))
            units = {signal.name: signal.unit for signal in message.signals if signal.unit}
            tables[message.name] = Table(columns, units, TIME, message.is_multiplexed())
        yield LogRun(self.path.stem, str(self.path), tables)

    def _refuse_channels(self, name: str, channels: list[int]) -> None:
        listed = ", ".join(map(str, channels))
        raise RecordingError(
            f"{self.path}: message '{name}' comes on the channels {listed}, which are two sources; "
            f"{advise('channel', channel=channels[0])}"
        )

    def _decode(
        self, message: Any, names: list[str], block: FrameBlock, numbers: np.ndarray
    ) -> list[np.ndarray]:
        """Return the named signals of frames of one message; `numbers` are those of the frames."""
        if is_plain(message) and (block.length >= message.length).all():
            signals = {signal.name: signal for signal in message.signals}
            return [extract_signal(signals[name], block.data) for name in names]
        rows = []
        for number, time_s, length, data in zip(
            numbers, block.time_s, block.length, block.data, strict=True
        ):
            try:
                values: Any = message.decode(data[:length].tobytes(), decode_choices=False)
            except Exception as error:  # cantools and bitstruct raise what they stumble over
                text = f"frame {number} at {time_s:.6f} s: is no message '{message.name}' of the DBC ({error})"
                self.report_damage(text, error)
                values = {}
            rows.append([values.get(name, np.nan) for name in names])
        return list(np.array(rows, dtype=float).reshape(len(rows), len(names)).T)

    def _open(self) -> Any:
        ending = self.path.suffix.lower()
        if ending == ".blf":
            return BlfBlockReader(self.path)
        if ending in (".log", ".txt"):
            return can.CanutilsLogReader(StringIO(read_candump(self.path)))
        return can.LogReader(self.path)

    def _iterate(self) -> Iterator[FrameBlock]:
        """Yield the frames of the chosen channel that carry data, by blocks."""
        for block in self._iterate_all():
            if self._channel is None:
                yield block
            else:
                yield select_frames(block, block.channel == self._channel)

    def _iterate_all(self) -> Iterator[FrameBlock]:
        count, last_s = 0, 0.0
        waiting: list[can.Message] = []
        try:
            with self._open() as reader:
                # python-can reads a file that is shorter than its header says without a word
                stated, there = getattr(reader, "file_size", 0), self.path.stat().st_size
                if there < stated:
                    self.report_damage(f"cut off at byte {there} of {stated}", None)
                for found in reader:
                    is_block = isinstance(found, FrameBlock)
                    if waiting and (is_block or len(waiting) >= BLOCK_FRAMES):
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
        except RecordingError:
            raise
        except Exception as error:  # python-can raises what its parsers stumble over
            kind = type(error).__name__
            self.report_damage(
                f"damaged after frame {count} at {last_s:.6f} s ({kind}: {error})", error
            )
            if waiting:
                yield gather_frames(waiting)


def read_candump(path: Path) -> str:
    """Return the frames of a log of candump as `candump -l` writes them."""
    lines = []
    for line in path.read_text(errors="replace").splitlines():
        printed = PRINTED_LINE.match(line)
        if printed:
            is_date = "-" in printed[1]  # candump -t A
            stamp_s = (
                datetime.fromisoformat(f"{printed[1]}+00:00").timestamp()
                if is_date
                else float(printed[1])
            )
            data = "".join(printed[4].split())
            lines.append(f"({stamp_s:.6f}) {printed[2]} {printed[3]}#{data}")
        elif line.lstrip().startswith("("):
            lines.append(line.strip())
    return "\n".join(lines) + "\n"


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
