"""The page process: reads the state of the loop and passes requests on to the supervisor.

The slots that it reads are overwritten by their writers, who wait for nobody; it writes into two
pipes that count their losses. However slow a browser is, or if this process dies, the loop feels
nothing of it, except where commands are sent: then the page's signal, which the bus process reads in
each cycle, has to come. `stop` travels in it, too.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Frame
from deploy.guidance import LeverGuidance, LeverMap
from deploy.kernel.limits import GuardLimits
from deploy.page.protocol import (
    BoreholeChoice,
    LoopHealth,
    OperatorRequest,
    PageState,
    RecordingStatus,
    ShownAdvice,
    SourceAge,
    Vector,
)
from deploy.page.scene import locate_borehole, place_tool, to_vector
from deploy.page.server import serve_page
from deploy.page.settings import LINK, PageSettings
from deploy.page.video_relay import VideoRelay
from deploy.runtime.operator_state import LoopSnapshot, PageSignal, PolicyAdvice
from deploy.runtime.perception_process import read_newer_frame
from deploy.runtime.process import Stop
from deploy.runtime.shm_layout import LOG_BYTES, LoopMemory, log_text
from deploy.runtime.target import TargetPosition, find_nearest, locate_hole, read_holes

log = logging.getLogger(__name__)

ADVICE_PERIODS = 3
"""Control periods without a new advice from which the last one is stale. Chosen by hand: one late
period must not grey the levers."""
UP: Vector = (0.0, 0.0, 1.0)
LOG_BEHIND_BYTES = LOG_BYTES // 32
"""Bytes that wait for the log process from which it counts as stuck: about 4 s of a full bus. It
looks 20 times a second. Chosen by hand."""
SUPERVISOR_S = 1.0
"""Age of the supervisor's switches from which it counts as silent: 50 of its cycles. Chosen by
hand."""
BEAT_S = 0.01
"""Between two signals of the page: a cycle of the bus process."""
TURN_S = 0.3
"""Time since the server last asked for a state from which it hangs. Chosen by hand: 75 of its turns."""
BEAT_PRIORITY = 20
"""Priority of the thread that signals, under SCHED_FIFO, below the supervisor."""
UNNAMED = "+"
"""Name of a borehole that perception does not know: one from a file, from the configuration, or
pointed at."""


@dataclass(frozen=True)
class PageProcessConfig:
    """Settings of a page process.

    Attributes:
        page: How to serve.
        machine: The machine.
        guidance: How the levers are shown.
        session: Where the link goes.
        limits: The guard's: ages from which positions and levers are stale, and delay of messages.
        borehole_s: Age from which the borehole is.
        camera_s: Age from which the camera's picture is; `None`: there is no camera.
        video_folder: Folder with the socket of the video process; `None`: there is no video.
    """

    page: PageSettings
    machine: Machine
    guidance: LeverGuidance
    session: Session
    limits: GuardLimits
    borehole_s: float
    camera_s: float | None = None
    video_folder: str | None = None


def run(stop: Stop, config: PageProcessConfig, memory: LoopMemory) -> None:
    """Serve the page until asked to stop.

    Raises:
        LinkError: the address is taken.
    """
    link = config.session.folder / LINK

    def announce(address: str) -> None:
        host = address.partition("#")[0]
        log.info("%s; the link with the token, for requests, stands in %s", host, link)

    feed = LoopFeed(config, memory)
    threading.Thread(target=feed.beat, args=(stop,), daemon=True, name="beat").start()
    extensions = (VideoRelay(config.video_folder),) if config.video_folder else ()
    serve_page(config.page, stop, config.machine, feed, config.session, announce, *extensions)


class LoopFeed:
    """Feed of the running loop, from its shared memory; a `deploy.page.protocol.PageFeed`.

    Args:
        config: Settings.
        memory: Where to read and write.
        clock: Monotonic time in s.
    """

    def __init__(
        self,
        config: PageProcessConfig,
        memory: LoopMemory,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        # Guidance is on at the start: a page that opens late must not find it switched off.
        self._config, self._memory, self._clock = config, memory, clock
        self._guiding, self._stopped_s, self._present_s = True, 0.0, 0.0
        self._turned_s, self._signalling = clock(), threading.Lock()
        self._levers = LeverMap(config.machine)

    def read_advice_number(self) -> int | None:
        """See `PageFeed`; the server asks in each of its turns."""
        self._turned_s = self._clock()
        return self._memory.advice.peek("number")

    def beat(self, stop: Stop) -> None:
        """Signal until asked to stop, as long as the server lives."""
        with contextlib.suppress(OSError):
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            thread = threading.get_native_id()
            os.sched_setscheduler(thread, policy, os.sched_param(BEAT_PRIORITY))
        while not stop():
            if self._clock() - self._turned_s < TURN_S:
                self.signal()
            time.sleep(BEAT_S)

    def signal(self) -> None:
        """Tell the bus process that the page lives, and when STOP was pressed last."""
        with self._signalling:
            signal = PageSignal(self._clock(), self._stopped_s, self._present_s)
            self._memory.page.write(signal)

    def read_state(self) -> PageState:
        """See `PageFeed`."""
        snapshot = self._memory.read_snapshot()
        aim = self._memory.target.read()
        targets = self._list_targets(aim)
        chosen = next((one for one in targets if one.chosen), None)
        state, advice = snapshot.state, snapshot.advice
        q = None if state is None else state.q
        path, insertion = place_tool(self._config.machine, q, chosen)
        if not self._guiding:
            path = ()
        return PageState(
            t_s=snapshot.t_s,
            alive=snapshot.alive,
            guiding=self._is_guiding(snapshot),
            advice=None if advice is None else self._convert_advice(advice),
            state=state,
            commands=snapshot.commands,
            streams=self._measure_ages(snapshot, aim),
            recording=self._describe_recording(snapshot),
            health=self._check_health(snapshot),
            targets=targets,
            insertion=insertion,
            path_in_base_m=path,
            view=self._memory.view.read(),
        )

    def _is_guiding(self, snapshot: LoopSnapshot) -> bool:
        """Return whether advice is shown, or, where commands may be sent, whether they are."""
        if not snapshot.commands:
            return self._guiding
        return snapshot.state is not None and snapshot.state.guard.sends

    def read_frame(self, after_s: float) -> Frame | None:
        """See `PageFeed`."""
        return read_newer_frame(self._memory.frame, after_s)

    def submit(self, request: OperatorRequest) -> bool:
        """See `PageFeed`."""
        facts: dict[str, Any] = {}
        self._present_s = self._clock()
        if request.kind == "present":
            self.signal()
            return True
        if request.kind in ("target", "point"):
            targets = self._list_targets(self._memory.target.read())
            # A borehole that is chosen already is granted without moving the target.
            if any(one.chosen and one.name == request.value for one in targets):
                return True
            find = self._find_named if request.kind == "target" else self._find_pointed
            place = find(request.value)
            if place is None:
                return False
            facts = {
                "center_in_base_m": place.center_in_base_m.tolist(),
                "std_m": place.std_m,
                # The time of the record is that of the request; the place was measured before.
                "seen_s": place.t_s,
            }
        values: dict[str, Any] = {"kind": request.kind, "value": request.value}
        if request.kind == "stop":
            # Straight to the bus process: the supervisor may hang.
            self._stopped_s = self._clock()
            self.signal()
        if request.kind in ("start", "stop"):
            facts = {"asked_s": self._clock()}
        # The request goes through a pipe: this process may not touch the loop's slots.
        taken = self._memory.requests.put(json.dumps(values | facts).encode())
        log_text(self._memory.page_log, "wish", self._clock(), values | {"taken": taken} | facts)
        if request.kind in ("start", "stop"):
            # guiding stops on the page even where the supervisor has no room for the request
            self._guiding = request.kind == "start"
            return taken or request.kind == "stop"
        return taken

    def confirms_stop(self) -> bool:
        """See `PageFeed`."""
        state = self._memory.state.read()
        if self._memory.request is None:
            return True
        return state is not None and state.t_s > self._stopped_s and not state.guard.sends

    def _convert_advice(self, advice: PolicyAdvice) -> ShownAdvice:
        button, exclusive = advice.button_right, self._config.machine.is_exclusive
        levers = self._levers.read_positions(advice.lever_rad, button)
        due_s = 0.0 if button else None
        if not button and advice.valid and advice.u[exclusive].any():
            # the policy wants it already; the shown levers go through neutral first, as fast as a
            # hand can
            most_rad = float(np.abs(advice.lever_rad).max())
            neutral_s = most_rad / self._config.guidance.max_rate_rad_s
            due_s = max(self._config.machine.period_s, neutral_s)
        return ShownAdvice(advice.valid, advice.reason.value, advice.number, levers, due_s)

    def _measure_ages(self, snapshot: LoopSnapshot, aim: Any | None) -> tuple[SourceAge, ...]:
        config, now_s = self._config, snapshot.t_s
        state, advice = snapshot.state, snapshot.advice
        advice_s = ADVICE_PERIODS * config.machine.period_s
        sources: list[tuple[str, float | None, float]] = [
            ("positions", None if state is None else state.q_t_s, config.limits.joints_s),
            ("levers", None if state is None else state.levers_t_s, config.limits.levers_s),
            ("advice", None if advice is None else advice.t_s, advice_s),
            ("borehole", None if aim is None else float(aim["t_s"]), config.borehole_s),
        ]
        if config.camera_s is not None:
            sources.append(("camera", self._memory.frame.peek("t_s"), config.camera_s))
        ages = []
        for name, t_s, limit_s in sources:
            ages.append(SourceAge(name, None if t_s is None else now_s - t_s, limit_s))
        return tuple(ages)

    def _describe_recording(self, snapshot: LoopSnapshot) -> RecordingStatus:
        controls = self._memory.controls.read()
        on = controls is not None and controls.recording
        # `since` of an ended recording is old and means nothing.
        seconds = snapshot.t_s - controls.recording_t_s if controls is not None and on else 0.0
        # Before the first state nothing can have been lost.
        dropped = snapshot.log_dropped if snapshot.state is not None else 0
        failed = controls is not None and controls.recording_failed
        return RecordingStatus(on, seconds, dropped, failed)

    def _check_health(self, snapshot: LoopSnapshot) -> LoopHealth:
        memory, controls = self._memory, self._memory.controls.read()
        # Before its first switches the supervisor is still starting.
        silent = controls is not None and snapshot.t_s - controls.t_s > SUPERVISOR_S
        return LoopHealth(
            delay_s=0.0 if snapshot.state is None else snapshot.state.held_up_s,
            delay_limit_s=self._config.limits.round_trip_s,
            log_behind=any(pipe.waiting > LOG_BEHIND_BYTES for pipe in memory.logs),
            supervisor_silent=silent,
        )

    def _list_targets(self, aim: Any | None) -> tuple[BoreholeChoice, ...]:
        radius_m = self._config.page.borehole_radius_m
        return list_boreholes(read_holes(self._memory.holes), aim, radius_m)

    def _find_named(self, name: str) -> TargetPosition | None:
        """Return the position of the borehole of that name."""
        for hole in read_holes(self._memory.holes):
            if str(int(hole["name"])) == name:
                return locate_hole(hole)
        return None

    def _find_pointed(self, value: str) -> TargetPosition | None:
        """Return the borehole at a point of the picture: one of perception's, else as measured."""
        # The newest picture is meant, whatever was drawn before.
        frame = self.read_frame(-1.0)
        if frame is None:
            return None
        x, y = map(float, value.split(","))
        found = locate_borehole(frame, x, y, self._config.page.borehole_radius_m)
        if found is None:
            return None
        # A hole that perception knows is better measured than one touch.
        known = find_nearest(read_holes(self._memory.holes), found[0])
        return TargetPosition(*found, frame.t_s) if known is None else locate_hole(known)


