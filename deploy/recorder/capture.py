"""The log process: writes messages and decisions, and flushes them to the disk twice a second.

MCAP holds every decoded message as a JSON topic of its name, `advice`, `guard`, `fault`, `bus`,
`holes`, and pictures of the camera as topic `camera` (`foxglove.CompressedImage`). BLF holds the
raw frames, for any tool that reads it. Times are monotonic ones plus one constant, so that a step
of the wall clock shows nowhere.
"""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
from can.io.blf import BLFWriter
from mcap.writer import CompressionType, Writer

from brokk_rl.errors import StorageError
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from deploy.bus.description import BusDescription, MessageLayout
from deploy.bus.protection import MessageFault
from deploy.picture import encode_jpeg
from deploy.runtime.bus_process import FRAME, FRAMES
from deploy.runtime.perception_process import read_frame
from deploy.runtime.process import Stop
from deploy.runtime.shared_memory import Slot
from deploy.runtime.shm_layout import LoopMemory, measure_wall_offset_ns

log = logging.getLogger(__name__)

POLL_S = 0.05
"""Between looks into the pipes, which hold minutes. Chosen by hand."""
FLUSH_S = 0.5
"""Time between two flushes: the longest piece that a power failure costs. Chosen by hand."""
MCAP, BLF = "capture.mcap", "frames.blf"
PICTURES = "camera"
"""Topic of the pictures."""
JPEG_QUALITY = 80
"""Chosen by hand: no loss that a person sees."""
EARLY = 0.9
"""Part of the time between pictures from which one is due: a camera's period is not exact."""
TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
BINARY = {"type": "string", "contentEncoding": "base64"}
"""Of Foxglove's schema of a picture: its viewer shows them."""
FACTS = "brokk"
"""Name of the metadata record."""


@dataclass(frozen=True)
class CaptureConfig:
    """Settings of a log process.

    Attributes:
        folder: For the files.
        dbc: The bus description.
        machine: The machine.
        facts: Further metadata: `source`, `policy`, …
        pictures_hz: Pictures of the camera a second; 0: none.
    """

    folder: Path
    dbc: str
    machine: Machine
    facts: dict[str, str]
    pictures_hz: float


def run(stop: Stop, capture: CaptureConfig, memory: LoopMemory) -> None:
    """Run until asked to stop, then empty the pipes once more.

    Those who write may go on unrecorded.

    Raises:
        StorageError: the disk is full, or the files cannot be written; the files stay readable up
            to there.
    """
    try:
        with CaptureWriter(capture) as target:
            asked, pictures = False, PictureSampler(memory.frame, capture.pictures_hz)
            while not asked:
                time.sleep(POLL_S)
                asked = stop()
                for pipe in memory.logs:
                    for data in pipe.take():
                        target.add(data)
                if (picture := pictures.due()) is not None:
                    target.add_picture(*picture)
                target.flush_when_due()
    except OSError as error:
        raise StorageError(
            f"log: {error.strerror or error} ({capture.folder}); nothing more is recorded"
        ) from error


class DurableBlfWriter(BLFWriter):
    """A BLF writer whose header is right after every flush, not only after closing."""

    def flush(self) -> None:
        """Write the buffer and the header."""
        self._flush()
        end = self.file.tell()
        self.file.seek(0)
        self._write_header(end)
        self.file.seek(end)
        self.file.flush()


