"""Specs of tasks: their terms with parameters, what all tasks have, and tasks made of terms alone.

A task lists its rewards, observations, endings, figures and criteria by name. Each names a function
`package.module:function`, whose first argument is the state after a control step
(`tasks.terms.StepState`); `params` gives the others. A package offers a task by a YAML of its own,
whose `_target_` is a subclass of `TermTask`, and functions for its terms; the shipped ones are in
`tasks.terms`. `examples/my_package` is such a package. This module needs no torch, so that a bad
value is refused before torch is loaded.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import field
from functools import partial
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from brokk_rl.contracts.task import FAULT, SUCCESS, Figure, TaskProcess
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.sim.simulator import find_site
from brokk_rl.spec import Count, Finite, NonNegative, Positive, Share, spec

if TYPE_CHECKING:
    import torch

    from brokk_rl.contracts.world import Simulator

BLOCK_AWAY_M = -20.0
"""Place of the block along x where a task has none: behind the machine and out of its reach, so
that nothing but the ground is in the way."""
DRAWN = ("q", "scene", "tip_m")
"""Entries of a start that are no commands."""
Outcome = Literal["success", "failure", "void", "time"]
"""Meaning of an ending. `success`: the task is done. `failure`: reward terms see `failed`. `void`:
the episode counts for nothing, and its last step has no reward. `time`: the learner estimates what
would have followed, as `time_out` does in other libraries."""


@spec
class TaskTerm:
    """A function of the state, with its parameters.

    Attributes:
        function: `package.module:function` of the state and `params`; the result is `(N,)` unless
            the kind of the term says otherwise.
        params: Values of the function's further parameters, by name.
    """

    function: str
    params: dict[str, Any] = field(default_factory=dict)

    kind: ClassVar[str] = "term"

    def check(self) -> None:
        _check_call(f"{self.kind} '{self.function}'", self.function, self.params)

    def resolve(self) -> Callable[[Any], torch.Tensor]:
        """Return the function of the state alone."""
        return partial(resolve_name(self.function), **self.params)


@spec
class RewardTerm(TaskTerm):
    """A weighted reward.

    Attributes:
        weight: Factor; negative for a penalty.
    """

    weight: Finite

    kind: ClassVar[str] = "reward term"


@spec
class ObservedTerm(TaskTerm):
    """A part of an observation group, `(N,)` or `(N, K)`.

    Attributes:
        samples: Newest samples of the function in the vector, oldest first.
        mean: Approximate mean, subtracted.
        std: Approximate standard deviation, by which the difference is divided.
        noise: Uniform error of each sample (±), in the unit of the function.
        bias: Uniform error that stays for an episode (±), in the same unit.
    """

    samples: Count
    mean: Finite
    std: Positive
    noise: NonNegative
    bias: NonNegative

    kind: ClassVar[str] = "observation term"


@spec
class TerminationTerm(TaskTerm):
    """An ending of the episode: where the function, `(N,)` bool, holds.

    Attributes:
        outcome: Meaning of the ending; see `Outcome`.
    """

    outcome: Outcome

    kind: ClassVar[str] = "termination term"


@spec
class FigureTerm(TaskTerm):
    """A figure of an episode, and its words in tables and films.

    Attributes:
        reduce: What becomes of the values of all steps. `at_success`: the value of the step with
            the first success; evaluation reports median and 95 % quantile of episodes with success.
            `until_success`: the last value up to that step.
        title: Name of the figure in words.
        unit: Unit in which it is shown; `share` for 0 or 1, of which the share is reported.
        factor: Factor from the unit of the function to the one shown.
        digits: Decimals shown.
    """

    reduce: Literal["last", "largest", "mean", "sum", "at_success", "until_success"]
    title: str
    unit: str
    factor: Finite
    digits: int

    kind: ClassVar[str] = "figure"

    def build(self) -> Figure:
        """Return the words of the figure."""
        return Figure(self.title, self.unit, self.factor, self.digits, self.reduce == "at_success")


@spec
class HeldCriterion(TaskTerm):
    """Success: a criterion, `(N,)` bool, holds for most of the episode.

    Attributes:
        share: Part of the counted control steps in which it must hold.
        after_s: Time from the start that is not counted.
    """

    share: Share
    after_s: NonNegative

    kind: ClassVar[str] = "success criterion"


@spec
class RewardCurriculum:
    """Reward terms that begin with a part of their weight and get the rest as episodes succeed.

    A beginner that pays in full for moving and touching stops to move. Success is counted over all
    environments: of each the last episode.

    Attributes:
        begin: Part of its weight with which each term begins, by its name.
        figure: Figure of an episode, 0 or 1, that counts as success.
        success: Share of successes up to which these parts hold, and from which on the full weights
            do; linear between them.
    """

    begin: dict[str, NonNegative]
    figure: str
    success: tuple[Share, Share]

    def check(self) -> None:
        if self.success[0] >= self.success[1]:
            raise ConfigError(f"success: expected low < high, got {list(self.success)}")

    def scale(self, succeeded: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the part of its weight of each term, scalars.

        Args:
            succeeded: Whether the last episode of each environment succeeded, `(N,)`, 0 or 1.
        """
        low, high = self.success
        share = ((succeeded.mean() - low) / (high - low)).clamp(0.0, 1.0)
        return {name: part + (1.0 - part) * share for name, part in self.begin.items()}


