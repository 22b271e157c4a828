"""The policy folder: how a policy is described, written, found and read.

A folder of a policy holds `policy.json` (the contract: task, machine, rate, order and scale of
observations and commands), `policy.safetensors` (weights of the actor) and, where the task can be
deployed, `policy.onnx` and `golden.json` (answers of the network in the run that trained it). A
training writes the contract before its first checkpoint, `model_<iteration>.pt`: the folder tells
machine and task without torch.

The spec of a task names the fields of its behaviour (`behaviour`): what stands between observation
and command. A policy has learned with these numbers and is another policy with others. The rest of
a task is the conditions of an examination, such as ranges, time limit and noise, and stays the
caller's.
"""

from __future__ import annotations

import copy
import hashlib
import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brokk_rl import registry
from brokk_rl.build import TARGET, describe_spec, drop_targets, name_class
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.machine import Machine
from brokk_rl.observation import measure_ranges, restore_encoder
from brokk_rl.plain_files import read_json
from brokk_rl.session import write_bytes, write_json

if TYPE_CHECKING:
    import torch

    from brokk_rl.contracts.task import TaskProcess

CONTRACT, WEIGHTS = "policy.json", "policy.safetensors"
ONNX, GOLDEN = "policy.onnx", "golden.json"
POLICY_FILES = (".pt", ".safetensors", ".onnx")
"""Endings of files that hold a policy."""
SCHEMA = 2
"""Version of `policy.json`."""
TOLERANCE = 1e-3
"""Largest difference of a command (of 2 full strokes) that counts as the same answer. Chosen by
hand: far above the rounding of float32, far below what a valve resolves."""
NUM_GOLDEN = 16
"""Answers in `golden.json`: whoever runs the file elsewhere compares with them first."""
OTHERWISE = "take an older checkpoint, or export the policy again (mode=export)"
"""Advice for a policy that cannot be read."""
STAMP = "task"
"""Key in the metadata of the weights: fingerprint of the task of the contract beside them."""


@dataclass(frozen=True)
class TaskDescription:
    """Name and behaviour of a task.

    Attributes:
        name: Name of the option, `task=<name>`; the class where no option has it.
        behaviour: Fields of the behaviour by dotted name, as plain JSON data.
    """

    name: str
    behaviour: dict[str, Any]

    def fingerprint(self) -> str:
        """Return a short hash of name and behaviour."""
        text = json.dumps([self.name, self.behaviour], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def to_json(self) -> dict[str, Any]:
        """Return the description as it stands in files, with its fingerprint."""
        return {"name": self.name, "behaviour": self.behaviour, "fingerprint": self.fingerprint()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any], where: str) -> TaskDescription:
        """Return the description that stands in the file `where`.

        Raises:
            CheckpointError: A part is missing, or the fingerprint is that of other values.
        """
        with suppress(KeyError, TypeError, ValueError):
            found = cls(name=str(data["name"]), behaviour=dict(data["behaviour"]))
            if data["fingerprint"] == found.fingerprint():
                return found
        raise CheckpointError(
            f"{where}: the description of its task is incomplete, or was changed after it was "
            "written, so that its fingerprint is another; export the policy again (mode=export)"
        )

    def apply_to(self, node: Mapping[str, Any]) -> dict[str, Any]:
        """Return the node of a task with the values of this behaviour."""
        changed = copy.deepcopy(dict(node))
        for path, value in self.behaviour.items():
            *parents, last = path.split(".")
            place = changed
            for part in parents:
                place = place.setdefault(part, {})
            place[last] = value
        return changed

    def require_same(self, other: TaskDescription, who: str, advice: str) -> None:
        """Refuse a task `other` that is not the one of the policy or checkpoint `who`.

        Raises:
            CheckpointError: Name or values differ; the message names them and ends with `advice`.
        """
        if self.name != other.name:
            raise CheckpointError(
                f"{who} was trained for task={self.name}, not for task={other.name}; {advice}"
            )
        values = []
        for key, (there, here) in list_differences(self.behaviour, other.behaviour):
            values.append(f"task.{key} is {format_value(there)} there, {format_value(here)} here")
        if values:
            raise CheckpointError(f"{who} acts by another task: {'; '.join(values)}; {advice}")


