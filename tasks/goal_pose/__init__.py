"""Moving the tool to a pose in the open: a point and a pitch (the paper's outlook).

The specs here need no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar

from brokk_rl.bounds import require_number, require_range
from brokk_rl.contracts.task import TaskProcess
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.observation import TargetScaling
from brokk_rl.spec import spec
from tasks.noise import ObservationNoise
from tasks.reward import RewardCurriculum, RewardTerm
from tasks.settings import ActionMapping, AdviceConfig, ArmStarts, ClassicalConfig, PhaseSwitch
from tasks.termination import Termination, check_terminations

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

    distance_m: tuple[float, float]
    bearing_rad: tuple[float, float]
    height_m: tuple[float, float]
    pitch_rad: tuple[float, float]

    def check(self) -> None:
        for name in ("bearing_rad", "height_m", "pitch_rad"):
            require_range(f"task.pose.{name}", getattr(self, name))
        require_range("task.pose.distance_m", self.distance_m, least=0)


@spec
class PoseCriteria:
    """Criteria of a reached pose.

    Attributes:
        strict_distance_m: Distance of the tool point from the target.
        strict_pitch_rad: Pitch error.
        paper_alignment: The paper's measure of alignment: both r^d and r^o at least this.
    """

    strict_distance_m: float
    strict_pitch_rad: float
    paper_alignment: float

    def check(self) -> None:
        for name in ("strict_distance_m", "strict_pitch_rad"):
            require_number(f"task.tolerance.{name}", getattr(self, name), above=0)
        require_number("task.tolerance.paper_alignment", self.paper_alignment, above=0, most=1)


@spec
class GoalPose:
    """Move the tool to any reachable pose: a target point and a wanted pitch, nothing in the way.

    Attributes:
        episode_s: Time limit.
        pose: Which poses are asked for.
        arms: Where the arm may begin.
        tolerance: Criteria of success.
        memory: Newest samples of history that the policy sees; the machine's `num_history` for all
            of them.
        advice: How to propose to a person who moves the levers; `null` where the policy's commands
            are given as they are.
        noise: Errors of the observation.
        switch: When only q2 moves.
        action: How the policy's output becomes commands.
        scaling: Normalisation of target point and pitch.
        classical: The classical controller, baseline and base of residual actions.
        reward: Reward terms by name.
        curriculum: Terms whose weights grow with success; `null` for constant weights.
        termination: Endings of an episode by name; `null` switches one off.
    """

    episode_s: float
    pose: PoseRanges
    arms: ArmStarts
    tolerance: PoseCriteria
    memory: int
    advice: AdviceConfig | None
    noise: ObservationNoise
    switch: PhaseSwitch
    action: ActionMapping
    scaling: TargetScaling
    classical: ClassicalConfig
    reward: dict[str, RewardTerm]
    curriculum: RewardCurriculum | None
    termination: dict[str, Termination | None]

    behaviour: ClassVar[tuple[str, ...]] = (
        "memory",
        "advice",
        "noise.filter",
        "switch",
        "action",
        "scaling",
        "classical",
    )
    """Fields that a policy has learned with; see `brokk_rl.policy_folder`."""

    def check(self) -> None:
        require_number("task.episode_s", self.episode_s, above=0)
        require_number("task.memory", self.memory, least=1)
        check_terminations(self.termination)
        if self.curriculum:
            self.curriculum.check_names(self.reward)
        if self.scaling.pitch_rad is None and self.pose.pitch_rad[0] != self.pose.pitch_rad[1]:
            raise ConfigError(
                "task.scaling.pitch_rad: the wanted pitch differs between episodes, so the "
                "policy must "
                "observe it: give [mean, std]"
            )

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        # by name: importing it loads torch
        make = resolve_name("tasks.goal_pose.goal:make_process")
        return make(self, machine, num_envs, device)
