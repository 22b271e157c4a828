"""Limits of the guard, and the machine's bounds that it goes by. Pure data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Interval

from brokk_rl.errors import ConfigError
from brokk_rl.spec import Count, NonNegative, Positive, spec

Numbers = tuple[float, ...]
ROUNDING = 1e-6
"""Difference from length 1 that counts as rounding of a file."""


@spec
class StayOutBox:
    """A box that the arm stays out of, along the axes of the base frame.

    Attributes:
        lower_m: Its corner of smallest coordinates, `(x, y, z)`.
        upper_m: Its corner of largest coordinates.
    """

    lower_m: tuple[float, float, float]
    upper_m: tuple[float, float, float]

    def check(self) -> None:
        if not all(low < high for low, high in zip(self.lower_m, self.upper_m, strict=True)):
            raise ConfigError(
                f"guard.envelope.stay_out: expected lower_m below upper_m, got {self.lower_m} and {self.upper_m}"
            )


@spec
class EnvelopeLimits:
    """Limits of the envelope; see `deploy.checks.envelope`.

    Attributes:
        shapes: File with the machine's shapes, from `brokk mode=export`: a path, or `package:path`.
        margin_m: Distance to obstacles below which the arm is brought no nearer.
        release_m: Further distance that it must have before a withheld command passes again.
        ground_m: Height of the ground in the base frame; `null`: there is none.
        stay_out: Boxes to stay out of, by name.
        face_normal: Unit vector out of the work surface, in the base frame. The surface goes
            through the rim of the chosen borehole.
        face_near_m: Distance to the work surface below which the tip is slowed.
        face_radius_m: Distance from the borehole, along the surface, up to which that holds.
        face_speed_m_s: Largest speed of the tip there.
    """

    shapes: str
    margin_m: Positive
    release_m: Positive
    ground_m: float | None
    stay_out: dict[str, StayOutBox]
    face_normal: tuple[float, float, float]
    face_near_m: Positive
    face_radius_m: Positive
    face_speed_m_s: Positive

    def check(self) -> None:
        if abs(math.hypot(*self.face_normal) - 1.0) > ROUNDING:
            raise ConfigError(f"face_normal: expected a unit vector, got {self.face_normal}")


@spec
class TargetLimits:
    """Limits of the borehole that commands are made for; see `deploy.kernel.target_check`.

    Attributes:
        age_s: Age from which it is too old.
        jump_m: Distance by which a borehole has jumped, and is another one.
        settle_s: Time for which one has to stay before it counts.
        seen_s: Age up to which the camera's boreholes show where the face is.
        face_step_m: Height above or below the boreholes seen around it from which it is not on
            their face.
        face_radius_m: Distance along the face up to which they count.
        contact_m: Height over the rim, and distance from the axis, up to which the chisel may touch
            the borehole. There a joint may stand still against its command.
    """

    age_s: Positive
    jump_m: Positive
    settle_s: Positive
    seen_s: Positive
    face_step_m: Positive
    face_radius_m: Positive
    contact_m: Positive


@spec
class FlowLimits:
    """Limits of the valves' feedback; see `deploy.kernel.flow_check`.

    Attributes:
        tolerance: Flow, of full, by which it may differ from what was asked for.
        settle_s: Time beyond the round trip for which the last flow may still be reported.
        num_messages: Messages on end that must differ.
        lever_scale: Largest flow over a lever's deflection.
    """

    tolerance: Positive
    settle_s: Positive
    num_messages: Count
    lever_scale: Annotated[float, Ge(1)]


@spec
class ObserverLimits:
    """Limits of the observer; its thresholds stand in its file, see `deploy.checks.observer`.

    Attributes:
        path: Its file, from `brokk mode=observe`: a path, or `package:path`.
    """

    path: str


@spec
class GuardLimits:
    """Limits of the guard.

    Attributes:
        max_command: Largest command, of full.
        max_rate_1_s: Largest growth of a command per second.
        max_reversals_1_s: Changes of a joint's direction within a second; more are withheld.
        max_starts_1_s: Times that a joint leaves rest within a second; more are withheld.
        overrun: Command beyond full that counts as rounding; a larger one is refused.
        neutral: Deflection of the operator's own levers, of full, below which they count as
            released.
        stop_margin: Distance to the joint limits (rad or m) within which no joint may come to rest
            on its way outward.
        stop_release: Further distance that a joint must have before it goes on.
        speed_margin: Speed over the machine's fastest that the look ahead assumes.
        coast_s: Time after the dead time until a joint rests.
        reaction_s: Time for which a command acts before the guard can take it back.
        joints_s: Age of joint positions from which they are stale.
        levers_s: Age of the remote's message from which it is stale.
        status_s: Age of the machine's status from which it is stale.
        request_s: Age of a command from which it is stale.
        ignored_s: Time for which the gateway may give the valves to another sender, or none, while
            commands are sent.
        controls_s: Age of the operator's switches from which they are stale.
        page_s: Age of the page's signal from which it is dead, where commands are sent and there is
            a page.
        vigilance_s: Time for which the dead-man may be held before the operator is asked to show
            that they are there; `null`: never.
        answer_s: Time to answer.
        round_trip_s: Time from the gateway to this computer and back from which it is too long.
        gap_s: Time between two cycles above which the process was stopped, or the computer asleep.
        jump_margin: Speed over the machine's fastest, beyond which a joint has jumped.
        jump_slack: Jump (rad or m) that noise alone may make.
        range_slack: Distance beyond the joint limits (rad or m) at which a position is still
            believed.
        num_jumps: Jumps among the last samples (`deploy.kernel.plausibility.WINDOW`) after which positions are not plausible.
        flow: Limits of the valves' feedback.
        target: Limits of the borehole.
        envelope: Limits of the arm in space; `null`: none. Without the machine's geometry there
            is none either.
        observer: Limits of the observer; `null`: none. For a machine other than that of its file
            there is none either, and where commands are sent that is an error.
    """

    max_command: Annotated[float, Interval(gt=0, le=1)]
    max_rate_1_s: Positive
    max_reversals_1_s: Count
    max_starts_1_s: Count
    overrun: NonNegative
    neutral: Annotated[float, Interval(gt=0, lt=1)]
    stop_margin: NonNegative
    stop_release: NonNegative
    speed_margin: Annotated[float, Ge(1)]
    coast_s: Positive
    reaction_s: Positive
    joints_s: Positive
    levers_s: Positive
    status_s: Positive
    request_s: Positive
    ignored_s: Positive
    controls_s: Positive
    page_s: Positive
    vigilance_s: Positive | None
    answer_s: Positive
    round_trip_s: Positive
    gap_s: Positive
    jump_margin: Annotated[float, Ge(1)]
    jump_slack: Positive
    range_slack: Positive
    num_jumps: Count
    flow: FlowLimits
    target: TargetLimits
    envelope: EnvelopeLimits | None
    observer: ObserverLimits | None


@dataclass(frozen=True)
class JointBounds:
    """Bounds of the machine's joints, each of length `J`, in plain numbers: the guard knows no numpy.

    Attributes:
        lower: Lower joint limits, rad or m.
        upper: Upper joint limits.
        max_speed: Speeds at full command, rad/s or m/s.
        exclusive: Joints that never move together with others.
        dead_time_s: Time after which a command acts.
    """

    lower: Numbers
    upper: Numbers
    max_speed: Numbers
    exclusive: tuple[bool, ...]
    dead_time_s: float
