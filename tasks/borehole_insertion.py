"""Inserting the chisel into boreholes of a concrete block (the paper's task)."""

from __future__ import annotations

import math
from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar

from brokk_rl.contracts.task import TaskProcess
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Count, Finite, NonNegative, NonNegativeRange, Positive, Range, spec
from tasks.settings import (
    CandidateTargets,
    PoseJudgement,
    ToolPoseTask,
    Uniform,
    find_tool_direction,
)

if TYPE_CHECKING:
    import torch

RADIUS = 5
"""Column of a scene with the radius of its hole; see `brokk_rl.sim.scene`, which loads torch."""
ROW_PROCESS = "tasks.hole_row:HoleRowProcess"
"""Process of a row of holes; importing it loads torch."""


@spec
class BoreholeRanges:
    """Ranges of the borehole; uniform (lowest, highest).

    Attributes:
        distance_m: Horizontal distance of the rim's centre from the slew axis.
        bearing_rad: Bearing of the hole from straight ahead.
        rim_z_m: Height of the rim above the ground.
        yaw_rad: Orientation of the block.
        block_scale: Scale of the block's footprint.
        radius_m: Radius of the hole, or the range in which it lies.
        lean_rad: Tilt of the hole's axis in the plane through the slew axis, away from the machine;
            `null`: every hole is vertical.
    """

    distance_m: NonNegativeRange
    bearing_rad: Range
    rim_z_m: Range
    yaw_rad: Range
    block_scale: NonNegativeRange
    radius_m: Positive | NonNegativeRange
    lean_rad: Range | None


@spec
class InsertionCriteria:
    """Criteria of an inserted chisel.

    Attributes:
        strict_depth_m: Depth of the tip below the rim, inside the hole.
        strict_tilt_rad: Largest tilt of the chisel against the hole at that moment.
        strict_force_n: Largest contact force of the episode.
        chisel_radius_m: Radius of the chisel; the tip is inside when it is off axis by no more than
            the clearance.
        slack_m: Softness of contacts and the corners of the polygon that stands for the round hole.
        paper_alignment: Both r^d and r^o at least this.
        paper_height_m: Height of the tip below the rim at the paper's limit (0.7 m with a nominal
            rim of 0.75 m).
    """

    strict_depth_m: Positive
    strict_tilt_rad: Positive
    strict_force_n: Positive
    chisel_radius_m: Positive
    slack_m: Finite
    paper_alignment: Positive
    paper_height_m: Finite


@spec
class HoleRow:
    """Boreholes side by side, one after the other, in a block that gives way.

    Attributes:
        num_holes: Holes of a row.
        spacing_m: Distance of two of them, across the bearing of the hole.
        lift_m: Height above the rim to which the tool is drawn between them.
        strike_n: Contact force from which the block moves, once for each hole.
        strike_m: By how much it does, in a direction drawn for the episode.
    """

    num_holes: Count
    spacing_m: Positive
    lift_m: Positive
    strike_n: Positive
    strike_m: NonNegative


