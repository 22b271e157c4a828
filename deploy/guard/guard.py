"""The guard: the last check of a command before it is sent.

Pure: no clock, no bus, no file, no tensor; the caller hands in everything.

    SILENT   nothing is sent. The default.
    LATCHED  zero is sent. Left only by hand: dead-man released, levers in neutral, nothing wrong.
    READY    zero is sent, until the dead-man is pressed, levers in neutral.
    ACTIVE   the requested command is sent, within the limits.

    SILENT --armed on purpose--> LATCHED --released, neutral, healthy--> READY
    READY --pressed, neutral, healthy--> ACTIVE
    ACTIVE --released--> READY
    ACTIVE or READY --anything wrong--> LATCHED
    any --no longer armed--> SILENT

Away from zero a command grows by no more than `max_rate_1_s`; towards zero it may fall at once. A
joint that has changed its direction `max_reversals_1_s` times within a second gets zero instead of a
further change. The envelope withholds what brings the arm too near to an obstacle.
Nothing is ever sent that the guard has not checked in the same cycle.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum

from deploy.guard.envelope import Envelope
from deploy.guard.limits import GuardLimits, JointBounds, Numbers


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
    ENVELOPE = "arm too near to ground, machine or a stay-out box"


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
        observed: Fault of a joint that does not move as commanded, else `GuardTrip.NONE`.
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
    observed: GuardTrip


@dataclass(frozen=True)
class CommandRequest:
    """A command to be sent.

    Attributes:
        u: Commands, `(J,)`.
        age_s: Since it was made.
        face_in_base_m: A point of the work surface, the rim of the borehole; `None` where none is
            known.
    """

    u: Numbers
    age_s: float
    face_in_base_m: Numbers | None


@dataclass(frozen=True)
class GuardDecision:
    """Decision of the guard in one cycle.

    Attributes:
        state: See the module.
        u: Command to send, `(J,)`; all zero unless ACTIVE.
        trip: Why the requested command is not sent now; `ENVELOPE` alone leaves the guard ACTIVE.
        cause: Why the guard latched last.
    """

    state: GuardState
    u: Numbers
    trip: GuardTrip
    cause: GuardTrip

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
        if wrong is GuardTrip.NONE and self._state is GuardState.ACTIVE and seen.deadman:
            wrong = self._check_request(request)
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
            return self._conclude(self._still, GuardTrip.NONE)
        assert request is not None
        limited = self._limit_command(request.u, seen.q, elapsed_s)
        if self._envelope is None:
            return self._conclude(limited, GuardTrip.NONE)
        face = request.face_in_base_m
        inside, held = self._envelope.limit_command(now_s, limited, seen.q, face)
        return self._conclude(inside, GuardTrip.ENVELOPE if held else GuardTrip.NONE)

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
            (not seen.estop, GuardTrip.ESTOP),
            (seen.trusted, GuardTrip.CHANNEL_INVALID),
            (seen.status_age_s <= limits.status_s, GuardTrip.STATUS_STALE),
            (seen.levers_age_s <= limits.levers_s, GuardTrip.LEVERS_STALE),
            (seen.joints_age_s <= limits.joints_s, GuardTrip.JOINTS_STALE),
            (seen.joints_plausible and all(map(math.isfinite, seen.q)), GuardTrip.JOINTS_INVALID),
            (seen.observed is GuardTrip.NONE, seen.observed),
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
        return GuardTrip.NONE

    def _check_request(self, request: CommandRequest | None) -> GuardTrip:
        """Return the fault of a request."""
        if request is None or not _is_recent(request.age_s, self._limits.request_s):
            return GuardTrip.REQUEST_STALE
        if not all(map(math.isfinite, request.face_in_base_m or ())):
            return GuardTrip.REQUEST_INVALID
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

    def _limit_command(self, u: Numbers, q: Numbers, elapsed_s: float) -> Numbers:
        """Return the command within magnitude, growth and joint limits."""
        limits, bounds = self._limits, self._bounds
        most = limits.max_rate_1_s * elapsed_s
        values = []
        for wanted, sent, at, lower, upper in zip(
            u, self._sent, q, bounds.lower, bounds.upper, strict=True
        ):
            value = max(-limits.max_command, min(limits.max_command, wanted))
            start = abs(sent) if value * sent > 0 else 0.0
            value = math.copysign(min(abs(value), start + most), value)
            outward = (value > 0 and at >= upper - limits.stop_margin) or (
                value < 0 and at <= lower + limits.stop_margin
            )
            values.append(0.0 if outward else value)
        return tuple(self._limit_reversals(joint, value) for joint, value in enumerate(values))

    def _limit_reversals(self, joint: int, value: float) -> float:
        """Return the command of a joint, or zero where it would change its direction too often."""
        if value == 0.0:
            return value
        before, reversed_s = self._directions[joint], self._reversed_s[joint]
        if value * before < 0:
            if self._before_s - reversed_s[0] < 1.0:
                return 0.0
            reversed_s.append(self._before_s)
        self._directions[joint] = math.copysign(1.0, value)
        return value

    def _conclude(self, u: Numbers, trip: GuardTrip) -> GuardDecision:
        self._sent = u
        if self._envelope is not None:
            self._envelope.note_sent(self._before_s, u)
        return GuardDecision(self._state, u, trip, self._cause)


def _is_recent(age_s: float, most_s: float) -> bool:
    """Return whether a record of this computer is new enough; one from the future is none."""
    # A record may be written between the clock's reading and its own.
    return abs(age_s) <= most_s
