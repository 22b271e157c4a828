"""State after a control step, on which reward, termination and observation terms depend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


@dataclass
class StepState:
    """State of every task after a control step; `N` environments, `J` joints.

    Attributes:
        q: Joint positions, `(N, J)`, rad or m.
        lower: Lower joint limits, `(J,)`.
        upper: Upper joint limits, `(J,)`.
        tip_m: Tool point in the base frame, `(N, 3)`.
        pitch_rad: Pitch of the tool, `(N,)`.
        u: Commands of this step, `(N, J)`, in [-1, 1].
        u_before: Commands of the step before, `(N, J)`.
        contact_force_n: Peak contact force of the step, `(N,)`.
        peak_force_n: The largest of the episode's steps before, `(N,)`.
        steps: Control steps of the episode as the time limit counts them, `(N,)`.
        max_steps: Time limit of an episode, control steps.
        is_first: Whether the episode began just before this step, `(N,)` bool.
        success: The task's strict criterion holds, `(N,)` bool.
        failed: The episode ends by a failure, such as a joint limit, `(N,)` bool.
    """

    q: torch.Tensor
    lower: torch.Tensor
    upper: torch.Tensor
    tip_m: torch.Tensor
    pitch_rad: torch.Tensor
    u: torch.Tensor
    u_before: torch.Tensor
    contact_force_n: torch.Tensor
    peak_force_n: torch.Tensor
    steps: torch.Tensor
    max_steps: int
    is_first: torch.Tensor
    success: torch.Tensor
    failed: torch.Tensor


@dataclass
class ToolState(StepState):
    """State of a tool-pose task.

    Attributes:
        target_m: Target point, `(N, 3)`.
        target_pitch_rad: Wanted pitch, `(N,)`.
        reach_m: Distance by which the switch decides, `(N,)`.
        reach_range_m: Good working range (nearest, farthest).
        positioning: Whether only the exclusive joints could move in this step, `(N,)` bool.
        lateral_m: Distance of the tool point from the vertical through the target, `(N,)`.
        paper_success: The paper's criterion holds, `(N,)` bool.
        closeness: How near the task is to done, 0 to about 1, `(N,)`.
        closeness_before: The same one step earlier.
    """

    target_m: torch.Tensor
    target_pitch_rad: torch.Tensor
    reach_m: torch.Tensor
    reach_range_m: tuple[float, float]
    positioning: torch.Tensor
    lateral_m: torch.Tensor
    paper_success: torch.Tensor
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
