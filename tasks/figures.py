"""Figures of an episode: functions of the state after a control step to `(N,)`.

A task lists its figures in its YAML (`task.figures`), with what becomes of the values of all steps
and with the words of tables and films.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tasks.step_state import StepState, ToolState

if TYPE_CHECKING:
    import torch


def success(state: StepState) -> torch.Tensor:
    """The task's criterion holds."""
    return state.success


def time(state: StepState) -> torch.Tensor:
    """Time since the start of the episode, s."""
    return state.time_s


def contact_force(state: StepState) -> torch.Tensor:
    """Peak contact force of the control period, N."""
    return state.contact_force_n


def valve_travel(state: StepState) -> torch.Tensor:
    """Sum over joints of the change of the given commands, per second."""
    given = state.history.u
    return (given[:, -1] - given[:, -2]).abs().sum(1) / state.period_s


def held_share(state: StepState) -> torch.Tensor:
    """Part of the counted control steps in which the criterion held."""
    return state.held_share


def paper_success(state: ToolState) -> torch.Tensor:
    """The paper's criterion holds."""
    return state.paper_success


def lateral_error(state: ToolState) -> torch.Tensor:
    """Distance of the tool point from the vertical through the target, m."""
    return state.lateral_m
