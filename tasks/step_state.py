"""State after a control step, on which the terms of a task depend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from brokk_rl.history import History
    from brokk_rl.kinematics import Kinematics


@dataclass
class StepState:
    """State of every task after a control step; `N` environments, `J` joints.

    Rewards, endings and figures see the machine itself. Observation terms see what sensors measure,
    and neither `success` nor `failed`.

    Attributes:
        history: The last positions and the commands given, `(N, H, J)` each, oldest first.
        lower: Lower joint limits, `(J,)`.
        upper: Upper joint limits, `(J,)`.
        tip_m: Tool point in the base frame, `(N, 3)`.
        pitch_rad: Pitch of the tool, `(N,)`.
        u: Commands that the policy asked for in this step, `(N, J)`, in [-1, 1].
        u_before: Those of the step before, `(N, J)`.
        contact_force_n: Peak contact force of the step, `(N,)`.
        peak_force_n: The largest of the episode's steps before, `(N,)`.
        steps: Control steps of the episode as the time limit counts them, `(N,)`.
        max_steps: Time limit of an episode, control steps.
        age: Control steps since the start of the episode, `(N,)`.
        period_s: Control period.
        start: What was drawn for the episode, `(N, …)` each, by name: `q`, `scene`, `tip_m`, and
            what the task asks for.
        kinematics: Kinematics of the machine.
        success: The task's criterion holds, `(N,)` bool.
        failed: The episode ends by a failure, such as a joint limit, `(N,)` bool.
        held_share: Part of the counted steps in which a `HeldCriterion` held, `(N,)`.
    """

    history: History
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
    age: torch.Tensor
    period_s: float
    start: dict[str, torch.Tensor]
    kinematics: Kinematics
    success: torch.Tensor
    failed: torch.Tensor
    held_share: torch.Tensor

    @property
    def q(self) -> torch.Tensor:
        """Joint positions, `(N, J)`, rad or m."""
        return self.history.q[:, -1]

    @property
    def is_first(self) -> torch.Tensor:
        """True where the episode began just before this step, `(N,)` bool."""
        return self.age == 1

    @property
    def time_s(self) -> torch.Tensor:
        """Time since the start of the episode, `(N,)`."""
        return self.age * self.period_s

    @property
    def speed(self) -> torch.Tensor:
        """Joint speeds over the last control period, `(N, J)`, rad/s or m/s."""
        return (self.history.q[:, -1] - self.history.q[:, -2]) / self.period_s

    @property
    def tip_velocity_m_s(self) -> torch.Tensor:
        """Velocity of the tool point over the last control period, `(N, 3)`."""
        before_m = self.kinematics.pose(self.history.q[:, -2]).tip_in_base_m
        return (self.tip_m - before_m) / self.period_s


@dataclass
class ToolState(StepState):
    """State of a task that moves the tool to a pose.

    Attributes:
        target_m: Target point of the controller, `(N, 3)`.
        target_pitch_rad: Wanted pitch, `(N,)`.
        reach_m: Distance by which the switch decides, `(N,)`.
        reach_range_m: Good working range (nearest, farthest).
        positioning: Whether only the exclusive joints could move in this step, `(N,)` bool.
        paper_success: The paper's criterion holds, `(N,)` bool.
        closeness: How near the task is to done, 0 to about 1, `(N,)`.
        closeness_before: The same one step earlier.
    """

    target_m: torch.Tensor
    target_pitch_rad: torch.Tensor
    reach_m: torch.Tensor
    reach_range_m: tuple[float, float]
    positioning: torch.Tensor
    paper_success: torch.Tensor
    closeness: torch.Tensor
    closeness_before: torch.Tensor

    @property
    def lateral_m(self) -> torch.Tensor:
        """Distance of the tool point from the vertical through the target, `(N,)`."""
        return (self.target_m - self.tip_m)[:, :2].norm(dim=1)

    @property
    def distance_m(self) -> torch.Tensor:
        """Distance from the tool point to the target, `(N,)`."""
        return (self.target_m - self.tip_m).norm(dim=1)

    @property
    def pitch_error_rad(self) -> torch.Tensor:
        """Size of the pitch error, `(N,)`."""
        return (self.target_pitch_rad - self.pitch_rad).abs()
