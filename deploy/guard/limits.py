"""Limits of the guard, and the machine's bounds that it goes by. Pure data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec

Numbers = tuple[float, ...]


@spec
class GuardLimits:
    """Limits of the guard.

    Attributes:
        max_command: Largest command, of full.
        max_rate_1_s: Largest growth of a command per second.
        max_reversals_1_s: Changes of a joint's direction within a second; more are withheld.
        overrun: Command beyond full that counts as rounding; a larger one is refused.
        neutral: Deflection of the operator's own levers, of full, below which they count as
            released.
        stop_margin: Distance to the joint limits (rad or m) within which commands further outward
            are zero.
        joints_s: Age of joint positions from which they are stale.
        levers_s: Age of the remote's message from which it is stale.
        status_s: Age of the machine's status from which it is stale.
        request_s: Age of a command from which it is stale.
        ignored_s: Time for which the gateway may give the valves to another sender, or none, while
            commands are sent.
        controls_s: Age of the operator's switches from which they are stale.
        round_trip_s: Time from the gateway to this computer and back from which it is too long.
        gap_s: Time between two cycles above which the process was stopped, or the computer asleep.
        jump_margin: Speed over the machine's fastest, beyond which a joint has jumped.
        jump_slack: Jump (rad or m) that noise alone may make.
        range_slack: Distance beyond the joint limits (rad or m) at which a position is still
            believed.
        num_jumps: Jumps in a row after which positions are not plausible.
    """

    max_command: float
    max_rate_1_s: float
    max_reversals_1_s: int
    overrun: float
    neutral: float
    stop_margin: float
    joints_s: float
    levers_s: float
    status_s: float
    request_s: float
    ignored_s: float
    controls_s: float
    round_trip_s: float
    gap_s: float
    jump_margin: float
    jump_slack: float
    range_slack: float
    num_jumps: int

    def check(self) -> None:
        if not 0 < self.max_command <= 1:
            raise ConfigError(f"guard.max_command: expected (0, 1], got {self.max_command}")
        # Zero and infinity would switch a check off, which nobody may do by a number.
        positive = (
            "max_rate_1_s",
            "joints_s",
            "levers_s",
            "status_s",
            "request_s",
            "ignored_s",
            "controls_s",
            "round_trip_s",
            "gap_s",
            "jump_slack",
            "range_slack",
        )
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"guard.{name}: expected more than 0, got {getattr(self, name)}")
        if (
            self.overrun < 0
            or self.stop_margin < 0
            or not 0 < self.neutral < 1
            or self.jump_margin < 1
            or self.num_jumps < 1
            or self.max_reversals_1_s < 1
        ):
            raise ConfigError(
                "guard: expected overrun and stop_margin of 0 or more, neutral in (0, 1), "
                "jump_margin, num_jumps and max_reversals_1_s of 1 or more"
            )


@dataclass(frozen=True)
class JointBounds:
    """Bounds of the machine's joints, each of length `J`.

    Attributes:
        lower: Lower joint limits, rad or m.
        upper: Upper joint limits.
        max_speed: Speeds at full command, rad/s or m/s.
        exclusive: Joints that never move together with others.
    """

    lower: Numbers
    upper: Numbers
    max_speed: Numbers
    exclusive: tuple[bool, ...]


def build_joint_bounds(
    lower: Sequence[float],
    upper: Sequence[float],
    max_speed: Sequence[float],
    exclusive: Sequence[bool],
) -> JointBounds:
    """Return the bounds of the joints, from arrays of length `J`."""
    return JointBounds(
        # Plain floats, since the guard must not depend on numpy.
        tuple(map(float, lower)),
        tuple(map(float, upper)),
        tuple(map(float, max_speed)),
        tuple(map(bool, exclusive)),
    )
