"""Moving the tool to a pose in the open: a point and a pitch (the paper's outlook)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brokk_rl.errors import ConfigError
from brokk_rl.spec import NonNegativeRange, Positive, Range, spec
from tasks.settings import CandidateTargets, PoseJudgement, ToolPoseTask, Uniform
from tasks.term_task import BLOCK_AWAY_M

if TYPE_CHECKING:
    import torch


@spec
class PoseRanges:
    """Ranges of the target poses; uniform (lowest, highest). Only reachable poses are kept.

    Attributes:
        distance_m: Horizontal distance of the target point from the slew axis.
        bearing_rad: Its bearing from straight ahead.
        height_m: Its height above the ground.
        pitch_rad: Wanted pitch; pi/2 points straight down.
    """

    distance_m: NonNegativeRange
    bearing_rad: Range
    height_m: Range
    pitch_rad: Range


@spec
class PoseCriteria:
    """Criteria of a reached pose.

    Attributes:
        strict_distance_m: Distance of the tool point from the target.
        strict_pitch_rad: Pitch error.
        paper_alignment: The paper's measure of alignment: both r^d and r^o at least this.
    """

    strict_distance_m: Positive
    strict_pitch_rad: Positive
    paper_alignment: Positive


@spec
class GoalPose(ToolPoseTask):
    """Move the tool to any reachable pose: a target point and a wanted pitch, nothing in the way.

    Attributes:
        pose: Which poses are asked for.
        tolerance: Criteria of success.
    """

    pose: PoseRanges
    tolerance: PoseCriteria

    def check(self) -> None:
        super().check()
        low, high = self.pose.pitch_rad
        if self.scaling.pitch_rad is None and low != high:
            raise ConfigError(
                "scaling.pitch_rad: the wanted pitch differs between episodes, so the policy must "
                "observe it: give [mean, std]"
            )

    @property
    def fixed_pitch_rad(self) -> float:
        """The only wanted pitch."""
        return self.pose.pitch_rad[0]

    def draw_targets(self, uniform: Uniform) -> CandidateTargets:
        """Draw poses; see `ToolPoseTask`."""
        pose = self.pose
        distance, bearing = uniform(pose.distance_m), uniform(pose.bearing_rad)
        place_m = (distance * bearing.cos(), distance * bearing.sin(), uniform(pose.height_m))
        columns = {"hole_x_m": BLOCK_AWAY_M}
        ground = distance.new_zeros(distance.shape)
        return CandidateTargets(place_m, uniform(pose.pitch_rad), columns, ground)

    def judge(
        self,
        tip_m: torch.Tensor,
        pitch_rad: torch.Tensor,
        peak_force_n: torch.Tensor,
        start: dict[str, torch.Tensor],
    ) -> PoseJudgement:
        """Judge tool poses; see `ToolPoseTask`."""
        rules = self.tolerance
        away_m = start["target_m"] - tip_m
        distance = away_m.norm(dim=1)
        turn = (start["target_pitch_rad"] - pitch_rad).abs()
        near = 1 / (1 + distance) >= rules.paper_alignment
        reached = (distance <= rules.strict_distance_m) & (turn <= rules.strict_pitch_rad)
        return PoseJudgement(
            reached=reached,
            success=reached,
            paper_success=near & (1 / (1 + turn) >= rules.paper_alignment),
            closeness=_measure_closeness(distance, turn),
            lateral_m=away_m[:, :2].norm(dim=1),
        )

    def describe_success(self) -> dict[str, float]:
        """Return distance and pitch error; see `ToolPoseTask`."""
        rules = self.tolerance
        return {
            "largest_distance_m": rules.strict_distance_m,
            "largest_pitch_error_rad": rules.strict_pitch_rad,
        }


def _measure_closeness(distance_m: torch.Tensor, turn_rad: torch.Tensor) -> torch.Tensor:
    """Return the closeness of a pose, 0 to 1.

    Sum of distance at three scales, pitch at three, and both together.
    """
    near, turned = _average_nearness(distance_m), _average_nearness(turn_rad)
    return 0.5 * near + 0.2 * turned + 0.3 * near * turned


def _average_nearness(error: torch.Tensor) -> torch.Tensor:
    """Return the mean of 1 / (1 + error) at three scales."""
    coarse, middle, fine = (1 / (1 + error / scale) for scale in (1.0, 0.3, 0.05))
    return (coarse + middle + fine) / 3