class CaptureWriter:
    """Writes both files; a context manager."""

    def __init__(self, capture: CaptureConfig) -> None:
        self._description = BusDescription(capture.dbc, capture.machine)
        self._offset_ns = measure_wall_offset_ns()
        capture.folder.mkdir(parents=True, exist_ok=True)
        self._mcap_file = (capture.folder / MCAP).open("wb")
        self._mcap = Writer(self._mcap_file, compression=CompressionType.ZSTD)
        self._mcap.start(profile="brokk", library="brokk-rl")
        machine = capture.machine
        facts = {
            "schema": "1", "machine": machine.name, "fingerprint": json.dumps(machine.fingerprint()), "dbc": capture.dbc,
            "started_ns": str(time.time_ns()),
        }  # fmt: skip
        self._mcap.add_metadata(FACTS, facts | capture.facts)
        now_ns = time.time_ns()
        self._mcap.add_attachment(
            now_ns,
            now_ns,
            Path(capture.dbc).name,
            "text/plain",
            resolve_package_path(capture.dbc).read_bytes(),
        )
        self._blf = DurableBlfWriter(capture.folder / BLF)
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}
        self._flushed_s = time.monotonic()

    def add(self, data: bytes) -> None:
        """Take one record of a pipe."""
        if data[:1] == FRAMES:
            for t_s, frame_id, sent, payload in _iterate_frames(data[1:]):
                self._add_frame(t_s, frame_id, sent, payload)
        else:
            values = json.loads(data[1:])
            self._write(values.pop("topic"), values.pop("t_s"), values)

    def add_picture(self, t_s: float, data: bytes) -> None:
        """Take a JPEG of the camera."""
        wall_ns = int(t_s * 1e9) + self._offset_ns
        stamp = {"sec": wall_ns // 10**9, "nsec": wall_ns % 10**9}
        values = {
            "timestamp": stamp,
            "frame_id": "camera",
            "format": "jpeg",
            "data": base64.b64encode(data).decode(),
        }
        self._write(PICTURES, t_s, values)

    def flush_when_due(self) -> None:
        """Flush where it is time to."""
        now_s = time.monotonic()
        if now_s - self._flushed_s >= FLUSH_S:
            self._flushed_s = now_s
            self.flush()

    def flush(self) -> None:
        """Write everything to the disk."""
        self._mcap.flush()
        self._blf.flush()
        os.fsync(self._mcap_file.fileno())
        os.fsync(self._blf.file.fileno())

    def __enter__(self) -> CaptureWriter:
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(OSError):  # the disk may be full; flushed data is whole
            self._mcap.finish()
            self._blf.stop()
        with contextlib.suppress(OSError):
            self._mcap_file.close()

    def _add_frame(self, t_s: float, frame_id: int, sent: bool, payload: bytes) -> None:
        wall_s = (int(t_s * 1e9) + self._offset_ns) / 1e9
        layout = self._description.by_id.get(frame_id)
        extended = layout.extended if layout else frame_id > 0x7FF
        self._blf.on_message_received(
            can.Message(
                timestamp=wall_s,
                arbitration_id=frame_id,
                data=payload,
                is_extended_id=extended,
                is_rx=not sent,
                check=False,
            )
        )
        if layout is None:
            return
        values = self._description.decode(layout, payload)
        if isinstance(values, MessageFault):
            self._write(
                "refused",
                t_s,
                {"message": layout.name, "fault": values.value, "data": payload.hex()},
            )
        else:
            self._write(layout.name, t_s, values | {"sent": sent}, layout)

    def _write(
        self, topic: str, t_s: float, values: dict[str, Any], layout: MessageLayout | None = None
    ) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._mcap.register_channel(
                topic, "json", self._schema(topic, layout)
            )
            self._sequence[topic] = 0
        self._sequence[topic] += 1
        wall_ns = int(t_s * 1e9) + self._offset_ns
        text = json.dumps({"t_s": t_s, **values}).encode()
        self._mcap.add_message(self._channels[topic], wall_ns, text, wall_ns, self._sequence[topic])

    def _schema(self, topic: str, layout: MessageLayout | None) -> int:
        properties: dict[str, Any] = {
            "t_s": {"type": "number", "description": "monotonic time in s"}
        }
        for signal in self._description.signals(layout.name) if layout else ():
            properties[signal] = {
                "type": "number",
                "description": self._description.unit(layout.name, signal) if layout else "",
            }
        title = topic
        if topic == PICTURES:
            title = "foxglove.CompressedImage"
            text = {"type": "string"}
            properties |= {"timestamp": TIME, "data": BINARY, "frame_id": text, "format": text}
        schema = {"title": title, "type": "object", "properties": properties}
        return self._mcap.register_schema(title, "jsonschema", json.dumps(schema).encode())


class PictureSampler:
    """Takes pictures for the recording, at a limited rate.

    Args:
        slot: The camera's newest frame; `None`: there is none.
        rate_hz: Pictures a second; 0: none.
    """

    def __init__(self, slot: Slot | None, rate_hz: float) -> None:
        self._slot = slot if rate_hz > 0 else None
        self._apart_s, self._taken, self._next_s = 1.0 / rate_hz if rate_hz else 0.0, 0, 0.0

    def due(self) -> tuple[float, bytes] | None:
        """Return time and JPEG of the newest picture, if one is due."""
        now_s = time.monotonic()
        if self._slot is None or now_s < self._next_s or self._slot.number == self._taken:
            return None
        self._taken, self._next_s = self._slot.number, now_s + EARLY * self._apart_s
        record = self._slot.read()
        if record is None:
            return None
        frame = read_frame(record)
        return frame.t_s, encode_jpeg(frame.color, JPEG_QUALITY)


def _iterate_frames(data: bytes) -> Iterator[tuple[float, int, bool, bytes]]:
    at = 0
    while at < len(data):
        t_s, frame_id, sent, length = FRAME.unpack_from(data, at)
        at += FRAME.size
        yield t_s, frame_id, bool(sent), data[at : at + length]
        at += length
