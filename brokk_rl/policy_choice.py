"""The policy that a command names by `policy=`: an option, or a path to a folder or checkpoint.

Before the configuration is composed, `prepare_arguments` makes the path an option of Hydra. After,
`insert_policy` puts in what the policy knows of itself: its machine, the option of its task and the
behaviour. A value that the caller gave and that contradicts the policy is refused.
"""

from __future__ import annotations

import copy
import logging
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import hydra
import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf

from brokk_rl import registry
from brokk_rl.build import RUN, build_node
from brokk_rl.errors import CheckpointError, ConfigError, list_choices
from brokk_rl.policy_folder import (
    CONTRACT,
    TARGET,
    StoredPolicy,
    TaskDescription,
    describe_spec,
    describe_task,
    drop_targets,
    find_policy,
    format_value,
    list_differences,
    name_target,
)
from brokk_rl.session import read_record

log = logging.getLogger(__name__)

T = TypeVar("T")

CLASSICAL, TRAINED, SHIPPED, UNTRAINED = (
    f"brokk_rl.rl.policy.{name}Policy" for name in ("Classical", "Trained", "Shipped", "Untrained")
)
TRAIN = "brokk_rl.modes.train.Train"
OLD_KEYS = ("policy.folder", "checkpoint", "start_from", "doctor.policy", "resume")
"""Names that `policy` had in one mode or another. Other modes than training still have `resume`."""
NAMED = ("experiment", "ablation", "preset", "search")
"""Groups whose options may change machine and task."""
WHOLE = ("--config-name", "-cn")
"""Arguments of a command whose configuration is given whole, as `resolved.yaml` is."""


