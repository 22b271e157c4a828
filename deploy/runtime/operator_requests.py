"""Requests of the operator at the page: arm sending, record, choose a borehole.

The supervisor carries them out, some fifty times a second.
"""

from __future__ import annotations

import json
import logging
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from brokk_rl.errors import ConfigError
from deploy.recorder.capture import CaptureConfig
from deploy.runtime.operator_state import OperatorControls
from deploy.runtime.process import ChildProcess
from deploy.runtime.process_group import ProcessGroup
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import TargetPosition, TargetSelector

log = logging.getLogger(__name__)


class RecordingControl:
    """The log process, started and ended on request; each recording has a folder of its own.

    While none is running the pipes are emptied, so that nothing old is written later and nothing
    counts as lost.

    Args:
        group: The processes of the run.
        capture: Settings; the first recording goes into its folder, the next ones into
            `recording_2`, … in it.
        wanted: Whether a recording is to be running from the beginning.

    Attributes:
        wanted: Whether a recording is to be running.
        next_folder: Folder of the next recording, where it was given one.
        since_s: When the recording began, monotonic.
        failed: Whether the last recording has ended unasked.
    """

    def __init__(self, group: ProcessGroup, capture: CaptureConfig, wanted: bool) -> None:
        self._group, self._capture = group, capture
        self._child: ChildProcess | None = None
        self._number = 0
        # Set by the supervisor and by requests; `refresh` acts on it.
        self.wanted = wanted
        self.next_folder: Path | None = None
        self.since_s, self.failed = 0.0, False

    @property
    def recording(self) -> bool:
        """True while a log process is writing."""
        return self._child is not None and not self._child.asked_to_stop

    def refresh(self) -> None:
        """Start or end the log process as wanted."""
        child = self._child
        if child is not None and child.code is not None:
            # One that died is not started again by itself: that would hide the fault, and the group
            # raises the alarm.
            if not child.asked_to_stop:
                self.wanted, self.failed = False, True
            self._child = child = None
        if child is None and self.wanted:
            capture = replace(self._capture, folder=self._choose_folder())
            self._child = self._group.start("log", "deploy.recorder.capture:run", (capture,))
            self.since_s, self.failed = time.monotonic(), False
        elif child is not None and not self.wanted and not child.asked_to_stop:
            child.ask_to_stop()
        # The pipes fill while nothing is recorded; their writers would count losses.
        elif child is None:
            for pipe in self._group.memory.logs:
                for _ in pipe.take():
                    pass

    def _choose_folder(self) -> Path:
        # Numbered from 1: the first recording has the run folder itself.
        self._number += 1
        chosen, self.next_folder = self.next_folder, None
        if chosen is not None:
            return chosen
        folder = self._capture.folder
        return folder if self._number == 1 else folder / f"recording_{self._number}"


class RequestHandler:
    """Carries out requests and publishes the controls that follow from them.

    Args:
        memory: Where to read and write.
        recorder: Of this run.
        selector: Of the borehole that the advice is for.
        armed: Whether sending is armed from the beginning.
        commands: Whether anything is ever sent.
    """

    def __init__(
        self,
        memory: LoopMemory,
        recorder: RecordingControl,
        selector: TargetSelector,
        armed: bool,
        commands: bool,
    ) -> None:
        self._memory, self._recorder, self._selector = memory, recorder, selector
        self._armed, self._armed_s, self._commands = armed, time.monotonic(), commands

    def refresh(self) -> None:
        """Carry out new requests, and publish the controls."""
        for data in self._memory.requests.take():
            self._carry_out(json.loads(data))
        try:
            self._selector.refresh()
        except ConfigError as error:  # a faulty target file costs an alarm, not the run
            log.error("%s", error)
        self._recorder.refresh()
        recorder = self._recorder
        controls = OperatorControls(
            t_s=time.monotonic(),
            armed=self._armed,
            armed_t_s=self._armed_s,
            recording=recorder.recording,
            recording_t_s=recorder.since_s,
            recording_failed=recorder.failed,
        )
        self._memory.controls.write(controls)

    def _carry_out(self, request: dict) -> None:
        if request["kind"] == "record":
            self._recorder.wanted = request["value"] == "on"
            if "into" in request:
                self._recorder.next_folder = Path(request["into"])
        elif "center_in_base_m" in request:
            center_m = np.array(request["center_in_base_m"])
            place = TargetPosition(center_m, request["std_m"], request["seen_s"])
            self._selector.choose(place)
        else:
            # `commands` is a promise of the run's configuration that no request can break.
            self._armed = self._commands and request["kind"] == "start"
            # When the person asked for it, not when it is carried out: a stop may lie between.
            self._armed_s = float(request["asked_s"])
        log.info("requested: %s %s", request["kind"], request["value"])
