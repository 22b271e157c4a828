"""The state of machine, operator and guard, and the policy's advice, as all processes read them.

The bus process writes `OperatorState` into shared memory, the policy process `PolicyAdvice`; page,
study read them from there. Times are monotonic, in s, and 0 where nothing has come
yet. Old values are never left out: their age says how old they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from deploy.guidance import LeverPositions
from deploy.kernel.guard import GuardState, GuardTrip
from deploy.runtime.shared_memory import Axes, Joints, Point

ALIVE_S = 0.2
"""Age of the newest state up to which the bus process counts as running: 20 of its cycles. Chosen
by hand; longer hides a dead process, shorter takes a busy computer for one."""


class AdviceStatus(Enum):
    """Why there is an advice, or none; stored by position."""

    VALID = "valid"
    NO_STATE = "nothing from the bus"
    STALE = "positions are stale"
    IMPLAUSIBLE = "positions are not plausible"
    WARMING_UP = "history is filling"
    NO_TARGET = "no borehole is known"
    TARGET_OLD = "the borehole was found too long ago"
    TARGET_REFUSED = "the borehole is beyond its limits"
    TARGET_UNKNOWN = "the policy was not trained for such a borehole"
    FAULT = "a sensor or valve is faulty"
    REJECTED = "the policy's answer makes no sense"
    DONE = "the chisel is in the borehole"


@dataclass(frozen=True, eq=False)
class OperatorState:
    """Machine, operator and guard in one cycle of the bus process.

    Attributes:
        t_s: Time of the cycle.
        q: Joint positions, rad or m, in machine order.
        q_t_s: When the oldest of them was measured.
        q_plausible: Whether the sensors call them valid and they did not jump.
        flow: Valve feedback received last, of full.
        flow_sum: Sum over all feedback so far, for means over any period.
        flow_number: Number of feedback messages so far.
        flow_t_s: When the last of them came.
        lever: The operator's own levers, of full, in the order of `deploy.guidance.AXES`.
        button_right: Whether the operator holds the right button.
        deadman: Whether the dead-man is held.
        remote_on: Whether the remote is switched on.
        levers_t_s: When the remote's last message came.
        estop: Whether an emergency stop is on.
        exclusive_selected: Whether the exclusive joint is selected at the machine.
        status_t_s: When the machine's last status came.
        oil_c: Temperature of the oil, degrees Celsius; NaN where not measured.
        held_up_s: Largest delay of a message beyond the shortest seen, by the gateway's clock.
        round_trip_s: From the gateway to here and back, as it measured on our commands; infinite
            where it has not.
        bus_up: Whether the bus works.
        trusted: Whether messages arrive uncorrupted.
        alone: Whether nobody else sends valve commands.
        guard: State of the guard.
        trip: Why the guard lets nothing pass now.
        cause: Why it latched last.
        sent: Commands sent, of full.
        frames: Messages received so far.
        refused: Messages refused so far.
        lost: Messages lost so far.
        missed: Cycles missed so far.
        target: Fault of the borehole, `GuardTrip.NONE` for none.
        prompt: Whether the operator is asked to show that they are there.
        observed_joint: Number, from 1, of the joint that is not driven or does not move as asked; 0
            while all do.
    """

    t_s: float
    q: Joints
    q_t_s: float
    q_plausible: bool
    flow: Joints
    flow_sum: Joints
    flow_number: int
    flow_t_s: float
    lever: Axes
    button_right: bool
    deadman: bool
    remote_on: bool
    levers_t_s: float
    estop: bool
    exclusive_selected: bool
    status_t_s: float
    oil_c: float
    held_up_s: float
    round_trip_s: float
    bus_up: bool
    trusted: bool
    alone: bool
    guard: GuardState
    trip: GuardTrip
    cause: GuardTrip
    sent: Joints
    frames: int
    refused: int
    lost: int
    missed: int
    target: GuardTrip
    prompt: bool
    observed_joint: int

    @property
    def levers(self) -> LeverPositions:
        """The operator's own levers."""
        return LeverPositions(*self.lever.tolist(), button_right=self.button_right)


@dataclass(frozen=True, eq=False)
class PolicyAdvice:
    """Result of one control period of the policy process.

    Attributes:
        t_s: When it was made.
        number: Counts up; tells a new advice from an old one.
        reason: `VALID`, or why there is no advice; then the levers are on their way to neutral.
        u: Advised commands in machine order; zero unless valid.
        lever_rad: Lever angles to show, in the order of `deploy.guidance.AXES`.
        button_right: Whether the right button is to be held.
        target_in_base_m: Centre of the rim of the borehole that it is for.
        infer_s: Time that the network took.
    """

    t_s: float
    number: int
    reason: AdviceStatus
    u: Joints
    lever_rad: Axes
    button_right: bool
    target_in_base_m: Point
    infer_s: float

    @property
    def valid(self) -> bool:
        """True if there is an advice."""
        return self.reason is AdviceStatus.VALID


@dataclass(frozen=True, eq=False)
class RequestedCommand:
    """Commands that the policy, or whoever commands the valves on purpose, wants sent.

    Attributes:
        t_s: When they were made.
        u: Commands in machine order, of full.
    """

    t_s: float
    u: Joints


@dataclass(frozen=True)
class OperatorControls:
    """Switches on the operator's side.

    Attributes:
        t_s: When they were written; the guard latches when that is long ago.
        armed: Whether commands are to be sent at all.
        armed_t_s: When a person asked for that. A later stop is stronger.
        recording: Whether a recording is running.
        recording_t_s: When it began.
        recording_failed: Whether a recording has ended unasked.
    """

    t_s: float
    armed: bool
    armed_t_s: float
    recording: bool = False
    recording_t_s: float = 0.0
    recording_failed: bool = False


@dataclass(frozen=True)
class PageSignal:
    """Word of the operator's page. It reaches the bus process directly, without the supervisor.

    Attributes:
        t_s: When it was written; a page that is dead writes no more.
        stopped_s: When STOP was pressed last; 0: never.
        present_s: When a person touched the page last; 0: never.
    """

    t_s: float
    stopped_s: float
    present_s: float


@dataclass(frozen=True)
class LoopSnapshot:
    """State and advice at one moment; `None` where nothing has come yet.

    Attributes:
        t_s: Time of the snapshot.
        state: Newest state.
        advice: Newest advice.
        commands: Whether this loop can command valves at all; in the default mode it cannot.
        log_dropped: Records that the log could not take: the recording has gaps.
    """

    t_s: float
    state: OperatorState | None
    advice: PolicyAdvice | None
    commands: bool
    log_dropped: int

    @property
    def alive(self) -> bool:
        """True while the bus process is running."""
        return self.state is not None and self.t_s - self.state.t_s < ALIVE_S
