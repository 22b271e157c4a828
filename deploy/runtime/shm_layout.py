"""Layout of the memory that the processes of the loop share.

`J` joints; times are monotonic, in s, and 0 where nothing has come.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping

import numpy as np

from brokk_rl.contracts.vision import CameraView
from deploy.runtime.operator_state import (
    LoopSnapshot,
    OperatorControls,
    OperatorState,
    PageSignal,
    PolicyAdvice,
    RequestedCommand,
)
from deploy.runtime.shared_memory import Pipe, RecordSlot, Slot

LOG_BYTES = 8 << 20
"""Size of each pipe to the log: about two minutes of a full bus, so that a slow disk costs nothing."""
VISION_LOG_BYTES = 1 << 20
"""Size of perception's pipe to the log, a short text a frame. Chosen by hand."""
REQUEST_BYTES = 1 << 12
"""Size of the pipe for the page's requests, which the supervisor takes 50 times a second. Chosen by hand."""
REPORT_BYTES = 1 << 16
"""Size of the pipe for the processes' reports on their timing, one each. Chosen by hand."""
TEXT = b"J"
"""First byte of a text in a pipe to the log."""
MOST_HOLES = 8
"""Boreholes that perception hands on, the surest first. Chosen by hand."""

HOLE = np.dtype(
    [
        ("name", np.uint16),
        ("center_in_base_m", float, (3,)),
        ("axis_in_base", float, (3,)),
        ("radius_m", float),
        ("std_m", float),
        ("score", float),  # probability that it is one, in [0, 1]
        ("t_s", float),  # when it was seen last
    ]
)
"""A borehole that perception knows."""

HOLES = np.dtype([("t_s", float), ("count", np.uint8), ("holes", HOLE, (MOST_HOLES,))])
"""All boreholes that perception knows."""

TARGET = np.dtype([("t_s", float), ("center_in_base_m", float, (3,)), ("std_m", float)])
"""The borehole to drill: when it was found, the centre of its rim, and its standard deviation."""


def build_frame_fields(num_px: int) -> np.dtype:
    """Return the fields of a frame of at most `num_px` pixels; see `brokk_rl.signals.Frame`."""
    return np.dtype(
        [
            ("t_s", float),
            ("width", np.uint16),
            ("height", np.uint16),
            ("color", np.uint8, (num_px, 3)),  # RGB, row by row
            ("depth_m", np.float32, (num_px,)),  # NaN where unknown
            ("camera_matrix", float, (3, 3)),
            ("base_from_camera", float, (4, 4)),  # NaN where nobody knows it
        ]
    )


class LoopMemory:
    """All memory that the processes of a run share; each process gets the same object.

    Args:
        num_joints: Of the machine.
        commands: Without, there is no way from any process to the valves.
        frame_px: Pixels of a camera's frame; 0: no camera.

    Attributes:
        state: From the bus process.
        advice: From the policy.
        request: Commands to be sent; `None` where nothing ever is.
        target: The borehole.
        controls: From the operator's side.
        page: From the page, straight to the bus process.
        frame: Newest frame of the camera.
        holes: Boreholes that perception knows.
        view: Where a moving camera looks.
        bus_log: From the bus process to the log.
        policy_log: From the policy to the log.
        page_log: From the operator's page to the log.
        vision_log: From perception to the log.
        requests: From the operator's page to the supervisor, a JSON text each.
        reports: On each process's timing, one after the other, written when it ends.
    """

    def __init__(self, num_joints: int, commands: bool, frame_px: int = 0) -> None:
        self.state = RecordSlot("state", OperatorState, num_joints)
        self.advice = RecordSlot("advice", PolicyAdvice, num_joints)
        self.request = RecordSlot("request", RequestedCommand, num_joints) if commands else None
        self.target = Slot("target", TARGET)
        self.controls = RecordSlot("controls", OperatorControls, num_joints)
        self.page = RecordSlot("page", PageSignal, num_joints)
        self.frame = Slot("frame", build_frame_fields(frame_px))
        self.holes = Slot("holes", HOLES)
        self.view = RecordSlot("view", CameraView, num_joints)
        self.bus_log = Pipe("bus_log", LOG_BYTES)
        self.policy_log = Pipe("policy_log", LOG_BYTES)
        self.page_log = Pipe("page_log", LOG_BYTES)
        self.vision_log = Pipe("vision_log", VISION_LOG_BYTES)
        self.requests = Pipe("requests", REQUEST_BYTES)
        self.reports = Pipe("reports", REPORT_BYTES)

    @property
    def logs(self) -> tuple[Pipe, ...]:
        """Pipes to the log."""
        return self.bus_log, self.policy_log, self.page_log, self.vision_log

    @property
    def files(self) -> list[int]:
        """File descriptors that child processes inherit."""
        return [part.memory.fd for part in vars(self).values() if part is not None]

    def read_snapshot(self) -> LoopSnapshot:
        """Return the newest state and advice."""
        state, advice = self.state.read(), self.advice.read()
        dropped = sum(pipe.dropped for pipe in self.logs)
        return LoopSnapshot(time.monotonic(), state, advice, self.request is not None, dropped)

    def close(self) -> None:
        """Unmap and close all of it."""
        for part in vars(self).values():
            if part is not None:
                part.memory.close()


def log_text(pipe: Pipe, topic: str, t_s: float, values: Mapping[str, object]) -> None:
    """Put a decision into a pipe to the log, as a JSON text with topic and time."""
    pipe.put(TEXT + json.dumps({"topic": topic, "t_s": t_s, **values}).encode())


def measure_wall_offset_ns() -> int:
    """Return the difference of wall clock and monotonic clock.

    Taken once: a later step of the wall clock changes nothing.
    """
    return time.time_ns() - time.monotonic_ns()
