"""What reward terms see."""

from dataclasses import dataclass

import torch


@dataclass
class ToolState:
    """State after a control step; `N` environments, `J` joints.

    Attributes:
        tip_m: Tool point in the base frame, `(N, 3)`.
        pitch_rad: Pitch of the tool, `(N,)`.
        target_m: Target point, `(N, 3)`.
        target_pitch_rad: Wanted pitch, `(N,)`.
        reach_m: Distance by which the switch decides, `(N,)`.
        reach_range_m: Good working range (nearest, farthest).
        positioning: Whether only the exclusive joints could move in this step, `(N,)` bool.
        contact_force_n: Peak contact force of the step, `(N,)`.
        peak_force_n: The largest of the episode's steps before, `(N,)`.
        u: Commands of this step, `(N, J)`.
        u_before: Commands of the step before, `(N, J)`.
        lateral_m: Distance of the tool point from the vertical through the target, `(N,)`.
        success: The task's strict criterion holds, `(N,)` bool.
        paper_success: The paper's criterion holds, `(N,)` bool.
        failed: The episode ends by a joint limit, `(N,)` bool.
        closeness: How near the task is to done, 0 to about 1, `(N,)`.
        closeness_before: The same one step earlier.
    """

    tip_m: torch.Tensor
    pitch_rad: torch.Tensor
    target_m: torch.Tensor
    target_pitch_rad: torch.Tensor
    reach_m: torch.Tensor
    reach_range_m: tuple[float, float]
    positioning: torch.Tensor
    contact_force_n: torch.Tensor
    peak_force_n: torch.Tensor
    u: torch.Tensor
    u_before: torch.Tensor
    lateral_m: torch.Tensor
    success: torch.Tensor
    paper_success: torch.Tensor
    failed: torch.Tensor
    closeness: torch.Tensor
    closeness_before: torch.Tensor

    @property
    def distance_m(self) -> torch.Tensor:
        """Distance from the tool point to the target, `(N,)`."""
        return (self.target_m - self.tip_m).norm(dim=1)

    @property
    def pitch_error_rad(self) -> torch.Tensor:
        """Size of the pitch error, `(N,)`."""
        return (self.target_pitch_rad - self.pitch_rad).abs()
