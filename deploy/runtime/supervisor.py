"""The parent of the loop: starts its processes, watches over them, and reports on timing.

A child that dies is not started again in secret: bus or policy end the run with an error, a dead
log is an alarm beside which guidance goes on. Whoever dies, the gateway goes to zero flow by
itself.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from deploy.guidance import LeverPositions, convert_to_positions, find_full_angles_rad
from deploy.page.loop_feed import PageProcessConfig
from deploy.page.settings import PageSettings
from deploy.recorder.capture import CaptureConfig
from deploy.runtime.operator_requests import RecordingControl, RequestHandler
from deploy.runtime.operator_state import LoopSnapshot
from deploy.runtime.perception_process import CameraConfig
from deploy.runtime.process import ChildProcess
from deploy.runtime.process_group import PATIENCE_S, BusAndPolicySettings, ProcessGroup
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import DetectedTarget, TargetSelector

log = logging.getLogger(__name__)

PROCESSES, TIMING = "processes.json", "timing.json"
"""Files in the run folder: process ids, and how each process kept its time."""
WATCH_S = 0.05
"""Between looks at requests and processes. Chosen by hand: quick for a person."""
TERMINAL_HZ = 10
"""Refresh rate of the terminal, as fast as a person can read it."""
BAR_WIDTH = 10
"""Characters of a lever bar from neutral to full."""
LARGEST_AGE_S = 9.999
"""Age above which the terminal shows no more digits."""


@spec
class DeploymentLoop(BusAndPolicySettings):
    """The loop on the machine: listens, advises, records; commands valves only if `commands`.

    Attributes (and those of `BusAndPolicySettings`):
        target_s: Age of the borehole from which there is no advice.
        pitch_rad: Wanted pitch of the tool, for policies that ask for one; else `null`.
        commands: Whether the policy's advice is sent to the valves. `false`: nothing is ever sent.
        armed: Whether sending is armed from the beginning; the dead-man must be held all the same.
        record: Whether everything is recorded.
        seconds: Length of the run; `null`: until told to stop.
        show: Whether to show levers and state in the terminal.
        page: The operator's page; `null`: none.
        camera: Camera beside the loop; `null`: there is none.
    """

    target_s: float
    pitch_rad: float | None
    commands: bool
    armed: bool
    record: bool
    seconds: float | None
    show: bool
    page: PageSettings | None
    camera: CameraConfig | None

    def check(self) -> None:
        if self.armed and not self.commands:
            raise ConfigError(
                "deploy.armed: nothing is ever sent in this mode; deploy=auto sends the policy's commands"
            )
        if self.seconds is not None and self.seconds <= 0:
            raise ConfigError(f"deploy.seconds: expected more than 0, or null, got {self.seconds}")
        if isinstance(self.target, DetectedTarget) and (
            self.camera is None or self.camera.finder is None
        ):
            raise ConfigError(
                "target=seen: there is no camera that looks for boreholes; choose camera=… as well"
            )

    def run(
        self, machine: Machine, session: Session, companions: Sequence[CompanionProcess]
    ) -> None:
        """Run until the time is over or a person stops it.

        Writes `processes.json` and `timing.json`.

        Args:
            machine: The machine.
            session: Where to write.
            companions: Further processes: the twin and a simulated operator of a bench.

        Raises:
            CheckpointError: the policy cannot be used on this machine.
            ConfigError: bus description or levers do not fit the machine.
            LinkError: bus or policy process died.
        """
        self.check_machine(machine)
        frame_px = self.camera.num_px if self.camera else 0
        memory = LoopMemory.new(machine.num_joints, self.commands, frame_px)
        group = ProcessGroup(memory, self.realtime)
        recorder = self._build_recorder(memory, machine, session.folder)
        try:
            # Companions first: the loop then finds its bus in use from the beginning.
            for one in companions:
                group.start(one.name, one.target, one.arguments, one.realtime)
            self._start(group, machine, session)
            recorder.refresh()
            # Process ids are written before the loop runs, for tools that watch it from outside.
            write_json(session.folder / PROCESSES, group.pids | recorder.pids)
            selector = TargetSelector(self.target.build(), memory.target, memory.holes)
            handler = RequestHandler(memory, recorder, selector, self.armed, self.commands)
            full_rad = find_full_angles_rad(self.guidance.levers or machine.levers)
            self._watch(group, memory, full_rad, handler)
        except KeyboardInterrupt:
            log.info("stopping")
        finally:
            # The order matters: the log is ended last, so that it records how the others ended.
            group.end()
            recorder.end(PATIENCE_S)
            # Also after an error: the timing often explains it.
            _write_timing_report(memory, session)
            memory.close()

    def _start(self, group: ProcessGroup, machine: Machine, session: Session) -> None:
        self.start_processes(group, machine, self.target_s, self.pitch_rad)
        if self.page is not None:
            config = self.build_page_config(self.page, machine, session)
            group.start("page", "deploy.page.loop_feed:run", (config,))
        if self.camera is not None:
            group.start("camera", "deploy.runtime.perception_process:run", (self.camera,))

    def build_page_config(
        self, page: PageSettings, machine: Machine, session: Session
    ) -> PageProcessConfig:
        """Return the settings of the process that serves `page` beside this loop."""
        return PageProcessConfig(
            page=page,
            machine=machine,
            guidance=self.guidance,
            session=session,
            positions_s=self.limits.joints_s,
            levers_s=self.limits.levers_s,
            borehole_s=self.target_s,
            camera_s=self.camera.stale_s if self.camera else None,
        )

    def _build_recorder(
        self, memory: LoopMemory, machine: Machine, folder: Path
    ) -> RecordingControl:
        # These facts go into every recording, so that it can be read without the run folder.
        facts = {"policy": self.policy, "source": f"{self.wire.interface} {self.wire.channel}"}
        pictures_hz = self.camera.record_hz if self.camera else 0.0

        def start(folder: Path) -> ChildProcess:
            capture = CaptureConfig(folder, self.dbc, machine, facts, pictures_hz)
            target = "deploy.recorder.capture:run"
            return ChildProcess("log", target, (capture, memory), memory.files)

        recorder = RecordingControl(memory, folder, start)
        recorder.wanted = self.record
        return recorder

    def _watch(
        self, group: ProcessGroup, memory: LoopMemory, full_rad: np.ndarray, handler: RequestHandler
    ) -> None:
        """Carry out requests, watch the processes and show the state, until it is time to stop."""
        end_s = None if self.seconds is None else time.monotonic() + self.seconds
        with contextlib.ExitStack() as stack:
            live = None
            if self.show:
                # On stderr: stdout belongs to the command's result.
                console = Console(stderr=True)
                live = stack.enter_context(Live(console=console, refresh_per_second=TERMINAL_HZ))
            # Times are monotonic: a clock that is set must not end a run.
            while end_s is None or time.monotonic() < end_s:
                handler.refresh()
                group.check()
                if live is not None:
                    live.update(build_table(memory.read_snapshot(), full_rad))
                time.sleep(WATCH_S)


@dataclass(frozen=True)
class CompanionProcess:
    """A further process of a bench.

    Attributes:
        name: Of the process.
        target: `module:function`, called as `function(stop, *arguments, memory)`.
        arguments: Its arguments.
        realtime: Real-time priority, where the loop asks for one: a machine is never late; `None`:
            an ordinary process.
    """

    name: str
    target: str
    arguments: tuple[Any, ...]
    realtime: int | None


class BenchSpec(Protocol):
    """A spec in `conf/bench`: stands in for machine and operator on a desk."""

    def companions(self, machine: Machine, session: Session) -> Sequence[CompanionProcess]:
        """Return the processes to run beside the loop."""
        ...


def _write_timing_report(memory: LoopMemory, session: Session) -> None:
    """Write `timing.json` and log a line for each process."""
    reports = [json.loads(text) for text in memory.reports.take()]
    for one in reports:
        log.info(
            "%s: %d cycles of %.0f ms, %d missed, late by %.1f ms (99 %%), %.1f ms at most",
            one["process"],
            one["cycles"],
            1e3 * one["period_s"],
            one["missed"],
            1e3 * one["late_p99_s"],
            1e3 * one["late_max_s"],
        )
    last = memory.read_snapshot()
    report = {"processes": reports, "log_dropped": last.log_dropped, "last": last.to_plain()}
    write_json(session.folder / TIMING, report)


def build_table(snapshot: LoopSnapshot, full_rad: np.ndarray) -> Table:
    """Return levers and safety as a table, for a desk without the operator's page.

    Args:
        snapshot: State and advice.
        full_rad: Angles of the four axes at full deflection, `(4,)`.
    """
    # The terminal's table is a stand-in; see `deploy.page` for the real one.
    grid = Table.grid(padding=(0, 2))
    state, advice = snapshot.state, snapshot.advice
    own = state.levers if state else None
    proposed = None
    if advice is not None:
        proposed = convert_to_positions(advice.lever_rad, full_rad, advice.button_right)
    for name in ("left_theta", "left_psi", "right_theta", "right_psi"):
        grid.add_row(
            name.replace("_", " "),
            _draw_bar(getattr(proposed, name, 0.0), "green"),
            _draw_bar(getattr(own, name, 0.0), "blue"),
        )
    grid.add_row("right button", _draw_button(proposed, "green"), _draw_button(own, "blue"))
    reason = "no policy yet" if advice is None else advice.reason.value
    safety = "bus process silent"
    if state is not None and snapshot.alive:
        safety = f"{state.guard.name.lower()}, {state.trip.value}"
    grid.add_row("advice", reason, f"safety: {safety}")
    if state is not None:
        joints = "  ".join(f"{q:+.3f}" for q in state.q)
        # An age of many digits would make the columns jump.
        age_s = min(snapshot.t_s - state.q_t_s, LARGEST_AGE_S)
        grid.add_row("joints", joints, f"{1e3 * age_s:.0f} ms old")
    return grid


def _draw_bar(part: float, color: str) -> Text:
    """Draw a bar from the middle to `part` of full, in [-1, 1]."""
    # NaN is a lever that is not known; it is drawn in neutral.
    shown = max(-1.0, min(1.0, part)) if math.isfinite(part) else 0.0
    filled = round(shown * BAR_WIDTH)
    cells = [" "] * (2 * BAR_WIDTH + 1)
    low, high = sorted((BAR_WIDTH, BAR_WIDTH + filled))
    cells[low : high + 1] = ["█"] * (high - low + 1)
    cells[BAR_WIDTH] = "│" if filled == 0 else "█"
    return Text("".join(cells), style=color)


def _draw_button(levers: LeverPositions | None, color: str) -> Text:
    held = levers is not None and levers.button_right
    return Text("■ held" if held else "□", style=color if held else "")
