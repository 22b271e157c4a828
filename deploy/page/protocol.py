"""What the page and whoever feeds it promise each other: `Shown` goes out, `Wish` and `Drawn` come back.

Plain data in SI units, made anew at every moment and never queued: a reader takes the newest and
misses the rest. Nothing is left out because it is old; its age says so, and the page greys it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, get_args

from brokk_rl.signals import Frame
from deploy.guidance import LeverPositions

Vector = tuple[float, float, float]
RequestKind = Literal["start", "stop", "record", "target", "point"]
REQUEST_KINDS: tuple[RequestKind, ...] = get_args(RequestKind)
"""What can be wished for."""


@dataclass(frozen=True)
class ShownAdvice:
    """Where the levers should go; drawn green.

    Attributes:
        valid: Whether there is an advice; if not, `reason` says why.
        reason: Why there is none, as `deploy.policy.policy_process.AdviceStatus` has it.
        number: Counts up; draw times refer to it.
        levers: Where to.
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
    """How fresh one source is.

    Attributes:
        name: `positions`, `levers`, `advice`, `camera`, `borehole`; the page has a word for each in
            both languages.
        age_s: Age of the newest; `None` where nothing has come yet.
        limit_s: Age from which it is stale.
    """

    name: str
    age_s: float | None
    limit_s: float

    @property
    def stale(self) -> bool:
        """Whether it is too old to be relied on."""
        return self.age_s is None or self.age_s > self.limit_s


@dataclass(frozen=True)
class Safety:
    """What stands between the loop and the valves.

    Attributes:
        commands: Whether this loop can command valves at all.
        state: The guard's: `SILENT`, `LATCHED`, `READY`, `ACTIVE`.
        trip: What is wrong now, `nothing` where all is well.
        deadman: Whether the dead-man is held.
        estop: Whether an emergency stop is on.
        bus_up: Whether the bus works.
    """

    commands: bool
    state: str
    trip: str
    deadman: bool
    estop: bool
    bus_up: bool


@dataclass(frozen=True)
class RecordingStatus:
    """Whether this is written down.

    Attributes:
        on: Whether it is.
        seconds: For how long.
        dropped: Records that found no room: what is written has gaps.
    """

    on: bool
    seconds: float
    dropped: int


@dataclass(frozen=True)
class BoreholeChoice:
    """A borehole that can be chosen.

    Attributes:
        name: For people and for `Wish.value`.
        center_in_base_m: Centre of its rim.
        axis_in_base: Unit vector out of it.
        radius_m: Its radius.
        std_m: Standard deviation of the centre; `None` where nobody has said.
        confidence: That it is one, in [0, 1]; `None` where nobody has said.
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
class PageState:
    """All that the page shows at one moment.

    Attributes:
        t_s: Monotonic time it stands for.
        alive: Whether the loop is at work.
        guiding: Whether advice is to be followed: a person has pressed start and not stop.
        advice: Where to; `None` before the first.
        own: The operator's own levers, drawn blue; `None` before the first.
        q: Joint positions in machine order, rad or m; `None` before the first.
        streams: How fresh each source is.
        safety: What may be sent; `None` before the first.
        recording: Whether it is written down.
        targets: Boreholes to choose from.
        path_in_base_m: Where the tool is going, from its tip; empty where nothing is planned.
        block_in_base_m: Two opposite corners of a block to draw; `None` where the point cloud is
            all that is known.
    """

    t_s: float
    alive: bool
    guiding: bool
    advice: ShownAdvice | None
    own: LeverPositions | None
    q: tuple[float, ...] | None
    streams: tuple[SourceAge, ...]
    safety: Safety | None
    recording: RecordingStatus
    targets: tuple[BoreholeChoice, ...]
    path_in_base_m: tuple[Vector, ...]
    block_in_base_m: tuple[Vector, Vector] | None

    @property
    def deadman(self) -> bool:
        """Whether the dead-man is known to be held now."""
        fresh = not any(stream.stale for stream in self.streams if stream.name == "levers")
        return (
            self.alive
            and fresh
            and self.safety is not None
            and self.safety.deadman
            and not self.safety.estop
        )

    def plain(self) -> dict[str, Any]:
        """Returns it as plain JSON data; what is not finite is null."""
        return _to_plain(asdict(self))


@dataclass(frozen=True)
class OperatorRequest:
    """What a person wants done, checked already: token, origin, dead-man.

    Attributes:
        kind: `start` and `stop` guiding, `record` on or off, choose a `target`, `point` at a
            borehole in the picture.
        value: `on` or `off` for `record`, the name of the `target`, `x,y` of the point as parts of
            the picture from its upper left corner, else empty.
    """

    kind: RequestKind
    value: str


@dataclass(frozen=True)
class DrawReport:
    """When an advice became visible on a page; reaction times count from then.

    Attributes:
        number: Of the advice.
        t_s: Monotonic time of this computer at which its frame was drawn, by the browser's clock
            and half the round trip.
        round_trip_s: Of the shortest memory with that page so far; half of it is how wrong `t_s`
            may be.
        page: Counts the pages that were opened.
    """

    number: int
    t_s: float
    round_trip_s: float
    page: int


class PageFeed(Protocol):
    """Where the page gets its state from, and where wishes go. No method waits: the loop must never feel the page."""

    def news(self) -> int | None:
        """Returns the number of the newest advice, `None` where there is none: whether `shown` has a new one, at little cost."""
        ...

    def shown(self) -> PageState:
        """Returns the newest state."""
        ...

    def frame(self, after_s: float) -> Frame | None:
        """Returns the newest frame if it is later than `after_s`, else `None`."""
        ...

    def wish(self, wish: OperatorRequest) -> bool:
        """Hands a wish on; says whether it was taken."""
        ...

    def drawn(self, drawn: DrawReport) -> None:
        """Hands on when something became visible."""
        ...


def _to_plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
