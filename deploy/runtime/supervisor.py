"""The parent of the loop: starts bus, policy and log, watches over them, shows what the outlet says, reports on timing.

A child that dies is not started again in secret: bus or policy end the run with an error, a dead
log is an alarm beside which guidance goes on. Whoever dies, the gateway goes to zero flow by
itself.
"""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from deploy.guidance import full_angles_rad
from deploy.page.from_loop import Beside
from deploy.page.settings import OperatorPage
from deploy.recorder.capture import Capture
from deploy.runtime.operator_requests import Recorder, Wanted
from deploy.runtime.operator_state import view
from deploy.runtime.perception_process import CameraConfig
from deploy.runtime.process import Child
from deploy.runtime.process_group import PATIENCE_S, Children, Listener
from deploy.runtime.shm_layout import Exchange
from deploy.runtime.target import DetectedTarget, TargetSelector
from deploy.runtime.terminal import table

log = logging.getLogger(__name__)

PROCESSES, TIMING = "processes.json", "timing.json"
WATCH_S = 0.05


@spec
class Loop(Listener):
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
    page: OperatorPage | None
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

    def run(self, machine: Machine, session: Session, companions: Sequence[Companion]) -> None:
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
        exchange = Exchange.new(
            machine.num_joints, self.commands, self.camera.num_px if self.camera else 0
        )
        children, recorder = (
            Children(exchange, self.realtime),
            self._recorder(exchange, machine, session.folder),
        )
        try:
            for companion in companions:
                children.start(
                    companion.name, companion.target, companion.arguments, companion.realtime
                )
            self._start(children, machine, session)
            recorder.refresh()
            write_json(session.folder / PROCESSES, children.pids | recorder.pids)
            aim = TargetSelector(self.target.build(), exchange.target, exchange.holes)
            full_rad = full_angles_rad(self.guidance.levers or machine.levers)
            self._watch(
                children,
                exchange,
                full_rad,
                Wanted(exchange, recorder, aim, self.armed, self.commands),
            )
        except KeyboardInterrupt:
            log.info("stopping")
        finally:
            children.end()
            recorder.end(PATIENCE_S)
            _report(exchange, session)
            exchange.close()

    def _start(self, children: Children, machine: Machine, session: Session) -> None:
        self.listen(children, machine, self.target_s, self.pitch_rad)
        if self.page is not None:
            camera_s = self.camera.stale_s if self.camera else None
            beside = Beside(
                self.page,
                machine,
                self.guidance,
                session,
                self.limits.joints_s,
                self.limits.levers_s,
                self.target_s,
                camera_s,
            )
            children.start("page", "deploy.page.from_loop:run", (beside,))
        if self.camera is not None:
            children.start("camera", "deploy.runtime.perception_process:run", (self.camera,))

    def _recorder(self, exchange: Exchange, machine: Machine, folder: Path) -> Recorder:
        facts = {"policy": self.policy, "source": f"{self.wire.interface} {self.wire.channel}"}

        def start(folder: Path) -> Child:
            capture = Capture(
                folder, self.dbc, machine, facts, self.camera.record_hz if self.camera else 0.0
            )
            return Child("log", "deploy.recorder.capture:run", (capture, exchange), exchange.files)

        recorder = Recorder(exchange, folder, start)
        recorder.wanted = self.record
        return recorder

    def _watch(
        self, children: Children, exchange: Exchange, full_rad: tuple[float, ...], wanted: Wanted
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
                    live.update(table(view(exchange), full_rad))
                time.sleep(WATCH_S)


@dataclass(frozen=True)
class Companion:
    """A further process of a bench.

    Attributes:
        name: What it is.
        target: `module:function`, called as `function(stop, *arguments, exchange)`.
        arguments: Its arguments.
        realtime: Real-time priority, where the loop asks for one: a machine is never late; `None`:
            an ordinary process.
    """

    name: str
    target: str
    arguments: tuple[Any, ...]
    realtime: int | None


def _report(exchange: Exchange, session: Session) -> None:
    """Writes `timing.json`, how each process kept its time, and says it in a line each."""
    reports = [json.loads(text) for text in exchange.reports.take()]
    for one in reports:
        log.info(
            "%s: %d cycles of %.0f ms, %d missed, late by %.1f ms (99 %%), %.1f ms at most",
            one["process"], one["cycles"], 1e3 * one["period_s"], one["missed"], 1e3 * one["late_p99_s"], 1e3 * one["late_max_s"],
        )  # fmt: skip
    dropped = sum(pipe.dropped for pipe in exchange.logs)
    write_json(
        session.folder / TIMING,
        {"processes": reports, "log_dropped": dropped, "last": view(exchange).plain()},
    )
