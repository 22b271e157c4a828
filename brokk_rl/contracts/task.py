"""Tasks and policies.

`brokk_rl.checks` holds a public checker for each contract, for our own entries and for those of
extensions.
Axes: `N` environments, `J` joints, `H` samples of history (oldest first), `K` numbers that describe
a target.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import torch

    from brokk_rl.history import History
    from brokk_rl.machine import Machine


from brokk_rl.contracts.world import World


@dataclass
class Transition:
    """What a task says about one control step; all of shape `(N,)`.

    Attributes:
        reward: Reward of the step.
        terminated: The episode ended by what happened (success, joint limit, …).
        timed_out: The episode ended by its time limit only.
        reason: Index into `TaskProcess.reasons` where the episode ended, else -1.
    """

    reward: torch.Tensor
    terminated: torch.Tensor
    timed_out: torch.Tensor
    reason: torch.Tensor


class TaskProcess(Protocol):
    """A task at work in `N` environments. No method synchronises with the host; all shapes are fixed."""

    num_actions: int
    max_episode_steps: int
    reasons: tuple[str, ...]
    """Names of the ways in which an episode can end."""
    state: dict[str, torch.Tensor]
    """Everything needed to go on exactly, by name, each `(N, …)`; written in place."""
    episode: dict[str, torch.Tensor]
    """Figures of the running episode, each `(N,)`; those that stand in `evaluation.json` have the
    names given there."""

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draws `count` valid starts: `q` `(count, J)`, `scene` `(count, S)` and whatever else `reset` needs."""
        ...

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begins a new episode in the environments of `mask` with the given starts, each entry `(N, …)`."""
        ...

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Turns the policy's action, `(N, num_actions)`, into valve commands `(N, J)`: bounds and the masks of exclusive joints."""
        ...

    def step(self, history: History, world: World) -> Transition:
        """Judges the control step that has just been simulated."""
        ...

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Returns the observation groups, called once a control step after `step` and `reset`.

        `history` is what sensors say; `shift_m`, `(N, 3)`, is how far off the target is believed
        (`SensingModel.misplacement`). `policy` is the vector of `brokk_rl.observation`; the tensors
        are the task's own and are overwritten by the next call.
        """
        ...

    def classical_action(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns the action, `(N, num_actions)`, with which the classical controller alone would act on these groups."""
        ...

    def describe(self) -> dict[str, Any]:
        """Returns `size`, order, scale and filters of the `policy` vector for the policy's contract, as plain JSON data."""
        ...

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Returns the policy as it runs on the machine: a module from the `policy` vector, `(B, …)`, to masked commands, `(B, J)`.

        `network` takes a dictionary of observation groups and returns the action.
        """
        ...


class Task(Protocol):
    """A spec in `conf/task`: builds a task process."""

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Returns the task for `num_envs` environments on `device`."""
        ...


class Policy(Protocol):
    """Anything that acts: a trained network, the classical controller, an untrained network."""

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns the action for the observation groups, shape `(N, num_actions)`."""
        ...
