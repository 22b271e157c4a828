"""Starts and criteria of the pose task, and its process."""

from __future__ import annotations

import torch

from brokk_rl.contracts.task import TaskProcess
from brokk_rl.machine import Machine
from brokk_rl.sim import scene
from tasks.classical import ClassicalController
from tasks.goal_pose import GoalPose
from tasks.options import ToolPoseOptions
from tasks.process import ToolPoseProcess
from tasks.starts import CandidateTargets, DrawTally, Uniform, draw_starts

BLOCK_AWAY_M = -20.0
"""Where the block stands along x: behind the machine and out of its reach, so that nothing but the
ground is in the way."""


def make_process(
    task: GoalPose, machine: Machine, num_envs: int, device: torch.device
) -> TaskProcess:
    """Return the process of `task` for `num_envs` environments on `device`."""
    goal = ReachingGoal(task, machine)
    options = ToolPoseOptions.of(task, depth_m=0.0)
    return ToolPoseProcess(goal, options, machine, num_envs, device)


class ReachingGoal:
    """Starts and criteria of the pose task; fulfils `tasks.process.ToolPoseGoal`."""

    def __init__(self, task: GoalPose, machine: Machine) -> None:
        self._task = task
        self._machine = machine

    def starts(
        self, count: int, seed: int, tally: DrawTally | None = None
    ) -> dict[str, torch.Tensor]:
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

        controller = ClassicalController(task.classical, self._machine, torch.device("cpu"))
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
            tally,
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
