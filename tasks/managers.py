"""Managers of a task's terms: rewards, endings, observations and figures.

They follow the managers of Isaac Lab and mjlab. None of their methods synchronises with the host.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from brokk_rl.contracts.task import FAULT, REWARD, SUCCESS
from brokk_rl.observation import ObservationEncoder, ObservationPart
from tasks.step_state import StepState
from tasks.terms import (
    FigureTerm,
    ObservedTerm,
    Outcome,
    RewardCurriculum,
    RewardTerm,
    TaskTerm,
    TerminationTerm,
)

Function = Callable[[Any], torch.Tensor]


class RewardManager:
    """Weighted sum of a task's reward terms.

    Args:
        terms: By name.
        curriculum: Terms whose weights grow with success; `None` for constant weights.
    """

    def __init__(
        self, terms: Mapping[str, RewardTerm], curriculum: RewardCurriculum | None
    ) -> None:
        self._functions = _resolve(terms)
        self._weights = {name: term.weight for name, term in terms.items()}
        self._curriculum = curriculum

    def sum(
        self,
        state: StepState,
        is_sound: torch.Tensor,
        succeeded: torch.Tensor,
        episode: dict[str, torch.Tensor],
    ) -> torch.Tensor:
        """Return the sum where `is_sound`, `(N,)`, else 0; adds up each term in `episode`.

        Args:
            state: After the step.
            is_sound: Whether the step counts, `(N,)` bool.
            succeeded: Whether the last episode of each environment succeeded, `(N,)`, 0 or 1.
            episode: Figures of the running episodes, written in place.
        """
        reward = torch.zeros_like(state.contact_force_n)
        scale = self._curriculum.scale(succeeded) if self._curriculum else {}
        for name, function in self._functions.items():
            part = scale.get(name, 1.0) * self._weights[name] * function(state)
            reward = reward + part
            episode[f"{REWARD}{name}"] += part.where(is_sound, 0.0)
        return reward.where(is_sound, 0.0)


@dataclass(frozen=True)
class Endings:
    """Endings of one control step, all of shape `(N,)`.

    Attributes:
        terminated: The episode ended by an event, bool.
        timed_out: The episode ended by time only, bool.
        is_sound: The step counts: neither a fault nor a void episode, bool.
        reason: Index into `TerminationManager.reasons`, -1 while the episode goes on.
    """

    terminated: torch.Tensor
    timed_out: torch.Tensor
    is_sound: torch.Tensor
    reason: torch.Tensor


class TerminationManager:
    """Endings of a task, in the order in which they count.

    Where several terms hold in one step, the first one counts; a time limit counts last.

    Attributes:
        terms: By name, those that are switched on.
        reasons: Names of all endings: events in the order of the YAML, faults of the world, time.
    """

    def __init__(self, terms: Mapping[str, TerminationTerm | None]) -> None:
        self.terms = {name: term for name, term in terms.items() if term is not None}
        self._functions = _resolve(self.terms)
        events = self._list("success", "failure", "void")
        self.reasons = (*events, FAULT, *self._list("time"))

    def judge(self, state: StepState, faults: torch.Tensor) -> Endings:
        """Return the endings; completes `state.success` and `state.failed`.

        Args:
            state: After the step; `success` is the criterion alone.
            faults: Worlds that diverged, `(N,)` bool.
        """
        held = {FAULT: faults}
        unsound = faults
        for name in self._list("void"):
            held[name] = self._functions[name](state)
            unsound = unsound | held[name]
        state.success = state.success & ~unsound
        terminated = unsound
        timed_out = torch.zeros_like(unsound)
        failed = timed_out
        for name in self._list("success", "failure", "time"):
            held[name] = self._functions[name](state)
            outcome = self.terms[name].outcome
            if outcome == "time":
                timed_out = timed_out | held[name]
                continue
            terminated = terminated | held[name]
            if outcome == "failure":
                failed = failed | held[name]
        state.failed = failed
        reason = torch.full_like(state.contact_force_n, -1.0)
        for index in reversed(range(len(self.reasons))):
            reason = reason.masked_fill(held[self.reasons[index]], float(index))
        return Endings(
            terminated=terminated,
            timed_out=timed_out & ~terminated,
            is_sound=~unsound,
            reason=reason,
        )

    def describe(self) -> dict[str, Any]:
        """Return joint margin and terms beyond success and time as plain JSON data."""
        margins, endings = [], {}
        for name in self._list("failure", "void"):
            term = self.terms[name]
            endings[name] = {"function": term.function, "params": term.params}
            if term.function == "tasks.termination:joint_limit":
                margins.append(term.params["margin"])
        return {"joint_margin": max(margins, default=None), "endings": endings}

    def _list(self, *outcomes: Outcome) -> list[str]:
        return [name for name, term in self.terms.items() if term.outcome in outcomes]


class ObservationManager:
    """Observation groups of a task: terms with noise, bias, history and scale.

    Attributes:
        encoders: Encoder of each group that has terms.
        state: What the terms remember, by name, `(N, …)` each.

    Args:
        groups: Terms of each group by name.
        example: Any state, from which the widths are learned.
    """

    def __init__(
        self, groups: Mapping[str, Mapping[str, ObservedTerm | None]], example: StepState
    ) -> None:
        self.encoders: dict[str, ObservationEncoder] = {}
        self.state: dict[str, torch.Tensor] = {}
        self._terms: dict[str, dict[str, ObservedTerm]] = {}
        self._functions: dict[str, dict[str, Function]] = {}
        for group, terms in groups.items():
            kept = {name: term for name, term in terms.items() if term is not None}
            if kept:
                self._add_group(group, kept, example)

    def _add_group(self, group: str, terms: dict[str, ObservedTerm], example: StepState) -> None:
        self._terms[group], self._functions[group] = terms, _resolve(terms)
        parts = []
        for name, term in terms.items():
            value = _widen(self._functions[group][name](example))
            width = value.shape[1]
            parts.append(ObservationPart(name, (term.samples, width), term.mean, term.std))
            key = f"{group}.{name}"
            self.state[f"samples.{key}"] = value.new_zeros(len(value), term.samples, width)
            if term.bias:
                self.state[f"bias.{key}"] = value.new_zeros(len(value), width)
        self.encoders[group] = ObservationEncoder(parts, torch.as_tensor, torch.cat)

    def draw_biases(self) -> dict[str, torch.Tensor]:
        """Return new errors for the entries of `state` that stay for an episode."""
        drawn = {}
        for group, terms in self._terms.items():
            for name, term in terms.items():
                if term.bias:
                    key = f"bias.{group}.{name}"
                    drawn[key] = _draw_error(term.bias, self.state[key])
        return drawn

    def observe(self, seen: StepState) -> dict[str, torch.Tensor]:
        """Take one sample of each term; return the groups, `(N, O)` each."""
        vectors = {}
        is_new = (seen.age == 0)[:, None, None]
        for group, encoder in self.encoders.items():
            samples = {}
            for name in self._terms[group]:
                kept = self.state[f"samples.{group}.{name}"]
                newest = self._measure(group, name, seen)[:, None]
                moved = torch.cat((kept[:, 1:], newest), 1)
                kept.copy_(torch.where(is_new, newest.expand_as(kept), moved))
                samples[name] = kept
            vectors[group] = encoder.encode(samples)
        return vectors

    def _measure(self, group: str, name: str, seen: StepState) -> torch.Tensor:
        """Return the newest sample of a term with its errors, `(N, K)`."""
        term, value = self._terms[group][name], _widen(self._functions[group][name](seen))
        if term.noise:
            value = value + _draw_error(term.noise, value)
        if term.bias:
            value = value + self.state[f"bias.{group}.{name}"]
        return value


class FigureManager:
    """Figures of the running episodes.

    Beside the task's own there are `return`, `length`, and the sum of each reward term.

    Attributes:
        figures: Words of the task's figures.

    Args:
        terms: By name.
    """

    def __init__(self, terms: Mapping[str, FigureTerm | None]) -> None:
        self._terms = {name: term for name, term in terms.items() if term is not None}
        self._functions = _resolve(self._terms)
        self.figures = {name: term.build() for name, term in self._terms.items()}

    def update(
        self, state: StepState, reward: torch.Tensor, episode: dict[str, torch.Tensor]
    ) -> None:
        """Write the figures of a step into `episode`."""
        episode["length"] += 1
        episode["return"] += reward
        is_open = episode[SUCCESS] == 0
        for name, term in self._terms.items():
            before = episode[name]
            value = self._functions[name](state).to(before.dtype)
            if term.reduce == "largest":
                value = torch.where(state.is_first, value, torch.maximum(before, value))
            elif term.reduce == "mean":
                value = before + (value - before) / episode["length"]
            elif term.reduce == "sum":
                value = before + value
            elif term.reduce == "until_success":
                value = torch.where(is_open, value, before)
            elif term.reduce == "at_success":
                value = torch.where(is_open & state.success, value, before)
            before.copy_(value)


def _resolve(terms: Mapping[str, TaskTerm]) -> dict[str, Function]:
    """Return the function of each term; once, since a compiled step cannot import."""
    return {name: term.resolve() for name, term in terms.items()}


def _widen(value: torch.Tensor) -> torch.Tensor:
    """Return a value `(N,)` or `(N, K)` as `(N, K)`."""
    return value[:, None] if value.dim() == 1 else value


def _draw_error(size: float, like: torch.Tensor) -> torch.Tensor:
    """Return uniform errors between `-size` and `size`, of the shape of `like`."""
    return (2.0 * torch.rand_like(like) - 1.0) * size
