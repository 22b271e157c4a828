"""A feed that plays a recorded session on the operator's page.

The state at any time is what the recording held up to then: nothing is simulated. Positions,
levers and status come from the messages of the bus, the rest from the topics of guard, policy,
perception and page.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.contracts.vision import CameraView
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from brokk_rl.spec import Positive, spec
from deploy.guidance import AXES, convert_to_positions, find_full_angles_rad
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
from deploy.recorder.capture_reader import CaptureContents, TopicMessages, read_capture
from deploy.recorder.topics import CAMERA_POSE, CLOUD, LENS, PICTURE
from deploy.runtime.operator_state import ALIVE_S, AdviceStatus, OperatorState
from deploy.runtime.shared_memory import RecordLayout

VIEWS = (PICTURE, LENS, CLOUD, CAMERA_POSE)
"""Topics of the camera."""
CLOCK_S = 1e-6
"""Rounding of the times of pictures."""
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
        delay_s: Delay of messages that is too long.
        camera_s: Age from which the camera's picture is stale.
    """

    capture: str
    bus_s: Positive
    advice_s: Positive
    borehole_s: Positive
    delay_s: Positive
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
        self._topics = {name: _Topic(rows) for name, rows in contents.messages.items()}
        self._begin_s = float(min(topic.t_s[0] for topic in self._topics.values()))
        end_s = float(max(topic.t_s[-1] for topic in self._topics.values()))
        self._duration_s = end_s - self._begin_s
        self._views = {name: _View(rows) for name, rows in contents.views.items()}
        self._picture = -1
        self._sources = {}
        for signal in (
            *(f"Position_{name}" for name in machine.joint_names),
            *(f"Lever_{side}_{axis}" for side, axis in AXES),
            *("ButtonRight", "DeadMan", "RemoteOn", "EStop", "ExclusiveSelected"),
        ):
            found = [topic for topic in self._topics.values() if signal in topic.rows.names]
            self._sources[signal] = found[0] if found else None
        self._blank = RecordLayout(OperatorState, machine.num_joints).new()
        self._full_rad = find_full_angles_rad(machine)
        self._marks = _list_marks(self._topics, self._begin_s)
        guard = self._topics.get("guard")
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
        return None if found is None else found[0]

    def read_state(self) -> PageState:
        """See `PageFeed`."""
        position_s = self.position_s
        at_s = self._begin_s + position_s
        state, ages_s = self._build_state(at_s)
        advice = self._find("advice", at_s)
        targets = self._list_targets(at_s, None if advice is None else advice[2])
        chosen = next((one for one in targets if one.chosen), None)
        path, insertion = place_tool(self._machine, state.q, chosen)
        view = self._find("view", at_s)
        replay, heard_s = self._replay, min(ages_s["positions"], ages_s["levers"])
        streams = [
            SourceAge("positions", _drop_infinite(ages_s["positions"]), replay.bus_s),
            SourceAge("levers", _drop_infinite(ages_s["levers"]), replay.bus_s),
            SourceAge("advice", None if advice is None else at_s - advice[1], replay.advice_s),
            SourceAge("borehole", self._measure_age("holes", at_s), replay.borehole_s),
        ]
        if PICTURE in self._views:
            _, taken_s, picture = self._views[PICTURE].find(at_s)
            age_s = None if picture is None else at_s - taken_s
            streams.append(SourceAge("camera", age_s, replay.camera_s))
        return PageState(
            t_s=self._clock(),
            alive=heard_s < ALIVE_S,
            guiding=True,
            advice=None if advice is None else self._convert_advice(advice[0], advice[2]),
            state=state,
            commands=self._commands,
            streams=tuple(streams),
            recording=RecordingStatus(True, position_s, 0, failed=False),
            health=LoopHealth(0.0, replay.delay_s, log_behind=False, supervisor_silent=False),
            targets=targets,
            insertion=insertion,
            path_in_base_m=path,
            view=None if view is None else CameraView(**view[2]),
            replay=ReplayTimeline(position_s, self._duration_s, self._speed, self._marks),
        )

    def read_frame(self, after_s: float) -> Frame | None:
        """See `PageFeed`; a jump back shows an earlier picture, at the time of the clock."""
        if not {PICTURE, LENS, CLOUD} <= self._views.keys():
            return None
        index, t_s, picture = self._views[PICTURE].find(self._begin_s + self.position_s)
        if picture is None or (index == self._picture and after_s >= 0):
            return None
        self._picture = index
        lens, cloud = self._views[LENS].find(t_s)[2], self._views[CLOUD].find(t_s)[2]
        pose = self._views[CAMERA_POSE].find(t_s)[2] if CAMERA_POSE in self._views else None
        if lens is None or cloud is None:
            return None
        return decode_frame(picture, lens, cloud, pose, self._clock())

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

    def _find(self, topic: str, at_s: float) -> tuple[int, float, dict[str, Any]] | None:
        """Return number, time and values of the last message of a topic at `at_s`."""
        found = self._topics.get(topic)
        return None if found is None else found.find(at_s)

    def _measure_age(self, topic: str, at_s: float) -> float | None:
        found = self._find(topic, at_s)
        return None if found is None else at_s - found[1]

    def _read_signal(self, signal: str, at_s: float) -> tuple[float, float]:
        """Return value and age of a signal of the bus; 0 and infinite where none has come."""
        topic = self._sources[signal]
        found = None if topic is None else topic.find(at_s)
        return (0.0, np.inf) if found is None else (found[2][signal], at_s - found[1])

    def _build_state(self, at_s: float) -> tuple[OperatorState, dict[str, float]]:
        names = self._machine.joint_names
        positions = [self._read_signal(f"Position_{name}", at_s) for name in names]
        levers = [self._read_signal(f"Lever_{side}_{axis}", at_s) for side, axis in AXES]
        ages_s = {"positions": max(age for _, age in positions), "levers": levers[0][1]}
        guard = self._find("guard", at_s)
        state = replace(
            self._blank,
            t_s=at_s,
            q=np.array([value for value, _ in positions]),
            lever=np.array([value for value, _ in levers]),
            button_right=bool(self._read_signal("ButtonRight", at_s)[0]),
            deadman=bool(self._read_signal("DeadMan", at_s)[0]),
            remote_on=bool(self._read_signal("RemoteOn", at_s)[0]),
            estop=bool(self._read_signal("EStop", at_s)[0]),
            exclusive_selected=bool(self._read_signal("ExclusiveSelected", at_s)[0]),
            bus_up=min(ages_s.values()) < ALIVE_S,
        )
        if guard is not None:
            values = guard[2]
            joint = values.get("joint")
            state = replace(
                state,
                guard=GuardState[values["state"]],
                trip=GuardTrip(values["trip"]),
                cause=GuardTrip(values["cause"]),
                observed_joint=names.index(joint) + 1 if joint else 0,
            )
        return state, ages_s

    def _convert_advice(self, number: int, values: dict[str, Any]) -> ShownAdvice:
        button = bool(values["button_right"])
        angles_rad = np.array(values["lever_rad"])
        levers = convert_to_positions(angles_rad, self._full_rad, button)
        reason = values["reason"]
        valid = reason == AdviceStatus.VALID.value
        return ShownAdvice(valid, reason, number, levers, 0.0 if button else None)

    def _list_targets(
        self, at_s: float, advice: dict[str, Any] | None
    ) -> tuple[BoreholeChoice, ...]:
        """Return the boreholes known at that time; the one that the advice is for is chosen."""
        seen, aim = self._find("holes", at_s), None
        if advice is not None and advice["reason"] == AdviceStatus.VALID.value:
            aim = {"center_in_base_m": advice["target_in_base_m"], "std_m": 0.0}
        return list_boreholes([] if seen is None else seen[2]["holes"], aim, RADIUS_M)


