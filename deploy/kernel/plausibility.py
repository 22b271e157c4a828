"""Plausibility of measured joint positions. Pure, as the guard is."""

from __future__ import annotations

from deploy.kernel.limits import GuardLimits, JointBounds

WINDOW = 50
"""Samples of a joint among which the rejected ones are counted: half a second of the example bus,
as many as a channel remembers. A loose contact that spoils every second sample is found."""
MASK = (1 << WINDOW) - 1


class PlausibilityFilter:
    """Rejects joint positions that the machine could not have reached.

    A few rejected among the last `WINDOW` make all positions implausible.

    Args:
        limits: Gives margin, slack and number.
        bounds: Gives the speeds and limits.
    """

    def __init__(self, limits: GuardLimits, bounds: JointBounds) -> None:
        self._limits, self._bounds = limits, bounds
        self._last: list[tuple[float, float] | None] = [None] * len(bounds.lower)
        # One bit a sample, the newest lowest.
        self._jumps = [0] * len(bounds.lower)

    @property
    def plausible(self) -> bool:
        """True if no joint has jumped too often of late."""
        return max(map(int.bit_count, self._jumps)) < self._limits.num_jumps

    def accept(self, joint: int, now_s: float, position: float) -> bool:
        """Return whether to use a new position of `joint`.

        It is compared with the last one that was used. A joint that stays at its new position is
        accepted again as soon as the machine could have got there.
        """
        limits, bounds, last = self._limits, self._bounds, self._last[joint]
        reach = limits.jump_slack
        if last is not None:
            reach += bounds.max_speed[joint] * limits.jump_margin * max(0.0, now_s - last[0])
        inside = (
            bounds.lower[joint] - limits.range_slack
            <= position
            <= bounds.upper[joint] + limits.range_slack
        )
        good = inside and (last is None or abs(position - last[1]) <= reach)
        self._jumps[joint] = (self._jumps[joint] << 1 | (not good)) & MASK
        if good:
            self._last[joint] = now_s, position
        return good
