"""Policies that can be evaluated, and the bundle in which a trained one leaves the trainer.

A bundle is a folder (or a run folder) with `policy.safetensors` (weights of the actor),
`policy.json` (the contract: task, machine, rate, order and scale of observations and commands) and,
where the task can be deployed, `policy.onnx` (from the observation vector to the masked command)
and `golden.json` (answers of the network in the run that trained it).

A trained policy acts by the task that it was trained in, whatever the caller composed.
"""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from brokk_rl.contracts.task import Policy, Task, TaskProcess
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.history import History
from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from brokk_rl.rl.loop import ControlLoop
from brokk_rl.rl.settings import TrainingConfig
from brokk_rl.session import write_json
from brokk_rl.spec import spec
from brokk_rl.task_description import (
    CONTRACT,
    TaskDescription,
    apply_behaviour,
    read_description,
    require_policy,
)

log = logging.getLogger(__name__)

WEIGHTS, ONNX = "policy.safetensors", "policy.onnx"
GOLDEN = "golden.json"
SCHEMA = 2
"""Version of `policy.json`. Files of version 1 do not describe the task; they are read too."""
TOLERANCE = 1e-3
"""Largest difference of a command (of 2 full strokes) that counts as the same answer. Chosen by
hand: far above the rounding of float32, far below what a valve resolves."""
STAMP = "task"
"""Key in the metadata of the weights: fingerprint of the task of the contract beside them."""
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
        loop.task.require("classical_action", "choose another policy=…")
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
            observations = loop.get_observations()
            actor = make_actor(
                config["actor"], config["obs_groups"], observations, loop.num_actions
            )
            scale_output(actor, self.training.output_gain)
            return NetworkPolicy(actor, loop)


@spec
class TrainedPolicy:
    """A trained policy.

    Attributes:
        folder: Run folder of `mode=train`, any folder with a policy bundle, or `package:path` for
            one that ships with a package.
    """

    folder: str

    label: ClassVar[str] = "trained"

    def choose_task(self, task: Task, machine: Machine, asked: Collection[str]) -> Task:
        """Return the policy's own task: its behaviour, under the conditions of `task`.

        Args:
            task: The task as it was composed.
            machine: The machine.
            asked: Keys of the configuration that the caller gave; see
                `brokk_rl.task_description.apply_behaviour`.

        Raises:
            CheckpointError: The bundle cannot be read, or is of another machine.
            ConfigError: The caller asked for something that the policy does not have.
        """
        folder = locate_bundle(self.folder)
        own = read_description(folder, read_contract(folder, machine))
        if own is None:  # `build` says what is assumed, and checks it
            return task
        return apply_behaviour(task, own, asked, f"the policy in {folder}")

    def build(self, loop: ControlLoop, seed: int) -> NetworkPolicy:
        """Return the policy.

        Raises:
            CheckpointError: The bundle is missing, corrupt, holds NaN, or was made for another
                machine or task.
        """
        folder = locate_bundle(self.folder)
        contract, weights = read_bundle(folder, loop.machine)
        own = read_description(folder, contract)
        if own is not None:
            _check_task(own, loop.description, folder)
        network = contract["network"]
        actor = make_actor(
            network["actor"], network["obs_groups"], loop.get_observations(), loop.num_actions
        )
        try:
            actor.load_state_dict(weights)
        except RuntimeError as error:
            raise CheckpointError(
                f"{self.folder}: the weights do not fit task and machine "
                f"({str(error).splitlines()[-1].strip()}); evaluate with the task that the policy "
                "was trained for (task=…)"
            ) from error
        if own is None:
            _check_assumption(actor, loop, folder)
        return NetworkPolicy(actor.to(loop.device), loop)


@spec
class ShippedPolicy:
    """The policy that ships, or the classical controller where it fits neither machine nor task.

    Attributes:
        folder: Folder of the policy, as in `TrainedPolicy`.
    """

    folder: str

    label: ClassVar[str] = "shipped"

    def choose_task(self, task: Task, machine: Machine, asked: Collection[str]) -> Task:
        """Return the policy's own task, or `task` where the classical controller stands in."""
        try:
            return TrainedPolicy(folder=self.folder).choose_task(task, machine, asked)
        except (CheckpointError, ConfigError) as error:
            log.info(
                "the classical controller acts, for the policy that ships does not fit: %s", error
            )
            return task

    def build(self, loop: ControlLoop, seed: int) -> Policy:
        """Return the policy, or the classical controller."""
        try:
            return TrainedPolicy(folder=self.folder).build(loop, seed)
        except CheckpointError:  # `choose_task` has said why
            return ClassicalPolicy().build(loop, seed)


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


