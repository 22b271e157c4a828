"""Policies that can be evaluated, and the bundle in which a trained one leaves the trainer.

A bundle is a folder (or a run folder) with `policy.safetensors` (weights of the actor),
`policy.json` (the contract: machine, rate, order and scale of observations and commands) and, where
the task can be deployed, `policy.onnx` (from the observation vector to the masked command).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from brokk_rl.contracts.task import (
    ClassicalTask,
    Policy,
    supports_classical_control,
    supports_deployment,
)
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from brokk_rl.rl.runner import TrainingConfig
from brokk_rl.rl.vec_env import ControlLoop
from brokk_rl.session import write_json
from brokk_rl.spec import spec

WEIGHTS, CONTRACT, ONNX = "policy.safetensors", "policy.json", "policy.onnx"
SCHEMA = 1
"""Version of `policy.json`."""
EXPLORATION_PREFIX = "distribution."
"""Weights of the exploration noise. They belong to the training, not to the policy: a finished
training hardly explores any more."""


@spec
class ClassicalPolicy:
    """The task's classical controller: inverse kinematics with dead-time compensation."""

    label: ClassVar[str] = "classical"

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy; the controller's numbers are the task's (`task.classical`).

        Raises:
            ConfigError: The task has no classical controller.
        """
        if not supports_classical_control(loop.task):
            raise ConfigError(
                f"policy=classical: the task ({type(loop.task).__name__}) has no classical "
                "controller; choose another policy=…, or give the task the method "
                "`classical_action` (brokk_rl.contracts.task.ClassicalTask)"
            )
        return _ClassicalActor(loop.task)


@spec
class UntrainedPolicy:
    """A freshly initialised network, as training would start from it.

    Attributes:
        training: The training configuration that gives its shape.
    """

    training: TrainingConfig

    label: ClassVar[str] = "untrained"

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy with weights drawn from `seed`."""
        config = self.training.runner_config()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return NetworkPolicy(make_actor(config["actor"], config["obs_groups"], loop), loop)


@spec
class TrainedPolicy:
    """A trained policy.

    Attributes:
        folder: Run folder of `mode=train`, any folder with a policy bundle, or `package:path` for
            one that ships with a package.
    """

    folder: str

    label: ClassVar[str] = "trained"

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy.

        Raises:
            CheckpointError: The bundle is missing, corrupt, holds NaN, or was made for another
                machine or task.
        """
        contract, weights = read_bundle(locate_bundle(self.folder), loop.machine)
        actor = make_actor(contract["network"]["actor"], contract["network"]["obs_groups"], loop)
        try:
            actor.load_state_dict(weights)
        except RuntimeError as error:
            raise CheckpointError(
                f"{self.folder}: the weights do not fit task and machine "
                f"({str(error).splitlines()[-1].strip()}); evaluate with the task that the policy "
                "was trained for (task=…)"
            ) from error
        return NetworkPolicy(actor.to(loop.device), loop)


class _ClassicalActor:
    def __init__(self, task: ClassicalTask) -> None:
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


def make_actor(
    config: dict[str, Any], obs_groups: dict[str, list[str]], loop: ControlLoop
) -> MLPModel:
    """Return an actor network of rsl-rl for the observation groups of `loop`.

    Raises:
        ConfigError: The configuration names a group that the task does not observe.
    """
    # a copy by way of JSON: rsl-rl writes into its configuration
    actor_class, arguments = resolve_class(json.loads(json.dumps(config)))
    observations = loop.get_observations()
    missing = set(obs_groups["actor"]) - set(observations.keys())
    if missing:
        raise ConfigError(
            f"rl.runner.obs_groups.actor: the task gives no group {', '.join(sorted(missing))}"
        )
    actor = actor_class(observations, obs_groups, "actor", loop.num_actions, **arguments)
    return actor.to(loop.device)


def write_bundle(
    folder: Path,
    actor: MLPModel,
    training: TrainingConfig,
    loop: ControlLoop,
    facts: dict[str, Any],
) -> dict[str, Any]:
    """Write weights and contract of a policy into `folder`; return the contract.

    A task that cannot be deployed has `null` for `observation` in the contract.
    """
    config = training.runner_config()
    weights = {}
    for name, value in actor.state_dict().items():
        weights[name] = value.detach().cpu().contiguous()
    machine = loop.machine
    contract = {
        "schema": SCHEMA,
        "machine": machine.name,
        "fingerprint": machine.fingerprint(),
        "rate_hz": 1 / machine.period_s,
        "dead_time_s": machine.dead_time_s,
        "joints": list(machine.joint_names),
        "exclusive": list(machine.exclusive),
        "command": {"range": [-1.0, 1.0], "order": list(machine.joint_names), "masked": True},
        "observation": loop.task.describe() if supports_deployment(loop.task) else None,
        "network": {
            "actor": config["actor"],
            "obs_groups": {"actor": config["obs_groups"]["actor"]},
        },
        "trained": facts,
    }
    part = folder / f".{WEIGHTS}.part"
    save_file(weights, part)
    part.replace(folder / WEIGHTS)
    write_json(folder / CONTRACT, contract)
    return contract


def locate_bundle(folder: str) -> Path:
    """Return the folder of a policy: a path, or `package:path` within an installed package.

    Raises:
        CheckpointError: There is no such package.
    """
    try:
        return resolve_package_path(folder)
    except ConfigError as error:
        raise CheckpointError(f"policy.folder={error}") from error


def read_bundle(folder: Path, machine: Machine) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return contract and weights of the bundle in `folder`; errors as in `TrainedPolicy.build`."""
    if not (folder / CONTRACT).exists():
        raise CheckpointError(
            f"{folder} holds no policy ({CONTRACT} is missing); "
            "give the folder of a finished training run"
        )
    try:
        contract = json.loads((folder / CONTRACT).read_text())
        weights = load_file(folder / WEIGHTS)
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(
            f"the policy in {folder} is corrupt: {error}; "
            "export it again from a checkpoint (mode=export)"
        ) from error
    machine.check_fingerprint(contract.get("fingerprint", {}), f"the policy in {folder}")
    bad = []
    for name, value in weights.items():
        if not torch.isfinite(value).all():
            bad.append(name)
    if bad:
        raise CheckpointError(
            f"the policy in {folder} holds NaN or infinite weights in {', '.join(bad[:3])}"
        )
    return contract, weights


def load_initial_weights(actor: torch.nn.Module, folder: str, machine: Machine) -> None:
    """Copy the network of the policy in `folder` into `actor`; its exploration stays as it is.

    A bundle holds no critic: the critic starts with fresh weights.

    Args:
        actor: The network to be trained.
        folder: Run folder, or `package:path`; as in `policy.folder`.
        machine: The machine.

    Raises:
        CheckpointError: The bundle cannot be used, or its network has another shape.
    """
    _, weights = read_bundle(locate_bundle(folder), machine)
    for name, value in actor.state_dict().items():
        if name.startswith(EXPLORATION_PREFIX):
            weights[name] = value
    try:
        actor.load_state_dict(weights)
    except RuntimeError as error:
        raise CheckpointError(
            f"start_from={folder}: the policy does not fit task, machine and rl.runner.actor "
            f"({str(error).splitlines()[-1].strip()}); train with those it was made with, "
            "or start_from=null"
        ) from error
