"""One job: build the mode of a composed configuration once, and run it in its session.

Jobs of a sweep have folders of their own, and GPUs where they run at the same time. submitit starts
all jobs of a local sweep at once, and either gives them no GPU or the same ones. The launching
process therefore lists places, one for each GPU, and a job waits for a free place. A place is a
locked file, which the system unlocks when the process ends for any reason. So two sweeps on one
computer share the GPUs.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import re
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, read_write

from brokk_rl import distributed, extensions, registry
from brokk_rl.arguments import parse_words
from brokk_rl.build import build_mode
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.session import read_earlier_job, require_new_folder

log = logging.getLogger(__name__)

WITH_POLICIES = {"policy", "rivals"}
"""Nodes that may hold a policy."""
LONGEST_NAME = 120
"""Characters of a job's folder name; file systems take 255 bytes, and paths are read by people."""
OFFERED = "BROKK_PLACES"
"""Environment variable with the places, one job at a time in each.

`0,1,2,3` are four GPUs, `0,0` allows two jobs on one GPU, and `cpu,cpu` two jobs without a GPU.
"""
NO_GPU = "cpu"
POLL_S = 0.5
"""Seconds between looks for a free place; short against a job of minutes."""


def run(cfg: DictConfig) -> float | None:
    """Build the mode and run it, within its session where it has one."""
    sweep = HydraConfig.get().mode is RunMode.MULTIRUN
    extensions.refuse_ambiguous(HydraConfig.get().runtime.choices)
    goes_on = cfg.get("resume") is not None
    if any(cfg.get(node) for node in WITH_POLICIES):
        from brokk_rl import policy_choice  # its imports take 0.2 s

        cfg = policy_choice.insert_policy(cfg)
        goes_on |= policy_choice.is_going_on(cfg)
    values, shared = extensions.read_values(cfg)
    if "session" in values:
        folder = choose_run_folder(values)
        if not (sweep or goes_on) and distributed.read_rank().first:
            require_new_folder(folder)
        values["session"] |= {"out": str(folder)}
    mode = build_mode(values, shared)
    distributed.check_together(type(mode), sweep)
    return _run_in_session(mode, values, sweep, goes_on) if "session" in values else mode.run()


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
        is_number = objective is not None and math.isfinite(objective)
        record["objective"] = objective if is_number else None
        return objective


def _collect_facts(name: str, mode: Any) -> dict[str, Any]:
    """Return the fields of `session.json` about mode, options, overrides and machine."""
    settings = HydraConfig.get()
    chosen = {}
    for key, value in settings.runtime.choices.items():
        if value and not str(key).startswith("hydra"):
            chosen[str(key)] = str(value)
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
        job = name_job(int(settings.job.num), list(settings.overrides.task), list(fixed))
        return Path(settings.sweep.dir) / job
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
    parts = [f"{datetime.now():%Y-%m-%d_%H-%M-%S}", registry.read_mode_name(values), name]
    return Path("runs") / "_".join(part for part in parts if part)


def _format_resolved(mode: Any, values: dict[str, Any]) -> str:
    """Return the text of `resolved.yaml`, which runs again in a new folder."""
    content: dict[str, Any] = {"defaults": [{"hydra": "brokk"}, "_self_"], "run": values["run"]}
    for field in dataclasses.fields(mode):
        if field.name in values:
            content[field.name] = values[field.name]
    content["session"] = values["session"] | {"out": "???"}
    text = OmegaConf.to_yaml(OmegaConf.create(content))
    return f"# Runs again: brokk --config-dir <this folder> --config-name resolved\n{text}"


def name_job(number: int, overrides: Sequence[str], fixed: Sequence[str]) -> str:
    """Return the folder name of a job: its number, and the values that vary over the sweep.

    The name consists of letters, digits, dots, `-` and `_`, so that it needs no quotes in a shell or an
    override. Of a path the stem is kept.

    Args:
        number: Number of the job in its sweep.
        overrides: Overrides of the job.
        fixed: Keys of overrides that all jobs share.
    """
    parts = [str(number)]
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        if key not in fixed:
            files = re.sub(r"[^\s,\[\]]*/([^\s,\[\]/]+)", r"\1", value)
            text = f"{re.split('[./@]', key)[-1]}-{re.sub(r'[.]ya?ml', '', files)}"
            parts.append(re.sub(r"[^\w.]+", "-", text).strip("-"))
    return "_".join(parts)[:LONGEST_NAME]


class SweepFolder(Callback):
    """Hydra callback that prepares a sweep: names of its folders, and places for its jobs."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember the fixed overrides; Hydra calls this before the first job.

        The jobs, which may run in other processes, find the keys of the fixed overrides where Hydra
        keeps those that no folder name should have.
        """
        fixed = []
        for override in parse_words(config.hydra.overrides.task):
            if not override.is_sweep_override():
                fixed.append(override.get_key_element().lstrip("+~"))
        with read_write(config):
            config.hydra.overrides.hydra.append(
                f"hydra.job.config.override_dirname.exclude_keys={fixed}"
            )
        if str(config.hydra.launcher._target_).endswith(".LocalLauncher"):
            offer_places()


def offer_places() -> None:
    """List the places in the environment: those the user has set, else each visible GPU, else one."""
    if OFFERED in os.environ:
        return
    import torch

    count = torch.cuda.device_count()
    visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
    os.environ[OFFERED] = visible if count else NO_GPU


@contextmanager
def take_place() -> Iterator[str | None]:
    """Wait for a free place and show its GPU alone; does nothing outside a local submitit job."""
    offered = os.environ.get(OFFERED)
    if not offered or os.environ.get("SUBMITIT_EXECUTOR") != "local":
        yield None
        return
    names = [name.strip() for name in offered.split(",")]
    file, gpu = _wait_for_place(names)
    try:
        os.environ["CUDA_VISIBLE_DEVICES"] = "" if gpu == NO_GPU else gpu
        yield gpu
    finally:
        file.close()


def _wait_for_place(names: list[str]) -> tuple[IO[str], str]:
    """Return the open, locked file of the first free place, and its GPU."""
    import fcntl  # Windows has none; the command says so before it comes here

    folder = Path(tempfile.gettempdir()) / f"brokk_places_{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    said = False
    while True:
        for number, name in enumerate(names):
            nth = names[:number].count(name)  # the same GPU named twice is two places
            file = (folder / f"{name.replace('/', '_')}.{nth}").open("w")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.close()
                continue
            return file, name
        if not said:
            log.info("waiting for one of %d places: %s", len(names), ", ".join(names))
            said = True
        time.sleep(POLL_S)
