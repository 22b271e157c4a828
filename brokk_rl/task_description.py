"""Description of a task in checkpoints and policy bundles: the part of it that a policy relies on.

The spec of a task names the fields of its behaviour (`behaviour`): what stands between observation
and command. A policy has learned with these numbers and is another policy with others. The rest of
a task is the conditions of an examination, such as ranges, time limit and noise, and stays the
caller's, as the plant does.

`apply_behaviour` gives a task the behaviour of a policy. Values that the caller asked for and that
contradict it are refused by name. This module needs neither torch nor the configuration's language.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar

import yaml

from brokk_rl import registry
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.session import RESOLVED

log = logging.getLogger(__name__)

T = TypeVar("T")
CONTRACT = "policy.json"
"""File of a policy: task, machine, rate, order and scale of observations and commands."""
TRAINING = "brokk_rl.modes.train.Train"
"""Mode whose `resolved.yaml` holds the task of the policy beside it."""


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
        try:
            found = cls(name=str(data["name"]), behaviour=dict(data["behaviour"]))
            stamp = data["fingerprint"]
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{where}: the description of its task is incomplete ({error}); export the policy "
                "again (mode=export)"
            ) from error
        if stamp != found.fingerprint():
            raise CheckpointError(
                f"{where}: the description of its task was changed after it was written: its "
                f"fingerprint is {found.fingerprint()}, the file says {stamp}. Export the policy "
                "again (mode=export)"
            )
        return found

    def compare(self, other: TaskDescription) -> dict[str, tuple[Any, Any]]:
        """Return the values of both, `(own, other's)`, by dotted name where they differ."""
        return dict(compare_tables(self.behaviour, other.behaviour))


def compare_tables(mine: Any, other: Any, place: str = "") -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Yield dotted names and values, `(mine, other)`, of what differs between nested tables."""
    if isinstance(mine, dict) and isinstance(other, dict):
        for key in sorted(mine.keys() | other.keys()):
            name = f"{place}.{key}" if place else str(key)
            yield from compare_tables(mine.get(key), other.get(key), name)
    elif mine != other:
        yield place, (mine, other)


def describe_task(task: object) -> TaskDescription:
    """Return the description of a task's spec; a spec without `behaviour` has a name only."""
    behaviour = {}
    for path in getattr(task, "behaviour", ()):
        value: Any = task
        for part in path.split("."):
            value = getattr(value, part)
        behaviour[path] = json.loads(json.dumps(value, default=asdict))
    return TaskDescription(name=name_task(type(task)), behaviour=behaviour)


def name_task(kind: type) -> str:
    """Return the name of the registered option whose spec is `kind`, else that of the class."""
    return name_target(f"{kind.__module__}.{kind.__qualname__}")


def name_target(target: str) -> str:
    """Return the name of the registered option with a `_target_`, else the target itself."""
    for name, offered in _list_tasks().items():
        if offered == target:
            return name
    return target


def restore_task(task: T, description: TaskDescription) -> T:
    """Return `task` with the behaviour of a description.

    Raises:
        CheckpointError: The description is that of another task, or of another version of it.
    """
    if name_task(type(task)) != description.name:
        raise CheckpointError(
            f"expected a policy of task={name_task(type(task))}, got one of "
            f"task={description.name}; give task={description.name}"
        )
    expected = set(getattr(task, "behaviour", ()))
    if odd := sorted(expected ^ description.behaviour.keys()):
        raise CheckpointError(
            f"the policy's description of task={description.name} and this version of it differ in "
            f"{', '.join(odd)}; use the version that trained it"
        )
    try:
        for path, value in description.behaviour.items():
            task = _replace_at(task, path.split("."), value)
    except ConfigError as error:
        raise CheckpointError(
            f"the policy's description of its task does not fit this version: {error}"
        ) from error
    return task


