"""Inserting the chisel into a vertical borehole in a concrete block (the paper's task)."""

import math
from typing import ClassVar

import torch

from brokk_rl.contracts.task import TaskProcess
from brokk_rl.machine import Machine
from brokk_rl.observation import TargetScaling
from brokk_rl.sim import scene
from brokk_rl.spec import spec
from tasks.advice import AdviceConfig
from tasks.classical import ClassicalConfig
from tasks.control import ActionMapping, PhaseSwitch
from tasks.noise import MeasuredNoise, ObservationNoise
from tasks.process import ToolPoseOptions, ToolPoseProcess
from tasks.reward import RewardTerm
from tasks.starts import ArmStarts, CandidateTargets, Uniform, draw_starts

DOWN_RAD = math.pi / 2
"""Pitch of a tool that points straight down, rad (the paper's 1.57)."""


@spec
class BoreholeRanges:
    """Ranges of the borehole; uniform (lowest, highest).

    Attributes:
        distance_m: Horizontal distance of the rim's centre from the slew axis.
        bearing_rad: Bearing of the hole from straight ahead.
        rim_z_m: Height of the rim above the ground.
        yaw_rad: Orientation of the block.
        block_scale: Scale of the block's footprint.
        radius_m: Radius of the hole.
    """

    distance_m: tuple[float, float]
    bearing_rad: tuple[float, float]
    rim_z_m: tuple[float, float]
    yaw_rad: tuple[float, float]
    block_scale: tuple[float, float]
    radius_m: float


@spec
class InsertionCriteria:
    """Criteria of an inserted chisel.

    Attributes:
        strict_depth_m: Depth of the tip below the rim, inside the hole.
        chisel_radius_m: Radius of the chisel; the tip is inside when it is off axis by no more than
            the clearance.
        slack_m: Softness of contacts and the corners of the polygon that stands for the round hole.
        paper_alignment: Both r^d and r^o at least this.
        paper_height_m: Height of the tip below the rim at the paper's limit (0.7 m with a nominal
            rim of 0.75 m).
    """

    strict_depth_m: float
    chisel_radius_m: float
    slack_m: float
    paper_alignment: float
    paper_height_m: float


@spec
class BoreholeInsertion:
    """Insert the 8 cm chisel into the 10 cm borehole of a concrete block.

    Attributes:
        episode_s: Time limit.
        end_on_success: Whether strict success ends the episode.
        limit_margin: Distance to a joint limit (rad or m) at which the episode ends.
        depth_m: Depth below the rim of the target point (paper: 0.1 m; a little more makes the
            controller pass the strict depth).
        hole: Where the hole may be.
        arms: Where the arm may begin.
        success: Criteria.
        memory: Newest samples of history that the policy sees; the machine's `num_history` for all
            of them.
        advice: How to propose to a person who moves the levers; `null` where the policy's commands
            are given as they are.
        noise: Errors of the observation.
        switch: When only q2 moves.
        action: How the policy's output becomes commands.
        scaling: Normalisation of the hole position.
        classical: The classical controller, baseline and base of residual actions.
        reward: Reward terms by name.
    """

    episode_s: float
    end_on_success: bool
    limit_margin: float
    depth_m: float
    hole: BoreholeRanges
    arms: ArmStarts
    success: InsertionCriteria
    memory: int
    advice: AdviceConfig | None
    noise: ObservationNoise | MeasuredNoise
    switch: PhaseSwitch
    action: ActionMapping
    scaling: TargetScaling
    classical: ClassicalConfig
    reward: dict[str, RewardTerm]

    behaviour: ClassVar[tuple[str, ...]] = (
        "depth_m",
        "memory",
        "advice",
        "noise.filter",
        "switch",
        "action",
        "scaling",
        "classical",
    )
    """Fields that a policy has learned with; see `brokk_rl.task_description`."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        return ToolPoseProcess(
            InsertionGoal(self, machine), ToolPoseOptions.of(self), machine, num_envs, device
        )


class InsertionGoal:
    """Starts and criteria of the borehole task; fulfils `tasks.process.ToolPoseGoal`."""

    def __init__(self, task: BoreholeInsertion, machine: Machine) -> None:
        self._task = task
        self._machine = machine

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
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

        controller = task.classical.build(self._machine, torch.device("cpu"))
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
