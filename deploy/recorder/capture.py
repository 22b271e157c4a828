"""The log process: writes messages and decisions, and flushes them to the disk twice a second.

MCAP holds every decoded message of the bus as a topic of its name, and the decisions of all
processes, as protobuf messages with complete schemas (`topics`). Beside them stand Foxglove's own
messages (`camera_topics`), from which Foxglove and Rerun show pictures and points. Times are monotonic ones
plus one constant, so that a step of the wall clock shows nowhere.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from brokk_rl.errors import StorageError
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from brokk_rl.signals import Frame
from deploy.bus.description import BusDescription, MessageLayout
from deploy.kernel.bus_process import FRAME, FRAMES
from deploy.kernel.protection import MessageFault
from deploy.recorder.camera_topics import encode_frame
from deploy.recorder.topics import TIME, TOPICS, TopicSchema, describe_bus_fields
from deploy.runtime.perception_process import read_newer_frame
from deploy.runtime.process import Stop
from deploy.runtime.shared_memory import Slot
from deploy.runtime.shm_layout import LoopMemory, measure_wall_offset_ns

log = logging.getLogger(__name__)

POLL_S = 0.05
"""Between looks into the pipes, which hold minutes. Chosen by hand."""
FLUSH_S = 0.5
"""Time between two flushes: the longest piece that a power failure costs. Chosen by hand."""
MCAP = "capture.mcap"
EARLY = 0.9
"""Part of the time between pictures from which one is due: a camera's period is not exact."""
FACTS, NUM_FACTS = "brokk", 3
"""Name of the metadata record, and how often it begins a capture: the majority counts."""


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
                if (frame := pictures.due()) is not None:
                    target.add_frame(frame)
                target.flush_when_due()
    except OSError as error:
        raise StorageError(
            f"log: {error.strerror or error} ({capture.folder}); nothing more is recorded"
        ) from error


class CaptureWriter:
    """Writes the file; a context manager."""

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
        self._facts = facts | capture.facts
        # Without them no capture can be read, and one wrong byte spoils one of them.
        for _ in range(NUM_FACTS):
            self._mcap.add_metadata(FACTS, self._facts)
        now_ns, dbc = time.time_ns(), resolve_package_path(capture.dbc).read_bytes()
        self._mcap.add_attachment(now_ns, now_ns, Path(capture.dbc).name, "text/plain", dbc)
        self._schemas: dict[str, TopicSchema] = {}
        self._channels: dict[str, int] = {}
        self._flushed_s = time.monotonic()

    def add(self, data: bytes) -> None:
        """Take one record of a pipe."""
        if data[:1] == FRAMES:
            for t_s, frame_id, sent, payload in _iterate_frames(data[1:]):
                self._add_frame(t_s, frame_id, sent, payload)
        else:
            values = json.loads(data[1:])
            topic, t_s = values.pop("topic"), values.pop("t_s")
            self._write(topic, t_s, values)

    def add_frame(self, frame: Frame) -> None:
        """Take a frame of the camera."""
        for topic, message in encode_frame(frame):
            message.timestamp.FromNanoseconds(int(frame.t_s * 1e9) + self._offset_ns)
            name, data = message.DESCRIPTOR.full_name, message.SerializeToString()
            schema = build_file_descriptor_set(message).SerializeToString()
            self._write_message(topic, frame.t_s, name, schema, data)

    def flush_when_due(self) -> None:
        """Flush where it is time to."""
        now_s = time.monotonic()
        if now_s - self._flushed_s >= FLUSH_S:
            self._flushed_s = now_s
            self.flush()

    def flush(self) -> None:
        """Write everything to the disk."""
        self._mcap.flush()
        os.fsync(self._mcap_file.fileno())

    def __enter__(self) -> CaptureWriter:
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(OSError):  # the disk may be full; flushed data is whole
            # Again at the end: the beginning may be lost whole.
            self._mcap.add_metadata(FACTS, self._facts)
            self._mcap.finish()
        with contextlib.suppress(OSError):
            self._mcap_file.close()

    def _add_frame(self, t_s: float, frame_id: int, sent: bool, payload: bytes) -> None:
        layout = self._description.by_id.get(frame_id)
        if layout is None:
            return
        values = self._description.decode(layout, payload)
        if isinstance(values, MessageFault):
            refused = {"message": layout.name, "fault": values.value, "data": payload.hex()}
            self._write("refused", t_s, refused)
        else:
            self._write(layout.name, t_s, values | {"sent": sent}, layout)

    def _write(
        self, topic: str, t_s: float, values: dict[str, Any], layout: MessageLayout | None = None
    ) -> None:
        if topic not in self._schemas:
            fields = describe_bus_fields(self._description, layout) if layout else TOPICS[topic]
            self._schemas[topic] = TopicSchema(topic, fields)
        schema = self._schemas[topic]
        given = {name: value for name, value in values.items() if value is not None}
        self._write_message(
            topic, t_s, schema.name, schema.data, schema.encode({TIME: t_s, **given})
        )

    def _write_message(
        self, topic: str, t_s: float, schema: str, schema_data: bytes, data: bytes
    ) -> None:
        """Write a protobuf message; the first one of a topic decides its schema."""
        if topic not in self._channels:
            number = self._mcap.register_schema(schema, "protobuf", schema_data)
            self._channels[topic] = self._mcap.register_channel(topic, "protobuf", number)
        wall_ns = int(t_s * 1e9) + self._offset_ns
        self._mcap.add_message(self._channels[topic], wall_ns, data, wall_ns)


class PictureSampler:
    """Takes pictures for the recording, at a limited rate.

    Args:
        slot: The camera's newest frame.
        rate_hz: Pictures a second; 0: none.
    """

    def __init__(self, slot: Slot, rate_hz: float) -> None:
        self._slot, self._apart_s = slot, EARLY / rate_hz if rate_hz else math.inf
        self._taken_s, self._next_s = -math.inf, 0.0 if rate_hz else math.inf

    def due(self) -> Frame | None:
        """Return the newest frame, if one is due."""
        now_s = time.monotonic()
        frame = read_newer_frame(self._slot, self._taken_s) if now_s >= self._next_s else None
        if frame is not None:
            self._taken_s, self._next_s = frame.t_s, now_s + self._apart_s
        return frame


def _iterate_frames(data: bytes) -> Iterator[tuple[float, int, bool, bytes]]:
    at = 0
    while at < len(data):
        t_s, frame_id, sent, length = FRAME.unpack_from(data, at)
        at += FRAME.size
        yield t_s, frame_id, bool(sent), data[at : at + length]
        at += length
