"""Tasks made of terms: everything that is particular to them stands in their YAML.

A package offers such a task by a YAML of its own whose `_target_` is a subclass of `TermTask`, and
functions for its terms. `docs/extending.md` builds one. The specs here need no torch, so that a bad
value is refused before torch is loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, ClassVar

from brokk_rl.bounds import require_number
from brokk_rl.contracts.task import TaskProcess
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim.objects import SceneObject
from brokk_rl.spec import spec
from tasks.reward import RewardCurriculum, RewardTerm
from tasks.step_state import StepState
from tasks.termination import Termination, check_terminations, require_function

if TYPE_CHECKING:
    import torch


@dataclass
class TermState(StepState):
    """State of a task made of terms.

    Observation terms see the state as sensors measure it, without `success` and `failed`.

    Attributes:
        time_s: Time since the start of the episode, `(N,)`.
        speed: Joint speeds over the last control period, `(N, J)`, rad/s or m/s.
        tip_before_m: Tool point one control period earlier, `(N, 3)`.
        start_tip_m: Tool point at the start of the episode, `(N, 3)`.
        command: What the task asks for in this episode, `(N, K)` each, by name.
        period_s: Control period.
    """

    time_s: torch.Tensor
    speed: torch.Tensor
    tip_before_m: torch.Tensor
    start_tip_m: torch.Tensor
    command: dict[str, torch.Tensor]
    period_s: float

    @property
    def tip_velocity_m_s(self) -> torch.Tensor:
        """Velocity of the tool point over the last control period, `(N, 3)`."""
        return (self.tip_m - self.tip_before_m) / self.period_s


@spec
class UniformCommand:
    """Numbers that the task asks for, drawn for each episode.

    Attributes:
        lowest: Lower ends of the ranges, one for each number.
        highest: Upper ends.
    """

    lowest: tuple[float, ...]
    highest: tuple[float, ...]

    def check(self) -> None:
        if len(self.lowest) != len(self.highest) or not self.lowest:
            raise ConfigError(
                "task.command: expected as many lowest as highest values, got "
                f"{list(self.lowest)} and {list(self.highest)}"
            )
        for low, high in zip(self.lowest, self.highest, strict=True):
            require_number("task.command: lowest", low)
            require_number("task.command: highest", high, least=low)


@spec
class StartsNearHome:
    """Arms that begin around the machine's home position.

    Attributes:
        spread: Largest distance of each joint from home, as a share of half its travel.
        margin: Distance from joint limits, rad or m.
    """

    spread: float
    margin: float

    def check(self) -> None:
        require_number("task.start.spread", self.spread, least=0, most=1)
        require_number("task.start.margin", self.margin, least=0)


@spec
class ObservedTerm:
    """A part of an observation group.

    Attributes:
        function: `package.module:function` from `TermState` to `(N,)` or `(N, K)`.
        samples: Newest samples of the function in the vector, oldest first.
        mean: Approximate mean, subtracted.
        std: Approximate standard deviation, by which the difference is divided.
        noise: Uniform error of each sample (±), in the unit of the function.
        bias: Uniform error that stays for an episode (±), in the same unit.
    """

    function: str
    samples: int
    mean: float
    std: float
    noise: float
    bias: float

    def check(self) -> None:
        require_function("observation term", self.function)
        where = f"observation term '{self.function}'"
        require_number(f"samples of the {where}", self.samples, least=1)
        require_number(f"mean of the {where}", self.mean)
        require_number(f"std of the {where}", self.std, above=0)
        for name in ("noise", "bias"):
            require_number(f"{name} of the {where}", getattr(self, name), least=0)


@spec
class HeldCriterion:
    """Success: a criterion holds for most of the episode.

    Attributes:
        function: `package.module:function` from `TermState` to `(N,)` bool.
        share: Part of the counted control steps in which it must hold.
        after_s: Time from the start that is not counted.
    """

    function: str
    share: float
    after_s: float

    def check(self) -> None:
        require_function("success criterion", self.function)
        require_number("task.success.share", self.share, above=0, most=1)
        require_number("task.success.after_s", self.after_s, least=0)


@spec
class JointAction:
    """Map from the policy's output, one number for each joint, to valve commands.

    Attributes:
        scale: Factor on the output; the product is clipped to [-1, 1].
        mask: Keep exclusive and other joints apart, as the machine does: those move whose largest
            command is larger.
    """

    scale: float
    mask: bool

    def check(self) -> None:
        require_number("task.action.scale", self.scale, above=0)


@spec
class TermTask:
    """A task made of terms.

    A task is a subclass of its own, so that its policies carry its name; it needs no method.

    Attributes:
        episode_s: Time limit.
        scene: Objects that stand beside the machine by name; `null` leaves one out.
        start: Where the arm begins.
        command: What the task asks for, drawn for each episode, by name.
        observation: Parts of the policy's vector by name, in this order; `null` leaves one out.
        privileged: Parts that only the critic sees, likewise.
        action: How the policy's output becomes commands.
        reward: Reward terms by name.
        curriculum: Terms whose weights grow with success; `null` for constant weights.
        success: Criterion of success.
        termination: Endings of an episode by name; `null` switches one off.
    """

    episode_s: float
    scene: dict[str, SceneObject | None]
    start: StartsNearHome
    command: dict[str, UniformCommand]
    observation: dict[str, ObservedTerm | None]
    privileged: dict[str, ObservedTerm | None]
    action: JointAction
    reward: dict[str, RewardTerm]
    curriculum: RewardCurriculum | None
    success: HeldCriterion
    termination: dict[str, Termination | None]

    behaviour: ClassVar[tuple[str, ...]] = ("observation", "action")
    """Fields that a policy has learned with; see `brokk_rl.policy_folder`."""

    def check(self) -> None:
        require_number("task.episode_s", self.episode_s, above=self.success.after_s)
        if not select_terms(self.observation):
            raise ConfigError("task.observation: expected one term or more, got none")
        check_terminations(self.termination)
        if self.curriculum:
            self.curriculum.check_names(self.reward)

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        # by name: importing it loads torch
        make = resolve_name("tasks.term_task.process:TermProcess")
        return make(self, machine, num_envs, device)


def select_terms(terms: Mapping[str, ObservedTerm | None]) -> dict[str, ObservedTerm]:
    """Return the terms that are switched on."""
    return {name: term for name, term in terms.items() if term is not None}
