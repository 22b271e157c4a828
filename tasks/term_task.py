"""Tasks made of terms: everything that is particular to them stands in their YAML.

A package offers such a task by a YAML of its own whose `_target_` is a subclass of `TermTask`, and
functions for its terms (`tasks.terms`). `examples/my_package` is one. The specs here need no torch,
so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar

from brokk_rl.contracts.task import SUCCESS, TaskProcess
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.spec import Finite, NonNegative, Positive, Share, spec
from tasks.terms import (
    FigureTerm,
    HeldCriterion,
    ObservedTerm,
    RewardCurriculum,
    RewardTerm,
    TerminationTerm,
    check_terminations,
)

if TYPE_CHECKING:
    import torch

BLOCK_AWAY_M = -20.0
"""Place of the block along x where a task has none: behind the machine and out of its reach, so
that nothing but the ground is in the way."""
DRAWN = ("q", "scene", "tip_m")
"""Entries of a start that are no commands."""


@spec
class EpisodeTask:
    """Common fields of all tasks.

    Attributes:
        episode_s: Time limit.
        scene: MJCF file with what stands beside the machine; `null` for nothing.
        privileged: Parts that only the critic sees, by name; `null` leaves one out.
        reward: Reward terms by name.
        curriculum: Terms whose weights grow with success; `null` for constant weights.
        figures: Figures of an episode by name, in the order of tables; `null` leaves one out.
        termination: Endings of an episode by name; `null` switches one off.
    """

    episode_s: Positive
    scene: str | None
    privileged: dict[str, ObservedTerm | None]
    reward: dict[str, RewardTerm]
    curriculum: RewardCurriculum | None
    figures: dict[str, FigureTerm | None]
    termination: dict[str, TerminationTerm | None]

    process: ClassVar[str]
    """`package.module:class` of its `TaskProcess`."""

    def check(self) -> None:
        check_terminations(self.termination)
        if self.curriculum:
            self.curriculum.check_names(self.reward)
        if self.figures.get(SUCCESS) is None:
            raise ConfigError(f"figures.{SUCCESS}: expected the figure by which policies compare")

    def check_machine(self, machine: Machine) -> None:
        """Refuse values that do not fit a machine; needs no torch."""
        if self.episode_s < machine.period_s:
            raise ConfigError(
                f"task.episode_s: expected at least a control step of machine '{machine.name}', "
                f"{machine.period_s:g} s, got {self.episode_s:g}"
            )

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        self.check_machine(machine)
        make = resolve_name(self.process)  # by name: importing it loads torch
        return make(self, machine, num_envs, device)


@spec
class UniformCommand:
    """Numbers that the task asks for, drawn for each episode.

    Attributes:
        lowest: Lower ends of the ranges, one for each number.
        highest: Upper ends.
    """

    lowest: tuple[Finite, ...]
    highest: tuple[Finite, ...]

    def check(self) -> None:
        pairs = zip(self.lowest, self.highest, strict=False)
        is_alike = len(self.lowest) == len(self.highest) > 0
        if not is_alike or any(low > high for low, high in pairs):
            raise ConfigError(
                "highest: expected as many values as lowest has, none of them below, got "
                f"{list(self.highest)} for {list(self.lowest)}"
            )


@spec
class StartsNearHome:
    """Arms that begin around the machine's home position.

    Attributes:
        spread: Largest distance of each joint from home, as a share of half its travel.
        margin: Distance from joint limits, rad or m.
    """

    spread: Share
    margin: NonNegative


@spec
class JointAction:
    """Map from the policy's output, one number for each joint, to valve commands.

    Attributes:
        scale: Factor on the output; the product is clipped to [-1, 1].
        mask: Keep exclusive and other joints apart, as the machine does: those move whose largest
            command is larger.
    """

    scale: Positive
    mask: bool


@spec
class TermTask(EpisodeTask):
    """A task made of terms.

    A task is a subclass of its own, so that its policies carry its name; it needs no method.

    Attributes:
        start: Where the arm begins.
        command: What the task asks for, drawn for each episode, by name.
        observation: Parts of the policy's vector by name, in this order; `null` leaves one out.
        action: How the policy's output becomes commands.
        success: Criterion of success.
    """

    start: StartsNearHome
    command: dict[str, UniformCommand]
    observation: dict[str, ObservedTerm | None]
    action: JointAction
    success: HeldCriterion

    process: ClassVar[str] = "tasks.process:TermProcess"
    behaviour: ClassVar[tuple[str, ...]] = ("observation", "action")
    """Fields that a policy has learned with; see `brokk_rl.policy_folder`."""

    def check(self) -> None:
        super().check()
        if self.episode_s <= self.success.after_s:
            raise ConfigError(
                f"episode_s: expected more than success.after_s of {self.success.after_s:g} s, got "
                f"{self.episode_s:g}"
            )
        if not any(self.observation.values()):
            raise ConfigError("observation: expected one term or more, got none")
        if taken := self.command.keys() & set(DRAWN):
            raise ConfigError(f"command: expected other names than {', '.join(sorted(taken))}")
