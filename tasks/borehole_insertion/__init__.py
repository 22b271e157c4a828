"""Inserting the chisel into a vertical borehole in a concrete block (the paper's task).

The specs here need no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar

from brokk_rl.bounds import require_number, require_range
from brokk_rl.contracts.task import TaskProcess
from brokk_rl.machine import Machine
from brokk_rl.observation import TargetScaling
from brokk_rl.spec import spec
from tasks.noise import MeasuredNoise, ObservationNoise
from tasks.reward import RewardCurriculum, RewardTerm
from tasks.settings import ActionMapping, AdviceConfig, ArmStarts, ClassicalConfig, PhaseSwitch
from tasks.termination import Termination, check_terminations

if TYPE_CHECKING:
    import torch


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

    def check(self) -> None:
        for name in ("bearing_rad", "rim_z_m", "yaw_rad"):
            require_range(f"task.hole.{name}", getattr(self, name))
        for name in ("distance_m", "block_scale"):
            require_range(f"task.hole.{name}", getattr(self, name), least=0)
        require_number("task.hole.radius_m", self.radius_m, above=0)


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

    def check(self) -> None:
        for name in ("strict_depth_m", "chisel_radius_m"):
            require_number(f"task.success.{name}", getattr(self, name), above=0)
        for name in ("slack_m", "paper_height_m"):
            require_number(f"task.success.{name}", getattr(self, name))
        require_number("task.success.paper_alignment", self.paper_alignment, above=0, most=1)


@spec
class BoreholeInsertion:
    """Insert the 8 cm chisel into the 10 cm borehole of a concrete block.

    Attributes:
        episode_s: Time limit.
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
        curriculum: Terms whose weights grow with success; `null` for constant weights.
        termination: Endings of an episode by name; `null` switches one off.
    """

    episode_s: float
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
    curriculum: RewardCurriculum | None
    termination: dict[str, Termination | None]

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
    """Fields that a policy has learned with; see `brokk_rl.policy_folder`."""

    def check(self) -> None:
        require_number("task.episode_s", self.episode_s, above=0)
        require_number("task.memory", self.memory, least=1)
        require_number("task.depth_m", self.depth_m)
        check_terminations(self.termination)
        if self.curriculum:
            self.curriculum.check_names(self.reward)

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        # by name: importing it loads torch
        make = resolve_name("tasks.borehole_insertion.goal:make_process")
        return make(self, machine, num_envs, device)
