"""Servo of a joint that is commanded by position: a second-order loop behind a dead time.

Once a control period, joint by joint:

    target   command of `dead_time_s` ago, as a position; the two commands of a period act one after the
             other
    held     play operator of width `play_rad` on the target: gear play, or Coulomb friction that the
             stiffness of the loop does not overcome (the width is twice friction over stiffness)
    reached  held target less the sag under gravity, `sag_rad + sag_slope * (held - middle of travel)`
    joint    `response_s^2 q'' + 2 damping response_s q' + q = reached`, solved exactly; viscous friction
             and the derivative gain are in the damping
    torque   the pull `held - q - 2 firmware_damping damping response_s q'` is at most `limit_rad`; weight
             and the other damping (back EMF, friction) act beside it: where the limit is below the sag,
             the joint falls
    limits   speed at most `top_speed` of the machine's `max_speed`

With `response_s`, play and sag of 0 the joint is at its target after one period: the ideal servo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch

from actuators.models.joint_model import CommandParts, JointMemory, PlannableModel
from actuators.models.parameters import NonNegativePerJoint, PerJoint, PositivePerJoint
from brokk_rl.machine import Machine
from brokk_rl.spec import spec

SHORTEST_RESPONSE_S = 1e-5
"""Response from which a loop is at its target within a period, to the last bit; avoids 0 / 0."""
NEAR_CRITICAL = 1e-4
"""Distance of the squared damping from 1 within which the loop counts as critically damped: there
the two solutions agree to a ten-thousandth, and 0 / 0 is avoided."""
FULL_TORQUE_TRAVEL = 0.05
"""Error of position, over the travel, that `shortage` counts in; as in `diagnosis.mjcf.plant`."""
NO_LIMIT_RAD = 1e6
"""Pull without a limit; finite, so that no gradient is NaN."""
SMALL_SHARE = 0.05
"""Time over the time constant below which a series of three terms is exact to 2e-6."""
LEAST_OUTSIDE = 0.02
"""Part of the damping that always acts beside the limit; avoids 0 / 0."""
SUBSTEPS = 2
"""Steps of a part of a period in which the limit acts. At 50 Hz, 20 loops and limits moved by steps of
the target keep within 0.06 mrad of scipy's solution with 2, within 0.11 mrad with 1; within 0.4 mrad
where damping lies within the limit."""


@spec
class Servo:
    """Dead time, play, sag, second-order loop and top speed, joint by joint.

    Attributes:
        dead_time_s: Time from command to first motion; `null` takes the machine's.
        response_s: Inverse of the loop's natural frequency, s/rad; 0 for a joint that is at its
            target at once.
        damping: Damping ratio of the loop, above 0; 1 without overshoot.
        top_speed: Largest speed over the machine's `max_speed`.
        play_rad: Change of the target that is not followed at a reversal (m for a sliding joint).
        sag_rad: How far the joint stays below its target in the middle of its travel, in the
            negative direction (m for a sliding joint).
        sag_slope: Change of the sag over the change of the target.
        limit_rad: Error of the held target from which on the motor pulls no harder: its largest torque
            over the stiffness of the loop (m for a sliding joint); `null` for no limit.
        firmware_damping: Part of the damping that the loop itself commands, so that it lies within the
            limit; the rest is back EMF and viscous friction. Nothing without a limit.
    """

    label: ClassVar = "servo"
    interfaces: ClassVar = frozenset({"position"})

    dead_time_s: PerJoint | None
    response_s: NonNegativePerJoint
    damping: PositivePerJoint
    top_speed: PositivePerJoint
    play_rad: NonNegativePerJoint
    sag_rad: PerJoint
    sag_slope: PerJoint
    # Files from before there was a limit lack it; neutral.
    limit_rad: PositivePerJoint | None = None
    firmware_damping: NonNegativePerJoint = 0.5

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> ServoModel:
        """Return a model for `num_envs` environments on `device`.

        Raises:
            ConfigError: the machine is not commanded by position, or a number makes no sense.
        """
        return ServoModel(self, machine, num_envs, device)


class ServoModel(PlannableModel):
    """Exact solution of the loop over each part of a period with one command.

    Attributes:
        parameters: Numbers by name, `(N, J)`, `limit_rad` only where there is a limit.
        drive_changes: Changes by effects, `(N, J)` by name: a factor on the `damping`; `shortage`, the
            error of 5 % of the travel over another limit, 0 for none, and its `firmware_damping`. The
            lower limit counts.
    """

    STATES = ("held", "speed")
    INTERFACE = ("position", "a servo follows positions")

    def __init__(
        self, config: Servo, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        super().__init__(config, machine, num_envs, device)
        self.drive_changes: dict[str, torch.Tensor] = {}

    def ask(self, commands: torch.Tensor) -> torch.Tensor:
        """Return the targets of commands, rad or m."""
        return self.plant.middle + self.plant.half_travel * commands

    def solve(self, drive: CommandParts) -> tuple[PartSolution, PartSolution]:
        """Return the motion over the two parts of a period."""
        value, limit = self.parameters, self.read_limit()
        damping = value["damping"] * self.drive_changes.get("damping", 1.0)
        found = []
        for share in (drive.part, 1.0 - drive.part):
            loop = value["response_s"], damping, share * self.plant.period_s
            limited = None if limit is None else LimitedSolution.build(*loop, limit)
            found.append(PartSolution(LoopSolution.build(*loop), limited))
        first, second = found
        return first, second

    def begin(self, drive: CommandParts, q: torch.Tensor, before: torch.Tensor) -> JointMemory:
        """Return speed and held target of joints at `q`, as near to it as the play allows."""
        bent = q + self._sag(q)
        speed = (q - before) / self.plant.period_s
        return {"held": self.hold(bent, drive.earlier[0]), "speed": speed}

    def advance(
        self,
        k: int,
        q: torch.Tensor,
        drive: CommandParts,
        solution: tuple[PartSolution, PartSolution],
        memory: JointMemory,
    ) -> tuple[torch.Tensor, JointMemory]:
        """Return positions, speeds and held targets after step `k`."""
        begin, held, speed = q, memory["held"], memory["speed"]
        for target, part in zip((drive.earlier[k], drive.later[k]), solution, strict=True):
            held = self.hold(held, target)
            reached = held - self._sag(held)
            error, free_speed = part.loop.advance(q - reached, speed)
            free = error + reached, free_speed
            if part.limited is not None:
                free = part.limited.advance(q, speed, held, reached, self._sag(q), free)
            q, speed = free
        most = self.parameters["top_speed"] * self.plant.max_speed
        way = most * self.plant.period_s
        limited = q.clamp(begin - way, begin + way)
        speed = speed.clamp(-most, most)
        stopped = self.plant.hold_from(begin, limited)
        return stopped, {"held": held, "speed": speed.masked_fill(stopped != limited, 0.0)}

    def hold(self, held: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the target behind the play, `(N, J)`."""
        half = 0.5 * self.parameters["play_rad"]
        return held.clamp(target - half, target + half)

    def _sag(self, at: torch.Tensor) -> torch.Tensor:
        """Return how far joints stay below targets `at`, `(N, J)`, rad or m."""
        value = self.parameters
        return value["sag_rad"] + value["sag_slope"] * (at - self.plant.middle)

    def read_limit(self) -> PullLimit | None:
        """Return the limit of the torque; `None` where there can be none."""
        own, changes = self.parameters, self.drive_changes
        if "shortage" not in changes:
            if "limit_rad" not in own:
                return None
            return PullLimit(own["limit_rad"], own["firmware_damping"])
        full = 2.0 * FULL_TORQUE_TRAVEL * self.plant.half_travel
        limit_rad = full / torch.maximum(changes["shortage"], full / NO_LIMIT_RAD)
        inside = changes["firmware_damping"]
        if "limit_rad" not in own:
            return PullLimit(limit_rad, inside)
        inside = torch.where(own["limit_rad"] < limit_rad, own["firmware_damping"], inside)
        return PullLimit(torch.minimum(own["limit_rad"], limit_rad), inside)


