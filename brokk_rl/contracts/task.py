"""Contract of a task, and of the policies that act in it.

A task is a spec in `conf/task` with one method, `build`. It returns a `TaskProcess`: the episodes
of `N` environments at once. Its abstract methods are all that training and evaluation need. The
others are optional: a subclass that has one overrides it, and `TaskProcess.offers` names it.

`brokk_rl.checks.check_task` exercises a task against all of this, for our own options and for those
of extensions.

One control step calls, in this order: `command` (action to valve commands), the physics, `step`
(reward and end), `reset` (of the environments that ended), `observe`.

Axes: `N` environments, `J` joints, `H` samples of history (oldest first), `S` columns of a scene.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from brokk_rl.contracts.world import World
from brokk_rl.errors import ConfigError

if TYPE_CHECKING:
    import torch

    from brokk_rl.history import History
    from brokk_rl.machine import Machine

STEPS = "steps"
"""Entry of `TaskProcess.state` with the control steps of the running episode. The trainer sets it
once to spread the first episodes over time."""
FAULT = "fault"
"""Entry of `TaskProcess.reasons` for an episode whose world diverged (`World.faults`)."""
REWARD = "reward/"
"""Begins the figures of `TaskProcess.episode` that add up one term of the reward each."""
SUCCESS = "success_strict"
"""Figure of `TaskProcess.episode` by which policies are compared: 1 after success, else 0."""
OPTIONAL = {
    "classical_action": "classical controller",
    "example_action": "example to imitate",
    "move_target": "target that can be moved",
    "count_starts": "count of the starts that can be done",
    "bring_near": "starts near its target",
    "describe": "description of its observation",
    "deployable": "policy that can leave the trainer",
    "take_estimate": "target that a sensor estimates",
    "plan": "planned motion",
}
"""Optional methods of `TaskProcess`, and what a task without one lacks."""


@dataclass(frozen=True)
class Figure:
    """Summary of a figure over episodes, and its words in tables and films.

    Attributes:
        title: Its name in words.
        unit: Unit in which it is shown; `share` for a figure of 0 or 1, of which the share is
            reported with its interval.
        factor: Factor from the unit of the figure to the one shown.
        digits: Decimals shown.
        of_success: Whether it counts in episodes with success only; median and 95 % quantile are
            reported.
    """

    title: str
    unit: str
    factor: float
    digits: int
    of_success: bool

    def word(self, value: float) -> str:
        """Return a value with the shown unit."""
        unit = "" if self.unit == "share" else f" {self.unit}"
        return f"{self.factor * value:.{self.digits}f}{unit}"


SUCCESS_FIGURE = Figure("success", "share", 1.0, 3, of_success=False)
"""Words for `SUCCESS` in a task that has none of its own."""


@dataclass
class Transition:
    """Judgement of one control step; all tensors of shape `(N,)`.

    Attributes:
        reward: Reward of the step.
        terminated: The episode ended by an event (success, joint limit, …), bool.
        timed_out: The episode ended by its time limit only, bool.
        reason: Index into `TaskProcess.reasons` where the episode ended, else -1.
    """

    reward: torch.Tensor
    terminated: torch.Tensor
    timed_out: torch.Tensor
    reason: torch.Tensor


class TaskProcess(ABC):
    """Episodes of a task in `N` environments.

    No method synchronises with the host, and all shapes are fixed: a GPU captures the control step
    in a CUDA graph.
    """

    num_actions: int
    """Length of the policy's action."""
    max_episode_steps: int
    """Time limit of an episode, control steps."""
    reasons: tuple[str, ...]
    """Names of the ways in which an episode can end; `FAULT` is one of them."""
    state: dict[str, torch.Tensor]
    """All that is needed to go on exactly, by name, each `(N, …)`; written in place. `STEPS` is one
    of them, `(N,)`."""
    episode: dict[str, torch.Tensor]
    """Figures of the running episode, by name, each `(N,)`; written in place. `SUCCESS` is one of
    them; evaluation reports the others too."""
    moved: torch.Tensor | None = None
    """Environments whose block moved in the last step, `(N,)` bool; `None`: none ever does. The loop
    places these blocks as the entry `start.scene` of `state` says."""
    figures: Mapping[str, Figure] = {SUCCESS: SUCCESS_FIGURE}
    """Words for figures of `episode`, in the order of tables; the others are reported as means and
    stand in no table."""

    @property
    def offers(self) -> frozenset[str]:
        """Names of the optional methods that this task has; see `OPTIONAL`."""
        own = type(self)
        return frozenset(
            name for name in OPTIONAL if getattr(own, name) is not getattr(TaskProcess, name)
        )

    @abstractmethod
    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw `count` valid starts; the same seed gives the same starts.

        Returns:
            `q` `(count, J)`, `scene` `(count, S)` (`brokk_rl.sim.scene`), and whatever else `reset`
            needs.
        """

    @abstractmethod
    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begin new episodes in the environments of `mask`, `(N,)` bool, from `start`, `(N, …)`."""

    @abstractmethod
    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Return valve commands `(N, J)` in [-1, 1] for the policy's action, `(N, num_actions)`.

        The action is not clipped. Joints that the machine forbids to move together are masked here.
        """

    @abstractmethod
    def step(self, history: History, world: World) -> Transition:
        """Judge the control step that has just been simulated."""

    @abstractmethod
    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return the observation groups, each `(N, …)` float32; one of them is `policy`.

        Called once a control step, after `step` and `reset`.

        Args:
            history: Positions as sensors measure them, and the commands in force.
            shift_m: Error of the target's believed place, `(N, 3)`
                (`SensingModel.misplacement`); `None` for no such error.
        """

    def classical_action(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the classical controller's action, `(N, num_actions)`, for observation groups."""
        self.refuse("classical_action")

    def example_action(self, groups: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the action that a training may imitate, `(N, num_actions)`.

        Unlike a policy it may use groups of what only a simulator knows. The second tensor says
        where it follows a path that is known to be clear, `(N,)` bool.
        """
        self.refuse("example_action")

    def move_target(self, mask: torch.Tensor, shift_m: torch.Tensor) -> None:
        """Shift the target in the environments of `mask`, `(N,)` bool, by `shift_m`, `(N, 3)`.

        The estimate of the target shifts with it, and the entry `start.scene` of `state`. The block
        itself is the world's (`brokk_rl.contracts.world.World.place`).
        """
        self.refuse("move_target")

    def count_starts(self, count: int, seed: int) -> dict[str, float]:
        """Return shares of the candidates drawn for `count` starts, by condition, the last one all."""
        self.refuse("count_starts")

    def bring_near(
        self,
        start: dict[str, torch.Tensor],
        share: float,
        height_m: tuple[float, float],
        way: tuple[float, float],
        seed: int,
    ) -> dict[str, torch.Tensor]:
        """Return starts of which the first part begins upright above its target, on the CPU.

        Args:
            start: Starts, as `starts` returns them.
            share: Part of the starts that are brought near.
            height_m: Heights of the tool point above the target, (lowest, highest).
            way: Parts of the way back to the arm of the start, (least, most).
            seed: The same seed gives the same heights.
        """
        self.refuse("bring_near")

    def describe(self) -> dict[str, Any]:
        """Return `size`, order, scale and filters of the `policy` group, as plain JSON data.

        It becomes `observation` in `policy.json`; the machine's computer builds the same vector
        with `brokk_rl.observation`. A task made of terms lists its `parts`. Two entries stand
        elsewhere in that file: `stop`, when an episode ends, and `masked`, `False` where commands
        may move exclusive and other joints at once.
        """
        self.refuse("describe")

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return the whole policy: from the `policy` group, `(B, O)`, to masked commands `(B, J)`.

        `network` takes a dictionary of observation groups and returns the action. A task with this
        method also has `describe`.
        """
        self.refuse("deployable")

    def take_estimate(self, target_m: torch.Tensor) -> None:
        """Take estimated targets, `(N, 3)`, in the place of drawn errors, from now on."""
        self.refuse("take_estimate")

    def plan(
        self, q: torch.Tensor, target_m: torch.Tensor, num_times: int, step_s: float
    ) -> torch.Tensor:
        """Return the planned motion towards targets, `(N, T, J)`.

        Args:
            q: Present joint positions, `(N, J)`.
            target_m: Targets, `(N, 3)`.
            num_times: `T`; the first time is now.
            step_s: Time between two of them.
        """
        self.refuse("plan")

    def require(self, method: str, advice: str) -> None:
        """Refuse a task without an optional method; `advice` says what to change.

        Raises:
            ConfigError: The task does not offer it.
        """
        if method not in self.offers:
            self.refuse(method, advice)

    def refuse(self, method: str, advice: str = "choose another task") -> NoReturn:
        """Raise a `ConfigError` that names an optional method which this task does not offer."""
        raise ConfigError(
            f"the task ({type(self).__name__}) has no {OPTIONAL[method]}: expected the method "
            f"`{method}` (brokk_rl.contracts.task); {advice}"
        )


class Task(Protocol):
    """A spec in `conf/task`: builds a task process.

    A class attribute `behaviour` names the fields that a policy has learned with, such as
    `("depth_m", "noise.filter")`. Checkpoints and policies carry them, and a policy is evaluated and
    exported with its own (`brokk_rl.policy_folder`). Without it only the task's name is known.
    """

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        ...


class Policy(Protocol):
    """Source of actions: a trained network, the classical controller."""

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the action for the observation groups, shape `(N, num_actions)`."""
        ...