def make_actor(
    config: Mapping[str, Any],
    obs_groups: Mapping[str, list[str]],
    observations: TensorDict,
    num_actions: int,
) -> MLPModel:
    """Return an actor network of rsl-rl for observation groups, on their device.

    Raises:
        ConfigError: The configuration names a group that the task does not observe.
    """
    # a copy by way of JSON: rsl-rl writes into its configuration
    actor_class, arguments = resolve_class(json.loads(json.dumps(config)))
    missing = set(obs_groups["actor"]) - set(observations.keys())
    if missing:
        raise ConfigError(
            f"rl.runner.obs_groups.actor: the task gives no group {', '.join(sorted(missing))}"
        )
    actor = actor_class(observations, obs_groups, "actor", num_actions, **arguments)
    return actor.to(observations.device)


def scale_output(actor: MLPModel, gain: float) -> None:
    """Scale the weights of the last layer, so that a fresh network acts almost alike everywhere.

    Andrychowicz et al. 2021 recommend 0.01. A residual policy then begins as the controller that it
    corrects.
    """
    last = [layer for layer in actor.mlp.modules() if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        for parameter in last.parameters():
            parameter.mul_(gain)


def observe_once(task: TaskProcess, machine: Machine, device: torch.device) -> TensorDict:
    """Return the observation groups of a task with one environment, whose arm is at rest."""
    start = {name: value.to(device) for name, value in task.starts(1, 0).items()}
    q = start["q"][:, None].repeat(1, machine.num_history, 1)
    task.reset(torch.ones(1, dtype=torch.bool, device=device), start)
    groups = task.observe(History(q=q, u=torch.zeros_like(q)))
    return TensorDict(dict(groups), batch_size=[1], device=device)


def write_bundle(
    folder: Path,
    actor: MLPModel,
    network: dict[str, Any],
    task: TaskProcess,
    description: TaskDescription,
    machine: Machine,
    facts: dict[str, Any],
) -> dict[str, Any]:
    """Write weights and contract of a policy into `folder`; return the contract.

    A task that cannot be deployed has `null` for `observation` in the contract.

    Args:
        folder: Where to.
        actor: The network.
        network: Its configuration, `TrainingConfig.describe_network`.
        task: Its task.
        description: Description of that task.
        machine: The machine.
        facts: Facts about the training.
    """
    weights = {}
    for name, value in actor.state_dict().items():
        weights[name] = value.detach().cpu().contiguous()
    contract = _make_contract(network, task, description, machine) | {"trained": facts}
    part = folder / f".{WEIGHTS}.part"
    save_file(weights, part, {STAMP: description.fingerprint()})
    part.replace(folder / WEIGHTS)
    write_json(folder / CONTRACT, contract)
    return contract


def _make_contract(
    network: dict[str, Any], task: TaskProcess, description: TaskDescription, machine: Machine
) -> dict[str, Any]:
    """Return all that a stranger needs to run the policy, as plain JSON data."""
    names = list(machine.joint_names)
    observation = task.describe() if "describe" in task.offers else None
    stop = (observation or {}).pop("stop", {})
    masked = (observation or {}).pop("masked", True)
    contract = {
        "schema": SCHEMA,
        "task": description.to_json(),
        "machine": machine.name,
        "fingerprint": machine.fingerprint(),
        "rate_hz": 1 / machine.period_s,
        "dead_time_s": machine.dead_time_s,
        "joints": names,
        "units": [joint.unit for joint in machine.joints],
        "limits": {"lower": machine.lower.tolist(), "upper": machine.upper.tolist()},
        "exclusive": list(machine.exclusive),
        "history": {
            "samples": machine.num_history,
            "period_s": machine.period_s,
            "order": "oldest first",
            "q": "measured positions; before the first sample: the first one",
            "u": "commands in force in the period that ended with each position; before: 0",
        },
        "command": {
            "range": [-1.0, 1.0],
            "order": names,
            "masked": masked,
            "unit": "share of full valve opening, + towards larger positions; held for one period",
        },
        "observation": observation,
        "stop": {"time_s": task.max_episode_steps * machine.period_s} | stop,
        "network": network,
    }
    if machine.has_bodies:
        links = []
        for joint, body in zip(machine.joints, machine.bodies, strict=True):
            origin_m = [dimension.value for dimension in body.origin_m]
            links.append({"kind": joint.kind, "axis": list(body.axis), "origin_m": origin_m})
        contract["kinematics"] = {"links": links, "tool_m": machine.tip_m.tolist()}
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


def read_contract(folder: Path, machine: Machine) -> dict[str, Any]:
    """Return the contract of the bundle in `folder`; errors as in `TrainedPolicy.build`."""
    require_policy(folder)
    try:
        contract = json.loads((folder / CONTRACT).read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(_say_corrupt(folder, error)) from error
    machine.check_fingerprint(contract.get("fingerprint", {}), f"the policy in {folder}")
    return contract


def read_bundle(folder: Path, machine: Machine) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return contract and weights of the bundle in `folder`; errors as in `TrainedPolicy.build`."""
    contract = read_contract(folder, machine)
    try:
        with safe_open(folder / WEIGHTS, framework="pt") as file:
            stamp = (file.metadata() or {}).get(STAMP)
        weights = load_file(folder / WEIGHTS)
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(_say_corrupt(folder, error)) from error
    bad = []
    for name, value in weights.items():
        if not torch.isfinite(value).all():
            bad.append(name)
    if bad:
        raise CheckpointError(
            f"the policy in {folder} holds NaN or infinite weights in {', '.join(bad[:3])}"
        )
    if stamp != contract.get("task", {}).get("fingerprint"):
        raise CheckpointError(
            f"{folder}: {WEIGHTS} and {CONTRACT} are of different policies; export the policy "
            "again (mode=export)"
        )
    return contract, weights


def _say_corrupt(folder: Path, error: Exception) -> str:
    return (
        f"the policy in {folder} is corrupt: {error}; "
        "export it again from a checkpoint (mode=export)"
    )


def _check_task(own: TaskDescription, here: TaskDescription, folder: Path) -> None:
    """Refuse a control loop whose task is not the policy's own."""
    if own.name != here.name:
        raise CheckpointError(
            f"the policy in {folder} was trained for task={own.name}, not for task={here.name}; "
            f"evaluate it with task={own.name}"
        )
    if differences := own.compare(here):
        values = []
        for key, (there, given) in differences.items():
            values.append(f"task.{key} is {json.dumps(there)} there, {json.dumps(given)} here")
        raise CheckpointError(
            f"the policy in {folder} acts by another task: {'; '.join(values)}. Give the values of "
            "the policy."
        )


def _check_assumption(actor: MLPModel, loop: ControlLoop, folder: Path) -> None:
    """Check that a policy which does not describe its task acts as recorded in the task at hand.

    Raises:
        CheckpointError: It acts otherwise, or nothing was recorded.
    """
    here = loop.description
    values = [f"task={here.name}"]
    for key, value in here.behaviour.items():
        values.append(f"task.{key}={json.dumps(value)}")
    lacks = f"the policy in {folder} does not say which task it was trained in ({CONTRACT} is old)"
    if not here.behaviour:
        log.warning("%s; assumed: %s", lacks, ", ".join(values))
        return
    path = folder / GOLDEN
    if not path.exists() or "deployable" not in loop.task.offers:
        raise CheckpointError(
            f"{lacks}, and there is no {GOLDEN} to find it out; export it again from a checkpoint"
        )
    golden = json.loads(path.read_text())
    module = loop.task.deployable(PlainActor(actor).to(loop.device).eval())
    with torch.no_grad():
        found = module(torch.tensor(golden["observation"], device=loop.device))
    expected = torch.tensor(golden["command"], device=loop.device)
    difference = float((found - expected).abs().max())
    if not difference <= TOLERANCE:
        raise CheckpointError(
            f"{lacks}, and in the task composed here its answers differ from {GOLDEN} by up to "
            f"{difference:.3g}: {', '.join(values)}. Give the values that it was trained with "
            "(task.…=…)."
        )
    log.warning("%s; assumed: %s; its golden answers agree", lacks, ", ".join(values))


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
