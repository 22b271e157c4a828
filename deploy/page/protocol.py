"""Protocol between the page and its feed: `PageState` goes out, requests come back.

Plain data in SI units, made anew at every moment and never queued: a reader takes the newest state
and misses the rest. Old values are never left out: their age is part of the state, and the page
greys them.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, Protocol, get_args

from brokk_rl.contracts.vision import CameraView
from brokk_rl.machine import Machine
from brokk_rl.signals import Frame
from deploy.guidance import LeverPositions
from deploy.runtime.operator_state import OperatorState

Vector = tuple[float, float, float]
RequestKind = Literal["start", "stop", "present", "record", "target", "point", "seek", "play"]
REQUEST_KINDS: tuple[RequestKind, ...] = get_args(RequestKind)


@dataclass(frozen=True)
class ShownAdvice:
    """Advised lever positions; drawn green.

    Attributes:
        valid: Whether there is an advice; if not, `reason` says why.
        reason: Value of `deploy.runtime.operator_state.AdviceStatus`.
        number: Counts up.
        levers: Positions to move to.
        button_due_s: Time until the right button is to be held, 0 where that is now; `None` where
            it is not coming.
    """

    valid: bool
    reason: str
    number: int
    levers: LeverPositions
    button_due_s: float | None


@dataclass(frozen=True)
class SourceAge:
    """Age of one source of the state.

    Attributes:
        name: `positions`, `levers`, `advice`, `camera`, `borehole`; the page has a word for each in
            both languages.
        age_s: Age of the newest value; `None` where nothing has come yet.
        limit_s: Age from which it is stale.
    """

    name: str
    age_s: float | None
    limit_s: float

    @property
    def stale(self) -> bool:
        """True if it is too old to be relied on."""
        return self.age_s is None or self.age_s > self.limit_s


@dataclass(frozen=True)
class RecordingStatus:
    """State of the recording.

    Attributes:
        on: Whether it is running.
        seconds: Its length so far.
        dropped: Records that found no room: the recording has gaps.
        failed: Whether the last recording has ended unasked: an alarm.
    """

    on: bool
    seconds: float
    dropped: int
    failed: bool


@dataclass(frozen=True)
class LoopHealth:
    """Readings of the loop itself, from which alarms come.

    Attributes:
        delay_s: Largest delay of a message of the bus beyond the shortest seen.
        delay_limit_s: Delay from which the guard lets nothing pass.
        log_behind: Whether records wait for the log process for seconds.
        supervisor_silent: Whether the supervisor has not written its switches for long.
    """

    delay_s: float
    delay_limit_s: float
    log_behind: bool
    supervisor_silent: bool


@dataclass(frozen=True)
class InsertionReading:
    """Position of the tool relative to the chosen borehole.

    Attributes:
        depth_m: Depth of the tip below the rim, along the hole's axis; negative above the rim.
        lateral_m: Distance of the tip from that axis.
        angle_rad: Angle between tool and axis.
        wanted_m: Depth from which it counts as inserted.
        inserted: Whether it is, within the hole's radius.
        center_in_view_m: Centre of the rim as seen along the tool: right, up, ahead of the tip.
        axis_in_view: Unit vector out of the hole, likewise.
    """

    depth_m: float
    lateral_m: float
    angle_rad: float
    wanted_m: float
    inserted: bool
    center_in_view_m: Vector
    axis_in_view: Vector


@dataclass(frozen=True)
class BoreholeChoice:
    """A borehole that can be chosen.

    Attributes:
        name: For people, and the value of a `target` request.
        center_in_base_m: Centre of its rim.
        axis_in_base: Unit vector out of it.
        radius_m: Its radius.
        std_m: Standard deviation of the centre; `None` where unknown.
        confidence: Probability that it is one, in [0, 1]; `None` where unknown.
        chosen: Whether the advice is for it.
    """

    name: str
    center_in_base_m: Vector
    axis_in_base: Vector
    radius_m: float
    std_m: float | None
    confidence: float | None
    chosen: bool


@dataclass(frozen=True)
class TimelineMark:
    """An event on the timeline of a recording.

    Attributes:
        t_s: Time since its beginning.
        kind: `alarm`, `state` of the guard, or `request` of the operator.
        name: Event in English words.
    """

    t_s: float
    kind: Literal["alarm", "state", "request"]
    name: str


@dataclass(frozen=True)
class ReplayTimeline:
    """Place in a recording that is played.

    Attributes:
        position_s: Time since its beginning.
        duration_s: Its length.
        speed: Of the playback over real time; 0: it stands still.
        marks: Events, in order of time.
    """

    position_s: float
    duration_s: float
    speed: float
    marks: tuple[TimelineMark, ...]


@dataclass(frozen=True)
class PageState:
    """Everything that the page shows at one moment.

    Attributes:
        t_s: Monotonic time of the state.
        alive: Whether the loop is running.
        guiding: Whether advice is to be followed: a person has pressed start and not stop.
        advice: Advised levers; `None` before the first.
        state: Of machine, operator and guard; `None` before the first.
        commands: Whether this loop can command valves at all.
        streams: Age of each source.
        recording: State of the recording.
        health: Of the loop itself.
        targets: Boreholes to choose from.
        insertion: Tool and chosen borehole; `None` while either is not known.
        path_in_base_m: Way of the tool from its tip; empty where nothing is planned.
        view: Where a moving camera looks, and why; `None` without one.
        replay: Place in the recording that is played; `None`: this is live.
    """

    t_s: float
    alive: bool
    guiding: bool
    advice: ShownAdvice | None
    state: OperatorState | None
    commands: bool
    streams: tuple[SourceAge, ...]
    recording: RecordingStatus
    health: LoopHealth
    targets: tuple[BoreholeChoice, ...]
    insertion: InsertionReading | None
    path_in_base_m: tuple[Vector, ...]
    view: CameraView | None = None
    replay: ReplayTimeline | None = None

    @property
    def own(self) -> LeverPositions | None:
        """The operator's own levers, drawn blue."""
        return None if self.state is None else self.state.levers

    @property
    def q(self) -> tuple[float, ...] | None:
        """Joint positions in machine order, rad or m."""
        return None if self.state is None else tuple(self.state.q.tolist())

    @property
    def safety(self) -> dict[str, Any] | None:
        """Return the state of guard, dead-man and emergency stop as plain data."""
        state = self.state
        if state is None:
            return None
        return {
            "commands": self.commands,
            "state": state.guard.name,
            "trip": state.trip.value,
            "deadman": state.deadman,
            "estop": state.estop,
            "bus_up": state.bus_up,
            "prompt": state.prompt,
            "observed_joint": state.observed_joint,
        }

    @property
    def deadman(self) -> bool:
        """True if the dead-man is known to be held now."""
        state = self.state
        if state is None or not self.alive or state.estop:
            return False
        stale = any(one.stale for one in self.streams if one.name == "levers")
        return state.deadman and not stale

    def to_plain(self) -> dict[str, Any]:
        """Return it as plain JSON data for the page; a number that is not finite is null."""
        found = asdict(replace(self, state=None))
        found |= {"own": self.own and asdict(self.own), "q": self.q, "safety": self.safety}
        return convert_to_plain(found)


