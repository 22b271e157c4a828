"""What the person at the page wants: sending armed, recording, which borehole. The supervisor does it, a few times a second."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from brokk_rl.errors import ConfigError
from deploy.runtime.process import ChildProcess
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import TargetPosition, TargetSelector

log = logging.getLogger(__name__)


class RecordingControl:
    """The log process, there or not as it is wanted; one at a time, each recording in a folder of its own.

    While there is none the pipes are emptied, so that nothing old is written later and nothing
    counts as lost.

    Args:
        memory: With the pipes.
        folder: Of the first recording; the next ones go into `recording_2`, … in it.
        start: Starts a log process that writes into a folder.
    """

    def __init__(
        self, memory: LoopMemory, folder: Path, start: Callable[[Path], ChildProcess]
    ) -> None:
        self._memory, self._folder, self._start = memory, folder, start
        self._child: ChildProcess | None = None
        self._asked, self._number = False, 0
        self.wanted = False
        self.into: Path | None = None
        """Folder of the next recording, where it has one of its own."""
        self.since_s = 0.0
        """When the recording began, monotonic."""

    @property
    def recording(self) -> bool:
        """Whether a log process is at work."""
        return self._child is not None and not self._asked

    @property
    def pids(self) -> dict[str, int]:
        """Its process id by its name, empty without one."""
        return {} if self._child is None else {"log": self._child.pid}

    def refresh(self) -> None:
        """Starts or ends the log process where that is wanted; one that died is an alarm, and not started again by itself."""
        child = self._child
        if child is not None and child.code is not None:
            if not self._asked:
                log.error(
                    "ALARM: the log has died (exit code %s); nothing is recorded any more",
                    child.code,
                )
                self.wanted = False
            self._child = child = None
        if child is None and self.wanted:
            self._number += 1
            folder = self.into or (
                self._folder if self._number == 1 else self._folder / f"recording_{self._number}"
            )
            self.into = None
            self._child, self._asked, self.since_s = self._start(folder), False, time.monotonic()
        elif child is not None and not self.wanted and not self._asked:
            child.ask_to_stop()
            self._asked = True
        elif child is None:
            for pipe in self._memory.logs:
                for _ in pipe.take():
                    pass

    def end(self, patience_s: float) -> None:
        """Ends it, once nobody has anything more to say."""
        if self._child is not None:
            self._child.end(patience_s)


class RequestHandler:
    """Takes wishes and writes the controls that follow from them.

    Args:
        memory: Where to read and write.
        recorder: Of this run.
        aim: Which borehole the advice is for.
        armed: Whether sending is armed from the beginning.
        commands: Whether anything is ever sent.
    """

    def __init__(
        self,
        memory: LoopMemory,
        recorder: RecordingControl,
        aim: TargetSelector,
        armed: bool,
        commands: bool,
    ) -> None:
        self._memory, self._recorder, self._aim = memory, recorder, aim
        self._armed, self._commands = armed, commands

    def refresh(self) -> None:
        """Takes what has come, and says how things stand."""
        for data in self._memory.wishes.take():
            wish = json.loads(data)
            if wish["kind"] == "record":
                self._recorder.wanted = wish["value"] == "on"
                self._recorder.into = Path(wish["into"]) if "into" in wish else self._recorder.into
            elif "center_in_base_m" in wish:
                self._aim.choose(
                    TargetPosition(np.array(wish["center_in_base_m"]), wish["std_m"], wish["t_s"])
                )
            else:
                self._armed = self._commands and wish["kind"] == "start"
            log.info("wished: %s %s", wish["kind"], wish["value"])
        try:
            self._aim.refresh()
        except ConfigError as error:  # a file that makes no sense costs an alarm, not the run
            log.error("%s", error)
        self._recorder.refresh()
        controls = self._memory.controls.new()
        controls["t_s"], controls["armed"] = time.monotonic(), self._armed
        controls["recording"], controls["recording_t_s"] = (
            self._recorder.recording,
            self._recorder.since_s,
        )
        self._memory.controls.write(controls)
