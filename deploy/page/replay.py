"""A feed that plays a recorded session on the operator's page.

The state at any time is what the recording held up to then: nothing is simulated. Positions,
levers and status come from the messages of the bus, the rest from the topics of guard, policy,
perception and page.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from brokk_rl.contracts.vision import CameraView
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from deploy.guidance import AXES, LeverMap
from deploy.kernel.guard import GuardState, GuardTrip
from deploy.page.loop_feed import list_boreholes
from deploy.page.protocol import (
    BoreholeChoice,
    LoopHealth,
    OperatorRequest,
    PageState,
    RecordingStatus,
    ReplayTimeline,
    ShownAdvice,
    SourceAge,
    TimelineMark,
)
from deploy.page.scene import place_tool
from deploy.recorder.camera_topics import decode_frame
from deploy.recorder.capture_reader import CaptureContents, read_capture
from deploy.recorder.topics import CAMERA_POSE, CLOUD, LENS, PICTURE
from deploy.runtime.operator_state import ALIVE_S, AdviceStatus, OperatorState
from deploy.runtime.shared_memory import RecordLayout

VIEWS = (PICTURE, LENS, CLOUD, CAMERA_POSE)
"""Topics of the camera."""
CLOCK_S = 1e-6
"""Rounding of the times of pictures, whole nanoseconds of the wall clock."""
SWITCHES = {
    "button_right": "ButtonRight",
    "deadman": "DeadMan",
    "remote_on": "RemoteOn",
    "estop": "EStop",
    "exclusive_selected": "ExclusiveSelected",
}
"""Switches of the state, and their signals."""
MOST_MARKS = 200
"""Marks on the timeline; each state carries them. Chosen by hand."""
RADIUS_M = 0.05
"""Radius of a borehole of which the recording holds the centre alone, as in `conf/page`."""


@spec
class CaptureReplay:
    """A recorded session on the page, with a timeline.

    Attributes:
        capture: The `capture.mcap`, or the folder that it lies in.
        bus_s: Age from which positions and levers are stale.
        advice_s: Age from which the advice is.
        borehole_s: Age from which the boreholes are.
        camera_s: Age from which the camera's picture is stale.
    """

    capture: str
    bus_s: Positive
    advice_s: Positive
    borehole_s: Positive
    camera_s: Positive

    def build(self, machine: Machine) -> ReplayFeed:
        """Return the feed, at the beginning of the recording and playing.

        Raises:
            RecordingError: there is no such capture, or it was made on another machine.
        """
        path = Path(self.capture)
        path = path / "capture.mcap" if path.is_dir() else path
        contents = read_capture(path, VIEWS)
        contents.check_machine(machine, path)
        if not contents.messages:
            raise RecordingError(f"{path}: expected messages to replay, found none")
        return ReplayFeed(self, machine, contents, time.monotonic)


class ReplayFeed:
    """Feed of a recorded session; a `deploy.page.protocol.PageFeed`.

    Args:
        replay: Settings.
        machine: The machine.
        contents: Of the capture.
        clock: Monotonic time in s.
    """

    def __init__(
        self,
        replay: CaptureReplay,
        machine: Machine,
        contents: CaptureContents,
        clock: Callable[[], float],
    ) -> None:
        self._replay, self._machine, self._clock = replay, machine, clock
        topics = {}
        for name, messages in contents.messages.items():
            topics[name] = _Series(messages.series("t_s"), messages)
        self._begin_s = float(min(topic.t_s[0] for topic in topics.values()))
        end_s = float(max(topic.t_s[-1] for topic in topics.values()))
        self._duration_s = end_s - self._begin_s
        self._signals: dict[str, _Series] = {}
        for topic in topics.values():
            for signal in topic.rows.names:
                self._signals.setdefault(signal, topic)
        self._series = dict(topics)
        for name, pictures in contents.views.items():
            taken_s = np.array([t_s for t_s, _ in pictures])
            self._series[name] = _Series(taken_s - CLOCK_S, pictures)
        self._picture = -1
        self._blank = RecordLayout(OperatorState, machine.num_joints).new()
        self._levers = LeverMap(machine)
        self._marks = _list_marks(topics, self._begin_s)
        guard = topics.get("guard")
        # Without any other state, the loop could only listen.
        self._commands = guard is not None and any(
            values["state"] != GuardState.SILENT.name for _, values in guard.rows
        )
        self._anchor_s, self._position_s, self._speed = clock(), 0.0, 1.0

    @property
    def position_s(self) -> float:
        """Time since the beginning of the recording."""
        since_s = (self._clock() - self._anchor_s) * self._speed
        return min(self._duration_s, self._position_s + since_s)

    def read_advice_number(self) -> int | None:
        """See `PageFeed`."""
        found = self._find("advice", self._begin_s + self.position_s)
        return None if found is None else found.number

    def read_state(self) -> PageState:
        """See `PageFeed`."""
        position_s = self.position_s
        at_s = self._begin_s + position_s
        state, advice = self._build_state(at_s), self._find("advice", at_s)
        targets = self._list_targets(at_s, advice)
        chosen = next((one for one in targets if one.chosen), None)
        path, insertion = place_tool(self._machine, state.q, chosen)
        view = self._find("view", at_s)
        return PageState(
            t_s=self._clock(),
            alive=state.bus_up,
            guiding=True,
            advice=None if advice is None else self._convert_advice(advice),
            state=state,
            commands=self._commands,
            streams=self._measure_ages(at_s, state),
            recording=RecordingStatus(True, position_s, 0, failed=False),
            health=LoopHealth(0.0, math.inf, log_behind=False, supervisor_silent=False),
            targets=targets,
            insertion=insertion,
            path_in_base_m=path,
            view=None if view is None else CameraView(**view.values),
            replay=ReplayTimeline(position_s, self._duration_s, self._speed, self._marks),
        )

    def read_frame(self, after_s: float) -> Frame | None:
        """See `PageFeed`; a jump back shows an earlier picture, at the time of the clock."""
        picture = self._find(PICTURE, self._begin_s + self.position_s)
        if picture is None or (picture.number == self._picture and after_s >= 0):
            return None
        self._picture = picture.number
        lens, cloud = self._find(LENS, picture.t_s), self._find(CLOUD, picture.t_s)
        if lens is None or cloud is None:
            return None
        pose = self._find(CAMERA_POSE, picture.t_s)
        placed = None if pose is None else pose.values
        return decode_frame(picture.values, lens.values, cloud.values, placed, self._clock())

    def submit(self, request: OperatorRequest) -> bool:
        """See `PageFeed`; moves along the recording."""
        position_s = self.position_s
        if request.kind == "play":
            self._speed = 0.0 if request.value == "off" else float(request.value)
            if self._speed and position_s >= self._duration_s:
                position_s = 0.0
        elif request.kind == "seek":
            position_s = min(self._duration_s, float(request.value))
        else:
            return False
        self._anchor_s, self._position_s = self._clock(), position_s
        return True

    def confirms_stop(self) -> bool:
        """See `PageFeed`; nothing moves."""
        return True

    def _find(self, topic: str, at_s: float) -> _Found | None:
        """Return the last message of a topic at `at_s`, `None` before the first."""
        found = self._series.get(topic)
        return None if found is None else found.find(at_s)

    def _measure_ages(self, at_s: float, state: OperatorState) -> tuple[SourceAge, ...]:
        replay, ages = self._replay, []
        for name, t_s in (("positions", state.q_t_s), ("levers", state.levers_t_s)):
            ages.append(SourceAge(name, at_s - t_s if np.isfinite(t_s) else None, replay.bus_s))
        topics = [("advice", "advice", replay.advice_s), ("borehole", "holes", replay.borehole_s)]
        if PICTURE in self._series:
            topics.append(("camera", PICTURE, replay.camera_s))
        for name, topic, limit_s in topics:
            found = self._find(topic, at_s)
            ages.append(SourceAge(name, None if found is None else at_s - found.t_s, limit_s))
        return tuple(ages)

    def _read_signal(self, signal: str, at_s: float) -> tuple[float, float]:
        """Return value and time of a signal of the bus; 0 and `-inf` where none has come."""
        series = self._signals.get(signal)
        found = None if series is None else series.find(at_s)
        return (0.0, -math.inf) if found is None else (found.values[signal], found.t_s)

    def _build_state(self, at_s: float) -> OperatorState:
        names = self._machine.joint_names
        positions = [self._read_signal(f"Position_{name}", at_s) for name in names]
        levers = [self._read_signal(f"Lever_{side}_{axis}", at_s) for side, axis in AXES]
        q_t_s, levers_t_s = min(t_s for _, t_s in positions), levers[0][1]
        state = replace(
            self._blank,
            t_s=at_s,
            q=np.array([value for value, _ in positions]),
            q_t_s=q_t_s,
            lever=np.array([value for value, _ in levers]),
            levers_t_s=levers_t_s,
            bus_up=at_s - max(q_t_s, levers_t_s) < ALIVE_S,
            **{name: bool(self._read_signal(one, at_s)[0]) for name, one in SWITCHES.items()},
        )
        guard = self._find("guard", at_s)
        if guard is None:
            return state
        joint = guard.values.get("joint")
        return replace(
            state,
            guard=GuardState[guard.values["state"]],
            trip=GuardTrip(guard.values["trip"]),
            cause=GuardTrip(guard.values["cause"]),
            observed_joint=names.index(joint) + 1 if joint else 0,
        )

    def _convert_advice(self, advice: _Found) -> ShownAdvice:
        values, button = advice.values, bool(advice.values["button_right"])
        levers = self._levers.read_positions(np.array(values["lever_rad"]), button)
        valid = values["reason"] == AdviceStatus.VALID.value
        return ShownAdvice(valid, values["reason"], advice.number, levers, 0.0 if button else None)

    def _list_targets(self, at_s: float, advice: _Found | None) -> tuple[BoreholeChoice, ...]:
        """Return the boreholes known at that time; the one that the advice is for is chosen."""
        seen, aim = self._find("holes", at_s), None
        if advice is not None and advice.values["reason"] == AdviceStatus.VALID.value:
            aim = {"center_in_base_m": advice.values["target_in_base_m"], "std_m": 0.0}
        return list_boreholes([] if seen is None else seen.values["holes"], aim, RADIUS_M)


class _Found(NamedTuple):
    """A message of a topic: its number from 0, its time, and its values, or the data of a picture."""

    number: int
    t_s: float
    values: Any


class _Series:
    """Messages of a topic in order of time.

    Args:
        t_s: Times from which they count, `(T,)`.
        rows: Time and values of each.
    """

    def __init__(self, t_s: np.ndarray, rows: Any) -> None:
        self.t_s, self.rows = t_s, rows

    def find(self, at_s: float) -> _Found | None:
        """Return the last message at `at_s`, `None` before the first."""
        index = int(np.searchsorted(self.t_s, at_s, side="right")) - 1
        return None if index < 0 else _Found(index, *self.rows[index])


def _list_marks(topics: dict[str, _Series], begin_s: float) -> tuple[TimelineMark, ...]:
    """Return the changes of the guard, and requests of the operator, in order of time."""
    found, before = [], None
    for t_s, values in topics["guard"].rows if "guard" in topics else ():
        # The reason for sending nothing may change while the state stays.
        if values["state"] == before:
            continue
        before = values["state"]
        latched = values["state"] == GuardState.LATCHED.name
        name = values["cause"] if latched else values["state"]
        found.append(TimelineMark(t_s - begin_s, "alarm" if latched else "state", name))
    for t_s, values in topics["wish"].rows if "wish" in topics else ():
        found.append(TimelineMark(t_s - begin_s, "request", values["kind"]))
    # Where there are too many, alarms say most.
    found.sort(key=lambda mark: mark.kind != "alarm")
    return tuple(sorted(found[:MOST_MARKS], key=lambda mark: mark.t_s))