def apply_behaviour(task: T, own: TaskDescription, asked: Collection[str], who: str) -> T:
    """Return `task` with the behaviour of the policy `who`; the rest of it stays.

    Args:
        task: The task as it was composed.
        own: The policy's description of its task.
        asked: Keys of the configuration that the caller gave, such as `task.memory`; `task` for the
            choice of the option.
        who: Names the policy in messages.

    Raises:
        ConfigError: The caller asked for something that the policy does not have.
        CheckpointError: The policy's task is another one, or cannot be restored.
    """
    composed = describe_task(task)
    if composed.name != own.name:
        asking = "was asked for" if "task" in asked else "is composed"
        raise ConfigError(
            f"{who} was trained for task={own.name}, but task={composed.name} {asking}. Give "
            f"task={own.name}, or another policy."
        )
    restored = restore_task(task, own)
    differences = composed.compare(describe_task(restored))
    refused = []
    for key, (here, there) in differences.items():
        if _is_asked(f"task.{key}", asked):
            refused.append(f"task.{key}={_show(here)} was asked for, the policy has {_show(there)}")
    if refused:
        raise ConfigError(
            f"{who} acts by the task that it was trained in, which contradicts what was asked: "
            f"{'; '.join(refused)}. Leave these out, and the policy's own values are taken; or give "
            "a policy that was trained with them."
        )
    if differences:
        values = ", ".join(f"task.{key}={_show(there)}" for key, (_, there) in differences.items())
        log.info("%s acts by its own task: %s", who, values)
    return restored


def read_description(
    folder: Path, contract: Mapping[str, Any] | None = None
) -> TaskDescription | None:
    """Return the description of the policy in a folder; `None` where nothing says what it is.

    It stands in `contract`, the content of `policy.json`. An older run folder has none, but its
    `resolved.yaml` holds the task that it trained.
    """
    if contract and "task" in contract:
        return TaskDescription.from_json(contract["task"], str(folder))
    resolved = read_training_config(folder)
    if resolved is None:
        return None
    data = resolved["task"]
    target = registry.rename_targets(f"_target_: {data['_target_']}").removeprefix("_target_: ")
    if target not in _list_tasks().values():
        return None
    kind = resolve_name(target)
    behaviour = {}
    for path in getattr(kind, "behaviour", ()):
        value: Any = data
        for part in path.split("."):
            value = value[part]
        behaviour[path] = _drop_targets(value)
    log.info("%s: policy and checkpoint do not describe their task; %s does", folder, RESOLVED)
    return TaskDescription(name=name_task(kind), behaviour=behaviour)


def read_training_config(folder: Path) -> dict[str, Any] | None:
    """Return `resolved.yaml` of a training in `folder`; `None` where no training ran there."""
    path = folder / RESOLVED
    data = yaml.safe_load(path.read_text()) if path.is_file() else None
    return data if isinstance(data, dict) and data.get("_target_") == TRAINING else None


def require_policy(folder: Path) -> None:
    """Refuse a folder without a policy; needs no torch.

    Raises:
        CheckpointError: It holds none.
    """
    if not (folder / CONTRACT).exists():
        raise CheckpointError(
            f"{folder} holds no policy ({CONTRACT} is missing); "
            "give the folder of a finished training run"
        )


def read_task_name(folder: Path) -> str | None:
    """Return the name of the task of the policy or run in `folder`; `None` where it is unknown.

    A folder that cannot be read has none either: whoever reads it next says why.
    """
    path = folder / CONTRACT
    try:
        contract = json.loads(path.read_text()) if path.is_file() else None
        found = read_description(folder, contract)
    except (OSError, ValueError, KeyError, TypeError, CheckpointError, yaml.YAMLError):
        return None
    return found.name if found else None


def _list_tasks() -> dict[str, str]:
    """Return the class of each registered task by the name of its option."""
    found = {}
    for option in registry.list_options():
        if option.group == "task":
            found[option.name] = str((yaml.safe_load(option.path.read_text()) or {})["_target_"])
    return found


def _replace_at(spec: Any, path: list[str], value: Any) -> Any:
    """Return `spec` with another value at a path of field names."""
    first, rest = path[0], path[1:]
    if rest:
        value = _replace_at(getattr(spec, first), rest, value)
    return replace(spec, **{first: value})


def _drop_targets(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _drop_targets(item) for key, item in value.items() if key != "_target_"}
    return value


def _is_asked(key: str, asked: Collection[str]) -> bool:
    """Return whether `key`, a table above it, or a value below it was given."""
    return any(
        name == key or key.startswith(f"{name}.") or name.startswith(f"{key}.")
        for name in asked
        if name != "task"
    )


def _show(value: Any) -> str:
    return "null" if value is None else json.dumps(value).strip('"')
