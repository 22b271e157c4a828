"""Starts and criteria of the borehole task, and its process."""

from __future__ import annotations

import math

import torch

from brokk_rl.contracts.task import TaskProcess
from brokk_rl.machine import Machine
from brokk_rl.sim import scene
from tasks.borehole_insertion import BoreholeInsertion
from tasks.classical import ClassicalController
from tasks.options import ToolPoseOptions
from tasks.process import ToolPoseProcess
from tasks.starts import CandidateTargets, DrawTally, Uniform, draw_starts

DOWN_RAD = math.pi / 2
"""Pitch of a tool that points straight down, rad (the paper's 1.57)."""


def make_process(
    task: BoreholeInsertion, machine: Machine, num_envs: int, device: torch.device
) -> TaskProcess:
    """Return the process of `task` for `num_envs` environments on `device`."""
    goal = InsertionGoal(task, machine)
    return ToolPoseProcess(goal, ToolPoseOptions.of(task), machine, num_envs, device)


class InsertionGoal:
    """Starts and criteria of the borehole task; fulfils `tasks.process.ToolPoseGoal`."""

    def __init__(self, task: BoreholeInsertion, machine: Machine) -> None:
        self._task = task
        self._machine = machine

    def starts(
        self, count: int, seed: int, tally: DrawTally | None = None
    ) -> dict[str, torch.Tensor]:
        """Draw valid starts; see `tasks.process.ToolPoseGoal`."""
        task, hole = self._task, self._task.hole

        def draw(uniform: Uniform) -> CandidateTargets:
            distance, bearing = uniform(hole.distance_m), uniform(hole.bearing_rad)
            rim = torch.stack(
                (distance * bearing.cos(), distance * bearing.sin(), uniform(hole.rim_z_m)), 1
            )
            columns = {
                "hole_x_m": rim[:, 0],
                "hole_y_m": rim[:, 1],
                "rim_z_m": rim[:, 2],
                "yaw_rad": bearing + uniform(hole.yaw_rad),
                "block_scale": uniform(hole.block_scale),
                "hole_radius_m": torch.full_like(distance, hole.radius_m),
            }
            return CandidateTargets(
                target_m=rim,
                pitch_rad=torch.full_like(distance, DOWN_RAD),
                scene=torch.stack([columns[name] for name in scene.COLUMNS], 1),
                object_z_m=rim[:, 2],
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
            task.depth_m,
            "borehole_insertion",
            tally,
        )

    def judge(
        self, tip_m: torch.Tensor, pitch_rad: torch.Tensor, start: dict[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Judge tool poses; see `tasks.process.ToolPoseGoal`."""
        rules, rim = self._task.success, start["target_m"]
        lateral = (tip_m - rim)[:, :2].norm(dim=1)
        below = rim[:, 2] - tip_m[:, 2]
        inside = lateral <= self._clearance_m
        target = rim.clone()
        target[:, 2] -= self._task.depth_m
        distance = (target - tip_m).norm(dim=1)
        turn = (start["target_pitch_rad"] - pitch_rad).abs()
        aligned = (1 / (1 + distance) >= rules.paper_alignment) & (
            1 / (1 + turn) >= rules.paper_alignment
        )
        return {
            "success": inside & (below >= rules.strict_depth_m),
            "paper_success": aligned & (below >= rules.paper_height_m),
            "closeness": _measure_closeness(
                distance, lateral, turn, below * inside, rules.strict_depth_m
            ),
        }

    def describe_success(self) -> dict[str, float]:
        """Return depth and lateral error; see `tasks.process.ToolPoseGoal`."""
        depth_m = self._task.success.strict_depth_m
        return {"least_depth_below_target_m": depth_m, "largest_lateral_m": self._clearance_m}

    @property
    def _clearance_m(self) -> float:
        """Distance from the hole's axis up to which the tip is inside."""
        rules = self._task.success
        return self._task.hole.radius_m - rules.chisel_radius_m + rules.slack_m


def _measure_closeness(
    distance_m: torch.Tensor,
    lateral_m: torch.Tensor,
    turn_rad: torch.Tensor,
    inside_m: torch.Tensor,
    depth_m: float,
) -> torch.Tensor:
    """Return the closeness of an insertion, 0 to 1.

    Sum of distance at three scales, alignment at three, and depth inside the hole.
    """
    approach = sum(1 / (1 + distance_m / scale) for scale in (1.0, 0.3, 0.1)) / 3
    aligned = sum(1 / (1 + lateral_m / scale) for scale in (0.1, 0.03, 0.01)) / 3
    upright = 1 / (1 + turn_rad / 0.2)
    return (
        0.3 * approach
        + 0.3 * aligned * approach
        + 0.1 * upright
        + 0.3 * (inside_m / depth_m).clamp(0.0, 1.0)
    )
