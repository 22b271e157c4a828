"""Control of the loop during a sitting: machine state, hole, pose of the twin, recording."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_json
from deploy.recorder import capture_reader
from deploy.recorder.capture import MCAP
from deploy.recorder.conversion import CaptureLogReader
from deploy.runtime.operator_state import AdviceStatus
from deploy.runtime.shm_layout import LoopMemory
from deploy.twin.faults import request_fault
from study.design import Hole

FRESH_S = 0.3
"""Age of positions and advice from which they are not there."""
CLOSING_S = 15.0
"""Longest wait for a capture to close before its content is read, s."""
GAP_S, LONGEST_GAP_S = 0.2, 1.0
"""Silence of the bus in a trial from which it is said, and the longest that is filled in between
its ends."""
FILLED = "filled"
"""Metadata of a recording that says so."""


@dataclass(frozen=True)
class MachineView:
    """Present state of the machine.

    Attributes:
        q: Joint positions, `(J,)`; `None` where nothing fresh is known.
        advised: Why there is no advice; `valid` where there is.
        recording: Whether it is recorded.
    """

    q: np.ndarray | None
    advised: str
    recording: bool


class Stage(Protocol):
    """Where trials take place."""

    def sight(self) -> MachineView:
        """Return the current state."""
        ...

    def prepare(self, hole: Hole, start: np.ndarray) -> None:
        """Make the hole known to the policy; a twin is put to the start, a machine has to be driven there."""
        ...

    def record(self, folder: Path | None) -> None:
        """Begin a recording in `folder`, or ends it."""
        ...

    def keep(self, folder: Path, begin_s: float, end_s: float) -> Recording:
        """Return the recording in `folder` between two times, once the recording has been closed.

        Where the bus was silent for a moment, positions go straight from one end of it to the
        other; the metadata `filled` says so.

        Raises:
            RecordingError: it cannot be used.
        """
        ...


class LoopStage:
    """The loop's machine or twin.

    Args:
        memory: Of the loop.
        machine: The machine.
        target: File that says to the loop where the hole is.
        port: Where the twin can be told to be put elsewhere; `None` on a machine.
    """

    def __init__(
        self, memory: LoopMemory, machine: Machine, target: Path, port: int | None
    ) -> None:
        self._memory, self._machine, self._target, self._port = memory, machine, target, port

    def sight(self) -> MachineView:
        """See `Stage`."""
        memory, now_s = self._memory, time.monotonic()
        state, advice, controls = memory.state.read(), memory.advice.read(), memory.controls.read()
        q, advised = None, AdviceStatus.NO_STATE
        if state is not None and now_s - state.q_t_s < FRESH_S and state.q_plausible:
            q = np.array(state.q)
        if advice is not None and now_s - advice.t_s < FRESH_S:
            advised = advice.reason
        return MachineView(q, advised.value, controls is not None and controls.recording)

    def prepare(self, hole: Hole, start: np.ndarray) -> None:
        """See `Stage`."""
        center = list(hole.center_in_base_m)
        write_json(self._target, {"center_in_base_m": center})
        if self._port is None:
            return
        try:
            place = {"q": start.tolist(), "hole_in_base_m": center}
            request_fault(self._port, {"place": place}, timeout_s=2.0)
        except OSError as error:
            raise RecordingError(
                f"the twin does not answer on port {self._port} ({error}); is it running?"
            ) from error

    def record(self, folder: Path | None) -> None:
        """See `Stage`."""
        request = {"kind": "record", "value": "off"}
        if folder is not None:
            request = {"kind": "record", "value": "on", "into": str(folder)}
        self._memory.requests.put(json.dumps(request).encode())

    def keep(self, folder: Path, begin_s: float, end_s: float) -> Recording:
        """See `Stage`."""
        path, patience_s = folder / MCAP, time.monotonic() + CLOSING_S
        while time.monotonic() < patience_s:
            if path.exists() and capture_reader.is_whole(path):
                break
            time.sleep(0.2)
        window = path, self._machine, begin_s, end_s
        try:
            return CaptureLogReader(longest_gap_s=GAP_S, shortest_s=0.0).between(*window)
        except RecordingError:
            found = CaptureLogReader(longest_gap_s=LONGEST_GAP_S, shortest_s=0.0).between(*window)
        text = f"silences of up to {LONGEST_GAP_S:g} s are filled in"
        return replace(found, metadata={**found.metadata, FILLED: text})
