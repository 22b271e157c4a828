"""Logs of a CAN bus (BLF, ASC, TRC, candump), decoded by a DBC file.

Each message of the DBC is a table with its signals and `time`, the time of the frame in s. A message is
known by its number and its kind, 11-bit or 29-bit. Signals of one page of a multiplexed message are
missing in the rows of the others. Frames are read and decoded by blocks.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pandas as pd

from actuators.recordings.advice import advise
from actuators.recordings.log_tables import LogFile, Table, Wanted
from brokk_rl import registry
from brokk_rl.errors import ConfigError, RecordingError

TIME = "time"
BLOCK_FRAMES = 65536
"""Frames that are decoded at once, and in the first of which messages are looked for: slow ones come once a second."""
WORD_BYTES = 8
"""Data of a classic frame."""
EXTENDED = 1 << 31
"""Bit of an identifier that has 29 bits, as in DBC files."""
FRAME_FIELDS = ["time_s", "frame_id", "channel", "data"]
PRINTED_LINE = re.compile(
    r"^\s*\(([-\d:. ]+)\)\s+(\S+)\s+([0-9A-Fa-f]+)\s+\[\d+\]((?:\s+[0-9A-Fa-f]{2})*).*$"
)


class CanLog(LogFile):
    """A log of a CAN bus.

    Args:
        path: The file.
        dbc: Its DBC file.
        channel: Channel of the recorder to read; `None` for all, where no message comes on two.
    """

    def __init__(self, path: Path, dbc: str, channel: int | str | None = None) -> None:
        super().__init__(path)
        self._channel = channel
        self._messages = {}
        for message in load_dbc(dbc):
            kind = EXTENDED if message.is_extended_frame else 0
            self._messages[message.frame_id | kind] = message

    def list_tables(self) -> dict[str, list[str]]:
        """Return the signals of the messages of the DBC that the beginning of the log has."""
        block = next(self._iterate(), pd.DataFrame(columns=FRAME_FIELDS))
        tables = {}
        for frame_id, frames in block.groupby("frame_id"):
            message = self._messages.get(frame_id)
            if message is not None:
                self._refuse_channels(message.name, frames)
                tables[message.name] = [TIME, *(signal.name for signal in message.signals)]
        if not tables:
            ids = []
            for one in sorted(block["frame_id"].unique())[:8]:
                ids.append(f"0x{one & ~EXTENDED:X}{'x' if one & EXTENDED else ''}")
            raise RecordingError(
                f"{self.path}: no message of the DBC is in this log; its identifiers are {', '.join(ids) or 'none'}"
            )
        return tables

    def read_tables(self, wanted: Wanted, max_rows: int | None) -> dict[str, Table]:
        """Return the signals of each message."""
        chosen = {at: one for at, one in self._messages.items() if one.name in wanted}
        names, parts = {}, {}
        for at, message in chosen.items():
            names[at] = [one.name for one in message.signals if one.name in wanted[message.name]]
            parts[at] = [np.empty((0, 1 + len(names[at])))]
        for block in self._iterate(chosen):
            for at, frames in block.groupby("frame_id"):
                self._refuse_channels(chosen[at].name, frames)
                values = self._decode(chosen[at], names[at], frames)
                parts[at].append(np.column_stack([frames["time_s"], values]))
            counts = [sum(map(len, several)) for several in parts.values()]
            if max_rows is not None and min(counts, default=0) >= max_rows:
                break
        tables = {}
        for at, message in chosen.items():
            values = np.concatenate(parts[at])[:max_rows]
            columns = dict(zip([TIME, *names[at]], values.T, strict=True))
            units = {signal.name: signal.unit for signal in message.signals if signal.unit}
            tables[message.name] = Table(columns, units, TIME, message.is_multiplexed())
        return tables

    def _refuse_channels(self, name: str, frames: pd.DataFrame) -> None:
        channels = sorted(frames["channel"].unique())
        if len(channels) > 1:
            raise RecordingError(
                f"{self.path}: message '{name}' comes on the channels {', '.join(channels)}, which are two sources; "
                f"{advise('channel', channel=channels[0])}"
            )

    def _decode(self, message: Any, names: list[str], frames: pd.DataFrame) -> np.ndarray:
        """Return the named signals of frames of one message, `(N, K)`; NaN for those of other pages."""
        is_whole = frames["data"].str.len().min() >= message.length
        if is_plain(message) and is_whole:
            words = b"".join(data[:WORD_BYTES].ljust(WORD_BYTES, b"\0") for data in frames["data"])
            rows = np.frombuffer(words, np.uint8).reshape(-1, WORD_BYTES)
            signals = [message.get_signal_by_name(name) for name in names]
            return np.array([extract_signal(one, rows) for one in signals]).T
        found = np.full((len(frames), len(names)), np.nan)
        for row, data in enumerate(frames["data"]):
            try:
                values: Any = message.decode(data, decode_choices=False)
            except Exception as error:  # cantools and bitstruct raise what they stumble over
                time_s = frames["time_s"].iloc[row]
                text = f"frame {frames.index[row]} at {time_s:.6f} s: is no message '{message.name}' of the DBC ({error})"
                self.report_damage(text, error)
                values = {}
            found[row] = [values.get(name, np.nan) for name in names]
        return found

    def _open(self) -> Any:
        if self.path.suffix.lower() in (".log", ".txt"):
            return can.CanutilsLogReader(StringIO(read_candump(self.path)))
        return can.LogReader(self.path)

    def _iterate(self, wanted: Container[int] | None = None) -> Iterator[pd.DataFrame]:
        """Yield the frames of the chosen channel that carry data, by blocks; the index is their number in the log.

        Args:
            wanted: Identifiers of the frames; `None` for all.
        """
        count, last_s = 0, 0.0
        waiting: dict[int, tuple[float, int, str, bytes]] = {}
        try:
            with self._open() as reader:
                # python-can reads a file that is shorter than its header says without a word
                stated, there = getattr(reader, "file_size", 0), self.path.stat().st_size
                if there < stated:
                    self.report_damage(f"cut off at byte {there} of {stated}", None)
                for frame in reader:
                    count, last_s = count + 1, frame.timestamp
                    if frame.is_error_frame or frame.is_remote_frame:
                        continue
                    frame_id = frame.arbitration_id | (EXTENDED if frame.is_extended_id else 0)
                    channel = str(frame.channel)
                    is_other = self._channel is not None and channel != str(self._channel)
                    if is_other or (wanted is not None and frame_id not in wanted):
                        continue
                    waiting[count - 1] = (last_s, frame_id, channel, bytes(frame.data))
                    if len(waiting) >= BLOCK_FRAMES:
                        yield gather_frames(waiting)
                        waiting = {}
        except RecordingError:
            raise
        except Exception as error:  # python-can raises what its parsers stumble over
            kind = type(error).__name__
            self.report_damage(
                f"damaged after frame {count} at {last_s:.6f} s ({kind}: {error})", error
            )
        if waiting:
            yield gather_frames(waiting)


def gather_frames(frames: dict[int, tuple[float, int, str, bytes]]) -> pd.DataFrame:
    """Return frames by their number as a table of `FRAME_FIELDS`."""
    return pd.DataFrame.from_dict(frames, orient="index", columns=FRAME_FIELDS)


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