def convert_to_plain(value: Any) -> Any:
    """Return nested data with lists for tuples, and `None` for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: convert_to_plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [convert_to_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class OperatorRequest:
    """A request of the operator; token, origin and dead-man are checked already.

    Attributes:
        kind: `start` and `stop` guiding, `present` where the page asks, `record` on or off, choose a `target`, `point` at a
            borehole in the picture; `seek` and `play` in a recording.
        value: `on` or `off` for `record`, the name of the `target`, `x,y` of the point as parts of
            the picture from its upper left corner, the time in s to `seek`, the speed to `play` at
            or `off`, else empty.
    """

    kind: RequestKind
    value: str


class PageFeed(Protocol):
    """Source of the page's state, and receiver of its requests.

    No method waits: the loop must never feel the page.
    """

    def read_advice_number(self) -> int | None:
        """Return the number of the newest advice, `None` where there is none.

        It tells at little cost whether `read_state` has a new one.
        """
        ...

    def read_state(self) -> PageState:
        """Return the newest state."""
        ...

    def read_frame(self, after_s: float) -> Frame | None:
        """Return the newest frame if it is later than `after_s`, else `None`."""
        ...

    def submit(self, request: OperatorRequest) -> bool:
        """Pass a request on; return whether it was accepted."""
        ...

    def confirms_stop(self) -> bool:
        """Return whether the guard sends nothing any more, after the last `stop` was submitted."""
        ...


class FeedSpec(Protocol):
    """A spec in `conf/feed`: source of the page's state."""

    def build(self, machine: Machine) -> PageFeed:
        """Return the feed."""
        ...
