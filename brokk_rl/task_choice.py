"""Task of a command that names a policy: the option it needs, and the values that were given.

A policy acts by the task that it was trained in. The command therefore chooses that option where
none was given, and tells the mode which values of the task somebody asked for: on the command line,
in an experiment, or in a file. The mode refuses those that the policy does not have.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from brokk_rl import registry
from brokk_rl.task_description import compare_tables, name_target, read_task_name, require_policy

NAMED = ("experiment", "ablation", "preset", "search")
"""Groups whose options may change the task."""
PLANT = ("machine", "sim", "actuator", "follower")
"""Groups that belong to the plant, and that an experiment may choose. The follower brings values of
the task too: how to propose to a person."""
MAIN = "config"
"""Name of the composed configuration; others, such as `resolved`, are given whole."""


def choose_task(cfg: DictConfig) -> DictConfig:
    """Return the configuration with the policy's task, and `asked` filled in.

    A mode without `asked`, and a training without `start_from`, names no policy; its configuration
    is returned as it is.
    """
    if "asked" not in cfg or ("start_from" in cfg and cfg.start_from is None):
        return cfg
    settings = HydraConfig.get()
    lines = list(settings.overrides.task)
    overrides = OverridesParser.create().parse_overrides(lines)
    whole = settings.job.config_name == MAIN
    asked = {*cfg.asked, *_list_given(overrides)}
    if whole:
        asked |= _find_brought(cfg, overrides)
        name = _read_policy_task(cfg)
        offered = {option.name for option in registry.list_options() if option.group == "task"}
        if name in offered and name != name_target(cfg.task._target_) and "task" not in asked:
            cfg = hydra.compose(MAIN, [*lines, f"task={name}"])
    OmegaConf.set_readonly(cfg, False)
    cfg.asked = sorted(asked)
    return cfg


def _list_given(overrides: list[Override]) -> set[str]:
    """Return the keys of the task that overrides name; `task` for the choice of the option."""
    given = set()
    for override in overrides:
        key = override.key_or_group.replace("/", ".")
        if key.split(".")[0] != "task":
            continue
        value = override.value()
        if isinstance(value, dict) and key != "task":
            for name, _ in compare_tables(_make_plain(value), {}, key):
                given.add(name)
        else:
            given.add(key)
    return given


def _find_brought(cfg: DictConfig, overrides: list[Override]) -> set[str]:
    """Return the keys of the task in which experiments and option files differ from the option."""
    kept, brings = [], False
    for override in overrides:
        group = override.key_or_group.split("/")[0].split(".")[0]
        if group in NAMED or (group == "task" and str(override.value()).startswith("@")):
            brings = True
        elif group != "task":
            kept.append(str(override.input_line))
    if not brings:
        return set()
    choices = HydraConfig.get().runtime.choices
    kept = [f"{group}={choices[group]}" for group in PLANT if group in choices] + kept
    name = name_target(cfg.task._target_)
    plain = hydra.compose(MAIN, [f"mode={choices['mode']}", *kept, f"task={name}"])
    here, there = (OmegaConf.to_container(one.task, resolve=True) for one in (cfg, plain))
    return {key for key, _ in compare_tables(here, there, "task")}


def _read_policy_task(cfg: DictConfig) -> str | None:
    """Return the name of the task of the policy or checkpoint that the configuration names."""
    folder = OmegaConf.select(cfg, "policy.folder", default=None)
    folder = OmegaConf.select(cfg, "start_from", default=folder)
    checkpoint = OmegaConf.select(cfg, "checkpoint", default=None)
    if checkpoint is not None:
        path = Path(str(checkpoint))
        return read_task_name(path.parent if path.suffix == ".pt" else path)
    if folder is not None:
        path = registry.resolve_package_path(str(folder))
        if OmegaConf.select(cfg, "policy.folder", default=None) == folder:
            require_policy(path)
        return read_task_name(path)
    return None


def _make_plain(value: Any) -> Any:
    """Return a parsed override as plain data: its keys and strings are Hydra's own."""
    if isinstance(value, dict):
        return {str(key): _make_plain(item) for key, item in value.items()}
    return str(value)
