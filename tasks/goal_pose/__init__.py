"""Moving the tool to a pose in the open: a point and a pitch (the paper's outlook)."""

from typing import ClassVar

import torch

from brokk_rl.contracts.task import TaskProcess
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.observation import TargetScaling
from brokk_rl.sim import scene
from brokk_rl.spec import spec
from tasks.advice import AdviceConfig
from tasks.classical import ClassicalConfig
from tasks.control import ActionMapping, PhaseSwitch
from tasks.noise import ObservationNoise
from tasks.process import ToolPoseOptions, ToolPoseProcess
from tasks.reward import RewardTerm
from tasks.starts import ArmStarts, CandidateTargets, Uniform, draw_starts

BLOCK_AWAY_M = -20.0
"""Where the block stands along x: behind the machine and out of its reach, so that nothing but the
ground is in the way."""


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
        for name in ("distance_m", "bearing_rad", "height_m", "pitch_rad"):
            low, high = getattr(self, name)
            if low > high:
                raise ConfigError(
                    f"task.pose.{name}: expected (lowest, highest), got [{low}, {high}]"
                )


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


@spec
class GoalPose:
    """Move the tool to any reachable pose: a target point and a wanted pitch, nothing in the way.

    Attributes:
        episode_s: Time limit.
        end_on_success: Whether strict success ends the episode.
        limit_margin: Distance to a joint limit (rad or m) at which the episode ends.
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
    """

    episode_s: float
    end_on_success: bool
    limit_margin: float
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

    behaviour: ClassVar[tuple[str, ...]] = (
        "memory",
        "advice",
        "noise.filter",
        "switch",
        "action",
        "scaling",
        "classical",
    )
    """Fields that a policy has learned with; see `brokk_rl.task_description`."""

    def check(self) -> None:
        if self.scaling.pitch_rad is None and self.pose.pitch_rad[0] != self.pose.pitch_rad[1]:
            raise ConfigError(
                "task.scaling.pitch_rad: the wanted pitch differs between episodes, so the "
                "policy must "
                "observe it: give [mean, std]"
            )

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        return ToolPoseProcess(
            ReachingGoal(self, machine),
            ToolPoseOptions.of(self, depth_m=0.0),
            machine,
            num_envs,
            device,
        )


class ReachingGoal:
    """Starts and criteria of the pose task; fulfils `tasks.process.ToolPoseGoal`."""

    def __init__(self, task: GoalPose, machine: Machine) -> None:
        self._task = task
        self._machine = machine

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw valid starts; see `tasks.process.ToolPoseGoal`."""
        task, pose = self._task, self._task.pose

        def draw(uniform: Uniform) -> CandidateTargets:
            distance, bearing = uniform(pose.distance_m), uniform(pose.bearing_rad)
            place = scene.make_nominal_scenes(len(distance))
            place[:, scene.COLUMNS.index("hole_x_m")] = BLOCK_AWAY_M
            return CandidateTargets(
                target_m=torch.stack(
                    (distance * bearing.cos(), distance * bearing.sin(), uniform(pose.height_m)), 1
                ),
                pitch_rad=uniform(pose.pitch_rad),
                scene=place,
                object_z_m=torch.zeros_like(distance),
            )

        controller = task.classical.build(self._machine, torch.device("cpu"))
        return draw_starts(
            count,
            seed,
            draw,
            task.arms,
            self._machine,
            controller,
            task.switch.reach_m,
            0.0,
            "goal_pose",
        )

    def judge(
        self, tip_m: torch.Tensor, pitch_rad: torch.Tensor, start: dict[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Judge tool poses; see `tasks.process.ToolPoseGoal`."""
        rules = self._task.tolerance
        distance = (start["target_m"] - tip_m).norm(dim=1)
        turn = (start["target_pitch_rad"] - pitch_rad).abs()
        return {
            "success": (distance <= rules.strict_distance_m) & (turn <= rules.strict_pitch_rad),
            "paper_success": (1 / (1 + distance) >= rules.paper_alignment)
            & (1 / (1 + turn) >= rules.paper_alignment),
            "closeness": _measure_closeness(distance, turn),
        }

    def describe_success(self) -> dict[str, float]:
        """Return distance and pitch error; see `tasks.process.ToolPoseGoal`."""
        rules = self._task.tolerance
        return {
            "largest_distance_m": rules.strict_distance_m,
            "largest_pitch_error_rad": rules.strict_pitch_rad,
        }


def _measure_closeness(distance_m: torch.Tensor, turn_rad: torch.Tensor) -> torch.Tensor:
    """Return the closeness of a pose, 0 to 1.

    Sum of distance at three scales, pitch at three, and both together.
    """
    near = torch.stack([1 / (1 + distance_m / scale) for scale in (1.0, 0.3, 0.05)]).mean(0)
    turned = torch.stack([1 / (1 + turn_rad / scale) for scale in (1.0, 0.3, 0.05)]).mean(0)
    return 0.5 * near + 0.2 * turned + 0.3 * near * turned
