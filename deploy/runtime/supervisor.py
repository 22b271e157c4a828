"""The parent of the loop: starts its processes, watches over them, and reports on timing.

A process that dies is never restarted. If it is the bus or the policy, the run ends with an error.
If it is the log, guidance goes on with an alarm. In any case the gateway sets zero flow by itself.
"""

from __future__ import annotations

import json
import logging
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import Positive, spec
from deploy.bus.description import BusDescription
from deploy.guard_setup import build_envelope, read_observer_content
from deploy.page.loop_feed import PageProcessConfig
from deploy.page.settings import PageSettings
from deploy.recorder.capture import CaptureConfig
from deploy.runtime.detached_log import detach_logging
from deploy.runtime.operator_requests import RecordingControl, RequestHandler
from deploy.runtime.perception_process import CameraConfig
from deploy.runtime.process import ask_for_priority, give_up_priority
from deploy.runtime.process_group import OPTIONAL, BusAndPolicySettings, ProcessGroup
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import DetectedTarget, TargetSelector
from deploy.video.settings import VideoSettings

log = logging.getLogger(__name__)

PROCESSES, TIMING = "processes.json", "timing.json"
"""Files in the run folder: process ids, and how each process kept its time."""
WATCH_S = 0.02
"""Between looks at requests and processes: a quarter of the guard's limit for the switches."""
SUPERVISOR_PRIORITY = 30
"""Priority of the supervisor under SCHED_FIFO, below all that depend on it. The guard latches when
the supervisor's switches are older than 0.08 s, so it must not wait for other work. Its children do
not inherit it."""


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
        page: The operator's page; `null`: none.
        camera: Camera beside the loop; `null`: there is none.
        video: Live video on the page; `null`: none.
    """

    target_s: Positive
    pitch_rad: float | None
    commands: bool
    armed: bool
    record: bool
    seconds: Positive | None
    page: PageSettings | None
    camera: CameraConfig | None
    video: VideoSettings | None

    def check(self) -> None:
        if self.armed and not self.commands:
            raise ConfigError(
                "armed: nothing is ever sent in this mode; deploy=auto sends the policy's commands"
            )
        if self.video is not None and self.page is None:
            raise ConfigError("video: there is no page to show it; choose page=… as well")
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
            ConfigError: bus description, levers or the observer's file do not fit the machine.
            FrameError: the camera's folder holds no frames.
            LinkError: bus or policy process died.
        """
        self._check_parts(machine)
        frame_px = self.camera.num_px if self.camera else 0
        # These facts go into every recording, so that it can be read without the run folder.
        facts = {"policy": self.policy, "source": f"{self.wire.interface} {self.wire.channel}"}
        pictures_hz = self.camera.record_hz if self.camera else 0.0
        capture = CaptureConfig(session.folder, self.dbc, machine, facts, pictures_hz)
        with detach_logging(), tempfile.TemporaryDirectory(prefix="brokk-") as sockets:
            memory = LoopMemory(machine.num_joints, self.commands, frame_px)
            group = ProcessGroup(memory, self.realtime, OPTIONAL)
            recorder = RecordingControl(group, capture, wanted=self.record)
            try:
                # Companions first: the loop then finds its bus in use from the beginning.
                for one in companions:
                    group.start(one.name, one.target, one.arguments, one.realtime)
                self._start(group, machine, session, sockets)
                if self.realtime:
                    ask_for_priority(SUPERVISOR_PRIORITY, inherited=False)
                recorder.refresh()
                # Process ids are written before the loop runs, for tools that watch it from outside.
                write_json(session.folder / PROCESSES, group.pids)
                selector = TargetSelector(self.target.build(), memory.target, memory.holes)
                handler = RequestHandler(memory, recorder, selector, self.armed, self.commands)
                self._watch(group, handler)
            except KeyboardInterrupt:
                log.info("stopping")
            finally:
                if self.realtime:
                    give_up_priority()
                group.end()
                # Also after an error: the timing often explains it.
                _write_timing_report(memory, session)
                memory.close()

    def _check_parts(self, machine: Machine) -> None:
        """Check before any process runs that all parts of the loop can."""
        self.check_machine(machine)
        if self.commands:
            BusDescription(self.dbc, machine).check_protection()
            read_observer_content(self.limits, machine, self.wire.interface, commands=True)
            build_envelope(self.limits, machine, commands=True)
        if self.video is not None:
            self.video.require_packages()
        if self.camera is not None:
            self.camera.check_frames()

    def _start(self, group: ProcessGroup, machine: Machine, session: Session, sockets: str) -> None:
        needs_page = self.page is not None
        self.start_processes(group, machine, self.target_s, self.pitch_rad, needs_page)
        if self.page is not None:
            config = self.build_page_config(self.page, machine, session)
            if self.video is not None:
                config = replace(config, video_folder=sockets)
                group.start("video", "deploy.video.video_process:run", (self.video, sockets))
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
            limits=self.limits,
            borehole_s=self.target_s,
            camera_s=self.camera.stale_s if self.camera else None,
        )

    def _watch(self, group: ProcessGroup, handler: RequestHandler) -> None:
        """Carry out requests and watch the processes, until it is time to stop."""
        # Times are monotonic: a clock that is set must not end a run.
        end_s = time.monotonic() + (self.seconds or math.inf)
        while time.monotonic() < end_s:
            handler.refresh()
            group.check()
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
    """A spec in `conf/bench`: replaces machine and operator at a desk."""

    def companions(self, machine: Machine, session: Session) -> Sequence[CompanionProcess]:
        """Return the processes to run beside the loop."""
        ...


def _write_timing_report(memory: LoopMemory, session: Session) -> None:
    """Write `timing.json` and log a line for each process."""
    reports = [json.loads(text) for text in memory.reports.take()]
    for one in reports:
        cycles = f"{one['cycles']} cycles of {1e3 * one['period_s']:.0f} ms, {one['missed']} missed"
        late = f"{1e3 * one['late_p99_s']:.1f} ms (99 %), {1e3 * one['late_max_s']:.1f} ms at most"
        log.info("%s: %s, late by %s", one["process"], cycles, late)
    report = {"processes": reports, "log_dropped": memory.read_snapshot().log_dropped}
    write_json(session.folder / TIMING, report)
