"""Observation terms that every machine offers: functions of `tasks.step_state.StepState`.

Joints and tool come as sensors measure them. The contact force is the simulator's; a machine needs
a sensor for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from tasks.step_state import StepState


def joint_positions(state: StepState) -> torch.Tensor:
    """Positions within the travel, -1 at the lower and 1 at the upper limit, `(N, J)`."""
    return (2.0 * state.q - state.lower - state.upper) / (state.upper - state.lower)


def joint_speeds(state: StepState) -> torch.Tensor:
    """Speeds over the last control period, `(N, J)`, rad/s or m/s."""
    return state.speed


def commands(state: StepState) -> torch.Tensor:
    """Valve commands in force, `(N, J)`, in [-1, 1]."""
    return state.history.u[:, -1]


def tip_position(state: StepState) -> torch.Tensor:
    """Tool point in the base frame, `(N, 3)`, m."""
    return state.tip_m


def tip_velocity(state: StepState) -> torch.Tensor:
    """Velocity of the tool point over the last control period, `(N, 3)`, m/s."""
    return state.tip_velocity_m_s


def tool_pitch(state: StepState) -> torch.Tensor:
    """Pitch of the tool below the horizontal, `(N,)`, rad."""
    return state.pitch_rad


def contact_force(state: StepState) -> torch.Tensor:
    """Peak contact force of the last control period, `(N,)`, N."""
    return state.contact_force_n


def drawn(state: StepState, name: str) -> torch.Tensor:
    """Numbers that were drawn for the episode under a name of `task.command`, `(N, K)`."""
    return state.start[name]


def time_share(state: StepState) -> torch.Tensor:
    """Part of the time limit that is over, `(N,)`."""
    return state.steps / state.max_steps
