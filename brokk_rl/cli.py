"""The command `brokk`: compose the configuration, run its mode, and explain errors."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import os
import shutil
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.logging import RichHandler

import brokk_rl
from brokk_rl import distributed, extensions, gpu_pool
from brokk_rl.arguments import read_arguments
from brokk_rl.errors import BrokkError, ConfigError
from brokk_rl.explain import compose_choices, explain, read_mode_name
from brokk_rl.mode_help import describe_mode
from brokk_rl.policy_choice import insert_policy, is_going_on, prepare_arguments
from brokk_rl.session import read_earlier_job, remove_empty_folders, require_new_folder
from brokk_rl.sim import probe
from brokk_rl.sweep import SweepFolder, name_job

log = logging.getLogger(__name__)


class FailedJob(BaseException):
    """A failed job on its way to `main`.

    It is no `Exception`, so that Hydra raises it again without a message of its own.
    """


def main() -> int:
    """Run the command and return its exit code.

    0: finished; 1: a defect of this package; 2: an error that the user can correct; 130:
    interrupted; 141: the reader of the output closed it, as `| head` does.
    """
    if "--version" in sys.argv[1:]:
        sys.stdout.write(f"brokk {brokk_rl.__version__}\n")
        return 0
    if sys.platform == "win32":
        sys.stderr.write("error: brokk_rl needs Linux or macOS; on Windows install it in WSL 2\n")
        return 2
    trace = "1" in (os.environ.get("BROKK_TRACE"), os.environ.get("HYDRA_FULL_ERROR"))
    set_up_logging()
    # The launcher options keep the names that submitit gave them; Hydra warns of that three times.
    warnings.filterwarnings(
        "ignore", message=r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema"
    )
    # This must precede the import of torch. Threads that wait actively make an update thirty times
    # slower where other programs run on the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Pictures are written to files. A notebook hands down a backend that may not be installed here.
    os.environ["MPLBACKEND"] = "agg"
    probe.keep_renderer_for_drawing()
    # A run that a scheduler stops ends like one that is stopped by hand.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with _make_hydra_raise():
            sys.argv[1:] = prepare_arguments(read_arguments(sys.argv[1:]))
            extensions.register_options(sys.argv[1:])
            if _is_mode_help(sys.argv[1:]):
                sys.stdout.write(_describe_chosen_mode())
                return 0
            command = hydra.main(version_base="1.3", config_path="pkg://conf", config_name="config")
            command(run_job)()
            sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes stdout once more when it ends; that must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        if _is_first_process():
            sys.stderr.write("interrupted\n")
        return 130
    except (FailedJob, Exception) as error:
        SweepFolder.drop_if_unused()
        cause = error.args[0] if isinstance(error, FailedJob) else error
        message = explain(cause)
        if trace or message is None:
            traceback.print_exception(cause)
        # Of several processes the first one reports an error of the configuration for all.
        if message is not None and (_is_first_process() or not isinstance(cause, ConfigError)):
            sys.stderr.write(f"error: {message}\n")
        return 1 if message is None else 2
    return 0


def run_job(cfg: DictConfig) -> float | None:
    """Run one composed configuration: the whole command, or one job of a sweep."""
    set_up_logging()  # A launcher may run the job in a process of its own.
    try:
        with gpu_pool.take_place():
            return _run(cfg)
    except Exception as error:
        if HydraConfig.get().mode is not RunMode.MULTIRUN:
            raise FailedJob(error) from error
        message = explain(error)
        if message is None:
            raise
        # The other jobs go on. Hydra repeats only the first error, at the end, and an error of
        # another process comes without its cause.
        log.error("job %s failed: %s", HydraConfig.get().job.num, message)
        raise BrokkError(message) from error


def _run(cfg: DictConfig) -> float | None:
    """Build the mode and run it, within its session where it has one."""
    from brokk_rl.build import build_mode

    sweep = HydraConfig.get().mode is RunMode.MULTIRUN
    cfg = insert_policy(cfg)
    values, shared = extensions.read_values(cfg)
    if "session" not in values:
        mode = build_mode(values, shared)
        distributed.check_together(type(mode), sweep)
        return mode.run()
    folder = choose_run_folder(values)
    goes_on = is_going_on(cfg, folder)
    try:
        if not (sweep or goes_on) and distributed.read_rank().first:
            require_new_folder(folder)
        mode = build_mode(values | {"session": values["session"] | {"out": str(folder)}}, shared)
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
    facts = _collect_facts(read_mode_name(values), mode)
    with mode.session.start(resolved, facts, resume) as record:
        objective = mode.run()
        record.fields["objective"] = (
            objective if objective is not None and math.isfinite(objective) else None
        )
        return objective


def _is_first_process() -> bool:
    """Return true for the process that reports to the user: the first one."""
    try:
        return distributed.read_rank().first
    except ConfigError:
        return True


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
    """Return the run folder: that of a sweep's job, else `session.out`, else a new one in `runs`."""
    settings = HydraConfig.get()
    if settings.mode is RunMode.MULTIRUN:
        fixed = settings.job.config.override_dirname.exclude_keys
        return Path(settings.sweep.dir) / name_job(
            int(settings.job.num), list(settings.overrides.task), list(fixed)
        )
    out = values["session"]["out"]
    if out and out != "???":
        return Path(out)
    name = settings.runtime.choices.get("experiment") or settings.runtime.choices.get("task")
    name = Path(name).stem if name else None  # An option may be a file: experiment=@<path>.
    stem = "_".join(
        filter(None, (f"{datetime.now():%Y-%m-%d_%H-%M-%S}", read_mode_name(values), name))
    )
    return Path("runs") / stem


def set_up_logging() -> None:
    """Send log records to stderr, unless logging is set up already."""
    handler = RichHandler(
        console=Console(stderr=True),
        show_path=False,
        log_time_format="%H:%M:%S",
        omit_repeated_times=False,
    )
    logging.basicConfig(
        level=logging.INFO if _is_first_process() else logging.ERROR,
        format="%(message)s",
        handlers=[handler],
    )
    # Hydra logs a target that cannot be loaded before it raises the error, which `main` explains.
    logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)
    # It reports its font cache otherwise.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)


def _is_mode_help(arguments: Sequence[str]) -> bool:
    """Return true where the help of one mode is asked for, not that of the command."""
    asked = "--help" in arguments or "-h" in arguments
    return asked and any(argument.startswith("mode=") for argument in arguments)


def _describe_chosen_mode() -> str:
    """Return the help of the mode of the command line, with the options chosen there."""
    cfg = compose_choices()
    own = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    choices, node = map(OmegaConf.to_container, (cfg.hydra.runtime.choices, own))
    assert isinstance(choices, dict) and isinstance(node, dict)
    return describe_mode(
        {str(key): value for key, value in choices.items()},
        {str(key): value for key, value in node.items()},
        shutil.get_terminal_size().columns,
    )


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


@contextlib.contextmanager
def _make_hydra_raise() -> Iterator[None]:
    """Make Hydra raise its errors instead of printing them and leaving."""
    name = "HYDRA_FULL_ERROR"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
