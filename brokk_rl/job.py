"""One job: build the mode of a composed configuration once, and run it in its session."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from brokk_rl import distributed, extensions, registry
from brokk_rl.build import build_mode
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.session import read_earlier_job, remove_empty_folders, require_new_folder
from brokk_rl.sweep import name_job

log = logging.getLogger(__name__)

WITH_POLICIES = {"policy", "rivals"}
"""Nodes that may hold a policy."""


def run(cfg: DictConfig) -> float | None:
    """Build the mode and run it, within its session where it has one."""
    sweep = HydraConfig.get().mode is RunMode.MULTIRUN
    extensions.refuse_ambiguous(HydraConfig.get().runtime.choices)
    built: dict[str, Any] = {}
    goes_on = cfg.get("resume") is not None
    if any(cfg.get(node) for node in WITH_POLICIES):
        from brokk_rl import policy_choice  # its imports take 0.2 s

        cfg, built = policy_choice.insert_policy(cfg)
        goes_on |= policy_choice.is_going_on(cfg)
    values, shared = extensions.read_values(cfg)
    if "session" not in values:
        mode = build_mode(values | built, shared)
        distributed.check_together(type(mode), sweep)
        return mode.run()
    folder = choose_run_folder(values)
    try:
        if not (sweep or goes_on) and distributed.read_rank().first:
            require_new_folder(folder)
        built["session"] = values["session"] | {"out": str(folder)}
        mode = build_mode(values | built, shared)
        distributed.check_together(type(mode), sweep)
        return _run_in_session(mode, values, sweep, goes_on)
    except Exception:
        if sweep:
            # Hydra made these folders, in several levels where an override holds a path. A folder
            # into which a job has written stays.
            remove_empty_folders([folder, *folder.parents])
        raise


def _run_in_session(mode: Any, values: dict[str, Any], sweep: bool, goes_on: bool) -> float | None:
    """Run a mode in its run folder; a finished job of a sweep is not run again."""
    folder, resolved = mode.session.folder, _format_resolved(mode, values)
    before = read_earlier_job(folder, resolved) if sweep else None
    if before and before.get("outcome") == "finished":
        log.info("job %s is done already: %s", HydraConfig.get().job.num, folder)
        return before.get("objective")
    if before and getattr(mode, "resume", "") is None:
        mode = dataclasses.replace(mode, resume=str(folder))
    resume = bool(before) or goes_on
    log.info("run folder: %s", folder)
    facts = _collect_facts(registry.read_mode_name(values), mode)
    with mode.session.start(resolved, facts, resume) as record:
        objective = mode.run()
        record.fields["objective"] = (
            objective if objective is not None and math.isfinite(objective) else None
        )
        return objective


def _collect_facts(name: str, mode: Any) -> dict[str, Any]:
    """Return the fields of `session.json` about mode, options, overrides and machine."""
    settings = HydraConfig.get()
    made = OmegaConf.to_container(settings.runtime.choices)
    assert isinstance(made, dict)
    chosen = {
        str(key): value
        for key, value in made.items()
        if value and str(key).split("/")[0] != "hydra"
    }
    overrides = list(settings.overrides.task)
    for override in overrides:
        key, _, value = override.partition("=")
        if value.startswith("["):  # Hydra does not record options that were chosen as a list.
            chosen.setdefault(key, value)
    facts: dict[str, Any] = {"mode": name, "choices": chosen, "overrides": overrides}
    if machine := getattr(mode, "machine", None):
        facts |= {"machine": machine.name, "fingerprint": machine.fingerprint()}
    return facts


def choose_run_folder(values: Mapping[str, Any]) -> Path:
    """Return the run folder: that of a sweep's job, else `session.out`, else a new one in `runs`.

    Raises:
        ConfigError: `session` is no table, or `session.out` no single folder.
    """
    settings = HydraConfig.get()
    if settings.mode is RunMode.MULTIRUN:
        fixed = settings.job.config.override_dirname.exclude_keys
        return Path(settings.sweep.dir) / name_job(
            int(settings.job.num), list(settings.overrides.task), list(fixed)
        )
    session = values["session"]
    if not isinstance(session, Mapping):
        raise ConfigError(
            f"session={session or 'null'}: it is a table, whose values are given as session.<name>=…; "
            f"{list_choices(str(session), ('out', 'seed', 'device'))}"
        )
    out = session.get("out")  # a preset may set others in a mode without a session
    if isinstance(out, (list, dict)):
        raise ConfigError(f"session.out: expected one folder, got {out}; change session.out=…")
    if out and out != "???":
        return Path(str(out))
    name = settings.runtime.choices.get("experiment") or settings.runtime.choices.get("task")
    name = Path(name).stem if name else None  # An option may be a file: experiment=@<path>.
    stem = "_".join(
        filter(None, (f"{datetime.now():%Y-%m-%d_%H-%M-%S}", registry.read_mode_name(values), name))
    )
    return Path("runs") / stem


def _format_resolved(mode: Any, values: dict[str, Any]) -> str:
    """Return the text of `resolved.yaml`, which runs again in a new folder."""
    content: dict[str, Any] = {"defaults": [{"hydra": "brokk"}, "_self_"], "run": values["run"]}
    for field in dataclasses.fields(mode):
        if field.name in values:
            content[field.name] = values[field.name]
    content["session"] = values["session"] | {"out": "???"}
    return (
        "# Runs again: brokk --config-dir <this folder> --config-name resolved\n"
        + OmegaConf.to_yaml(OmegaConf.create(content))
    )
