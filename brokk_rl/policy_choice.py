"""The policy that a command names by `policy=`: an option, or a path to a folder or checkpoint.

Before the configuration is composed, `prepare_arguments` makes the path an option of Hydra. After,
`insert_policy` puts in what the policy knows of itself: its machine, the option of its task and the
behaviour. A value that the caller typed and that contradicts the policy is refused.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from brokk_rl import registry
from brokk_rl.arguments import is_given_whole, list_names, parse_words
from brokk_rl.build import RUN, TARGET, build_node, drop_targets
from brokk_rl.errors import CheckpointError, ConfigError
from brokk_rl.extensions import store_option
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import (
    StoredPolicy,
    TaskDescription,
    find_policy,
    format_value,
    list_differences,
    name_target,
)
from brokk_rl.session import read_record

log = logging.getLogger(__name__)

PLACE = "brokk_rl.rl.policy"
CLASSICAL, TRAINED = f"{PLACE}.ClassicalPolicy", f"{PLACE}.TrainedPolicy"
SHIPPED = f"{PLACE}.ShippedPolicy"
TRAIN = "brokk_rl.modes.train.Train"
RIVALS_OWN = ("classical", "advice")
"""Fields of a task that the classical controller keeps beside a policy."""


def prepare_arguments(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of the command as Hydra understands them.

    A path after `policy=` becomes an option of that group. A training that goes on in its own
    folder, or from a checkpoint, takes up the overrides of its run.
    """
    overrides = parse_words(arguments)
    # `policy@rivals.<name>` is another key than `policy`
    given = {one.key_or_group: one for one in overrides if one.package is None}
    prepared = list(arguments)
    is_whole = is_given_whole(arguments)
    for override in overrides:
        if override.key_or_group == "policy":
            for name in _list_paths(override):
                store_option("policy", name, {TARGET: TRAINED, "path": name, "task": None})
                if is_whole and override.package is None:  # such a configuration has no groups
                    prepared.remove(str(override.input_line))
                    prepared.append(f"policy={{{TARGET}: {TRAINED}, path: '{name}', task: null}}")
    return prepared if is_whole else prepared + _recall_overrides(given)


def insert_policy(cfg: DictConfig) -> DictConfig:
    """Return the configuration with what its policies know of machine and task.

    Raises:
        CheckpointError: There is no such policy, or it does not fit machine or task.
        ConfigError: The caller typed a value that the policy does not have.
    """
    OmegaConf.set_readonly(cfg, False)
    OmegaConf.set_struct(cfg, False)
    target = OmegaConf.select(cfg, f"policy.{TARGET}", default=None)
    if target == TRAINED or (target == SHIPPED and cfg.get(RUN) == TRAIN):
        cfg.policy[TARGET] = TRAINED
        cfg = _take_over(cfg)
    elif target == SHIPPED:
        try:
            cfg = _take_over(cfg.copy())
        except (CheckpointError, ConfigError) as error:
            if "policy" in _list_given():  # the caller asked for this one
                raise
            text = "the classical controller acts, for the shipped policy does not fit: %s"
            log.info(text, error)
            cfg.policy = {TARGET: CLASSICAL, "task": None}
    for node in _list_rivals(cfg):
        if node[TARGET] == TRAINED:
            _insert_task(cfg, node)
    return cfg


def _list_rivals(cfg: DictConfig) -> list[DictConfig]:
    """Return the policies beside the one; what is none is refused when it is built."""
    rivals = cfg.get("rivals")
    nodes = rivals.values() if isinstance(rivals, DictConfig) else ()
    return [node for node in nodes if isinstance(node, DictConfig)]


def is_going_on(cfg: DictConfig) -> bool:
    """Return whether a training goes on in the folder of its policy."""
    path = OmegaConf.select(cfg, "policy.path", default=None)
    out = OmegaConf.select(cfg, "session.out", default=None)
    if cfg.get(RUN) != TRAIN or path is None or out is None:
        return False
    return _find_run(path).resolve() == Path(out).resolve()


def _list_paths(override: Override) -> list[str]:
    """Return the values of `policy=` that are no options; of a sweep there may be several."""
    offered = {option.name for option in registry.list_options("policy")}
    paths = []
    for value in list_names(override):
        is_other = value not in offered and not value.startswith("@")
        if is_other and (Path(value).exists() or set("/:.") & set(value)):
            paths.append(value)
    return paths


def _find_run(policy: str) -> Path:
    """Return the run folder of a policy: that of a checkpoint, or the folder itself."""
    return Path(policy).parent if policy.endswith(".pt") else Path(policy)


def _recall_overrides(given: Mapping[str, Override]) -> list[str]:
    """Return the overrides of the run with which a training goes on, but for those given anew."""
    values = {key: str(override.value()) for key, override in given.items()}
    policy, out = values.get("policy", ""), values.get("session.out")
    run = _find_run(policy)
    is_own = out is not None and Path(out).resolve() == run.resolve()
    is_training = values.get("mode", "train") == "train"
    if not (policy and is_training and (policy.endswith(".pt") or is_own)):
        return []
    recalled = []
    lines = (read_record(run) or {}).get("overrides", [])
    for override in parse_words(lines):
        if override.key_or_group not in {*given, "session.out"}:
            recalled.append(str(override.input_line))
    return recalled


