"""Logs of a CAN bus (BLF, ASC, TRC, candump), decoded by a DBC file.

Each message of the DBC is a table with its signals and `time`, that of the frame since the first one. A
message is known by its number and its kind, 11-bit or 29-bit. Signals of one page of a multiplexed
message are missing in the rows of the others.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import can
import cantools

from actuators.recordings.guess import advise
from actuators.recordings.log_tables import Table
from actuators.recordings.message_log import LoggedMessage, MessageLog
from brokk_rl import registry
from brokk_rl.errors import ConfigError

EXTENDED = 1 << 31
"""Bit of an identifier that has 29 bits, as in DBC files."""
PRINTED_LINE = re.compile(
    r"^\s*\(([-\d:. ]+)\)\s+(\S+)\s+([0-9A-Fa-f]+)\s+\[\d+\]((?:\s+[0-9A-Fa-f]{2})*).*$"
)


class CanLog(MessageLog):
    """A log of a CAN bus.

    Args:
        path: The file.
        dbc: Its DBC file.
        channel: Channel of the recorder to read; `None` for all, where no message comes on two.
    """

    clock = "time"

    def __init__(self, path: Path, dbc: str, channel: int | str | None = None) -> None:
        super().__init__(path)
        self._channel = None if channel is None else str(channel)
        self._messages, self.units = {}, {}
        file = str(registry.resolve_package_path(dbc))
        try:
            database: Any = cantools.database.load_file(file, strict=False)
        except Exception as error:  # cantools raises what its parser stumbles over
            raise ConfigError(f"dbc={dbc}: cannot be read ({error})") from error
        for message in database.messages:
            kind = EXTENDED if message.is_extended_frame else 0
            self._messages[message.frame_id | kind] = message
            self.units[message.name] = {one.name: one.unit for one in message.signals if one.unit}

    def read_tables(self, max_rows: int | None) -> dict[str, Table]:
        """Return the signals of the messages of the DBC; refuse a log that has none."""
        tables = super().read_tables(max_rows)
        if not tables:
            with self._open() as reader:
                found = sorted({read_identifier(frame) for frame in reader})
            ids = [f"0x{one & ~EXTENDED:X}{'x' if one & EXTENDED else ''}" for one in found[:8]]
            listed = ", ".join(ids) or "none"
            self.refuse(f"no message of the DBC is in this log; its identifiers are {listed}")
        return tables

    def _open(self) -> Any:
        if self.path.suffix.lower() in (".log", ".txt"):
            return can.CanutilsLogReader(StringIO(read_candump(self.path)))
        return can.LogReader(self.path)

    def _iterate(self) -> Iterator[LoggedMessage]:
        channels: dict[int, str] = {}
        with self._open() as reader:
            # python-can reads a file that is shorter than its header says without a word
            stated, there = getattr(reader, "file_size", 0), self.path.stat().st_size
            if there < stated:
                self.report_damage(f"cut off at byte {there} of {stated}", None)
            for frame in reader:
                frame_id, channel = read_identifier(frame), str(frame.channel)
                is_empty = frame.is_error_frame or frame.is_remote_frame
                is_other = self._channel not in (None, channel)
                if frame_id not in self._messages or is_empty or is_other:
                    continue
                message = self._messages[frame_id]
                table = message.name
                if channels.setdefault(frame_id, channel) != channel:
                    both = sorted((channel, channels[frame_id]))
                    text = f"message '{table}' comes on the channels {', '.join(both)}, which are two sources"
                    self.refuse(f"{text}; {advise('channel', channel=both[0])}")
                decode = partial(message.decode, bytes(frame.data), decode_choices=False)
                yield LoggedMessage(table, round(frame.timestamp * 1e9), decode)


def read_identifier(frame: can.Message) -> int:
    """Return the identifier of a frame, with the bit of its kind."""
    return frame.arbitration_id | (EXTENDED if frame.is_extended_id else 0)


def read_candump(path: Path) -> str:
    """Return the frames of a log of candump as `candump -l` writes them."""
    lines = []
    for line in path.read_text(errors="replace").splitlines():
        printed = PRINTED_LINE.match(line)
        if printed:
            stamp, data = printed[1], "".join(printed[4].split())
            if "-" in stamp:  # candump -t A
                stamp = datetime.fromisoformat(f"{stamp}+00:00").timestamp()
            lines.append(f"({float(stamp):.6f}) {printed[2]} {printed[3]}#{data}")
        elif line.lstrip().startswith("("):
            lines.append(line.strip())
    return "\n".join(lines) + "\n"