def list_boreholes(
    holes: Sequence[Mapping[str, Any]], aim: Mapping[str, Any] | None, radius_m: float
) -> tuple[BoreholeChoice, ...]:
    """Return the boreholes that perception knows, and the one that the advice is for.

    Args:
        holes: Records of `deploy.runtime.shm_layout.HOLE`, or their fields by name.
        aim: `center_in_base_m` and `std_m` of the target; `None` without one.
        radius_m: Of a borehole of which only the centre is known.
    """
    # The target may be perception's own or one from a file; the nearest known hole is shown as
    # chosen.
    chosen = None if aim is None else find_nearest(holes, np.array(aim["center_in_base_m"]))
    shown = list(holes)
    if aim is not None and chosen is None:
        chosen = {"name": None, "axis_in_base": UP, "radius_m": radius_m, "score": None}
        # 0 stands for "not known".
        std_m = float(aim["std_m"]) or None
        chosen |= {"center_in_base_m": aim["center_in_base_m"], "std_m": std_m}
        shown.append(chosen)
    found = []
    for hole in shown:
        choice = BoreholeChoice(
            name=UNNAMED if hole["name"] is None else str(int(hole["name"])),
            center_in_base_m=to_vector(hole["center_in_base_m"]),
            axis_in_base=to_vector(hole["axis_in_base"]),
            radius_m=float(hole["radius_m"]),
            std_m=hole["std_m"],
            confidence=hole["score"],
            chosen=hole is chosen,
        )
        found.append(choice)
    return tuple(found)