def _take_over(cfg: DictConfig) -> DictConfig:
    """Return the configuration with machine, option and behaviour of the first policy."""
    stored = find_policy(str(cfg.policy.path))
    own = stored.task
    if own is None:  # a checkpoint by itself: the mode compares when it reads it
        return cfg
    given = _list_given()
    brought = []
    if "task" in cfg:
        cfg = _choose_option(cfg, own, given, stored)
    if "machine" in cfg:
        brought = _insert_plant(cfg, stored, given)
    if "task" in cfg:
        brought += _insert_behaviour(cfg, own, given, stored)
    if brought:
        log.info("the policy in %s brings %s", stored.name, " and ".join(brought))
    return cfg


def _choose_option(
    cfg: DictConfig, own: TaskDescription, given: set[str], stored: StoredPolicy
) -> DictConfig:
    """Return the configuration with the option of the policy's task."""
    composed = name_target(str(cfg.task[TARGET]))
    if composed == own.name:
        return cfg
    settings = HydraConfig.get()
    if "task" in given or settings.job.config_name != "config":
        raise ConfigError(
            f"the policy in {stored.name} was trained for task={own.name}, but task={composed} was "
            "asked for. Leave task= out, or give another policy"
        )
    changed = hydra.compose("config", [*settings.overrides.task, f"task={own.name}"])
    OmegaConf.set_struct(changed, False)
    return changed


def _insert_plant(cfg: DictConfig, stored: StoredPolicy, given: set[str]) -> list[str]:
    """Put in the machine of the policy, and with another machine the actuator of its training.

    Return what was put in: nothing where the machine is that of the configuration.
    """
    here: Machine = build_node(OmegaConf.to_container(cfg.machine, resolve=True), "machine")
    name = stored.contract["machine"]
    differing = here.list_differences(stored.contract["fingerprint"])
    if not differing:
        return []
    plant = stored.list_plant()
    if _is_given("machine", given) or "machine" not in plant:
        raise ConfigError(
            f"the policy in {stored.name} was trained with machine={name}, but machine={here.name} "
            f"was asked for: {', '.join(differing)} differ. Leave machine= out, and the policy "
            "brings its own; or give another policy"
        )
    cfg.machine = plant["machine"]
    if "actuator" not in plant or not cfg.get("actuator") or _is_given("actuator", given):
        return [f"its machine '{name}'"]
    cfg.actuator = plant["actuator"]
    return [f"its machine '{name}'", "the actuator model of its training"]


def _insert_behaviour(
    cfg: DictConfig, own: TaskDescription, given: set[str], stored: StoredPolicy
) -> list[str]:
    """Put the behaviour of the policy into the task; return the values that it changed.

    The classical controller as a rival keeps the numbers that were composed, and what it knows of a
    person: a policy may rest on those of an earlier version, which are no honest opponent.
    """
    before: Any = OmegaConf.to_container(cfg.task, resolve=True)
    after = own.apply_to(before)
    changes = dict(list_differences(drop_targets(before), drop_targets(after), "task"))
    refused, brought = [], []
    for key, (here, there) in changes.items():
        brought.append(f"{key}={format_value(there)}")
        if _is_given(key, given):
            refused.append(
                f"{key}={format_value(here)} was asked for, the policy has {format_value(there)}"
            )
    if refused:
        raise ConfigError(
            f"the policy in {stored.name} acts by the task that it was trained in: "
            f"{'; '.join(refused)}. Leave these out, and the policy's own values are taken; or "
            "give a policy that was trained with them"
        )
    if changes:
        cfg.task = after
        own_values = {key: before[key] for key in RIVALS_OWN if key in before}
        for node in _list_rivals(cfg):
            if node[TARGET] == CLASSICAL and own_values:
                node.task = after | own_values
        if before.get("advice") and not after.get("advice"):
            log.warning(
                "the policy in %s was trained without a person at the levers and proposes as if it moved "
                "them itself; the classical controller beside it knows of the person",
                stored.name,
            )
    return brought


def _insert_task(cfg: DictConfig, node: DictConfig) -> None:
    """Give another policy of the command a task of its own where it acts by another one."""
    own = find_policy(str(node.path)).task
    before: Any = OmegaConf.to_container(cfg.task, resolve=True)
    if own is None or node.task is not None or name_target(before[TARGET]) != own.name:
        return
    after = own.apply_to(before)
    if drop_targets(after) != drop_targets(before):
        node.task = after


def _list_given() -> set[str]:
    """Return the keys that the caller typed."""
    given = set()
    for override in parse_words(HydraConfig.get().overrides.task):
        key, value = override.key_or_group.replace("/", "."), override.value()
        if isinstance(value, dict):
            given.update(f"{key}.{name}" for name in value)
        else:
            given.add(key)
    return given


def _is_given(key: str, given: set[str]) -> bool:
    """Return whether `key`, a table above it but for the whole task, or a value below was typed."""
    above = {name for name in given if key.startswith(f"{name}.") and name != "task"}
    return bool(above) or any(name == key or name.startswith(f"{key}.") for name in given)
