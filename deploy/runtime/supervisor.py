"""The parent of the loop: starts bus, policy and log, watches over them, shows what the outlet says, reports on timing.

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
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from deploy.guidance import LeverPositions, find_full_angles_rad
from deploy.page.loop_feed import PageProcessConfig
from deploy.page.settings import PageSettings
from deploy.recorder.capture import CaptureConfig
from deploy.runtime.operator_requests import RecordingControl, RequestHandler
from deploy.runtime.operator_state import LoopSnapshot, read_snapshot
from deploy.runtime.perception_process import CameraConfig
from deploy.runtime.process import ChildProcess
from deploy.runtime.process_group import PATIENCE_S, BusAndPolicySettings, ProcessGroup
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import DetectedTarget, TargetSelector

log = logging.getLogger(__name__)

PROCESSES, TIMING = "processes.json", "timing.json"
WATCH_S = 0.05


@spec
class DeploymentLoop(BusAndPolicySettings):
    """The loop on the machine: listens, advises, records; commands valves only where `commands` says so.

    Attributes (and those of `Listener`):
        target_s: Age of the borehole from which there is no advice.
        pitch_rad: Wanted pitch of the tool, for policies that ask for one; else `null`.
        commands: Whether the policy's advice is sent to the valves. `false`: nothing is ever sent.
        armed: Whether sending is armed from the beginning; the dead-man must be held all the same.
        record: Whether everything is recorded.
        seconds: When to stop; `null`: when told to.
        show: Whether to show levers and state in the terminal.
        page: The operator's page; `null`: none.
        camera: What is seen of the boreholes; `null`: there is no camera.
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
        """Runs until the time is over or a person stops it; leaves `processes.json` and `timing.json`.

        Args:
            machine: The machine.
            session: Where to write.
            companions: Further processes: the twin and a simulated operator of a bench.

        Raises:
            CheckpointError: the policy cannot be used on this machine.
            ConfigError: bus description or levers do not fit the machine.
            LinkError: bus or policy process died.
        """
        self.refuse(machine)
        memory = LoopMemory.new(
            machine.num_joints, self.commands, self.camera.num_px if self.camera else 0
        )
        children, recorder = (
            ProcessGroup(memory, self.realtime),
            self._recorder(memory, machine, session.folder),
        )
        try:
            for companion in companions:
                children.start(
                    companion.name, companion.target, companion.arguments, companion.realtime
                )
            self._start(children, machine, session)
            recorder.refresh()
            write_json(session.folder / PROCESSES, children.pids | recorder.pids)
            aim = TargetSelector(self.target.build(), memory.target, memory.holes)
            full_rad = find_full_angles_rad(self.guidance.levers or machine.levers)
            self._watch(
                children,
                memory,
                full_rad,
                RequestHandler(memory, recorder, aim, self.armed, self.commands),
            )
        except KeyboardInterrupt:
            log.info("stopping")
        finally:
            children.end()
            recorder.end(PATIENCE_S)
            _write_timing_report(memory, session)
            memory.close()

    def _start(self, children: ProcessGroup, machine: Machine, session: Session) -> None:
        self.listen(children, machine, self.target_s, self.pitch_rad)
        if self.page is not None:
            camera_s = self.camera.stale_s if self.camera else None
            beside = PageProcessConfig(
                self.page,
                machine,
                self.guidance,
                session,
                self.limits.joints_s,
                self.limits.levers_s,
                self.target_s,
                camera_s,
            )
            children.start("page", "deploy.page.loop_feed:run", (beside,))
        if self.camera is not None:
            children.start("camera", "deploy.runtime.perception_process:run", (self.camera,))

    def _recorder(self, memory: LoopMemory, machine: Machine, folder: Path) -> RecordingControl:
        facts = {"policy": self.policy, "source": f"{self.wire.interface} {self.wire.channel}"}

        def start(folder: Path) -> ChildProcess:
            capture = CaptureConfig(
                folder, self.dbc, machine, facts, self.camera.record_hz if self.camera else 0.0
            )
            return ChildProcess(
                "log", "deploy.recorder.capture:run", (capture, memory), memory.files
            )

        recorder = RecordingControl(memory, folder, start)
        recorder.wanted = self.record
        return recorder

    def _watch(
        self,
        children: ProcessGroup,
        memory: LoopMemory,
        full_rad: tuple[float, ...],
        wanted: RequestHandler,
    ) -> None:
        """Shows, does what is wanted and looks after the children until it is time to stop."""
        end_s = None if self.seconds is None else time.monotonic() + self.seconds
        with contextlib.ExitStack() as stack:
            live = (
                stack.enter_context(Live(console=Console(stderr=True), refresh_per_second=10))
                if self.show
                else None
            )
            while end_s is None or time.monotonic() < end_s:
                wanted.refresh()
                children.check()
                if live is not None:
                    live.update(build_table(read_snapshot(memory), full_rad))
                time.sleep(WATCH_S)


