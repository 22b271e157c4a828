"""Terms of a task: functions by name, with parameters from YAML.

A task lists its rewards, observations, endings, figures and criteria by name. Each names a function
`package.module:function`, whose first argument is the state after a control step
(`tasks.step_state.StepState`); `params` gives the others. A package of one's own brings functions
of its own. The shipped ones are in `tasks.reward`, `tasks.observations`, `tasks.termination` and
`tasks.figures`. This module needs no torch, so that a bad value is refused before torch is loaded.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import field
from functools import partial
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from brokk_rl.contracts.task import FAULT, Figure
from brokk_rl.errors import ConfigError
from brokk_rl.spec import Count, Finite, NonNegative, Positive, Share, spec

if TYPE_CHECKING:
    import torch

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
        success: Share of successes up to which these parts hold, and from which on the full weights
            do; linear between them.
    """

    begin: dict[str, NonNegative]
    success: tuple[Share, Share]

    def check(self) -> None:
        if self.success[0] >= self.success[1]:
            raise ConfigError(f"success: expected low < high, got {list(self.success)}")

    def check_names(self, reward: Collection[str]) -> None:
        """Refuse names that are no terms of `reward`."""
        if odd := sorted(self.begin.keys() - set(reward)):
            raise ConfigError(
                f"curriculum.begin: there is no reward term {', '.join(odd)}; expected some "
                f"of {', '.join(sorted(reward))}"
            )

    def scale(self, succeeded: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the part of its weight of each term, scalars.

        Args:
            succeeded: Whether the last episode of each environment succeeded, `(N,)`, 0 or 1.
        """
        low, high = self.success
        share = ((succeeded.mean() - low) / (high - low)).clamp(0.0, 1.0)
        return {name: part + (1.0 - part) * share for name, part in self.begin.items()}


def check_terminations(terms: Mapping[str, TerminationTerm | None]) -> None:
    """Refuse the name `fault`, and a task without a time limit."""
    if FAULT in terms:
        raise ConfigError(f"termination.{FAULT}: the simulator's own faults have this name")
    if not any(term and term.outcome == "time" for term in terms.values()):
        raise ConfigError(
            "termination: expected a time limit; give task.termination.time_limit="
            '{function: "tasks.termination:time_limit", outcome: time}'
        )


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
