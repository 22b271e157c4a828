"""Policies that can be evaluated: options of `policy=`, and the networks behind them.

A trained policy acts by the task that it was trained in; the command puts that task into its
configuration (`brokk_rl.policy_choice`).
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from tensordict import TensorDict

from brokk_rl.contracts.task import Policy, Task, TaskProcess
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import StoredPolicy, TaskDescription, find_policy
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.spec import spec

EXPLORATION_PREFIX = "distribution."
"""Weights of the exploration noise. They belong to the training, not to the policy: a finished
training hardly explores any more."""


class PolicySpec(Protocol):
    """A spec in `conf/policy`: builds a policy.

    One that acts by another task than that of the command has it as `task`.
    """

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy for the control loop."""
        ...


@spec
class ClassicalPolicy:
    """The task's classical controller: inverse kinematics with dead-time compensation.

    Attributes:
        task: Task whose numbers it has (`task.classical`); `null`: that of the command.
    """

    task: Task | None

    label: ClassVar[str] = "classical"

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy.

        Raises:
            ConfigError: The task has no classical controller.
        """
        loop.task.require("classical_action", "choose another policy=…")
        return _ClassicalActor(loop.task)


@spec
class TrainedPolicy:
    """A trained policy.

    Attributes:
        path: Run folder, policy folder or checkpoint, or `package:path` for one that ships with a
            package.
        task: Task by which it acts; `null`: that of the command.
    """

    path: str
    task: Task | None

    label: ClassVar[str] = "trained"

    def build(self, loop: ControlLoop, seed: int) -> NetworkPolicy:
        """Return the policy.

        Raises:
            CheckpointError: It is missing, corrupt, holds NaN, or was made for another machine or
                task.
        """
        return load_policy(find_policy(self.path), loop)


@spec
class ShippedPolicy(TrainedPolicy):
    """The policy that ships; the command takes the classical controller where it does not fit."""

    label: ClassVar[str] = "shipped"


def load_policy(stored: StoredPolicy, loop: ControlLoop) -> NetworkPolicy:
    """Return a stored policy for a control loop; errors as in `TrainedPolicy.build`."""
    who, content = f"the policy in {stored.name}", stored.read(loop.device)
    groups = loop.get_observations()
    actor = restore_actor(content, who, loop.machine, loop.description, groups, loop.num_actions)
    return NetworkPolicy(actor, loop)


def restore_actor(
    content: Mapping[str, Any],
    who: str,
    machine: Machine,
    task: TaskDescription,
    observations: TensorDict,
    num_actions: int,
) -> MLPModel:
    """Return the actor of a policy.

    Args:
        content: What `StoredPolicy.read` returned.
        who: The policy, for messages.
        machine: The machine on which it is to act.
        task: Description of the task in which it is to act.
        observations: Observation groups of that task.
        num_actions: Width of an action.

    Raises:
        CheckpointError: It was made for another machine or task.
    """
    machine.check_fingerprint(content["fingerprint"], who)
    own = TaskDescription.from_json(content["task"], who)
    own.require_same(task, who, "give the values of the policy")
    actor = make_actor(content["network"], observations, num_actions)
    _load_weights(actor, content["weights"], f"{who}: the weights do not fit task and machine")
    return actor


def _load_weights(actor: torch.nn.Module, weights: Mapping[str, Any], problem: str) -> None:
    try:
        actor.load_state_dict(weights)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise CheckpointError(
            f"{problem} ({reason}); give those that it was trained with"
        ) from error


class _ClassicalActor:
    def __init__(self, task: TaskProcess) -> None:
        self._task = task

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        return self._task.classical_action(groups)


class NetworkPolicy:
    """The deterministic action of an actor network."""

    def __init__(self, actor: MLPModel, loop: ControlLoop) -> None:
        self.actor = actor.to(loop.device).eval()

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the mean action; see `brokk_rl.contracts.task.Policy`."""
        return self.actor(TensorDict(groups, batch_size=[len(next(iter(groups.values())))]))


class PlainActor(torch.nn.Module):
    """Copy of an actor that takes a plain dictionary of groups, since ONNX cannot export a TensorDict."""

    def __init__(self, actor: MLPModel) -> None:
        super().__init__()
        assert actor.distribution is not None
        self.groups = list(actor.obs_groups)
        self.normalizer = copy.deepcopy(actor.obs_normalizer)
        self.mlp = copy.deepcopy(actor.mlp)
        self.output = actor.distribution.as_deterministic_output_module()

    def forward(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the deterministic action, `(N, num_actions)`."""
        latent = torch.cat([groups[name] for name in self.groups], dim=-1)
        return self.output(self.mlp(self.normalizer(latent)))


def make_actor(network: Mapping[str, Any], observations: TensorDict, num_actions: int) -> MLPModel:
    """Return an actor network of rsl-rl for observation groups, on their device.

    Args:
        network: Its configuration; see `TrainingConfig.describe_network`.
        observations: Observation groups of the task.
        num_actions: Width of an action.

    Raises:
        ConfigError: The configuration names a group that the task does not observe.
    """
    # a copy by way of JSON: rsl-rl writes into its configuration
    config = json.loads(json.dumps(network))
    actor_class, arguments = resolve_class(config["actor"])
    require_groups(config["obs_groups"], observations)
    actor = actor_class(observations, config["obs_groups"], "actor", num_actions, **arguments)
    return actor.to(observations.device)


def require_groups(asked: Mapping[str, Sequence[str]], observations: TensorDict) -> None:
    """Raise a `ConfigError` where a network wants observations that the task does not give."""
    offered = set(map(str, observations.keys()))
    for network, names in asked.items():
        if missing := sorted(set(names) - offered):
            raise ConfigError(
                f"rl.runner.obs_groups.{network}: the task gives no group {', '.join(missing)}; "
                f"it gives {', '.join(sorted(offered))}: rl.runner.obs_groups.{network}=[policy]"
            )


def observe_once(task: TaskProcess, machine: Machine, device: torch.device) -> TensorDict:
    """Return the observation groups of a task with one environment, whose arm is at rest."""
    start = {name: value.to(device) for name, value in task.starts(1, 0).items()}
    q = start["q"][:, None].repeat(1, machine.num_history, 1)
    task.reset(torch.ones(1, dtype=torch.bool, device=device), start)
    groups = task.observe(History(q=q, u=torch.zeros_like(q)))
    return TensorDict(dict(groups), batch_size=[1], device=device)


def load_initial_weights(actor: torch.nn.Module, path: str, machine: Machine) -> None:
    """Copy the network of the policy at `path` into `actor`; its exploration stays as it is.

    A policy folder holds no critic: the critic starts with fresh weights.

    Raises:
        CheckpointError: The policy cannot be used, or its network has another shape.
    """
    content = find_policy(path).read()
    machine.check_fingerprint(content["fingerprint"], f"the policy in {path}")
    weights = dict(content["weights"])
    for name, value in actor.state_dict().items():
        if name.startswith(EXPLORATION_PREFIX):
            weights[name] = value
    problem = f"policy={path}: it does not fit task, machine and rl.runner.actor"
    _load_weights(actor, weights, problem)
