"""The machine during a sitting, and the trial that runs on it, phase by phase."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from brokk_rl.errors import RecordingError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.session import write_json
from brokk_rl.spec import NonNegative, Positive, spec
from deploy.runtime.operator_state import AdviceStatus
from deploy.runtime.shm_layout import LoopMemory
from deploy.twin.faults import request_fault
from study import study_folder as folders
from study.design import Hole, Trial
from study.measures import find_insertion
from study.study_folder import StudyData

Phase = Literal["ready", "starting", "countdown", "running", "settling", "over"]
FRESH_S = 0.3
"""Age of positions and advice from which they are not there."""
LOST_S = 1.0
"""Time without positions after which a trial is aborted."""
STARTING_S = 10.0
"""Longest wait for a recording to begin, s."""


@spec
class Times:
    """Times and tolerance of a trial.

    Attributes:
        countdown_s: Time from the press on the page to the beginning.
        settle_s: Time for which a recording goes on after the end.
        start_tolerance: Distance from the start, rad or m, up to which the page shows a joint as
            being there.
    """

    countdown_s: NonNegative
    settle_s: NonNegative
    start_tolerance: Positive


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


class LoopStage:
    """The loop's machine or twin, where trials take place.

    Args:
        memory: Of the loop.
        target: File that says to the loop where the hole is.
        port: Where the twin can be told to be put elsewhere; `None` on a machine.
    """

    def __init__(self, memory: LoopMemory, target: Path, port: int | None) -> None:
        self._memory, self._target, self._port = memory, target, port

    def sight(self) -> MachineView:
        """Return the current state."""
        memory, now_s = self._memory, time.monotonic()
        state, advice, controls = memory.state.read(), memory.advice.read(), memory.controls.read()
        q, advised = None, AdviceStatus.NO_STATE
        if state is not None and now_s - state.q_t_s < FRESH_S and state.q_plausible:
            q = np.array(state.q)
        if advice is not None and now_s - advice.t_s < FRESH_S:
            advised = advice.reason
        return MachineView(q, advised.value, controls is not None and controls.recording)

    def prepare(self, hole: Hole, start: np.ndarray) -> None:
        """Make the hole known to the policy; a twin is put to the start, a machine has to be driven there."""
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
        """Begin a recording in `folder`, or end it."""
        request = {"kind": "record", "value": "off"}
        if folder is not None:
            request = {"kind": "record", "value": "on", "into": str(folder)}
        self._memory.requests.put(json.dumps(request).encode())


class Attempt:
    """The trial that runs now; see the module.

    Attributes:
        trial: The row of the plan.
        phase: Its phase.

    Args:
        data: The study.
        trial: The planned trial.
        machine: The machine.
        stage: Where it takes place.
        times: Countdown and the like.
        facts: Further fields of the trial.
        clock: Monotonic time, s.
    """

    def __init__(
        self,
        data: StudyData,
        trial: Trial,
        machine: Machine,
        stage: LoopStage,
        times: Times,
        facts: dict[str, Any],
        clock: Callable[[], float],
    ) -> None:
        self.trial = trial
        self._folder, self._design, self._machine = data.folder, data.design, machine
        self._stage, self._times, self._facts, self._clock = stage, times, facts, clock
        self._hole = data.design.holes[trial.hole]
        self._start = np.array(data.design.starts[trial.start])
        self.phase: Phase = "ready"
        # All clocks begin now, so that nothing has timed out before the first tick.
        self._since_s = self._began_s = self._seen_s = clock()
        self._path = Path()
        self._ended: dict[str, Any] = {"outcome": "", "reason": "", "seconds": 0.0}
        stage.prepare(self._hole, self._start)

    def begin(self) -> str:
        """Begin the recording, then the countdown; returns why not, where it cannot."""
        if self.phase != "ready":
            return "not now"
        if self._stage.sight().q is None:
            return "no positions"
        entry = {
            **asdict(self.trial),
            **self._facts,
            # Until the trial is over, its file describes it as interrupted.
            "outcome": "aborted",
            "reason": "interrupted: the sitting ended during the trial",
        }
        # On the disk before the recording begins: no capture is without a trial.
        self._path = folders.write_trial(self._folder, self.trial.name, entry)
        self._stage.record(self._folder.resolve() / folders.CAPTURES / self._path.stem)
        self._enter("starting")
        return ""

    def stop(self) -> str:
        """End the trial at the participant's wish; a trial that has not begun stays as it is."""
        if self.phase == "running":
            return self._end("stopped", "")
        return self.abort("stopped before it began")

    def abort(self, reason: str) -> str:
        """End the trial for a fault: it is kept, does not count, and is repeated."""
        if self.phase in ("starting", "countdown", "running"):
            return self._end("aborted", reason)
        return "not now"

    def tick(self) -> None:
        """Advance to the next phase where time, positions or recording allow it."""
        now_s, sight = self._clock(), self._stage.sight()
        in_phase_s = now_s - self._since_s
        # The time at which positions were last known.
        self._seen_s = now_s if sight.q is not None else self._seen_s
        if self.phase in ("countdown", "running") and now_s - self._seen_s > LOST_S:
            self.abort("positions stopped coming")
        elif self.phase == "starting" and sight.recording:
            self._enter("countdown")
        elif self.phase == "starting" and in_phase_s > STARTING_S:
            self.abort("the recording did not begin")
        elif self.phase == "countdown" and in_phase_s >= self._times.countdown_s:
            self._began_s = now_s
            self._enter("running")
        elif self.phase == "running" and sight.q is not None:
            tip_m = compute_tool_kinematics(self._machine, sight.q).tip_in_base_m
            # Inserted wins where both happen in one tick.
            if find_insertion(tip_m[None], self._hole, self._design.success) is not None:
                self._end("inserted", "")
            elif in_phase_s >= self._design.limit_s:
                self._end("time limit", "")
        elif self.phase == "settling" and in_phase_s >= self._times.settle_s:
            self.close()

    def view(self) -> dict[str, Any]:
        """Return the trial as plain data for the pages."""
        sight, joints = self._stage.sight(), []
        if sight.q is not None:
            for name, away in zip(self._machine.joint_names, sight.q - self._start, strict=True):
                is_there = bool(abs(away) <= self._times.start_tolerance)
                joints.append({"joint": name, "away": round(float(away), 3), "there": is_there})
        lasts_s = {"countdown": self._times.countdown_s, "running": self._design.limit_s}
        left_s = lasts_s.get(self.phase, 0.0) - (self._clock() - self._since_s)
        return {
            **asdict(self.trial),
            **self._ended,
            "phase": self.phase,
            "joints": joints,
            "advised": sight.advised,
            "left_s": round(max(0.0, left_s), 1),
        }

    def close(self) -> None:
        """End the recording, and write down which part of it is the trial."""
        if self.phase != "settling":
            return
        end_s = self._clock()
        self._stage.record(None)
        # Without a window there is nothing to keep: the trial never ran.
        if self._ended["seconds"]:
            capture = f"{folders.CAPTURES}/{self._path.stem}"
            window_s = [self._began_s, end_s]
            folders.update_record(self._path, {"capture": capture, "window_s": window_s})
        self._enter("over")

    def _enter(self, phase: Phase) -> None:
        self.phase, self._since_s = phase, self._clock()

    def _end(self, outcome: str, reason: str) -> str:
        has_run = self.phase == "running"
        # A trial that never ran took no time.
        seconds = round(self._clock() - self._began_s, 2) if has_run else 0.0
        self._ended = {"outcome": outcome, "reason": reason, "seconds": seconds}
        folders.update_record(self._path, self._ended)
        self._enter("settling")
        # Nothing to settle where nothing moved.
        if not has_run:
            self.close()
        return ""