def _check_call(what: str, name: str, params: Mapping[str, Any]) -> None:
    """Refuse a function that is not there, and parameters that it does not take."""
    try:
        function = resolve_name(name)
        signature = inspect.signature(function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"{what} cannot be found ({error}); expected package.module:function"
        ) from error
    except TypeError as error:
        raise ConfigError(f"{what} is no function; expected package.module:function") from error
    try:
        signature.bind(None, **params)
    except TypeError as error:
        taken = ", ".join(list(signature.parameters)[1:]) or "none"
        raise ConfigError(
            f"params of the {what}: {error}; expected {taken}, got {', '.join(params) or 'none'}"
        ) from error
    for key, value in params.items():
        parameter = signature.parameters.get(key)
        is_wanted = parameter is not None and parameter.annotation in ("float", "int", float, int)
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if (is_wanted and not is_number) or (is_number and not math.isfinite(value)):
            raise ConfigError(
                f"params.{key} of the {what}: expected a finite number, got {value!r}"
            )


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
        if FAULT in self.termination:
            raise ConfigError(f"termination.{FAULT}: the simulator's own faults have this name")
        if not any(term and term.outcome == "time" for term in self.termination.values()):
            raise ConfigError(
                "termination: expected a time limit; give task.termination.time_limit="
                '{function: "tasks.terms:time_limit", outcome: time}'
            )
        for name in self.curriculum.begin if self.curriculum else ():
            if name not in self.reward:
                raise ConfigError(
                    f"curriculum.begin: there is no reward term {name}; "
                    f"{list_choices(name, self.reward)}"
                )
        if self.curriculum and self.figures.get(self.curriculum.figure) is None:
            name = self.curriculum.figure
            raise ConfigError(
                f"curriculum.figure: there is no figure {name}; {list_choices(name, self.figures)}"
            )
        if self.figures.get(SUCCESS) is None:
            raise ConfigError(f"figures.{SUCCESS}: expected the figure by which policies compare")

    def check_machine(self, machine: Machine) -> None:
        """Refuse values that do not fit a machine; needs no torch."""
        if self.episode_s < machine.period_s:
            raise ConfigError(
                f"task.episode_s: expected at least a control step of machine '{machine.name}', "
                f"{machine.period_s:g} s, got {self.episode_s:g}"
            )

    def check_sim(self, sim: Simulator) -> None:
        """Refuse a scene that there is not, or that the simulator does not build."""
        find_site(self.scene, sim)

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

    def command(self, output: torch.Tensor, exclusive: torch.Tensor) -> torch.Tensor:
        """Return valve commands in [-1, 1], `(N, J)`.

        Args:
            output: Output of the network, `(N, J)`.
            exclusive: Which joints are exclusive, `(J,)` bool.
        """
        u = (self.scale * output).clamp(-1.0, 1.0)
        if not self.mask:
            return u
        size = u.abs()
        alone, others = (size * exclusive).amax(1), (size * ~exclusive).amax(1)
        return u.where(mask_exclusive_joints(exclusive, alone > others), 0.0)


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

    process: ClassVar[str] = "tasks.term_process:TermProcess"
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
