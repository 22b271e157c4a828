"""Options of a tool-pose task that its process uses, as the task's spec has them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

from brokk_rl.observation import TargetScaling
from tasks.noise import MeasuredNoise, ObservationNoise
from tasks.reward import RewardCurriculum, RewardTerm
from tasks.settings import ActionMapping, AdviceConfig, ClassicalConfig, PhaseSwitch
from tasks.termination import Termination


@dataclass
class ToolPoseOptions:
    """Parts of a task's configuration that the process itself uses.

    See the task's spec. The controller's target lies `depth_m` below that of the goal.
    """

    episode_s: float
    depth_m: float
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

    @classmethod
    def of(cls, task: object, **fixed: Any) -> Self:
        """Return the options of a task's spec, whose fields have the same names.

        Args:
            task: The spec.
            **fixed: Options that the spec does not leave open.
        """
        names = []
        for field in fields(cls):
            if field.name not in fixed:
                names.append(field.name)
        return cls(**fixed, **{name: getattr(task, name) for name in names})
