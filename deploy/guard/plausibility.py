"""Whether a measured joint position can be true. Pure, as the guard is."""

from __future__ import annotations

from deploy.guard.limits import GuardLimits, JointBounds


class PlausibilityFilter:
    """Rejects joint positions that no machine could have reached; a few in a row make all of them implausible.

    Args:
        limits: Gives margin, slack and number.
        body: Gives the speeds and limits.
    """

    def __init__(self, limits: GuardLimits, body: JointBounds) -> None:
        self._limits, self._body = limits, body
        self._last: list[tuple[float, float] | None] = [None] * len(body.lower)
        self._jumps = [0] * len(body.lower)

    @property
    def plausible(self) -> bool:
        """Whether no joint has jumped too often in a row."""
        return max(self._jumps) < self._limits.num_jumps

    def accept(self, joint: int, now_s: float, position: float) -> bool:
        """Return whether to use a new position of `joint`; a rejected one is judged against the last that was used.

        Where the joint stays at its new place, it is believed again as soon as the machine could
        have got there.
        """
        limits, body, last = self._limits, self._body, self._last[joint]
        reach = limits.jump_slack
        if last is not None:
            reach += body.max_speed[joint] * limits.jump_margin * max(0.0, now_s - last[0])
        inside = (
            body.lower[joint] - limits.range_slack
            <= position
            <= body.upper[joint] + limits.range_slack
        )
        if inside and (last is None or abs(position - last[1]) <= reach):
            self._last[joint], self._jumps[joint] = (now_s, position), 0
            return True
        self._jumps[joint] += 1
        return False
