"""Do the valves get what was asked for? Commands, levers and valve feedback, compared. Pure.

A joint's feedback is right where it lies between the least and the largest value that was asked for
lately: by commands where the gateway follows them, else by the levers. At an emergency stop nothing
is asked for. So one comparison finds a flow that nobody asked for, a turned sign, another scale, and
the flow of another joint, at rest and in motion, whether or not this computer sends anything.
"""

from __future__ import annotations

from collections import deque
from typing import TypeVar

from deploy.kernel.guard import GuardTrip
from deploy.kernel.limits import FlowLimits, Numbers

T = TypeVar("T")
NOBODY, LEVERS, FROM_PC = 0, 1, 2
"""Values of `FlowSource`."""
MOST_NOTED = 1000
"""Commands, and positions of levers, that are kept where no feedback comes: seconds of each. By hand."""


class FlowCheck:
    """Comparison of valve feedback with commands and levers.

    Args:
        limits: Tolerances.
        num_joints: `J`.
        round_trip_s: Longest way to the gateway and back; what was asked for so long ago may be in
            force.

    Attributes:
        fault: The fault, `GuardTrip.NONE` while the flow is as asked for.
        joint: Number of its joint, -1 without.
    """

    def __init__(self, limits: FlowLimits, num_joints: int, round_trip_s: float) -> None:
        self._limits, self._round_trip_s = limits, round_trip_s
        nothing = (0.0,) * num_joints
        self._commands = deque[tuple[float, Numbers]]([(0.0, nothing)], MOST_NOTED)
        self._levers = deque[tuple[float, Numbers]]([(0.0, nothing)], MOST_NOTED)
        self._sources: deque[tuple[float, int]] = deque([(0.0, NOBODY)])
        self._wrong = [0] * num_joints
        self._estop_s: float | None = None
        self.fault, self.joint = GuardTrip.NONE, -1

    def note_command(self, now_s: float, u: Numbers) -> None:
        """Note the command that is sent from now on."""
        self._commands.append((now_s, u))

    def note_levers(self, now_s: float, u: Numbers) -> None:
        """Note what the operator's levers ask for from now on."""
        self._levers.append((now_s, u))

    def take(self, now_s: float, flow: Numbers, source: int, estop: bool, known_s: float) -> None:
        """Compare a message of valve feedback.

        Args:
            now_s: When it came.
            flow: Feedback, `(J,)`.
            source: Value of `FlowSource`.
            estop: Whether the emergency stop is on.
            known_s: Measured round trip; infinite where it is not known.
        """
        limits = self._limits
        since_s = now_s - min(known_s, self._round_trip_s) - limits.settle_s
        self._sources.append((now_s, source))
        commands, levers = _list_since(self._commands, since_s), _list_since(self._levers, since_s)
        sources = _list_since(self._sources, since_s)
        self._estop_s = (self._estop_s or now_s) if estop else None
        stopped = self._estop_s is not None and self._estop_s <= since_s
        worst, self.fault, self.joint = 0.0, GuardTrip.NONE, -1
        for joint, value in enumerate(flow):
            asked = [0.0] if NOBODY in sources or LEVERS in sources else []
            if FROM_PC in sources:
                asked += [u[joint] for u in commands]
            # The operator's levers act by the maker's own curve, which may be steeper.
            for u in levers if LEVERS in sources else ():
                asked.append(u[joint] * limits.lever_scale)
            if stopped:
                asked = [0.0]
            excess = max(min(asked) - value, value - max(asked)) - limits.tolerance
            self._wrong[joint] = self._wrong[joint] + 1 if excess > 0 else 0
            if self._wrong[joint] >= limits.num_messages and excess > worst:
                worst, self.joint = excess, joint
                self.fault = _classify(value, asked, limits.tolerance)


def _classify(flow: float, asked: list[float], tolerance: float) -> GuardTrip:
    """Return the fault of a joint whose flow is not as asked for."""
    largest = max(asked, key=abs)
    if abs(largest) <= tolerance:
        return GuardTrip.FLOW_UNASKED
    return GuardTrip.FLOW_TURNED if flow * largest < 0 else GuardTrip.FLOW_SCALED


def _list_since(noted: deque[tuple[float, T]], since_s: float) -> list[T]:
    """Return what was asked for at `since_s` and later; forget what is older."""
    while len(noted) > 1 and noted[1][0] <= since_s:
        noted.popleft()
    return [u for _, u in noted]