def list_differences(mine: Any, other: Any, place: str = "") -> Iterator[tuple[str, tuple]]:
    """Yield dotted names and values, `(mine, other)`, of what differs between nested tables."""
    if isinstance(mine, dict) and isinstance(other, dict):
        for key in sorted(mine.keys() | other.keys()):
            name = f"{place}.{key}" if place else str(key)
            yield from list_differences(mine.get(key), other.get(key), name)
    elif mine != other:
        yield place, (mine, other)


def format_value(value: Any) -> str:
    """Return plain data as it is typed on the command line."""
    return json.dumps(value).strip('"')


def describe_task(task: object) -> TaskDescription:
    """Return the description of a task's spec; a spec without `behaviour` has a name only."""
    behaviour = {}
    for path in getattr(task, "behaviour", ()):
        value = attrgetter(path)(task)
        behaviour[path] = json.loads(json.dumps(value, default=list_values))
    return TaskDescription(name=name_target(name_class(task)), behaviour=behaviour)


def list_values(one: Any) -> dict[str, Any]:
    """Return the fields of a spec by name, without those at a default.

    A field with a default came after the first policies, whose descriptions it leaves as they are.
    """
    values = {field.name: (getattr(one, field.name), field.default) for field in fields(one)}
    return {name: value for name, (value, default) in values.items() if value is not default}


def name_target(target: str) -> str:
    """Return the name of the task's option with the class `target`, else the class itself."""
    for option in registry.list_options("task"):
        if option.target == target:
            return option.name
    return target


def describe_policy(
    network: Mapping[str, Any],
    process: TaskProcess,
    task: TaskDescription,
    machine: Machine,
    **plant: object,
) -> dict[str, Any]:
    """Return the contract: all that a stranger needs to run the policy, as plain JSON data.

    Args:
        network: Configuration of the network, `TrainingConfig.describe_network`.
        process: The task's process; one that does not describe its vector cannot be deployed.
        task: Description of the task.
        machine: The machine.
        plant: Further specs of the plant that trained it, by the name of their group. The policy is
            evaluated with them where its machine is not the one of the command.
    """
    observation = process.describe() if "describe" in process.offers else None
    rest = dict(observation or {})
    stop, masked = rest.pop("stop", {}), rest.pop("masked", True)
    names = list(machine.joint_names)
    contract = {
        "schema": SCHEMA,
        "task": task.to_json(),
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
        "observation": None if observation is None else rest,
        "stop": {"time_s": process.max_episode_steps * machine.period_s} | stop,
        "network": dict(network),
        "plant": describe_spec({"machine": machine} | plant),
    }
    if machine.has_bodies:
        links = []
        for joint, body in zip(machine.joints, machine.bodies, strict=True):
            origin_m = [dimension.value for dimension in body.origin_m]
            links.append({"kind": joint.kind, "axis": list(body.axis), "origin_m": origin_m})
        contract["kinematics"] = {"links": links, "tool_m": machine.tip_m.tolist()}
    return contract


def write_policy(
    folder: Path, contract: Mapping[str, Any], weights: Mapping[str, torch.Tensor]
) -> None:
    """Write weights and contract into `folder`, each in one step."""
    from safetensors.torch import save

    saved = {name: value.detach().cpu().contiguous() for name, value in weights.items()}
    stamp = {STAMP: contract["task"]["fingerprint"]}
    write_bytes(folder / WEIGHTS, save(saved, stamp))
    write_json(folder / CONTRACT, contract)


