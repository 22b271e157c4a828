"""The guard: the last check of a command before it is sent.

Pure: no clock, no bus, no file, no tensor; the caller hands in everything.

    SILENT   nothing is sent. The default.
    LATCHED  zero is sent. Left only by hand: dead-man released, levers in neutral, nothing wrong.
    READY    zero is sent, until the dead-man is pressed, levers in neutral.
    ACTIVE   the requested command is sent, within the limits.

    SILENT --armed on purpose--> LATCHED --released, neutral, healthy, a fresh command--> READY
    READY --pressed, neutral, healthy--> ACTIVE
    ACTIVE --released--> READY
    ACTIVE or READY --anything wrong--> LATCHED
    any --no longer armed--> SILENT

Away from zero a command grows by no more than `max_rate_1_s`; towards zero it may fall at once. A
joint that has changed its direction `max_reversals_1_s` times within a second, or has left rest
`max_starts_1_s` times, gets zero instead. So does one that would come to rest beyond its limit: the
commands of the dead time are still under way. The envelope withholds what brings the arm too near
to an obstacle. A dead-man that is held for long has to be answered for (`vigilance_s`).
Nothing is ever sent that the guard has not checked in the same cycle.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from deploy.kernel.limits import GuardLimits, JointBounds, Numbers
from deploy.kernel.under_way import CommandsUnderWay

# It is handed in: the guard itself needs no numpy.
if TYPE_CHECKING:
    from deploy.checks.envelope import Envelope


class GuardState(Enum):
    """State of the guard; its number travels on the bus."""

    SILENT = 0
    LATCHED = 1
    READY = 2
    ACTIVE = 3

    @property
    def sends(self) -> bool:
        """True if anything is sent at all in this state."""
        return self is not GuardState.SILENT


class GuardTrip(Enum):
    """Why the guard does not pass a requested command."""

    NONE = "nothing"
    BUS_DOWN = "bus down"
    TIME_GAP = "time stood still"
    ESTOP = "emergency stop"
    STATUS_STALE = "machine status missing"
    LEVERS_STALE = "remote missing"
    JOINTS_STALE = "joint positions missing"
    JOINTS_INVALID = "joint positions not plausible"
    FEEDBACK_STALE = "valve feedback missing"
    CHANNEL_INVALID = "messages corrupted or from two senders"
    CONTROLS_STALE = "operator's switches missing"
    PAGE_SILENT = "operator's page silent"
    DESCRIPTION = "gateway has another bus description or machine"
    VIGILANCE = "operator did not answer"
    ROUND_TRIP = "way to the gateway and back unknown or too long"
    SECOND_SENDER = "somebody else sends commands"
    LEVER = "operator moves a lever"
    IGNORED = "the gateway does not follow"
    DEADMAN = "dead-man released"
    REQUEST_STALE = "no fresh command"
    REQUEST_INVALID = "command is no number, or beyond full"
    REQUEST_EXCLUSIVE = "exclusive joint together with others"
    NOT_ARMED = "not armed"
    JOINT_STILL = "a joint stands still: sensor, valve or hose"
    JOINT_TURNED = "a joint moves the wrong way: sensor or valve turned"
    JOINT_WEAK = "a joint moves too little: valve, hose or sensor"
    JOINT_DRIFTS = "a joint moves unasked: sensor drifts, or valve leaks"
    FLOW_UNASKED = "a joint is driven unasked, or in place of another"
    FLOW_TURNED = "a joint is driven the wrong way"
    FLOW_SCALED = "a joint is driven more or less than asked"
    PULSES = "valves switched too often"
    TARGET_INVALID = "borehole is no number"
    TARGET_OLD = "borehole found too long ago"
    TARGET_REACH = "borehole out of reach"
    TARGET_GROUND = "borehole below the ground"
    TARGET_FACE = "borehole off the seen face"
    TARGET_JUMPS = "borehole has just jumped"
    ENVELOPE = "arm too near to ground, machine or a stay-out box"


@dataclass(frozen=True)
class Observation:
    """Fault of a joint that is not driven or does not move as asked.

    Attributes:
        fault: The fault, `GuardTrip.NONE` while all joints move as commanded.
        joint: Number of its joint, -1 without.
    """

    fault: GuardTrip
    joint: int


NOTHING_OBSERVED = Observation(GuardTrip.NONE, -1)
"""Where nothing was found, or nobody looks."""


@dataclass(frozen=True)
class GuardInput:
    """Known values in one cycle. Ages in s, infinite where nothing has come yet.

    Attributes:
        q: Joint positions, `(J,)`, rad or m.
        joints_age_s: Age of the oldest of them.
        joints_plausible: Whether the sensors call them valid and they did not jump.
        trusted: Whether no needed channel is invalid.
        levers_age_s: Age of the remote's message.
        lever: Largest deflection of the operator's own levers, of full.
        deadman: Whether the dead-man is held.
        status_age_s: Age of the machine's status.
        estop: Whether an emergency stop is on.
        bus_up: Whether the bus works.
        alone: Whether nobody else sends valve commands.
        followed: Whether the gateway says that it goes by our commands.
        feedback_age_s: Age of the valves' feedback; it matters only while armed.
        controls_age_s: Age of the switches that arm; they matter only while armed.
        round_trip_s: Time from the gateway to here and back to it, as the gateway measured it on
            our commands; it matters only while armed, since nothing is sent otherwise.
        page_age_s: Age of the page's signal; 0 where there is no page. It matters only while armed.
        present_age_s: Since a person touched the page last; infinite where nobody has.
        described: Whether the gateway goes by our bus description and machine; `None` before it has
            said so.
        observed: Fault of a joint that is not driven or does not move as asked, else
            `GuardTrip.NONE`.
    """

    q: Numbers
    joints_age_s: float
    joints_plausible: bool
    trusted: bool
    levers_age_s: float
    lever: float
    deadman: bool
    status_age_s: float
    estop: bool
    bus_up: bool
    alone: bool
    followed: bool
    feedback_age_s: float
    controls_age_s: float
    round_trip_s: float
    page_age_s: float
    present_age_s: float
    described: bool | None
    observed: GuardTrip


@dataclass(frozen=True)
class CommandRequest:
    """A command to be sent.

    Attributes:
        u: Commands, `(J,)`.
        age_s: Since it was made.
        target: Fault of the borehole that it is for; `GuardTrip.NONE` without one.
        faces_in_base_m: Points of the work surface: the borehole's rim, and those that the camera
            sees; `None` where the command is for no borehole.
        is_seen: Whether the camera sees the work surface.
    """

    u: Numbers
    age_s: float
    target: GuardTrip = GuardTrip.NONE
    faces_in_base_m: tuple[Numbers, ...] | None = None
    is_seen: bool = False


@dataclass(frozen=True)
class GuardDecision:
    """Decision of the guard in one cycle.

    Attributes:
        state: See the module.
        u: Command to send, `(J,)`; all zero unless ACTIVE.
        trip: Why the requested command is not sent now; `ENVELOPE` alone leaves the guard ACTIVE.
        cause: Why the guard latched last.
        prompt: Whether the operator is asked to show that they are there.
    """

    state: GuardState
    u: Numbers
    trip: GuardTrip
    cause: GuardTrip
    prompt: bool = False

    @property
    def sends(self) -> bool:
        """True if anything is sent at all."""
        return self.state.sends


class Guard:
    """State machine that passes, limits or withholds each requested command.

    Args:
        limits: Limits on commands, ages and positions.
        bounds: The machine.
        envelope: Of the arm; `None`: there is none.
    """

    def __init__(self, limits: GuardLimits, bounds: JointBounds, envelope: Envelope | None) -> None:
        self._limits, self._bounds, self._envelope = limits, bounds, envelope
        self._still = (0.0,) * len(bounds.lower)
        self._state, self._cause = GuardState.SILENT, GuardTrip.NONE
        # NaN stands for never: no comparison with it holds
        self._sent, self._before_s, self._followed_s = self._still, math.nan, math.nan
        # Last direction of each joint, and when its last changes were, newest last.
        self._directions = [0.0] * len(self._still)
        most = limits.max_reversals_1_s
        self._reversed_s = [deque[float]([-math.inf] * most, most) for _ in self._still]
        most = limits.max_starts_1_s
        self._started_s = [deque[float]([-math.inf] * most, most) for _ in self._still]
        self._under_way = CommandsUnderWay(len(self._still), bounds.dead_time_s + limits.coast_s)
        # Direction in which each joint is withheld at its stop, 0 for none.
        self._held = [0.0] * len(self._still)
        # Since when the dead-man is held without a sign of the operator.
        self._awake_s, self._prompt = math.inf, False

    def decide(
        self, now_s: float, armed: bool, seen: GuardInput, request: CommandRequest | None
    ) -> GuardDecision:
        """Return the command to send in this cycle.

        Args:
            now_s: Monotonic time.
            armed: Whether commands are to be sent at all.
            seen: Known values.
            request: The requested command, `None` for nothing yet.
        """
        elapsed_s, self._before_s = now_s - self._before_s, now_s
        wrong = self._check_health(seen, elapsed_s)
        if seen.followed or self._state is not GuardState.ACTIVE:
            self._followed_s = now_s
        elif now_s - self._followed_s > self._limits.ignored_s and wrong is GuardTrip.NONE:
            wrong = GuardTrip.IGNORED
        if not armed:
            self._state, self._cause = GuardState.SILENT, GuardTrip.NONE
            return self._conclude(
                self._still, wrong if wrong is not GuardTrip.NONE else GuardTrip.NOT_ARMED
            )
        if self._state is GuardState.SILENT:
            self._state, self._cause = GuardState.LATCHED, GuardTrip.NOT_ARMED
        if wrong is GuardTrip.NONE:
            wrong = self._check_way(seen)
        if wrong is GuardTrip.NONE:
            wrong = self._check_request(request)
        if wrong is GuardTrip.NONE and self._state is GuardState.ACTIVE and seen.deadman:
            wrong = self._check_vigilance(now_s, seen)
        if wrong is not GuardTrip.NONE:
            if self._state is not GuardState.LATCHED:
                self._state, self._cause = GuardState.LATCHED, wrong
            return self._conclude(self._still, wrong)
        if not seen.deadman:
            self._state = GuardState.READY  # released, in neutral, nothing wrong: may be pressed
            return self._conclude(self._still, GuardTrip.DEADMAN)
        if self._state is GuardState.LATCHED:
            return self._conclude(self._still, self._cause)
        if self._state is GuardState.READY:
            self._state, self._cause = GuardState.ACTIVE, GuardTrip.NONE
            self._awake_s, self._prompt = now_s, False
            return self._conclude(self._still, GuardTrip.NONE)
        assert request is not None
        under_way = self._under_way.integrate(now_s)
        limited, trip = self._limit_command(request.u, seen.q, under_way, elapsed_s)
        if self._envelope is not None:
            faces, is_seen = request.faces_in_base_m, request.is_seen
            limited, held = self._envelope.limit_command(limited, seen.q, under_way, faces, is_seen)
            trip = GuardTrip.ENVELOPE if held else trip
        return self._conclude(limited, trip)

    def stops(self, seen: GuardInput) -> bool:
        """Return whether the motion must end: then the caller decides at once, not next cycle."""
        return self._state is GuardState.ACTIVE and (
            not seen.deadman or self._check_health(seen, 0.0) is not GuardTrip.NONE
        )

    def _check_health(self, seen: GuardInput, elapsed_s: float) -> GuardTrip:
        """Return the first fault, whatever command is requested."""
        limits = self._limits
        checks = (
            (seen.bus_up, GuardTrip.BUS_DOWN),
            (0.0 <= elapsed_s <= limits.gap_s, GuardTrip.TIME_GAP),
            # Before the emergency stop, which is shown all the same.
            (seen.observed is GuardTrip.NONE, seen.observed),
            (not seen.estop, GuardTrip.ESTOP),
            (seen.trusted, GuardTrip.CHANNEL_INVALID),
            (seen.described is not False, GuardTrip.DESCRIPTION),
            (seen.status_age_s <= limits.status_s, GuardTrip.STATUS_STALE),
            (seen.levers_age_s <= limits.levers_s, GuardTrip.LEVERS_STALE),
            (seen.joints_age_s <= limits.joints_s, GuardTrip.JOINTS_STALE),
            (seen.joints_plausible and all(map(math.isfinite, seen.q)), GuardTrip.JOINTS_INVALID),
            (seen.alone, GuardTrip.SECOND_SENDER),
            (seen.lever <= limits.neutral, GuardTrip.LEVER),
        )
        return next((trip for fine, trip in checks if not fine), GuardTrip.NONE)

    def _check_way(self, seen: GuardInput) -> GuardTrip:
        """Return the fault of what only matters where commands are sent."""
        if not seen.feedback_age_s <= self._limits.status_s:
            return GuardTrip.FEEDBACK_STALE
        if not _is_recent(seen.controls_age_s, self._limits.controls_s):
            return GuardTrip.CONTROLS_STALE
        if not seen.round_trip_s <= self._limits.round_trip_s:
            return GuardTrip.ROUND_TRIP
        if not _is_recent(seen.page_age_s, self._limits.page_s):
            return GuardTrip.PAGE_SILENT
        return GuardTrip.NONE if seen.described else GuardTrip.DESCRIPTION

    def _check_vigilance(self, now_s: float, seen: GuardInput) -> GuardTrip:
        """Return the fault of an operator who holds the dead-man and gives no other sign."""
        self._awake_s = max(self._awake_s, now_s - seen.present_age_s)
        vigilance_s = self._limits.vigilance_s
        held_s = now_s - self._awake_s
        self._prompt = vigilance_s is not None and held_s > vigilance_s
        if vigilance_s is not None and held_s > vigilance_s + self._limits.answer_s:
            return GuardTrip.VIGILANCE
        return GuardTrip.NONE

    def _check_request(self, request: CommandRequest | None) -> GuardTrip:
        """Return the fault of a request."""
        if request is not None and request.target is not GuardTrip.NONE:
            return request.target
        if request is None or not _is_recent(request.age_s, self._limits.request_s):
            return GuardTrip.REQUEST_STALE
        full = 1.0 + self._limits.overrun
        if len(request.u) != len(self._still) or not all(
            -full <= value <= full for value in request.u
        ):
            return GuardTrip.REQUEST_INVALID
        moved = set()
        for exclusive, value in zip(self._bounds.exclusive, request.u, strict=True):
            if value != 0:
                moved.add(exclusive)
        alone = sum(value != 0 for value in request.u) == 1
        if True in moved and not alone:
            return GuardTrip.REQUEST_EXCLUSIVE
        return GuardTrip.NONE

    def _limit_command(
        self, u: Numbers, q: Numbers, under_way: Numbers, elapsed_s: float
    ) -> tuple[Numbers, GuardTrip]:
        """Return the command within magnitude, growth, joint limits and switching, and the last's trip."""
        limits, trip = self._limits, GuardTrip.NONE
        most = limits.max_rate_1_s * elapsed_s
        values = []
        for joint, wanted in enumerate(u):
            value = max(-limits.max_command, min(limits.max_command, wanted))
            sent = self._sent[joint]
            start = abs(sent) if value * sent > 0 else 0.0
            value = math.copysign(min(abs(value), start + most), value)
            value = self._limit_outward(joint, value, q[joint], under_way[joint])
            if self._switches_too_often(joint, value):
                value, trip = 0.0, GuardTrip.PULSES
            values.append(value)
        return tuple(values), trip

    def _limit_outward(self, joint: int, value: float, q: float, under_way_s: float) -> float:
        """Return the command of a joint, or zero where it would come to rest beyond its limit."""
        limits, bounds = self._limits, self._bounds
        speed = bounds.max_speed[joint] * limits.speed_margin
        rest = q + speed * under_way_s
        # A joint that is withheld needs some more room before it goes on: no chatter at the stop.
        room = limits.stop_margin
        if value * self._held[joint] > 0:
            room += limits.stop_release
        further = rest + speed * value * limits.reaction_s
        outward = (value > 0 and further >= bounds.upper[joint] - room) or (
            value < 0 and further <= bounds.lower[joint] + room
        )
        self._held[joint] = math.copysign(1.0, value) if outward else 0.0
        return 0.0 if outward else value

    def _reverses(self, joint: int, value: float) -> bool:
        return value * self._directions[joint] < 0

    def _starts(self, joint: int, value: float) -> bool:
        return value != 0.0 and self._sent[joint] == 0.0

    def _switches_too_often(self, joint: int, value: float) -> bool:
        """Return whether a command would reverse a joint, or let it leave rest, once too often."""
        second_ago_s = self._before_s - 1.0
        if self._reverses(joint, value) and self._reversed_s[joint][0] > second_ago_s:
            return True
        return self._starts(joint, value) and self._started_s[joint][0] > second_ago_s

    def _note_switching(self, u: Numbers) -> None:
        """Remember reversals and starts of what is sent now."""
        for joint, value in enumerate(u):
            if self._reverses(joint, value):
                self._reversed_s[joint].append(self._before_s)
            if self._starts(joint, value):
                self._started_s[joint].append(self._before_s)
            if value != 0.0:
                self._directions[joint] = math.copysign(1.0, value)

    def _conclude(self, u: Numbers, trip: GuardTrip) -> GuardDecision:
        self._note_switching(u)
        self._sent = u
        self._under_way.note(self._before_s, u)
        prompt = self._prompt and self._state is GuardState.ACTIVE
        return GuardDecision(self._state, u, trip, self._cause, prompt)


def _is_recent(age_s: float, most_s: float) -> bool:
    """Return whether a record of this computer is new enough; one from the future is none."""
    # A record may be written between the clock's reading and its own.
    return abs(age_s) <= most_s