def prepare_arguments(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of the command as Hydra understands them.

    A path after `policy=` becomes an option of that group. A training that goes on in its own
    folder, or from a checkpoint, takes up the overrides of its run.

    Raises:
        ConfigError: A key has another name now; the message ends with the command that works.
        CheckpointError: There is no such policy.
    """
    overrides = []
    for argument in arguments:
        if "=" in argument and not argument.startswith("-"):
            overrides.extend(_parse(argument))
    _refuse_old_keys(arguments, overrides)
    is_whole = any(argument.startswith(WHOLE) for argument in arguments)
    prepared = list(arguments)
    for override in overrides:
        if override.key_or_group != "policy":
            continue
        for name in _list_paths(override):
            _offer(name)
            if is_whole:  # such a configuration has no groups
                prepared.remove(str(override.input_line))
                prepared.append(f"policy={{{TARGET}: {TRAINED}, path: '{name}', task: null}}")
    return prepared if is_whole else prepared + _recall_overrides(arguments, overrides)


def insert_policy(cfg: DictConfig) -> DictConfig:
    """Return the configuration with what its policies know of machine and task.

    Raises:
        CheckpointError: There is no such policy, or it does not fit machine or task.
        ConfigError: The caller gave a value that the policy does not have.
    """
    OmegaConf.set_readonly(cfg, False)
    OmegaConf.set_struct(cfg, False)
    target = OmegaConf.select(cfg, f"policy.{TARGET}", default=None)
    if cfg.get(RUN) == TRAIN:
        target = _choose_beginning(cfg, target)
    given = _list_given(list(HydraConfig.get().overrides.task))
    if target == SHIPPED:
        try:
            cfg = _take_over(cfg.copy(), given)
        except (CheckpointError, ConfigError) as error:
            log.info(
                "the classical controller acts, for the policy that ships does not fit: %s", error
            )
            cfg.policy = {TARGET: CLASSICAL, "task": None}
    elif target == TRAINED:
        cfg = _take_over(cfg, given)
    for group in ("rivals", "panel"):
        for node in (cfg.get(group) or {}).values():
            if node[TARGET] == TRAINED:
                _insert_task(cfg, node)
    return cfg


def restore_task(task: T, policy: str) -> T:
    """Return a task's spec with the behaviour of the policy at a path, for scripts and tests.

    Raises:
        CheckpointError: There is no such policy, or its task is another one.
    """
    own = find_policy(policy).task
    here = describe_task(task)
    if own is None or own.name != here.name:
        raise CheckpointError(f"{policy}: expected a policy of task={here.name}, got {own}")
    node = apply_behaviour(describe_spec(task), own.behaviour)
    return build_node(node, "task")


def apply_behaviour(node: Mapping[str, Any], behaviour: Mapping[str, Any]) -> dict[str, Any]:
    """Return the node of a task with the values of a behaviour, and its classes where it has any.

    Args:
        node: Plain data of the task's node.
        behaviour: Values by dotted name, as in `TaskDescription`.
    """
    changed = copy.deepcopy(dict(node))
    for path, value in behaviour.items():
        *parents, last = path.split(".")
        place = changed
        for part in parents:
            place = place.setdefault(part, {})
        place[last] = _keep_targets(place.get(last), value)
    return changed


def _keep_targets(before: Any, after: Any) -> Any:
    """Return `after` with the classes that the nodes `before` name in the same places."""
    if not isinstance(before, dict) or not isinstance(after, dict):
        return after
    kept = {TARGET: before[TARGET]} if TARGET in before else {}
    for key, value in after.items():
        kept[key] = _keep_targets(before.get(key), value)
    return kept


def is_going_on(cfg: DictConfig, folder: Path) -> bool:
    """Return whether a command goes on with the run in `folder`."""
    if cfg.get(RUN) != TRAIN:
        return cfg.get("resume") is not None
    path = OmegaConf.select(cfg, "policy.path", default=None)
    return path is not None and _find_run(path).resolve() == folder.resolve()


def _parse(argument: str) -> list[Override]:
    """Return an argument as Hydra reads it; Hydra itself says what is wrong with one."""
    try:
        return OverridesParser.create().parse_overrides([argument])
    except OverrideParseException:
        return []


def _refuse_old_keys(arguments: Sequence[str], overrides: Sequence[Override]) -> None:
    for override in overrides:
        key = override.key_or_group
        if key not in OLD_KEYS or (key == "resume" and not _is_training(overrides)):
            continue
        words = []
        for argument in arguments:
            if argument != override.input_line:
                words.append(argument)
        value = str(override.value())
        works = [*words, f"policy={value}"]
        has_folder = any(word.startswith("session.out=") for word in words)
        if key == "resume" and not has_folder:
            works.append(f"session.out={value}")
        raise ConfigError(
            f"{override.input_line}: '{key}' is now 'policy', in every mode. This works: "
            f"{shlex.join(['brokk', *works])}"
        )


def _is_training(overrides: Iterable[Override]) -> bool:
    """Return whether the mode of the command is `train`, as far as its words say."""
    for override in overrides:
        if override.key_or_group == "mode":
            return override.value() == "train"
        if override.key_or_group in NAMED and "mode" in _read_keys(override):
            return False
    return True


def _list_paths(override: Override) -> list[str]:
    """Return the values of `policy=` that are no options; of a sweep there may be several."""
    values: list[Any] = [override.value()]
    if override.is_sweep_override():
        values = list(override.sweep_string_iterator())
    offered = {option.name for option in registry.list_options() if option.group == "policy"}
    paths = []
    for value in values:
        if not isinstance(value, str) or value.startswith("@") or value in offered:
            continue
        if Path(value).exists() or "/" in value or ":" in value or value.endswith((".pt", ".onnx")):
            paths.append(value)
        else:
            raise CheckpointError(
                f"there is no policy={value}, and no folder of that name; "
                f"{list_choices(value, offered)}; or give a run folder, a policy folder or a "
                "checkpoint"
            )
    return paths


def _offer(name: str) -> None:
    """Put a path into Hydra's store as an option of `policy`."""
    folders = [part for part in name.split("/")[:-1] if part]
    ConfigStore.instance().store(
        name.rpartition("/")[2],
        {TARGET: TRAINED, "path": name, "task": None},
        "/".join(["policy", *folders]),
        provider="policy",
    )


def _find_run(policy: str) -> Path:
    """Return the run folder of a policy: that of a checkpoint, or the folder itself."""
    return Path(policy).parent if policy.endswith(".pt") else Path(policy)


def _recall_overrides(arguments: Sequence[str], overrides: Sequence[Override]) -> list[str]:
    """Return the overrides of the run with which a training goes on, but for those given anew."""
    given = {override.key_or_group: override for override in overrides}
    if "policy" not in given or not _is_training(overrides) or {"-m", "--multirun"} & {*arguments}:
        return []
    policy = str(given["policy"].value())
    out = given["session.out"].value() if "session.out" in given else None
    run = _find_run(policy)
    if not policy.endswith(".pt") and (out is None or Path(str(out)).resolve() != run.resolve()):
        return []
    record = read_record(run) or {}
    recalled = []
    for line in record.get("overrides", ()):
        key = _parse(line)[0].key_or_group
        if key not in given and key != "session.out":
            recalled.append(line)
    return recalled


def _choose_beginning(cfg: DictConfig, target: str | None) -> str | None:
    """Return the class of the policy with which training begins; an untrained one is none."""
    if target not in (None, TRAINED, SHIPPED, UNTRAINED):
        raise ConfigError(
            f"mode=train policy={HydraConfig.get().runtime.choices.get('policy')}: training begins "
            "with a network; expected policy=untrained, policy=shipped, or the path of a run "
            "folder, a policy folder or a checkpoint"
        )
    if target in (None, UNTRAINED):
        cfg.policy = None
        return None
    path = Path(str(cfg.policy.path))
    out = Path(OmegaConf.select(cfg, "session.out", default=None) or ".")
    if is_going_on(cfg, out) and not (path / CONTRACT).exists() and path.suffix != ".pt":
        return None  # it was stopped before it began, or begins now
    cfg.policy[TARGET] = TRAINED
    return TRAINED


def _take_over(cfg: DictConfig, given: set[str]) -> DictConfig:
    """Return the configuration with machine, option and behaviour of the first policy."""
    stored = find_policy(str(cfg.policy.path), may_lack=cfg.get(RUN) == TRAIN)
    own = stored.task
    if own is None:  # a checkpoint by itself: the mode compares when it reads it
        return cfg
    brought = []
    if "task" in cfg:
        cfg = _choose_option(cfg, own, given, stored)
    if "machine" in cfg:
        brought += _insert_plant(cfg, stored, given)
    if "task" in cfg and (num := _insert_behaviour(cfg, own, given, stored)):
        brought.append(f"{num} value{'s' if num > 1 else ''} of its task")
    if brought:
        log.info("the policy in %s brings %s", stored.name, ", ".join(brought))
    return cfg


def _choose_option(
    cfg: DictConfig, own: TaskDescription, given: set[str], stored: StoredPolicy
) -> DictConfig:
    """Return the configuration with the option of the policy's task."""
    composed = name_target(str(cfg.task[TARGET]))
    if composed == own.name:
        return cfg
    offered = {option.name for option in registry.list_options() if option.group == "task"}
    settings = HydraConfig.get()
    if "task" in given or own.name not in offered or settings.job.config_name != "config":
        raise ConfigError(
            f"the policy in {stored.name} was trained for task={own.name}, but task={composed} was "
            f"asked for. Leave task= out, or give another policy"
        )
    changed = hydra.compose("config", [*settings.overrides.task, f"task={own.name}"])
    OmegaConf.set_struct(changed, False)
    return changed


def _insert_plant(cfg: DictConfig, stored: StoredPolicy, given: set[str]) -> list[str]:
    """Put the machine of the policy into the configuration, and the actuator model of its training.

    Return what was brought: nothing where the machine is the same.
    """
    here = build_node(OmegaConf.to_container(cfg.machine, resolve=True), "machine")
    name, theirs = stored.contract["machine"], stored.contract["fingerprint"]
    differing = [part for part, stamp in here.fingerprint().items() if theirs.get(part) != stamp]
    if not differing:
        return []
    plant = stored.list_plant()
    if _find_given("machine", given) or "machine" not in plant:
        raise ConfigError(
            f"the policy in {stored.name} was trained with machine={name}, but machine={here.name} "
            f"was asked for: {', '.join(differing)} differ. Leave machine= out, and the policy "
            "brings its own; or give another policy"
        )
    cfg.machine = plant["machine"]
    brought = [f"its machine, {name}"]
    if "actuator" in plant and cfg.get("actuator") and not _find_given("actuator", given):
        cfg.actuator = plant["actuator"]
        brought.append(f"the actuator model of its training, {_name_class(cfg.actuator)}")
    return brought


def _insert_behaviour(
    cfg: DictConfig, own: TaskDescription, given: set[str], stored: StoredPolicy
) -> int:
    """Put the behaviour of the policy into the task; return how many values changed.

    The classical controller as a rival keeps the numbers that were composed: a policy may rest on
    those of an earlier version, which are no honest opponent.
    """
    before: Any = OmegaConf.to_container(cfg.task, resolve=True)
    after = apply_behaviour(before, own.behaviour)
    changes = dict(list_differences(drop_targets(before), drop_targets(after), "task"))
    refused = []
    for key, (here, there) in changes.items():
        if _find_given(key, given):
            refused.append(
                f"{key}={format_value(here)} was asked for, the policy has {format_value(there)}"
            )
    if refused:
        raise ConfigError(
            f"the policy in {stored.name} acts by the task that it was trained in: "
            f"{'; '.join(refused)}. Leave these out, and the policy's own values are taken; or "
            "give a policy that was trained with them"
        )
    if not changes:
        return 0
    cfg.task = after
    for node in (cfg.get("rivals") or {}).values():
        if node[TARGET] == CLASSICAL and "classical" in before:
            node.task = after | {"classical": before["classical"]}
    return len(changes)


def _insert_task(cfg: DictConfig, node: DictConfig) -> None:
    """Give another policy of the command a task of its own where it acts by another one."""
    stored = find_policy(str(node.path))
    if stored.task is None or node.task is not None:
        return
    before: Any = OmegaConf.to_container(cfg.task, resolve=True)
    after = apply_behaviour(before, stored.task.behaviour)
    if after != before and name_target(before[TARGET]) == stored.task.name:
        node.task = after


def _name_class(node: DictConfig) -> str:
    return str(node[TARGET]).rpartition(".")[2].lower()


def _list_given(lines: Sequence[str]) -> set[str]:
    """Return the keys that the caller gave: as words, in an experiment, or in a file of a task."""
    given = set()
    for override in OverridesParser.create().parse_overrides(list(lines)):
        key = override.key_or_group.replace("/", ".")
        value = override.value()
        if override.key_or_group in NAMED or (key == "task" and str(value).startswith("@")):
            given |= _read_keys(override)
        elif isinstance(value, dict):
            given |= _list_keys(_make_plain(value), key)
        else:
            given.add(key)
    return given


def _read_keys(override: Override) -> set[str]:
    """Return the keys that an option sets: of a task's file those that differ from its option."""
    group, name = override.key_or_group, str(override.value())
    path = Path(name.removeprefix("@")).expanduser()
    if not name.startswith("@"):
        found = [one for one in registry.list_options() if (one.group, one.name) == (group, name)]
        if not found:
            return set()
        path = found[0].path
    content = yaml.safe_load(path.read_text()) if path.is_file() else {}
    if group == "task":
        offered = content.get(TARGET)
        for option in registry.list_options():
            plain = yaml.safe_load(option.path.read_text()) if option.group == "task" else {}
            if plain.get(TARGET) == offered:
                return {key for key, _ in list_differences(content, plain, "task")}
    keys = _list_keys({key: value for key, value in content.items() if key != "defaults"}, "")
    for entry in content.get("defaults", ()):
        for place in entry if isinstance(entry, dict) else ():
            if place.startswith("override /"):
                keys.add(place.removeprefix("override /"))
    return keys


def _list_keys(node: Any, place: str) -> set[str]:
    """Return the dotted names of the leaves of nested tables."""
    if not isinstance(node, dict) or not node:
        return {place}
    keys = set()
    for key, value in node.items():
        keys |= _list_keys(value, f"{place}.{key}" if place else str(key))
    return keys


def _make_plain(value: Any) -> Any:
    """Return a parsed override as plain data: its keys are Hydra's own."""
    if isinstance(value, dict):
        return {str(key): _make_plain(item) for key, item in value.items()}
    return value


def _find_given(key: str, given: Iterable[str]) -> bool:
    """Return whether `key`, a table above it, or a value below it was given."""
    for name in given:
        if name == key or name.startswith(f"{key}."):
            return True
        if key.startswith(f"{name}.") and name != "task":
            return True
    return False
