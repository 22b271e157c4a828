"""Specs that all tool-pose tasks share: arms, phases, action, errors, controller and advice.

This module needs no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from annotated_types import Interval

from brokk_rl.errors import ConfigError
from brokk_rl.machine import mask_exclusive_joints
from brokk_rl.observation import TargetScaling
from brokk_rl.spec import Count, Finite, NonNegative, NonNegativeRange, Positive, spec
from tasks.term_task import EpisodeTask

if TYPE_CHECKING:
    import torch

Expected = NonNegative | NonNegativeRange
"""A number, or the range [low, high] in which it lies."""
DeadZone = Annotated[float, Interval(ge=0, le=0.99)]
"""A part of the full command that gives no motion."""
Uniform = Callable[[tuple[float, float]], "torch.Tensor"]
"""Draws `(M,)` numbers between two bounds."""


@dataclass
class ControllerGuidance:
    """Commands and errors for a history and a target; `N` environments.

    Attributes:
        command: Valve commands before the masks, `(N, J)` in [-1, 1]: exclusive joints as for
            positioning, the others as for the approach.
        error_m: Target minus predicted tool point, in the frame of the arm's plane (radial,
            tangential, up), `(N, 3)`.
        pitch_error_rad: Wanted minus predicted pitch, `(N,)`.
        goal_error_m: Waypoint minus predicted tool point, up, `(N,)`: hover height while not
            aligned, the final depth after.
        reach_m: Measured distance from the first joint behind the exclusive ones to the target,
            turned into the arm's plane, `(N,)`.
        reach_3d_m: The same measured in space.
        tip_z_m: Measured height of the tool point, `(N,)`.
        lowest: Commands below these would drive joints into their ends, `(N, J)` in [-1, 0].
        highest: Commands above these would, `(N, J)` in [0, 1].
    """

    command: torch.Tensor
    error_m: torch.Tensor
    pitch_error_rad: torch.Tensor
    goal_error_m: torch.Tensor
    reach_m: torch.Tensor
    reach_3d_m: torch.Tensor
    tip_z_m: torch.Tensor
    lowest: torch.Tensor
    highest: torch.Tensor


@dataclass(frozen=True)
class CommandBase:
    """Command that a network corrects, and what bounds the sum.

    Attributes:
        command: Command of the classical controller, `(N, J)`.
        lowest: Least commands, `(N, J)`; see `ActionMapping.bound`.
        highest: Largest commands, `(N, J)`.
        positioning: Whether only the exclusive joints move, `(N,)` bool.
    """

    command: torch.Tensor
    lowest: torch.Tensor
    highest: torch.Tensor
    positioning: torch.Tensor


@dataclass
class CandidateTargets:
    """Candidate targets, `M` of them.

    Attributes:
        place_m: Coordinates of the target point in the base frame, three of `(M,)`.
        pitch_rad: Wanted pitch of the tool, `(M,)`.
        scene: Columns of the scene that are not the nominal ones; see `brokk_rl.sim.scene`.
        object_z_m: Height of the top of the object, `(M,)`.
    """

    place_m: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    pitch_rad: torch.Tensor
    scene: Mapping[str, torch.Tensor | float]
    object_z_m: torch.Tensor


@dataclass
class PoseJudgement:
    """Judgement of tool poses, `(N,)` each.

    Attributes:
        reached: The tool is where the task wants it, bool.
        success: The strict criterion holds: reached, upright enough and without a blow, bool.
        paper_success: The paper's criterion holds, bool.
        closeness: How near the task is to done, 0 to about 1.
        lateral_m: Distance of the tool point from the line on which the tool is to go in; in the
            open from the vertical through the target.
    """

    reached: torch.Tensor
    success: torch.Tensor
    paper_success: torch.Tensor
    closeness: torch.Tensor
    lateral_m: torch.Tensor


@spec
class ObservationNoise:
    """Errors of the observation; drawn anew each episode unless said otherwise.

    Stereo sees a target worse with the square of its distance d from the camera.

    Attributes:
        target_sample_m: Uniform error of the target in each sample and axis (±), at the camera.
        target_sample_1_m: What d² adds to it.
        target_bias_m: Length of the constant error of the target, uniform from 0, in a random
            direction, at the camera.
        target_bias_1_m: What d² adds to it.
        camera_in_base_m: Where the camera is.
        target_relative: Uniform error of each sample as a share of each coordinate (±); the paper's
            5 %.
        filter: `mean` gives the policy the mean of all estimates of the episode, as a tracker of a
            fixed hole does; `none` each sample.
        q_scale: Scale error of all measured positions (±).
        q_scale_of: What `q_scale` scales. `position`: each position, as a wrong encoder would.
            `motion`: the distance of earlier positions from the newest, as a machine does that is
            faster or slower than its model.
        u_scale: Scale error of all recorded commands (±).
    """

    target_sample_m: NonNegative
    target_sample_1_m: NonNegative
    target_bias_m: NonNegative
    target_bias_1_m: NonNegative
    camera_in_base_m: tuple[Finite, Finite, Finite]
    target_relative: NonNegative
    filter: Literal["none", "mean"]
    q_scale: NonNegative
    q_scale_of: Literal["position", "motion"]
    u_scale: NonNegative

    def measure_bias_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Return the longest constant error of targets, `(N, 3)` in the base frame, as `(N, 1)`."""
        return self._grow(self.target_bias_m, self.target_bias_1_m, target_m)

    def measure_sample_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Return the half width of the error of each sample and axis, `(N, 1)`."""
        return self._grow(self.target_sample_m, self.target_sample_1_m, target_m)

    def _grow(
        self, near_m: float, growth_1_m: float, target_m: torch.Tensor
    ) -> torch.Tensor | float:
        if growth_1_m == 0.0:
            return near_m
        # axis by axis: a captured graph cannot copy the place of the camera from the host
        axes = zip(target_m.split(1, 1), self.camera_in_base_m, strict=True)
        return near_m + growth_1_m * sum((axis_m - at_m).square() for axis_m, at_m in axes)


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
    dead_zone: DeadZone | tuple[DeadZone, DeadZone]
    joints_at_once: Count | tuple[Count, Count] | None
    hold_s: NonNegative
    settle_s: NonNegative


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

    in_flight_samples: NonNegative
    dead_band: DeadZone
    gain_1_s: Positive
    top_speed_m_s: Positive
    top_rate_rad_s: Positive
    straight: bool
    damping: Positive
    rest: NonNegative
    creep: NonNegative
    hover_m: NonNegative
    funnel_m: tuple[NonNegative, NonNegative]
    margin_rad: NonNegative
    brake_s: Positive

    def check(self) -> None:
        outer_m, inner_m = self.funnel_m
        if outer_m <= inner_m:
            raise ConfigError(f"funnel_m: expected (outer, inner), got [{outer_m}, {inner_m}]")


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
    reach_m: NonNegativeRange
    height_m: Finite

    def reach(self, guidance: ControllerGuidance) -> torch.Tensor:
        """Return the distance by which the rule decides, `(N,)`."""
        return guidance.reach_m if self.rule == "planar" else guidance.reach_3d_m

    def positioning(self, guidance: ControllerGuidance) -> torch.Tensor:
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
        step: Largest change of a command from one control period to the next, of full command. A
            joint that must stand still, or comes to its end, is let go at once. Take more than
            `noise.u_scale`: the last command counts as observed, and a joint whose command is seen
            too small by more could not stay at full speed. `None`: no bound.
    """

    kind: Literal["direct", "residual"]
    scale: Positive
    mask: bool
    limits: bool
    step: Positive | None = None

    def bound(
        self, lowest: torch.Tensor, highest: torch.Tensor, last: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return least and largest commands, each `(N, J)`.

        Args:
            lowest: Least commands that do not drive joints into their ends, `(N, J)`.
            highest: Largest such commands, `(N, J)`.
            last: The command given last, as observed, `(N, J)`.
        """
        if not self.limits:
            lowest, highest = lowest.clamp(max=-1.0), highest.clamp(min=1.0)
        if self.step is None:
            return lowest, highest
        least = (last - self.step).minimum(highest).maximum(lowest)
        largest = (last + self.step).minimum(highest).maximum(lowest)
        return least, largest

    def command(
        self, output: torch.Tensor, base: CommandBase, exclusive: torch.Tensor
    ) -> torch.Tensor:
        """Return valve commands in [-1, 1], `(N, J)`.

        Args:
            output: Output of the network, `(N, J)`.
            base: Command of the classical controller, and bounds.
            exclusive: Which joints are exclusive, `(J,)` bool.
        """
        u = self.scale * output + (base.command if self.kind == "residual" else 0.0)
        u = u.minimum(base.highest).maximum(base.lowest)
        if self.mask:
            u = u.where(mask_exclusive_joints(exclusive, base.positioning), 0.0)
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

    margin_rad: NonNegative
    floor_m: Finite
    clearance_m: Finite
    nearest_m: NonNegative


@spec
class ToolPoseTask(EpisodeTask):
    """Move the tool to a pose: what all such tasks have.

    Attributes:
        arms: Where the arm may begin.
        advice: How to propose to a person who moves the levers; `null` where the policy's commands
            are given as they are.
        noise: Errors of the observation.
        switch: When only the exclusive joints move.
        action: How the policy's output becomes commands.
        scaling: Normalisation of target point and pitch.
        classical: The classical controller, baseline and base of residual actions.
    """

    arms: ArmStarts
    advice: AdviceConfig | None
    noise: ObservationNoise
    switch: PhaseSwitch
    action: ActionMapping
    scaling: TargetScaling
    classical: ClassicalConfig

    process: ClassVar[str] = "tasks.tool_pose:ToolPoseProcess"
    behaviour: ClassVar[tuple[str, ...]] = (
        "advice",
        "noise.filter",
        "switch",
        "action",
        "scaling",
        "classical",
    )
    """Fields that a policy has learned with; see `brokk_rl.policy_folder`."""

    @property
    def aim_below_m(self) -> float:
        """Depth of the controller's target below that of the observation."""
        return 0.0

    @property
    def leans(self) -> bool:
        """True where the tool goes in along its own direction instead of straight down."""
        return False

    @property
    def fixed_pitch_rad(self) -> float:
        """Wanted pitch, where the policy does not observe it."""
        raise NotImplementedError

    def draw_targets(self, uniform: Uniform) -> CandidateTargets:
        """Draw targets."""
        raise NotImplementedError

    def judge(
        self,
        tip_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        peak_force_n: torch.Tensor,
        start: dict[str, torch.Tensor],
    ) -> PoseJudgement:
        """Judge tool poses by what was drawn for their episodes.

        Args:
            tip_m: Tool points in the base frame, `(N, 3)`.
            pitch_rad: Pitches of the tool, `(N,)`.
            peak_force_n: Largest contact forces of the episodes so far, `(N,)`.
            start: What was drawn, `(N, …)` each: `target_m`, `target_pitch_rad` and `scene`.
        """
        raise NotImplementedError

    def describe_success(self) -> dict[str, float]:
        """Return the bounds of the strict criterion by name, with units, for `policy.json`."""
        raise NotImplementedError


def find_tool_direction(place_m: torch.Tensor, pitch_rad: torch.Tensor) -> torch.Tensor:
    """Return the direction of a tool at `place_m`, `(N, 3)`, that has a pitch, `(N,)`."""
    direction = place_m / place_m[:, :2].norm(dim=1, keepdim=True) * pitch_rad.cos()[:, None]
    direction[:, 2] = -pitch_rad.sin()
    return direction


def take_middle(value: float | tuple[float, float]) -> float:
    """Return a number, or the middle of a range."""
    return sum(value) / 2 if isinstance(value, tuple) else value