def write_golden_answers(
    folder: Path,
    contract: Mapping[str, Any],
    machine: Machine,
    observations: np.ndarray,
    commands: np.ndarray,
    is_certain: np.ndarray,
) -> None:
    """Write `golden.json`, and the ranges of the observations into the contract.

    Args:
        folder: Folder of the policy.
        contract: Its contract, to be completed.
        machine: The machine.
        observations: Vectors of the training run, `(B, O)`.
        commands: What the network answered there, `(B, J)`.
        is_certain: Rows whose answer the exported network repeats, `(B,)`.
    """
    apart = max(1, len(observations) // NUM_GOLDEN)
    rows = np.flatnonzero(is_certain)[::apart][:NUM_GOLDEN]
    golden = {
        "observation": observations[rows].astype(float).tolist(),
        "command": commands[rows].astype(float).tolist(),
    }
    whole = dict(contract)
    if contract["observation"]:
        encoder = restore_encoder(machine, contract["observation"])
        golden["inputs"] = {}
        for name, value in encoder.decode(observations[rows]).items():
            golden["inputs"][name] = np.asarray(value, float).tolist()
        if encoder.has_target:
            ranges = measure_ranges(encoder, observations, machine.joint_names)
            whole["training_observations"] = {"count": len(observations), "ranges": ranges}
    write_json(folder / GOLDEN, golden)
    write_json(folder / CONTRACT, whole)


@dataclass(frozen=True)
class StoredPolicy:
    """A policy on disk, known by its contract: nothing of it needs torch but `read`.

    Attributes:
        name: As it was given, for messages.
        file: Weights or checkpoint, whichever is newer; an ONNX file of a stranger.
        contract: Content of `policy.json`; empty for a checkpoint without one beside it.
    """

    name: str
    file: Path
    contract: dict[str, Any]

    @property
    def is_checkpoint(self) -> bool:
        """True for a checkpoint, that of a running training or one by itself."""
        return self.file.suffix == ".pt"

    @property
    def task(self) -> TaskDescription | None:
        """Description of its task; `None` where the contract is not known."""
        if "task" not in self.contract:
            return None
        return TaskDescription.from_json(self.contract["task"], self.name)

    def list_plant(self) -> dict[str, Any]:
        """Return the nodes `machine` and `actuator` of its training, as far as they are known.

        A file of somebody else can choose numbers, but no code: the classes are those of
        registered options, and below them those of the annotations.

        Raises:
            CheckpointError: No installed option has the class of a node.
        """
        known = registry.list_targets()
        nodes = {}
        for key, node in self.contract.get("plant", {}).items():
            if node and node[TARGET] not in known:
                raise CheckpointError(
                    f"the policy in {self.name} was trained with {key} {node[TARGET]}, which no "
                    "installed option has; install the package that it was trained with"
                )
            if node:
                nodes[key] = drop_targets(node, known)
        return nodes

    def read(self, device: torch.device | str = "cpu") -> dict[str, Any]:
        """Return `weights` of the actor by name, and the contract's `network`, `task`, `fingerprint`.

        Raises:
            CheckpointError: A file is missing or corrupt, holds NaN, or is of another policy; an
                ONNX file has no weights to go on with.
        """
        if self.is_checkpoint:
            content = read_checkpoint(self.file, device)
            return content | {"weights": content["actor_state_dict"]}
        if self.file.suffix == ".onnx" or not self.contract:
            raise CheckpointError(
                f"policy={self.name}: expected a run folder, a checkpoint, or {WEIGHTS} with its "
                f"{CONTRACT} in a policy folder, got {self.file.name} alone"
            )
        weights, stamp = _read_weights(self.file)
        if stamp != self.contract["task"]["fingerprint"]:
            raise CheckpointError(
                f"{self.name}: {WEIGHTS} and {CONTRACT} are of different policies; export the "
                "policy again (mode=export)"
            )
        return self.contract | {"weights": weights}


def find_policy(name: str) -> StoredPolicy:
    """Return the policy at a path: a policy folder, a run folder or a checkpoint.

    Args:
        name: The path, or `package:path` within an installed package.

    Raises:
        CheckpointError: There is none, or its contract cannot be read.
    """
    try:
        path = registry.resolve_package_path(name)
    except ConfigError as error:
        raise CheckpointError(f"policy={error}") from error
    if not path.exists():
        raise CheckpointError(
            f"policy={name}: expected a run folder, a policy folder or a checkpoint, but there is "
            "no such path; `ls runs` lists the runs of this folder"
        )
    if path.is_file():
        if path.suffix not in POLICY_FILES:
            raise CheckpointError(
                f"policy={name}: expected a folder or a checkpoint (model_<iteration>.pt), got a "
                f"file {path.name}"
            )
        return StoredPolicy(name, _require_whole(path), read_contract(path.parent, name))
    weights, checkpoints = path / WEIGHTS, list_checkpoints(path)
    contract = read_contract(path, name)
    exported_s = weights.stat().st_mtime if weights.exists() else 0.0
    if checkpoints and checkpoints[-1].stat().st_mtime > exported_s:
        return StoredPolicy(name, _require_whole(checkpoints[-1]), contract)
    if contract and (weights.exists() or (path / ONNX).exists()):
        return StoredPolicy(name, weights, contract)
    lacks = CONTRACT if not contract else f"neither {WEIGHTS} nor a checkpoint, model_*.pt,"
    raise CheckpointError(
        f"{name} holds no policy ({lacks} is missing). A training writes its first checkpoint "
        "after rl.save_interval iterations; give the folder of such a run, or of a policy"
    )


def find_checkpoint(name: str) -> Path:
    """Return a checkpoint: the file `name` itself, or the newest one of the run folder `name`.

    Raises:
        CheckpointError: There is none.
    """
    stored = find_policy(name)
    found = [stored.file] if stored.is_checkpoint else list_checkpoints(stored.file.parent)
    if not found:
        raise CheckpointError(
            f"policy={name}: the folder holds no checkpoint (model_<iteration>.pt); give the run "
            "folder of its training"
        )
    return found[-1]


def _require_whole(file: Path) -> Path:
    """Return a file; refuse a checkpoint that is no whole archive, without torch."""
    if file.suffix == ".pt" and not zipfile.is_zipfile(file):
        raise CheckpointError(_explain_corrupt(str(file), "no whole archive"))
    return file


def list_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a run folder, oldest first."""
    return sorted(folder.glob("model_*.pt"), key=lambda path: int(path.stem.removeprefix("model_")))


def find_resumed(policy: str | None, folder: Path) -> Path | None:
    """Return the checkpoint with which a training in `folder` goes on; `None` where it begins.

    It is the newest one there, or the one that was given as `policy` where that is of this run, or
    where the run has none yet.
    """
    here = list_checkpoints(folder)
    if policy is not None and policy.endswith(".pt"):
        given = Path(policy)
        if not here or given.resolve().parent == folder.resolve():
            return given
    return here[-1] if here else None


def read_checkpoint(path: Path, device: torch.device | str) -> dict[str, Any]:
    """Read a checkpoint without running code from it.

    Raises:
        CheckpointError: The file is missing or corrupt, or a weight is NaN.
    """
    import torch

    try:
        content = torch.load(path, weights_only=True, map_location=device)
        states = [content["actor_state_dict"], content["critic_state_dict"]]
    except Exception as error:  # torch raises many kinds, whose texts advise to trust the file
        reason = f"no checkpoint of ours ({type(error).__name__})"
        raise CheckpointError(_explain_corrupt(str(path), reason)) from error
    for state in states:
        _require_finite(state, str(path))
    return content


def read_contract(folder: Path, name: str) -> dict[str, Any]:
    """Return the content of `policy.json`, empty where there is none; `name` is for messages."""
    try:
        return read_json(folder / CONTRACT)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise CheckpointError(_explain_corrupt(name, error)) from error


def _read_weights(path: Path) -> tuple[dict[str, torch.Tensor], str | None]:
    """Return the weights in a file, and the stamp of their task."""
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import load_file

    try:
        with safe_open(path, framework="pt") as file:
            stamp = (file.metadata() or {}).get(STAMP)
        weights = load_file(path)
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(_explain_corrupt(str(path.parent), error)) from error
    _require_finite(weights, f"the policy in {path.parent}")
    return weights, stamp


def _require_finite(weights: Mapping[str, torch.Tensor], who: str) -> None:
    bad = [name for name, value in weights.items() if not value.isfinite().all()]
    if bad:
        raise CheckpointError(
            f"{who} holds NaN or infinite weights in {', '.join(bad[:3])}; {OTHERWISE}"
        )


def _explain_corrupt(name: str, error: object) -> str:
    return f"{name} is missing or corrupt: {error}; {OTHERWISE}"