class _Topic:
    """Messages of a topic with their times as an array."""

    def __init__(self, rows: TopicMessages) -> None:
        self.rows, self.t_s = rows, rows.series("t_s")

    def find(self, at_s: float) -> tuple[int, float, dict[str, Any]] | None:
        """Return number, time and values of the last message at `at_s`, `None` before the first."""
        index = int(np.searchsorted(self.t_s, at_s, side="right")) - 1
        return None if index < 0 else (index, *self.rows[index])


class _View:
    """Messages for viewers, likewise."""

    def __init__(self, rows: list[tuple[float, bytes]]) -> None:
        self._rows, self._t_s = rows, np.array([t_s for t_s, _ in rows])

    def find(self, at_s: float) -> tuple[int, float, bytes | None]:
        """Return number, time and data of the last message at `at_s`, `None` before the first."""
        # Times come from whole nanoseconds of the wall clock; they are off by less than this.
        index = int(np.searchsorted(self._t_s, at_s + CLOCK_S, side="right")) - 1
        return (index, 0.0, None) if index < 0 else (index, *self._rows[index])


def _list_marks(topics: dict[str, _Topic], begin_s: float) -> tuple[TimelineMark, ...]:
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


def _drop_infinite(age_s: float) -> float | None:
    return age_s if np.isfinite(age_s) else None
