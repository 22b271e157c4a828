"""Reward terms: functions of the state after a control step (`tasks.step_state`) to `(N,)`.

A task lists its terms with their parameters and weights in its YAML (`task.reward.<name>`). The six
terms of the paper's equation 1 carry the symbol of their term in the docstring.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tasks.step_state import StepState, ToolState

if TYPE_CHECKING:
    import torch

# the paper's equation 1


def working_distance(state: ToolState, edge: float) -> torch.Tensor:
    """r^m: while positioning, `edge` at the edge of the good working range, less outside."""
    near, far = state.reach_range_m
    outside = (state.reach_m - far).clamp(min=0.0) + (near - state.reach_m).clamp(min=0.0)
    return state.positioning * edge / (1.0 + outside)


def distance(state: ToolState) -> torch.Tensor:
    """r^d: 1 / (1 + distance of the tool to the target in m), once not positioning."""
    return ~state.positioning / (1.0 + state.distance_m)


def pitch(state: ToolState) -> torch.Tensor:
    """r^o: 1 / (1 + pitch error in rad), once not positioning."""
    return ~state.positioning / (1.0 + state.pitch_error_rad)


def insertion(state: ToolState) -> torch.Tensor:
    """r^i: r^d + r^o while the paper's criterion of success holds (weighted five times there)."""
    return (state.paper_success & ~state.positioning) * (
        1.0 / (1.0 + state.distance_m) + 1.0 / (1.0 + state.pitch_error_rad)
    )


def far_contact(state: ToolState, largest: float) -> torch.Tensor:
    """r^c: contact force in N while the tool is far from the hole: r^d at most `largest`."""
    far = 1.0 / (1.0 + state.distance_m) <= largest
    return (far & ~state.positioning) * state.contact_force_n


def approach_command_change(state: ToolState) -> torch.Tensor:
    """r^a: sum over joints of the change of command since the last step, once not positioning."""
    return ~state.positioning * command_change(state)


# beyond the paper


def command_change(state: StepState) -> torch.Tensor:
    """Sum over joints of the change of command since the last step, in all phases."""
    return (state.u - state.u_before).abs().sum(1)


def progress(state: ToolState) -> torch.Tensor:
    """Gain of closeness.

    A potential: it speeds up learning and leaves the best policy as it is (Ng et al. 1999).
    """
    return state.closeness - state.closeness_before


def success(state: StepState) -> torch.Tensor:
    """One when the task's criterion is fulfilled."""
    return state.success.float()


def failure(state: ToolState) -> torch.Tensor:
    """One plus the closeness that is given up when the episode ends by a failure."""
    return state.failed * (1.0 + state.closeness)


def contact(state: StepState, most_n: float) -> torch.Tensor:
    """Contact force in kN up to `most_n`: a hydraulic arm can break an obstacle."""
    return (state.contact_force_n / 1000.0).clamp(max=most_n / 1000.0)


def peak_contact(state: StepState, above_n: float, most_n: float) -> torch.Tensor:
    """Growth of the episode's peak contact force in kN, between two forces.

    An episode pays for its hardest blow, not for the time it leans on the rim: a penalty of every
    step in contact teaches a beginner to stay away from the hole.
    """
    peak_n = state.peak_force_n.maximum(state.contact_force_n)
    grown_n = peak_n.clamp(above_n, most_n) - state.peak_force_n.clamp(above_n, most_n)
    return grown_n / 1000.0


def duration(state: StepState) -> torch.Tensor:
    """One in each step."""
    return state.contact_force_n.new_ones(state.contact_force_n.shape)
