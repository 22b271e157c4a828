"""Specs that all tool-pose tasks share: arms, phases, action, controller and advice.

This module needs no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Protocol

from brokk_rl.bounds import require_number, require_range
from brokk_rl.errors import ConfigError
from brokk_rl.machine import mask_exclusive_joints
from brokk_rl.spec import spec

if TYPE_CHECKING:
    import torch

Expected = float | tuple[float, float]
"""A number, or the range [low, high] in which it lies."""


class SwitchInput(Protocol):
    """Distances by which `PhaseSwitch` decides, each `(N,)`; see `ControllerGuidance`."""

    reach_m: torch.Tensor
    reach_3d_m: torch.Tensor
    tip_z_m: torch.Tensor


@spec
class AdviceConfig:
    """Habits of the person for whom proposals are made; the middle of a range counts.

    Attributes:
        delay_s: Reaction delay, from the display to the hand.
        lag_s: Time constant of the hand.
        dead_zone: Deflection below which a lever commands nothing: an effective proposal is
            proposed larger.
        joints_at_once: Levers that the person can move at the same time, of a range the fewest: no
            more are proposed. `null`: all.
        hold_s: Time for which a lever once proposed is proposed again before a larger request takes
            its place.
        settle_s: Time for which the hand is followed after its last proposal; several times the
            lag.
    """

    delay_s: Expected
    lag_s: Expected
    dead_zone: Expected
    joints_at_once: int | tuple[int, int] | None
    hold_s: float
    settle_s: float

    def check(self) -> None:
        for name in ("delay_s", "lag_s", "dead_zone"):
            require_number(f"task.advice.{name}", take_middle(getattr(self, name)), least=0)
        require_number("task.advice.dead_zone", take_middle(self.dead_zone), most=0.99)
        fewest = self.joints_at_once
        if fewest is not None:
            fewest = fewest[0] if isinstance(fewest, tuple) else fewest
            require_number("task.advice.joints_at_once", fewest, least=1)
        for name in ("hold_s", "settle_s"):
            require_number(f"task.advice.{name}", getattr(self, name), least=0)


@spec
class ClassicalConfig:
    """Resolved-rate control of the tool with dead-time compensation.

    Attributes:
        in_flight_samples: Past commands that have not yet fully acted: dead time and lag, in
            control periods (may be fractional).
        dead_band: Command below which the static valve map gives no motion.
        gain_1_s: Speed of approach per distance left.
        top_speed_m_s: Bound on the speed of the tool point.
        top_rate_rad_s: Bound on the rate of its pitch.
        straight: Whether the slowest joint slows all of them alike, so that the tool goes
            straight; otherwise each goes as fast as it can.
        damping: Damping of the least squares, in the same unit as the Jacobian times joint speed
            (m/s at full command).
        rest: Share of full speed below which a joint is left alone.
        creep: Smallest share of full speed that is commanded at all, large enough to be beyond the
            dead band of every valve.
        hover_m: Height above the target at which the tool waits until it is aligned.
        funnel_m: Lateral error at which the descent begins and at which it is free, (outer, inner).
        margin_rad: Distance to a joint limit within which the joint is no longer driven towards it.
        brake_s: Time in which a joint at full speed would cover the distance before that margin
            over which it is slowed down.
    """

    in_flight_samples: float
    dead_band: float
    gain_1_s: float
    top_speed_m_s: float
    top_rate_rad_s: float
    straight: bool
    damping: float
    rest: float
    creep: float
    hover_m: float
    funnel_m: tuple[float, float]
    margin_rad: float
    brake_s: float

    def check(self) -> None:
        for name in ("gain_1_s", "top_speed_m_s", "top_rate_rad_s", "damping", "brake_s"):
            require_number(f"task.classical.{name}", getattr(self, name), above=0)
        for name in ("in_flight_samples", "rest", "creep", "hover_m", "margin_rad"):
            require_number(f"task.classical.{name}", getattr(self, name), least=0)
        require_number("task.classical.dead_band", self.dead_band, least=0, most=0.99)
        outer, inner = self.funnel_m
        if not outer > inner >= 0:
            raise ConfigError(
                f"task.classical.funnel_m: expected (outer, inner), got [{outer}, {inner}]"
            )


@spec
class PhaseSwitch:
    """Rule for the positioning phase, in which only the exclusive joints move (paper, III-B).

    Attributes:
        rule: `planar`: while the reach, with the target turned into the arm's plane, is out of
            range and the tool is not low. It does not depend on the direction of q1, and always
            lets the episode proceed. `text`: the same with the distance in space, as the paper's
            text says. `equation`: while that distance is out of range or the tool is above the
            height, as the paper's equation 1 says.
        reach_m: The good working range (nearest, farthest).
        height_m: Height of the tool below which the exclusive joints rest, to keep it off the
            ground.
    """

    rule: Literal["planar", "text", "equation"]
    reach_m: tuple[float, float]
    height_m: float

    def check(self) -> None:
        require_range("task.switch.reach_m", self.reach_m, least=0)
        require_number("task.switch.height_m", self.height_m)

    def reach(self, guidance: SwitchInput) -> torch.Tensor:
        """Return the distance by which the rule decides, `(N,)`."""
        return guidance.reach_m if self.rule == "planar" else guidance.reach_3d_m

    def positioning(self, guidance: SwitchInput) -> torch.Tensor:
        """Return which environments are positioning, `(N,)` bool."""
        near, far = self.reach_m
        reach = self.reach(guidance)
        out_of_range = (reach < near) | (reach > far)
        is_high = guidance.tip_z_m >= self.height_m
        return out_of_range | is_high if self.rule == "equation" else out_of_range & is_high


@spec
class ActionMapping:
    """Map from the policy's output to valve commands.

    Attributes:
        kind: `direct`: the output is the command. `residual`: it is added to the classical
            controller's command.
        scale: Factor on the output.
        mask: Keep exclusive and other joints apart, as the machine does; only an ablation switches
            it off.
        limits: Slow joints down before their ends, as far as the commands in flight let them be
            foreseen.
    """

    kind: Literal["direct", "residual"]
    scale: float
    mask: bool
    limits: bool

    def check(self) -> None:
        require_number("task.action.scale", self.scale, above=0)

    def command(
        self,
        output: torch.Tensor,
        base: torch.Tensor,
        lowest: torch.Tensor,
        highest: torch.Tensor,
        positioning: torch.Tensor,
        exclusive: torch.Tensor,
    ) -> torch.Tensor:
        """Return valve commands in [-1, 1], `(N, J)`.

        Args:
            output: Output of the network, `(N, J)`.
            base: Command of the classical controller, `(N, J)`.
            lowest: Least commands that do not drive joints into their ends, `(N, J)`
                (`ControllerGuidance.lowest`).
            highest: Largest such commands, `(N, J)`.
            positioning: Whether only the exclusive joints move, `(N,)` bool.
            exclusive: Which joints are exclusive, `(J,)` bool.
        """
        u = self.scale * output + (base if self.kind == "residual" else 0.0)
        if self.limits:
            u = u.minimum(highest).maximum(lowest)
        if self.mask:
            u = u.where(mask_exclusive_joints(exclusive, positioning), 0.0)
        return u.clamp(-1.0, 1.0)


@spec
class ArmStarts:
    """Ranges of the arm at the start of an episode.

    Attributes:
        margin_rad: Distance from joint limits.
        floor_m: Height above the ground that no joint behind the second and no tool point starts
            below.
        clearance_m: Height above the object that the tool point does not start below.
        nearest_m: Horizontal distance from the slew axis that the tool point does not start within.
    """

    margin_rad: float
    floor_m: float
    clearance_m: float
    nearest_m: float

    def check(self) -> None:
        for name in ("margin_rad", "nearest_m"):
            require_number(f"task.arms.{name}", getattr(self, name), least=0)
        for name in ("floor_m", "clearance_m"):
            require_number(f"task.arms.{name}", getattr(self, name))


def take_middle(value: Expected) -> float:
    """Return a number, or the middle of a range."""
    return sum(value) / 2 if isinstance(value, tuple) else value
