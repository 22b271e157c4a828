"""Policies that can be evaluated, and the bundle in which a trained one leaves the trainer.

A bundle is a folder (or a run folder) with `policy.safetensors` (weights of the actor),
`policy.json` (the contract: machine, rate, order and scale of observations and commands) and
`policy.onnx` (everything from the observation vector to the masked command, for the machine).
"""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from brokk_rl.contracts.task import Policy
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.machine import Machine
from brokk_rl.rl.runner import TrainingConfig
from brokk_rl.rl.vec_env import ControlLoop
from brokk_rl.session import write_json
from brokk_rl.spec import spec

WEIGHTS, CONTRACT, ONNX = "policy.safetensors", "policy.json", "policy.onnx"
SCHEMA = 1


@spec
class ClassicalPolicy:
    """Inverse kinematics with dead-time compensation under the same masks: what a user would pick instead of a learned policy."""

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Returns the policy; the controller's numbers are the task's (`task.classical`)."""
        return _ClassicalActor(loop)


@spec
class UntrainedPolicy:
    """A freshly initialised network, as training would start from it.

    Attributes:
        training: The training configuration that gives its shape.
    """

    training: TrainingConfig

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Returns the policy with weights drawn from `seed`."""
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

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Returns the policy.

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
                f"{self.folder}: the weights do not fit task and machine ({str(error).splitlines()[-1].strip()}); "
                "evaluate with the task that the policy was trained for (task=…)"
            ) from error
        return NetworkPolicy(actor.to(loop.device), loop)


def locate_bundle(folder: str) -> Path:
    """Returns the folder of a policy: a path, or `package:path` within an installed package.

    Raises:
        CheckpointError: There is no such package.
    """
    package, colon, inside = folder.partition(":")
    if not colon or Path(folder).exists():
        return Path(folder)
    try:
        return Path(str(resources.files(package))) / inside
    except (ModuleNotFoundError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"policy.folder={folder}: there is no package '{package}' ({error}); give a run folder, or package:path"
        ) from error


class _ClassicalActor:
    def __init__(self, loop: ControlLoop) -> None:
        self._task = loop.task

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        return self._task.classical_action(groups)


class NetworkPolicy:
    """The deterministic action of an actor network."""

    def __init__(self, actor: MLPModel, loop: ControlLoop) -> None:
        self.actor = actor.to(loop.device).eval()

    def act(self, groups: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns the mean action; see `brokk_rl.contracts.task.Policy`."""
        return self.actor(TensorDict(groups, batch_size=[len(next(iter(groups.values())))]))


def make_actor(
    config: dict[str, Any], obs_groups: dict[str, list[str]], loop: ControlLoop
) -> MLPModel:
    """Returns an actor network of rsl-rl for the observation groups of `loop`."""
    actor_class, arguments = resolve_class(json.loads(json.dumps(config)))
    missing = [
        name for name in obs_groups["actor"] if name not in set(loop.get_observations().keys())
    ]
    if missing:
        raise ConfigError(
            f"rl.runner.obs_groups.actor: the task gives no group {', '.join(missing)}"
        )
    return actor_class(
        loop.get_observations(), obs_groups, "actor", loop.num_actions, **arguments
    ).to(loop.device)


def write_bundle(
    folder: Path,
    actor: MLPModel,
    training: TrainingConfig,
    loop: ControlLoop,
    facts: dict[str, Any],
) -> dict[str, Any]:
    """Writes weights and contract of a policy into `folder`; returns the contract."""
    config = training.runner_config()
    weights = {
        name: value.detach().cpu().contiguous() for name, value in actor.state_dict().items()
    }
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
        "observation": loop.task.describe(),
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


def read_bundle(folder: Path, machine: Machine) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Returns contract and weights of the bundle in `folder`; see `Trained.build` for errors."""
    if not (folder / CONTRACT).exists():
        raise CheckpointError(
            f"{folder} holds no policy ({CONTRACT} is missing); give the folder of a finished training run"
        )
    try:
        contract = json.loads((folder / CONTRACT).read_text())
        weights = load_file(folder / WEIGHTS)
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(
            f"the policy in {folder} is corrupt: {error}; export it again from a checkpoint (mode=export)"
        ) from error
    machine.check_fingerprint(contract.get("fingerprint", {}), f"the policy in {folder}")
    bad = [name for name, value in weights.items() if not torch.isfinite(value).all()]
    if bad:
        raise CheckpointError(
            f"the policy in {folder} holds NaN or infinite weights in {', '.join(bad[:3])}"
        )
    return contract, weights


EXPLORATION_PREFIX = "distribution."
"""Exploration belongs to the training that begins, not to the policy: one that has settled explores
no more."""


def load_initial_weights(actor: torch.nn.Module, folder: str, machine: Machine) -> None:
    """Copies the network of the policy in `folder` into `actor`, whose exploration stays as it is.

    A bundle holds no critic: the one of the training that begins starts afresh.

    Args:
        actor: The network to be trained.
        folder: Run folder, or `package:path`; as in `policy.folder`.
        machine: The machine.

    Raises:
        CheckpointError: The bundle cannot be used, or its network has another shape.
    """
    _, weights = read_bundle(locate_bundle(folder), machine)
    kept = {
        name: value
        for name, value in actor.state_dict().items()
        if name.startswith(EXPLORATION_PREFIX)
    }
    try:
        actor.load_state_dict(weights | kept)
    except RuntimeError as error:
        raise CheckpointError(
            f"start_from={folder}: the policy does not fit task, machine and rl.runner.actor "
            f"({str(error).splitlines()[-1].strip()}); train with those it was made with, or start_from=null"
        ) from error
