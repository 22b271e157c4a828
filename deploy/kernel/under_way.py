"""Commands under way: what was sent and has not moved the arm yet. Pure.

A command acts after the dead time. The guard and its envelope look ahead to where the joints come to
rest, so both ask here for what is still to come.
"""

from __future__ import annotations

from collections import deque

from deploy.kernel.limits import Numbers


class CommandsUnderWay:
    """Time integral of the commands of the last `horizon_s`.

    Args:
        num_joints: `J`.
        horizon_s: Time after which a command has come to rest.
    """

    def __init__(self, num_joints: int, horizon_s: float) -> None:
        self._num_joints, self._horizon_s = num_joints, horizon_s
        self._sent: deque[tuple[float, Numbers]] = deque()

    def note(self, now_s: float, u: Numbers) -> None:
        """Remember the command that is sent from now on."""
        self._sent.append((now_s, u))
        # The oldest one that is kept began before the horizon and lasts into it.
        while len(self._sent) > 1 and self._sent[1][0] <= now_s - self._horizon_s:
            self._sent.popleft()

    def integrate(self, now_s: float) -> Numbers:
        """Return the time integral of each joint's commands, `(J,)`, in s."""
        totals, end_s = [0.0] * self._num_joints, now_s
        for begin_s, u in reversed(self._sent):
            begin_s = max(begin_s, now_s - self._horizon_s)
            for joint, value in enumerate(u):
                totals[joint] += value * (end_s - begin_s)
            end_s = begin_s
        return tuple(totals)
