"""Termination terms: functions of the state after a control step to where the episode ends, `(N,)`.

A task lists them by name in its YAML (`task.termination`) with their `outcome`; `null` switches one
off. The names are counted in `evaluation.json` and in the logs of a training.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tasks.step_state import StepState

if TYPE_CHECKING:
    import torch


def succeeded(state: StepState) -> torch.Tensor:
    """The task's criterion holds."""
    return state.success


def joint_limit(state: StepState, margin: float) -> torch.Tensor:
    """A joint comes within `margin` of its limit, rad or m."""
    lower, upper = state.lower + margin, state.upper - margin
    return ((state.q < lower) | (state.q > upper)).any(1)


def start_in_contact(state: StepState) -> torch.Tensor:
    """The arm touches something in the first step: the start was not valid."""
    return state.is_first & (state.contact_force_n > 0)


def contact_force(state: StepState, largest_n: float) -> torch.Tensor:
    """The tool presses harder than it may."""
    return state.contact_force_n > largest_n


def time_limit(state: StepState) -> torch.Tensor:
    """The time of the episode, `task.episode_s`, is over."""
    return state.steps >= state.max_steps