@dataclass(frozen=True)
class CompanionProcess:
    """A further process of a bench.

    Attributes:
        name: What it is.
        target: `module:function`, called as `function(stop, *arguments, memory)`.
        arguments: Its arguments.
        realtime: Real-time priority, where the loop asks for one: a machine is never late; `None`:
            an ordinary process.
    """

    name: str
    target: str
    arguments: tuple[Any, ...]
    realtime: int | None


def _write_timing_report(memory: LoopMemory, session: Session) -> None:
    """Writes `timing.json`, how each process kept its time, and says it in a line each."""
    reports = [json.loads(text) for text in memory.reports.take()]
    for one in reports:
        log.info(
            "%s: %d cycles of %.0f ms, %d missed, late by %.1f ms (99 %%), %.1f ms at most",
            one["process"], one["cycles"], 1e3 * one["period_s"], one["missed"], 1e3 * one["late_p99_s"], 1e3 * one["late_max_s"],
        )  # fmt: skip
    dropped = sum(pipe.dropped for pipe in memory.logs)
    write_json(
        session.folder / TIMING,
        {"processes": reports, "log_dropped": dropped, "last": read_snapshot(memory).plain()},
    )


WIDTH = 10
"""Characters from neutral to full."""


def build_table(view: LoopSnapshot, full_rad: tuple[float, ...]) -> Table:
    """Returns the view as a table; `full_rad` are the angles of the four axes at full deflection."""
    grid = Table.grid(padding=(0, 2))
    own = view.machine.levers if view.machine else None
    proposed = view.advice.levers.parts(full_rad) if view.advice else None
    for name in ("left_theta", "left_psi", "right_theta", "right_psi"):
        grid.add_row(
            name.replace("_", " "),
            _draw_bar(getattr(proposed, name, 0.0), "green"),
            _draw_bar(getattr(own, name, 0.0), "blue"),
        )
    grid.add_row("right button", _draw_button(proposed, "green"), _draw_button(own, "blue"))
    advice = "no policy yet" if view.advice is None else view.advice.reason
    safety = view.safety
    state = (
        "bus process silent"
        if safety is None or not view.alive
        else f"{safety.state.lower()}, {safety.trip}"
    )
    grid.add_row("advice", advice, f"safety: {state}")
    if view.machine is not None:
        grid.add_row(
            "joints",
            "  ".join(f"{q:+.3f}" for q in view.machine.q),
            f"{1e3 * min(view.machine.q_age_s, 9.999):.0f} ms old",
        )
    return grid


def _draw_bar(part: float, color: str) -> Text:
    """Draws -1 … 1 about the middle."""
    cells, filled = (
        [" "] * (2 * WIDTH + 1),
        round(max(-1.0, min(1.0, part if math.isfinite(part) else 0.0)) * WIDTH),
    )
    low, high = sorted((WIDTH, WIDTH + filled))
    cells[low : high + 1] = ["█"] * (high - low + 1)
    cells[WIDTH] = "│" if filled == 0 else "█"
    return Text("".join(cells), style=color)


def _draw_button(levers: LeverPositions | None, color: str) -> Text:
    held = levers is not None and levers.button_right
    return Text("■ held" if held else "□", style=color if held else "")