@dataclass(frozen=True, eq=False)
class LoopSolution:
    """Linear map of error and speed over a time, `response^2 e'' + 2 damping response e' + e = 0`.

    Attributes:
        kept: Error after it for one of error, `(N, J)`.
        gained: Error for one of speed, s.
        pulled: Speed for one of error, 1/s.
        carried: Speed for one of speed.
    """

    kept: torch.Tensor
    gained: torch.Tensor
    pulled: torch.Tensor
    carried: torch.Tensor

    @classmethod
    def build(
        cls, response_s: torch.Tensor, damping: torch.Tensor, time_s: torch.Tensor
    ) -> LoopSolution:
        """Return the map over `time_s`, `(N, J)`."""
        w = 1.0 / response_s.clamp(min=SHORTEST_RESPONSE_S)
        bend = damping.square() - 1.0
        bend = torch.where(bend.abs() < NEAR_CRITICAL, torch.full_like(bend, NEAR_CRITICAL), bend)
        rate, fade = w * bend.abs().sqrt(), damping * w
        slow, fast = torch.exp((rate - fade) * time_s), torch.exp(-(rate + fade) * time_s)
        decay, angle = torch.exp(-fade * time_s), rate * time_s
        cos = torch.where(bend > 0, 0.5 * (slow + fast), decay * torch.cos(angle))
        sin = torch.where(bend > 0, 0.5 * (slow - fast), decay * torch.sin(angle)) / rate
        return cls(cos + fade * sin, sin, -w.square() * sin, cos - fade * sin)

    def advance(
        self, error: torch.Tensor, speed: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return error and speed after the time, each `(N, J)`."""
        return (self.kept * error + self.gained * speed, self.pulled * error + self.carried * speed)


class PullLimit(NamedTuple):
    """Limit of a servo's torque.

    Attributes:
        limit_rad: Largest pull, `(N, J)`, rad or m.
        inside: Part of the damping within the limit, `(N, J)`.
    """

    limit_rad: torch.Tensor
    inside: torch.Tensor


@dataclass(frozen=True, eq=False)
class LimitedSolution:
    """Motion in `SUBSTEPS` equal steps, each of them with a pull at the limit or below it.

    Attributes:
        limit_rad: Largest pull, `(N, J)`, rad or m.
        brake: Pull for one of speed that the damping within the limit takes, s.
        loop: The loop below the limit, over a step.
        slipped: Motion over a step for one of speed, under a constant pull, s.
        faded: Speed for one of speed.
        moved: Motion for one of pull.
        pushed: Speed for one of pull, 1/s.
    """

    limit_rad: torch.Tensor
    brake: torch.Tensor
    loop: LoopSolution
    slipped: torch.Tensor
    faded: torch.Tensor
    moved: torch.Tensor
    pushed: torch.Tensor

    @classmethod
    def build(
        cls, response_s: torch.Tensor, damping: torch.Tensor, time_s: torch.Tensor, limit: PullLimit
    ) -> LimitedSolution:
        """Return the motion over `time_s`, `(N, J)`, with a limit."""
        step_s, response_s = time_s / SUBSTEPS, response_s.clamp(min=SHORTEST_RESPONSE_S)
        outside = damping * (1.0 - limit.inside).clamp(min=LEAST_OUTSIDE)
        fade_s = 0.5 * response_s / outside
        share = step_s / fade_s
        left = -torch.expm1(-share)
        # The difference of the two loses all its digits for a small share: there a series.
        series = share.square() * (0.5 - share * (1.0 / 6.0 - share / 24.0))
        behind = torch.where(share < SMALL_SHARE, series, share - left)
        final_1_s = 0.5 / (outside * response_s)  # final speed for one of pull
        return cls(
            limit.limit_rad,
            2.0 * limit.inside * damping * response_s,
            LoopSolution.build(response_s, damping, step_s),
            fade_s * left,
            1.0 - left,
            final_1_s * fade_s * behind,
            final_1_s * left,
        )

    def advance(
        self,
        q: torch.Tensor,
        speed: torch.Tensor,
        held: torch.Tensor,
        reached: torch.Tensor,
        weight: torch.Tensor,
        free: tuple[torch.Tensor, torch.Tensor],
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions and speeds after the time, each `(N, J)`.

        Args:
            q: Positions before, rad or m.
            speed: Speeds before, rad/s or m/s.
            held: Held targets.
            reached: Held targets less the sag.
            weight: Pull of the weight in the negative direction.
            free: Positions and speeds after the time without a limit; exact where it never acts.
        """
        acts, twice_held, twice_limit = None, held + held, self.limit_rad + self.limit_rad
        for _ in range(SUBSTEPS):
            error, loop_speed = self.loop.advance(q - reached, speed)
            loop_q, away = error + reached, twice_held - q - self.brake * speed
            side = torch.sign(away - loop_q - self.brake * loop_speed)
            pull = side * self.limit_rad - weight
            limited_q = q + self.slipped * speed + self.moved * pull
            limited_speed = self.faded * speed + self.pushed * pull
            # The mean pull over the step decides; a stiff loop is past its target by then.
            mean = away - limited_q - self.brake * limited_speed
            is_limited = side * mean > twice_limit
            q = torch.where(is_limited, limited_q, loop_q)
            speed = torch.where(is_limited, limited_speed, loop_speed)
            acts = is_limited if acts is None else acts | is_limited
        assert acts is not None, "there is a step"
        return torch.where(acts, q, free[0]), torch.where(acts, speed, free[1])


@dataclass(frozen=True, eq=False)
class PartSolution:
    """Motion over a part of a period with one command.

    Attributes:
        loop: Without a limit of the torque.
        limited: With one; `None` where there is none.
    """

    loop: LoopSolution
    limited: LimitedSolution | None
