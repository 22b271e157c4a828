"""The command `brokk`: compose the configuration, run its mode, and explain errors."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import sys
import traceback
import warnings
from typing import Any

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.logging import RichHandler

import brokk_rl
from brokk_rl import distributed, extensions
from brokk_rl.arguments import read_arguments
from brokk_rl.errors import BrokkError, ConfigError
from brokk_rl.explain import compose_choices, explain, list_sources
from brokk_rl.help import collect_comments, describe_command, describe_mode
from brokk_rl.sim import probe

log = logging.getLogger(__name__)

FILE_WIDTH = 160
"""Columns of a log that goes to a file or a pipe: most messages stay one line. Chosen by hand."""


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
    asks_help = {"--help", "-h"} & set(sys.argv[1:])
    if not sys.argv[1:] or (asks_help and not any("mode=" in word for word in sys.argv[1:])):
        sys.stdout.write(describe_command())
        return 0
    set_up_logging()
    # The launcher options keep the names that submitit gave them; Hydra warns of that three times.
    warnings.filterwarnings(
        "ignore", message=r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema"
    )
    # This must precede the import of torch. Threads that wait actively make an update thirty times
    # slower where other programs run on the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Hydra reads some sixty files of YAML for a command: libyaml does it in a tenth of the time.
    yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # type: ignore[misc]
    # Pictures are written to files. A notebook hands down a backend that may not be installed here.
    os.environ["MPLBACKEND"] = "agg"
    probe.keep_renderer_for_drawing()
    # A run that a scheduler stops ends like one that is stopped by hand.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # Hydra raises its errors instead of printing them and leaving.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        sys.argv[1:] = read_arguments(sys.argv[1:])
        if any(word.startswith("policy") for word in sys.argv[1:]):
            from brokk_rl.policy_choice import prepare_arguments  # it takes 0.25 s to import

            sys.argv[1:] = prepare_arguments(sys.argv[1:])
        extensions.register_options(sys.argv[1:])
        if asks_help:
            sys.stdout.write(_describe_chosen_mode())
            return 0
        hydra.main(version_base="1.3", config_path="pkg://conf", config_name="config")(run_job)()
        sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes stdout once more when it ends; that must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        if _is_first_process():
            sys.stderr.write("interrupted\n")
        return 130
    except SystemExit as left:  # Hydra has said why, as for `--cfg job --package` of no such part.
        return 2 if left.code else 0
    except (FailedJob, Exception) as error:
        cause = error.args[0] if isinstance(error, FailedJob) else error
        message = explain(cause)
        if message is None or os.environ.get("BROKK_TRACE") == "1":
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
        from brokk_rl import job  # its parts take a while to import

        with job.take_place():
            return job.run(cfg)
    except Exception as error:
        if HydraConfig.get().mode is not RunMode.MULTIRUN:
            raise FailedJob(error) from error
        message = explain(error)
        if message is None:
            raise
        # The other jobs go on. Hydra raises the first error again, at the end, and an error of
        # another process comes without its cause.
        log.error("job %s failed: %s", HydraConfig.get().job.num, message)
        raise BrokkError(message) from error


def _is_first_process() -> bool:
    """Return true for the process that reports to the user: the first one."""
    try:
        return distributed.read_rank().first
    except ConfigError:
        return True


def set_up_logging() -> None:
    """Send log records to stderr, unless logging is set up already."""
    console = Console(stderr=True)
    if not (console.is_terminal or os.environ.get("COLUMNS")):
        console.width = FILE_WIDTH
    handler = RichHandler(
        console=console, show_path=False, log_time_format="%H:%M:%S", omit_repeated_times=False
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


def _describe_chosen_mode() -> str:
    """Return the help of the mode of the command line, with the options chosen there."""
    node: Any = OmegaConf.to_container(compose_choices())
    choices = node.pop("hydra")["runtime"]["choices"]
    comments = collect_comments(list_sources())
    return describe_mode(choices, node, comments, shutil.get_terminal_size().columns)
