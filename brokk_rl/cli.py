"""The command `brokk`: compose the configuration, instantiate the mode, run it."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import logging
import os
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.logging import RichHandler

from brokk_rl import extensions
from brokk_rl.errors import BrokkError


def main() -> int:
    """Runs the command and returns its exit code: 0, 1 failed, 2 something the user can mend, 130 interrupted."""
    trace = "1" in (os.environ.get("BROKK_TRACE"), os.environ.get("HYDRA_FULL_ERROR"))
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands its errors to us instead of printing them
    try:
        extensions.register()
        hydra.main(version_base="1.3", config_path="pkg://conf", config_name="config")(job)()
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    except (BrokkError, HydraException, OmegaConfBaseException) as error:
        if trace:
            raise
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


def job(cfg: DictConfig) -> float | None:
    """Runs one composed configuration: all of `brokk`, or one job of a sweep."""
    set_up_logging()
    settings = HydraConfig.get()
    if "session" not in cfg:
        return instantiate(cfg, _convert_="all").run()
    folder = run_folder(cfg)
    mode = instantiate(cfg, session={"out": str(folder)}, _convert_="all")
    choices = {str(key): value for key, value in settings.runtime.choices.items() if value and not str(key).startswith("hydra")}
    facts: dict[str, Any] = {"mode": _mode_name(cfg), "choices": choices, "overrides": list(settings.overrides.task)}
    if machine := getattr(mode, "machine", None):
        facts |= {"machine": machine.name, "fingerprint": machine.fingerprint()}
    with mode.session.start(_resolved(cfg), facts, resume=bool(getattr(mode, "resume", None))) as record:
        record.fields["objective"] = mode.run()
    return record.fields["objective"]


def run_folder(cfg: DictConfig) -> Path:
    """Returns where a run writes: the job's folder in a sweep, else `session.out`, else a new folder under `runs`."""
    settings = HydraConfig.get()
    if settings.mode is RunMode.MULTIRUN:
        return Path(settings.runtime.output_dir)
    out = OmegaConf.select(cfg, "session.out", default=None)
    return Path(out) if out else Path("runs") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{_mode_name(cfg)}"


def set_up_logging() -> None:
    """Shows log records to a person, on stderr; does nothing where someone has set up logging already."""
    handler = RichHandler(console=Console(stderr=True), show_path=False, log_time_format="%H:%M:%S", omit_repeated_times=False)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[handler])


def _mode_name(cfg: DictConfig) -> str:
    return str(cfg._target_).split(".")[-2]


def _resolved(cfg: DictConfig) -> str:
    """Returns the text of `resolved.yaml`, which runs again under a new folder."""
    values = OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))
    values.session.out = "???"
    return "# Runs again: brokk --config-dir <this folder> --config-name resolved\n" + OmegaConf.to_yaml(
        OmegaConf.merge({"defaults": [{"hydra": "brokk"}, "_self_"]}, values)
    )
