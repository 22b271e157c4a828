"""Bringing the tool to a pose: what the tasks of this package share.

A task of this family has a target point and a wanted pitch. The policy sees an estimate of the
target that is wrong in the way a
camera is wrong, positions and commands through a scale that is slightly off, and acts under the
masks of the machine: the exclusive joints alone while positioning, all others afterwards.
"""

from typing import Literal

import torch

from brokk_rl.machine import mask_exclusive_joints
from brokk_rl.spec import spec
from tasks.classical import ControllerGuidance


@spec
class ObservationNoise:
    """What the policy is told is wrong by; drawn anew each episode unless said otherwise.

    Attributes:
        target_sample_m: Uniform error of the target in each sample and axis (±).
        target_bias_m: Length of the constant error of the target, uniform from 0, in a random
            direction.
        target_relative: Uniform error of each sample as a share of each coordinate (±); the paper's
            5 %.
        filter: `mean` gives the policy the mean of all estimates of the episode, as a tracker of a
            fixed hole does; `none` each sample.
        q_scale: Scale error of all measured positions (±).
        u_scale: Scale error of all recorded commands (±).
    """

    target_sample_m: float
    target_bias_m: float
    target_relative: float
    filter: Literal["none", "mean"]
    q_scale: float
    u_scale: float

    def bias_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Returns the longest constant error of targets, `(N, 3)` in the base frame: the same for all."""
        return self.target_bias_m

    def sample_m(self, target_m: torch.Tensor) -> torch.Tensor | float:
        """Returns the half width of the error of each sample and axis: the same for all."""
        return self.target_sample_m


@spec
class PhaseSwitch:
    """When only the exclusive joints move (paper, section III-B).

    Attributes:
        rule: `planar`: while the reach, with the target turned into the arm's plane, is out of
            range and the tool is not low; it
            does not depend on where q1 points and always lets the episode proceed. `text`: the same
                with the distance in space, as
            the paper's text says. `equation`: while that distance is out of range or the tool is
            above the height, as the paper's equation 1 says.
        reach_m: The good working range (nearest, farthest).
        height_m: Height of the tool below which the exclusive joints rest, to keep it off the
            ground.
    """

    rule: Literal["planar", "text", "equation"]
    reach_m: tuple[float, float]
    height_m: float

    def positioning(self, guidance: ControllerGuidance) -> torch.Tensor:
        """Returns which environments are positioning, `(N,)` bool."""
        near, far = self.reach_m
        distance = guidance.reach_m if self.rule == "planar" else guidance.reach_3d_m
        out = (distance < near) | (distance > far)
        if self.rule == "equation":
            return out | (guidance.tip_z_m >= self.height_m)
        return out & (guidance.tip_z_m >= self.height_m)


@spec
class ActionMapping:
    """How the policy's output becomes valve commands.

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

    def command(
        self,
        output: torch.Tensor,
        base: torch.Tensor,
        lowest: torch.Tensor,
        highest: torch.Tensor,
        positioning: torch.Tensor,
        exclusive: torch.Tensor,
    ) -> torch.Tensor:
        """Returns valve commands in [-1, 1], `(N, J)`.

        Args:
            output: What the network says, `(N, J)`.
            base: Command of the classical controller, `(N, J)`.
            lowest: Least commands that do not drive joints into their ends, `(N, J)`
                (`Guidance.lowest`).
            highest: Largest such commands, `(N, J)`.
            positioning: Whether only the exclusive joints move, `(N,)` bool.
            exclusive: Which joints are exclusive, `(J,)` bool.
        """
        u = self.scale * output + (base if self.kind == "residual" else 0.0)
        if self.limits:
            u = torch.maximum(torch.minimum(u, highest), lowest)
        if self.mask:
            u = torch.where(mask_exclusive_joints(exclusive, positioning), u, 0.0)
        return u.clamp(-1.0, 1.0)
