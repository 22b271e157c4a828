"""Contract of a task, and of the policies that act in it.

A task is a spec in `conf/task` with one method, `build`. It returns a `TaskProcess`: the episodes
of `N` environments at once. That contract is all that training and evaluation need. Five more are
optional:

* `ClassicalTask`: the task knows a classical controller. It is evaluated beside the trained policy,
  and `policy=classical` works.
* `MovableTask`: the target may be moved during an episode, as `mode=play` does.
* `DeployableTask`: the task can write its policy as one module from observation to command. Then
  `mode=export` and the end of `mode=train` write `policy.onnx`.
* `MirroredTask`: episodes have a mirror image, as `rl.symmetry` needs.
* `LookingTask`: a sensor may estimate the target, as `target=perceived` does.

`brokk_rl.checks.check_task` exercises a task against all of this, for our own options and for those
of extensions.

One control step calls, in this order: `command` (action to valve commands), the physics, `step`
(reward and end), `reset` (of the environments that ended), `observe`.

Axes: `N` environments, `J` joints, `H` samples of history (oldest first), `S` columns of a scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard, runtime_checkable

from brokk_rl.contracts.world import World
from brokk_rl.errors import ConfigError

if TYPE_CHECKING:
    import torch

    from brokk_rl.history import History
    from brokk_rl.machine import Machine
    from brokk_rl.symmetry import Mirror

STEPS = "steps"
"""Entry of `TaskProcess.state` with the control steps of the running episode. The trainer sets it
once to spread the first episodes over time."""
FAULT = "fault"
"""Entry of `TaskProcess.reasons` for an episode whose world diverged (`World.faults`)."""
REWARD = "reward/"
"""Begins the figures of `TaskProcess.episode` that add up one term of the reward each."""
SUCCESS = "success_strict"
"""Figure of `TaskProcess.episode` by which policies are compared: 1 after success, else 0."""


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


class TaskProcess(Protocol):
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

    def starts(self, count: int, seed: int) -> dict[str, torch.Tensor]:
        """Draw `count` valid starts; the same seed gives the same starts.

        Returns:
            `q` `(count, J)`, `scene` `(count, S)` (`brokk_rl.sim.scene`), and whatever else `reset`
            needs.
        """
        ...

    def reset(self, mask: torch.Tensor, start: dict[str, torch.Tensor]) -> None:
        """Begin new episodes in the environments of `mask`, `(N,)` bool, from `start`, `(N, …)`."""
        ...

    def command(self, action: torch.Tensor) -> torch.Tensor:
        """Return valve commands `(N, J)` in [-1, 1] for the policy's action, `(N, num_actions)`.

        The action is not clipped. Joints that the machine forbids to move together are masked here.
        """
        ...

    def step(self, history: History, world: World) -> Transition:
        """Judge the control step that has just been simulated."""
        ...

    def observe(
        self, history: History, shift_m: torch.Tensor | None = None
    ) -> dict[str, torch.Tensor]:
        """Return the observation groups, each `(N, …)` float32; one of them is `policy`.

        Called once a control step, after `step` and `reset`. The tensors are the task's own, and
        the next call overwrites them.

        Args:
            history: Positions as sensors measure them, and the commands in force.
            shift_m: Error of the target's believed place, `(N, 3)`
                (`SensingModel.misplacement`); `None` for no such error.
        """
        ...


@runtime_checkable
class ClassicalTask(Protocol):
    """A task process with a classical controller; optional."""

    def classical_action(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the classical controller's action, `(N, num_actions)`, for observation groups."""
        ...


@runtime_checkable
class MovableTask(Protocol):
    """A task process whose target somebody may move during an episode; optional."""

    def move_target(self, mask: torch.Tensor, shift_m: torch.Tensor) -> None:
        """Shift the target in the environments of `mask`, `(N,)` bool, by `shift_m`, `(N, 3)`.

        The estimate of the target shifts with it, and the entry `start.scene` of `state`. The block
        itself is the world's (`brokk_rl.contracts.world.World.place`).
        """
        ...


@runtime_checkable
class CountedStarts(Protocol):
    """A task process that says how many of its random starts can be done; optional."""

    def count_starts(self, count: int, seed: int) -> dict[str, float]:
        """Return shares of the candidates drawn for `count` starts, by condition, the last one all."""
        ...


@runtime_checkable
class DeployableTask(Protocol):
    """A task process whose policy can leave the trainer; optional."""

    def describe(self) -> dict[str, Any]:
        """Return `size`, order, scale and filters of the `policy` group, as plain JSON data.

        It becomes `observation` in `policy.json`; the machine's computer builds the same vector
        with `brokk_rl.observation`. A task made of terms lists its `parts`. Two entries stand
        elsewhere in that file: `stop`, when an episode ends, and `masked`, `False` where commands
        may move exclusive and other joints at once.
        """
        ...

    def deployable(self, network: torch.nn.Module) -> torch.nn.Module:
        """Return the whole policy: from the `policy` group, `(B, O)`, to masked commands `(B, J)`.

        `network` takes a dictionary of observation groups and returns the action.
        """
        ...


def supports_classical_control(process: object) -> TypeGuard[ClassicalTask]:
    """Return whether a task process has a classical controller."""
    return isinstance(process, ClassicalTask)


def can_move_target(process: object) -> TypeGuard[MovableTask]:
    """Return whether the target of a task process can be moved."""
    return isinstance(process, MovableTask)


def can_count_starts(process: object) -> TypeGuard[CountedStarts]:
    """Return whether a task process says how many of its starts can be done."""
    return isinstance(process, CountedStarts)


def supports_deployment(process: object) -> TypeGuard[DeployableTask]:
    """Return whether the policy of a task process can be exported to ONNX."""
    return isinstance(process, DeployableTask)


@runtime_checkable
class MirroredTask(Protocol):
    """A task process whose episodes have a mirror image; optional, for `rl.symmetry`."""

    def mirror(self) -> Mirror:
        """Return the mirror of all observation groups and of the action.

        Raises:
            ConfigError: The machine is not left-right symmetric.
        """
        ...


@runtime_checkable
class LookingTask(Protocol):
    """A task process whose target a sensor estimates (`brokk_rl.contracts.target`); optional."""

    def take_estimate(self, target_m: torch.Tensor) -> None:
        """Take estimated targets, `(N, 3)`, in the place of drawn errors, from now on."""
        ...

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
        ...


def find_looking_task(process: object) -> LookingTask:
    """Return a task process as one whose target a sensor estimates.

    Raises:
        ConfigError: it is none.
    """
    if not isinstance(process, LookingTask):
        raise ConfigError(
            f"target: the task ({type(process).__name__}) draws the errors of its target itself; "
            "give target=drawn, or a task with take_estimate and plan"
        )
    return process


class Task(Protocol):
    """A spec in `conf/task`: builds a task process.

    A class attribute `behaviour` names the fields that a policy has learned with, such as
    `("memory", "noise.filter")`. Checkpoints and policies carry them, and a policy is evaluated and
    exported with its own (`brokk_rl.task_description`). Without it only the task's name is known.
    """

    def build(self, machine: Machine, num_envs: int, device: torch.device) -> TaskProcess:
        """Return the task for `num_envs` environments on `device`."""
        ...


class Policy(Protocol):
    """Source of actions: a trained network, the classical controller, an untrained network."""

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the action for the observation groups, shape `(N, num_actions)`."""
        ...
