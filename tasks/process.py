"""Episodes of a task in `N` environments at once: managers of its terms, and what all tasks share.

The managers for rewards, endings, observations and figures follow those of Isaac Lab and mjlab. No
method synchronises with the host, and every tensor of `state` and `episode` keeps its address: the
whole control step can be captured in one CUDA graph.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from brokk_rl.contracts.task import FAULT, REWARD, STEPS, SUCCESS, TaskProcess, Transition
from brokk_rl.contracts.world import World
from brokk_rl.history import History
from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from brokk_rl.observation import ObservationEncoder, ObservationPart
from brokk_rl.sim import scene
from tasks.term_task import (
    EpisodeTask,
    FigureTerm,
    ObservedTerm,
    Outcome,
    RewardCurriculum,
    RewardTerm,
    TaskTerm,
    TerminationTerm,
)
from tasks.terms import StepState

START = "start."
"""Begins the entries of `state` that were drawn for the episode."""
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
            outcome = self.terms[name].outcome
            held[name] = self._functions[name](state)
            if outcome == "success":
                held[name] = held[name] & ~unsound
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
            if term.function == "tasks.terms:joint_limit":
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


class EpisodeProcess(TaskProcess):
    """Common part of all tasks' episodes: state, judgement, rewards, figures.

    Args:
        task: The spec.
        machine: The machine.
        num_envs: `N`.
        device: Where to compute.
    """

    def __init__(
        self, task: EpisodeTask, machine: Machine, num_envs: int, device: torch.device
    ) -> None:
        def to_constant(values: object) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device)

        def make_zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(num_envs, *shape, device=device)

        self.num_actions = machine.num_joints
        self.max_episode_steps = round(task.episode_s / machine.period_s)
        self._machine, self._kinematics = machine, Kinematics(machine, device)
        self._lower, self._upper = to_constant(machine.lower), to_constant(machine.upper)
        self._exclusive = to_constant(machine.is_exclusive).bool()
        self._rewards = RewardManager(task.reward, task.curriculum)
        self._endings = TerminationManager(task.termination)
        self.reasons = self._endings.reasons
        self._figures = FigureManager(task.figures)
        self._success_figure = task.curriculum.figure if task.curriculum else SUCCESS
        self.figures = self._figures.figures
        self.state = {name: make_zeros(*shape) for name, shape in self._list_shapes().items()}
        terms = (f"{REWARD}{name}" for name in task.reward)
        self.episode = {name: make_zeros() for name in (*self.figures, "return", "length", *terms)}
        rest = make_zeros(machine.num_history, machine.num_joints)
        example = self._make_state(History(q=rest, u=rest), make_zeros())
        self._observed = ObservationManager(self._list_groups(), example)
        self.state |= self._observed.state

    def _list_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of each entry of `state` but those of observations, without `N`."""
        joints = (self._machine.num_joints,)
        # `steps` decides about the time limit and may be set from outside (episodes out of step);
        # `age` counts since the reset
        one_each = (STEPS, "age", "succeeded", "held", "contact_force_n", "peak_force_n")
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(one_each, ())
        shapes |= {"u": joints, "u_before": joints}
        drawn = {"q": joints, "scene": (scene.SIZE,), "tip_m": (3,)} | self._list_drawn_shapes()
        return shapes | {START + name: shape for name, shape in drawn.items()}

    def _list_drawn_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of what the task asks for in an episode, without `N`."""
        return {}

    def _list_groups(self) -> dict[str, dict[str, ObservedTerm | None]]:
        """Return the terms of each observation group."""
        return {}

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begin new episodes; see `TaskProcess.reset`."""
        fresh = {START + name: value for name, value in start.items()}
        fresh |= {"succeeded": self.episode[self._success_figure]} | self._draw_errors(start)
        zero = torch.zeros((), device=mask.device)
        for name, value in self.state.items():
            rows = mask.reshape(-1, *[1] * (value.dim() - 1))
            value.copy_(torch.where(rows, fresh.get(name, zero), value))
        for value in self.episode.values():
            value.masked_fill_(mask, 0.0)

    def _draw_errors(self, start: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return what else begins anew in an episode, by its entry of `state`."""
        return self._observed.draw_biases()

    def _remember_command(self, u: torch.Tensor) -> torch.Tensor:
        self.state["u_before"].copy_(self.state["u"])
        self.state["u"].copy_(u)
        return u

    def step(self, history: History, world: World) -> Transition:
        """Judge a control step; see `TaskProcess.step`."""
        state = self.state
        state[STEPS] += 1
        state["age"] += 1
        # forces of a diverged world may be NaN, and one NaN would poison the sums over all worlds
        force_n = torch.where(world.faults, 0.0, world.contact_force_n)
        seen = self._make_state(history, force_n)
        self._judge_success(seen, world.faults)
        endings = self._endings.judge(seen, world.faults)
        reward = self._rewards.sum(seen, endings.is_sound, state["succeeded"], self.episode)
        self._figures.update(seen, reward, self.episode)
        self._remember(seen)
        return Transition(
            reward=reward,
            terminated=endings.terminated,
            timed_out=endings.timed_out,
            reason=endings.reason,
        )

    def _judge_success(self, seen: StepState, faults: torch.Tensor) -> None:
        """Write `success` of the state, the criterion alone."""

    def _remember(self, seen: StepState) -> None:
        """Keep what the next step needs of this one."""
        state, force_n = self.state, seen.contact_force_n
        state["contact_force_n"].copy_(force_n)
        state["peak_force_n"].copy_(torch.maximum(state["peak_force_n"], force_n))

    def _make_state(self, history: History, force_n: torch.Tensor) -> StepState:
        return StepState(**self._list_values(history, force_n))

    def _list_values(self, history: History, force_n: torch.Tensor) -> dict[str, Any]:
        """Return the fields of a `StepState` by name."""
        state = self.state
        pose = self._kinematics.pose(history.q[:, -1])
        nowhere = state["age"] < 0
        start = {}
        for name, value in state.items():
            if name.startswith(START):
                start[name.removeprefix(START)] = value
        return {
            "history": history,
            "lower": self._lower,
            "upper": self._upper,
            "tip_m": pose.tip_in_base_m,
            "pitch_rad": pose.pitch_rad,
            "u": state["u"],
            "u_before": state["u_before"],
            "contact_force_n": force_n,
            "peak_force_n": state["peak_force_n"],
            "steps": state[STEPS],
            "max_steps": self.max_episode_steps,
            "age": state["age"],
            "period_s": self._machine.period_s,
            "start": start,
            "success": nowhere,
            "failed": nowhere,
            "held_share": state["held"],
        }


def _resolve(terms: Mapping[str, TaskTerm]) -> dict[str, Function]:
    """Return the function of each term; once, since a compiled step cannot import."""
    return {name: term.resolve() for name, term in terms.items()}


def _widen(value: torch.Tensor) -> torch.Tensor:
    """Return a value `(N,)` or `(N, K)` as `(N, K)`."""
    return value[:, None] if value.dim() == 1 else value


def _draw_error(size: float, like: torch.Tensor) -> torch.Tensor:
    """Return uniform errors between `-size` and `size`, of the shape of `like`."""
    return (2.0 * torch.rand_like(like) - 1.0) * size