@spec
class BoreholeInsertion(ToolPoseTask):
    """Insert the 8 cm chisel into the 10 cm borehole of a concrete block.

    Attributes:
        depth_m: Depth below the rim of the target point (paper: 0.1 m; a little more makes the
            controller pass the strict depth).
        hole: Where the hole may be.
        row: Further holes of an episode; `null`: one that stays where it is.
        success: Criteria.
    """

    depth_m: Positive
    hole: BoreholeRanges
    row: HoleRow | None
    success: InsertionCriteria

    behaviour: ClassVar[tuple[str, ...]] = ("depth_m", *ToolPoseTask.behaviour)

    def check(self) -> None:
        super().check()
        if self._smallest_radius_m <= self.success.chisel_radius_m:
            raise ConfigError(
                f"hole.radius_m: expected more than the chisel's {self.success.chisel_radius_m:g} m "
                f"(success.chisel_radius_m), got {self._smallest_radius_m:g}; change one of them"
            )
        if self.leans and self.scaling.pitch_rad is None:
            raise ConfigError(
                "scaling.pitch_rad: expected [mean, std], since holes lean (hole.lean_rad) and the "
                "policy must observe by how much, got null"
            )
        if self.leans and self.row is not None:
            raise ConfigError(
                "row: expected null where holes lean (hole.lean_rad), since the tool is drawn "
                "straight up between the holes of a row, got a row; change one of them"
            )

    @property
    def aim_below_m(self) -> float:
        """The depth; see `ToolPoseTask`."""
        return self.depth_m

    @property
    def fixed_pitch_rad(self) -> float:
        """Straight down, rad (the paper's 1.57)."""
        return math.pi / 2

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        if self.row is None:
            return super().build(machine, num_envs, device)
        self.check_machine(machine)
        return resolve_name(ROW_PROCESS)(self, machine, num_envs, device)

    def draw_targets(self, uniform: Uniform) -> CandidateTargets:
        """Draw boreholes; see `ToolPoseTask`."""
        hole = self.hole
        distance, bearing = uniform(hole.distance_m), uniform(hole.bearing_rad)
        x_m, y_m, z_m = distance * bearing.cos(), distance * bearing.sin(), uniform(hole.rim_z_m)
        columns: dict[str, torch.Tensor | float] = {
            "hole_x_m": x_m,
            "hole_y_m": y_m,
            "rim_z_m": z_m,
            "yaw_rad": bearing + uniform(hole.yaw_rad),
            "block_scale": uniform(hole.block_scale),
        }
        radius_m = hole.radius_m
        columns["hole_radius_m"] = uniform(radius_m) if isinstance(radius_m, tuple) else radius_m
        pitch_rad = distance.new_full(distance.shape, self.fixed_pitch_rad)
        if hole.lean_rad:
            columns["lean_rad"] = uniform(hole.lean_rad)
            pitch_rad = pitch_rad + columns["lean_rad"]
        return CandidateTargets((x_m, y_m, z_m), pitch_rad, columns, z_m)

    def judge(
        self,
        tip_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        peak_force_n: torch.Tensor,
        start: dict[str, torch.Tensor],
    ) -> PoseJudgement:
        """Judge tool poses; see `ToolPoseTask`."""
        rules, rim = self.success, start["target_m"]
        target = rim.clone()
        if self.leans:
            axis = find_tool_direction(rim, start["target_pitch_rad"])
            below = ((tip_m - rim) * axis).sum(1)
            lateral = (tip_m - rim - below[:, None] * axis).norm(dim=1)
            target += self.depth_m * axis
        else:
            lateral = (tip_m - rim)[:, :2].norm(dim=1)
            below = rim[:, 2] - tip_m[:, 2]
            target[:, 2] -= self.depth_m
        inside = lateral <= start["scene"][:, RADIUS] + (rules.slack_m - rules.chisel_radius_m)
        distance = (target - tip_m).norm(dim=1)
        turn = (start["target_pitch_rad"] - pitch_rad).abs()
        near = 1 / (1 + distance) >= rules.paper_alignment
        aligned = near & (1 / (1 + turn) >= rules.paper_alignment)
        reached = inside & (below >= rules.strict_depth_m)
        is_gentle = peak_force_n <= rules.strict_force_n
        return PoseJudgement(
            reached=reached,
            success=reached & (turn <= rules.strict_tilt_rad) & is_gentle,
            paper_success=aligned & (below >= rules.paper_height_m),
            closeness=_measure_closeness(
                distance, lateral, turn, below * inside / rules.strict_depth_m
            ),
            lateral_m=lateral,
        )

    def describe_success(self) -> dict[str, float]:
        """Return depth and lateral error; see `ToolPoseTask`."""
        rules = self.success
        clearance_m = self._smallest_radius_m - rules.chisel_radius_m + rules.slack_m
        return {
            "least_depth_below_target_m": rules.strict_depth_m,
            "largest_lateral_m": clearance_m,
        }

    @property
    def leans(self) -> bool:
        """True where holes lean; see `ToolPoseTask`."""
        return self.hole.lean_rad is not None

    @property
    def _smallest_radius_m(self) -> float:
        radius_m = self.hole.radius_m
        return radius_m[0] if isinstance(radius_m, tuple) else radius_m


def _measure_closeness(
    distance_m: torch.Tensor, lateral_m: torch.Tensor, turn_rad: torch.Tensor, inside: torch.Tensor
) -> torch.Tensor:
    """Return the closeness of an insertion, 0 to 1.

    Sum of distance at three scales, alignment at three, and depth inside the hole.
    """
    approach = sum(1 / (1 + distance_m / scale) for scale in (1.0, 0.3, 0.1)) / 3
    aligned = sum(1 / (1 + lateral_m / scale) for scale in (0.1, 0.03, 0.01)) / 3
    upright = 1 / (1 + turn_rad / 0.2)
    deep = inside.clamp(0.0, 1.0)
    return 0.3 * approach + 0.3 * aligned * approach + 0.1 * upright + 0.3 * deep
