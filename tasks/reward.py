"""Reward terms: free functions of the state after a control step (`tasks.step_state`) to `(N,)`.

A task lists its terms and their weights in its YAML (`task.reward.<name>.weight=…`). An extension
names functions of its own there as `package.module:function`. The six terms of the paper's equation
1 carry the symbol of their term in the docstring.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from brokk_rl.bounds import require_number
from brokk_rl.contracts.task import REWARD
from brokk_rl.errors import ConfigError
from brokk_rl.spec import spec
from tasks.step_state import StepState, ToolState
from tasks.termination import require_function

if TYPE_CHECKING:
    import torch


@spec
class RewardTerm:
    """A weighted reward term.

    Attributes:
        function: `package.module:function` from `StepState` to `(N,)`; in a tool-pose task from
            `ToolState`.
        weight: Factor; negative for a penalty.
    """

    function: str
    weight: float

    def check(self) -> None:
        require_number(f"weight of the reward term '{self.function}'", self.weight)
        require_function("reward term", self.function)

    def __call__(self, state: ToolState) -> torch.Tensor:
        """Return the weighted term, `(N,)`."""
        return self.weight * resolve_name(self.function)(state)


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

    begin: dict[str, float]
    success: tuple[float, float]

    def check(self) -> None:
        for name, part in self.begin.items():
            require_number(f"task.curriculum.begin.{name}", part, least=0)
        low, high = self.success
        if not 0.0 <= low < high <= 1.0:
            raise ConfigError(
                f"task.curriculum.success: expected 0 <= low < high <= 1, got [{low}, {high}]"
            )

    def check_names(self, reward: Collection[str]) -> None:
        """Refuse names that are no terms of `reward`."""
        if odd := sorted(self.begin.keys() - set(reward)):
            raise ConfigError(
                f"task.curriculum.begin: there is no reward term {', '.join(odd)}; expected some "
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


class RewardSum:
    """Weighted sum of a task's terms.

    Args:
        terms: By name.
        curriculum: Terms whose weights grow with success; `None` for constant weights.
    """

    def __init__(
        self, terms: Mapping[str, RewardTerm], curriculum: RewardCurriculum | None
    ) -> None:
        self._functions: dict[str, Callable[[Any], torch.Tensor]] = {}
        for name, term in terms.items():
            self._functions[name] = resolve_name(term.function)
        self._weights = {name: term.weight for name, term in terms.items()}
        self._curriculum = curriculum

    def __call__(
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
        reward = state.contact_force_n.new_zeros(state.contact_force_n.shape)
        scale = self._curriculum.scale(succeeded) if self._curriculum else {}
        for name, function in self._functions.items():
            part = scale.get(name, 1.0) * self._weights[name] * function(state)
            reward = reward + part
            episode[f"{REWARD}{name}"] += part.where(is_sound, 0.0)
        return reward.where(is_sound, 0.0)


# the paper's equation 1


def working_distance(state: ToolState) -> torch.Tensor:
    """r^m: while positioning, 0.25 at the edge of the good working range, less outside."""
    near, far = state.reach_range_m
    outside = (state.reach_m - far).clamp(min=0.0) + (near - state.reach_m).clamp(min=0.0)
    return state.positioning * 0.25 / (1.0 + outside)


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


def far_contact(state: ToolState) -> torch.Tensor:
    """r^c: contact force in N while the tool is far from the hole (r^d <= 0.7: beyond 0.43 m)."""
    far = 1.0 / (1.0 + state.distance_m) <= 0.7
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
    """One when the strict criterion is fulfilled."""
    return state.success.float()


def failure(state: ToolState) -> torch.Tensor:
    """One plus the closeness that is given up when the episode ends by a failure."""
    return state.failed * (1.0 + state.closeness)


def contact(state: StepState) -> torch.Tensor:
    """Contact force in kN, saturating at 10 kN: a hydraulic arm can break an obstacle."""
    return (state.contact_force_n / 1000.0).clamp(max=10.0)


def peak_contact(state: StepState) -> torch.Tensor:
    """Growth of the episode's peak contact force in kN, up to 10 kN.

    An episode pays for its hardest blow, not for the time it leans on the rim: a penalty of every
    step in contact teaches a beginner to stay away from the hole.
    """
    peak_n = state.peak_force_n.maximum(state.contact_force_n)
    return (peak_n.clamp(max=10_000.0) - state.peak_force_n.clamp(max=10_000.0)) / 1000.0


def heavy_contact(state: StepState) -> torch.Tensor:
    """Growth of the episode's peak contact force beyond 10 kN, in kN, up to 100 kN.

    What `peak_contact` leaves out: to a policy whose blows are all harder than 10 kN, that term
    says nothing about softer ones.
    """
    peak_n = state.peak_force_n.maximum(state.contact_force_n)
    low, high = 10_000.0, 100_000.0
    return (peak_n.clamp(low, high) - state.peak_force_n.clamp(low, high)) / 1000.0


def duration(state: StepState) -> torch.Tensor:
    """One in each step."""
    return state.contact_force_n.new_ones(state.contact_force_n.shape)
