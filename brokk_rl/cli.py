"""The command `brokk`: compose the configuration, run its mode, and explain errors."""

from __future__ import annotations

import contextlib
import copy
import errno
import logging
import math
import os
import re
import shutil
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
)
from hydra.types import RunMode
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from rich.console import Console
from rich.logging import RichHandler

import brokk_rl
from brokk_rl import distributed, extensions, extras, gpu_pool, registry
from brokk_rl.errors import BrokkError, ConfigError, list_choices
from brokk_rl.mode_help import describe_mode
from brokk_rl.session import read_earlier_job, remove_empty_folders
from brokk_rl.sweep import SweepFolder, name_job
from brokk_rl.task_choice import choose_task

log = logging.getLogger(__name__)


CHECKED_FIRST = (
    "session machine sim task rl evaluation tracking excitation collect identify play bench subject "
    "diagnosis compare convert log inspect observe perceive render label twin study"
)
"""Nodes whose specs are checked before the mode is imported, and torch with it: their modules do
without."""


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
    # A run that a scheduler stops ends like one that is stopped by hand.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with _make_hydra_raise():
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
    """Instantiate the mode and run it, within its session where it has one."""
    sweep = HydraConfig.get().mode is RunMode.MULTIRUN
    cfg = _upgrade(cfg)
    check_values(cfg)
    cfg = _drop_consumed_groups(choose_task(cfg))
    if "session" not in cfg:
        distributed.check_together(get_class(str(cfg._target_)), sweep)
        return instantiate(cfg, _convert_="all").run()
    folder, resolved = choose_run_folder(cfg), _format_resolved(cfg)
    try:
        before = read_earlier_job(folder, resolved) if sweep else None
        if before and before.get("outcome") == "finished":
            log.info("job %s is done already: %s", HydraConfig.get().job.num, folder)
            return before.get("objective")
        again = {"resume": str(folder)} if before and "resume" in cfg and cfg.resume is None else {}
        mode = instantiate(cfg, session={"out": str(folder)}, **again, _convert_="all")
        distributed.check_together(type(mode), sweep)
        resume = bool(before or getattr(mode, "resume", None))
        with mode.session.start(resolved, _collect_facts(cfg, mode), resume) as record:
            objective = mode.run()
            record.fields["objective"] = (
                objective if objective is not None and math.isfinite(objective) else None
            )
            return objective
    except Exception:
        if sweep:
            # Hydra made these folders, in several levels where an override holds a path. A folder
            # into which a job has written stays.
            remove_empty_folders([folder, *folder.parents])
        raise


def check_values(cfg: DictConfig) -> None:
    """Build the specs that need no torch, so that their bad values are refused within a second.

    Raises:
        ConfigError: A value is bad, or one that must be given is not.
    """
    if missing := OmegaConf.missing_keys(cfg) - {"session.out"}:
        raise ConfigError(_explain_missing_value(min(missing)))
    cfg = copy.deepcopy(cfg)  # a node that takes in another one resolves that one in its place
    for name in CHECKED_FIRST.split():
        node = OmegaConf.select(cfg, name, throw_on_missing=False)
        if not isinstance(node, DictConfig):
            continue
        given = {"out": "."} if name == "session" else {}  # the command chooses the folder itself
        instantiate(node, **given, _convert_="all")


def _is_first_process() -> bool:
    """Return true for the process that reports to the user: the first one."""
    try:
        return distributed.read_rank().first
    except ConfigError:
        return True


def _upgrade(cfg: DictConfig) -> DictConfig:
    """Return the configuration in current terms, as `resolved.yaml` of an older run needs it."""
    text = registry.rename_targets(OmegaConf.to_yaml(cfg))
    content: Any = OmegaConf.to_container(OmegaConf.create(text))
    registry.upgrade_fields(content)
    return cfg if content == OmegaConf.to_container(cfg) else DictConfig(content)


def _drop_consumed_groups(cfg: DictConfig) -> DictConfig:
    """Return the configuration without groups that only another node uses (`actuator: ${actuator}`).

    An option can thus bring groups of its own: `link=simulated` brings the actuator that it
    simulates, which is chosen like any other.
    """
    taken = set()
    for name in re.findall(r"\$\{(\w+)\}", OmegaConf.to_yaml(cfg)):
        if name in cfg:
            taken.add(name)
    if not taken:
        return cfg
    taken -= set(getattr(get_class(str(cfg._target_)), "__dataclass_fields__", ()))
    whole = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(whole, dict)
    return OmegaConf.create({key: value for key, value in whole.items() if key not in taken})


def _collect_facts(cfg: DictConfig, mode: Any) -> dict[str, Any]:
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
    facts: dict[str, Any] = {
        "mode": _read_mode_name(cfg),
        "choices": chosen,
        "overrides": overrides,
    }
    if machine := getattr(mode, "machine", None):
        facts |= {"machine": machine.name, "fingerprint": machine.fingerprint()}
    return facts


def choose_run_folder(cfg: DictConfig) -> Path:
    """Return the run folder: that of a sweep's job, else `session.out`, else a new one in `runs`."""
    settings = HydraConfig.get()
    if settings.mode is RunMode.MULTIRUN:
        fixed = settings.job.config.override_dirname.exclude_keys
        return Path(settings.sweep.dir) / name_job(
            int(settings.job.num), list(settings.overrides.task), list(fixed)
        )
    out = OmegaConf.select(cfg, "session.out", default=None)
    if out:
        return Path(out)
    name = settings.runtime.choices.get("experiment") or settings.runtime.choices.get("task")
    name = Path(name).stem if name else None  # An option may be a file: experiment=@<path>.
    stem = "_".join(
        filter(None, (f"{datetime.now():%Y-%m-%d_%H-%M-%S}", _read_mode_name(cfg), name))
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


def explain(error: BaseException) -> str | None:
    """Return the message for the user, `None` for a defect that needs its traceback."""
    chain = list(_iterate_causes(error))
    ours = next((e for e in chain if isinstance(e, BrokkError)), None)
    full = next((e for e in chain if isinstance(e, OSError) and e.errno == errno.ENOSPC), None)
    missing = next((e for e in chain if isinstance(e, MissingMandatoryValue)), None)
    if full:
        where = f" ({full.filename})" if full.filename else ""
        return f"the disk is full{where}. Free some space, or choose another disk with session.out=<folder>."
    # The class is torch's; its name is compared so that torch need not be imported.
    if any(type(e).__name__ == "OutOfMemoryError" for e in chain):
        return f"the memory of the GPU is full: use fewer environments, or session.device=cpu ({error})"
    if ours:
        return f"{ours}{_locate_node(error)}"
    if missing:
        return _explain_missing_value(str(missing.full_key or missing))
    lacking = next((e for e in chain if isinstance(e, ModuleNotFoundError) and e.name), None)
    if lacking and (text := _explain_missing_module(lacking, chain)):
        return text
    if isinstance(error, MissingConfigException):
        return _explain_missing_option(error)
    if isinstance(error, InstantiationException):
        return _explain_bad_node(error)
    if isinstance(error, ConfigCompositionException):
        return _explain_bad_override(error)
    if isinstance(error, (HydraException, OmegaConfBaseException)) or str(error).startswith(
        "Config group override must"
    ):
        text = str(error)
        if "override_grammar" in text:
            text += '\nQuote words with brackets, braces or colons: \'log.joints={hip: ["tau[0]", "q[0]"]}\''
        return text
    return None


def _explain_missing_value(key: str) -> str:
    if "[" in key:  # an item of a list cannot be overridden
        return f"{key} has no value: fill in ??? in its file"
    return f"{key} has no default and must be given: {key}=<value>"


def _iterate_causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _explain_missing_module(lacking: ModuleNotFoundError, chain: list[BaseException]) -> str | None:
    """Explain a package that is not installed; `None` where no extra brings it."""
    for error in chain:
        # Hydra names the target that it could not load, in one of two ways.
        target = re.search(r"(?:target|loading) '([\w.]+)'", str(error))
        if target:
            return extras.explain_missing_module(str(lacking.name), target[1])
    return extras.explain_missing_module(str(lacking.name), "this run")


def _explain_missing_option(error: MissingConfigException) -> str:
    group, _, name = str(error.missing_cfg_file).rpartition("/")
    if not group:
        return str(error).split("\nConfig search path")[0]
    if group in ("hydra/sweeper", "hydra/sweeper/sampler"):
        return f"{group}={name} is not installed; Optuna comes with the extra: pip install 'brokk-rl[optuna]'"
    # Hydra lists none where a list of options was given.
    offered = error.options or [
        option.name for option in registry.list_options() if option.group == group
    ]
    if not offered:
        return f"there is no option '{name}' of '{group}', nor any other; `brokk mode=list` prints what there is"
    return f"there is no {group}={name}; {list_choices(name, offered)}"


def _explain_bad_node(error: InstantiationException) -> str:
    """Explain a node that cannot be built: an unknown field, a missing field, a missing target."""
    cause = error.__cause__
    called = re.search(r"call to target '([\w.]+)'", str(error))
    if called and isinstance(cause, TypeError):
        known = list(getattr(get_class(called[1]), "__dataclass_fields__", ()))
        name = called[1].rpartition(".")[2]
        if unknown := re.search(r"unexpected keyword argument '(\w+)'", str(cause)):
            place = re.search(r"full_key: (\S+)", str(error))
            key = f"{place[1]}.{unknown[1]}" if place else unknown[1]
            if renamed := registry.find_renamed_field(key):
                return f"{name} has no field '{unknown[1]}': '{renamed[0]}' is now '{renamed[1]}'"
            return f"{name} has no field '{unknown[1]}'; {list_choices(unknown[1], known)}{_locate_node(error)}"
        if lacking := re.search(r"missing \d+ required keyword-only arguments?: (.+)", str(cause)):
            return f"{name} lacks {lacking[1]}{_locate_node(error)}"
    return str(error)


def _locate_node(error: BaseException) -> str:
    """Return the end of a message: the place in the configuration that could not be built."""
    found = (
        re.search(r"full_key: (\S+)", str(error))
        if isinstance(error, InstantiationException)
        else None
    )
    return f" (in '{found[1]}': change {found[1]}.<field>=… or its file)" if found else ""


def _explain_bad_override(error: ConfigCompositionException) -> str:
    """Explain an override of a key that the configuration does not have."""
    text = str(error)
    found = re.search(r"(?:In '([^']+)': )?Could not override '([^']+)'", text)
    if not found:
        text = "\n".join(filter(None, (text, str(error.__cause__ or ""))))
        if mixed := re.search(
            r"override ([\w.]+)=.*Cannot merge (?:Dict|List)Config with (?:Dict|List)Config",
            text,
            re.DOTALL,
        ):
            return (
                f"{mixed[1]} holds a list and you gave a table, or the reverse; Hydra puts neither in the place of the other. Take "
                f"the old value away, '~{mixed[1]}' '+{mixed[1]}=…', or give the option as a file, <group>=@<path>."
            )
        return text
    where, key = found[1], found[2].split("@")[0]
    source = f"{where} changes" if where and where != "config" else "you gave"
    if renamed := registry.find_renamed_field(key):
        return f"{source} '{key}', but '{renamed[0]}' is now '{renamed[1]}'"
    # The mode itself may not compose; the message is then shorter.
    with contextlib.suppress(Exception):
        cfg = _compose_choices()
        if "No match in the defaults list" in text or key in {
            option.group for option in registry.list_options()
        }:
            groups = []
            for k in cfg.hydra.runtime.choices:
                if not str(k).startswith("hydra"):
                    groups.append(str(k))
            return f"{source} '{key}', but mode={_read_mode_name(cfg)} does not use such a group; {list_choices(key, groups)}"
        parent, _, leaf = key.rpartition(".")
        while (node := OmegaConf.select(cfg, parent, default=None) if parent else cfg) is None:
            parent, _, leaf = parent.rpartition(".")
        names = (
            [str(k) for k in node if str(k) not in ("hydra", "_target_")]
            if isinstance(node, DictConfig)
            else []
        )
        return f"{source} '{key}', but '{parent or f'mode={_read_mode_name(cfg)}'}' has no '{leaf}'; {list_choices(leaf, names)}"
    return f"{source} '{key}', which this mode does not have; `brokk mode=<mode> --cfg job` shows what it has"


def _is_mode_help(arguments: Sequence[str]) -> bool:
    """Return true where the help of one mode is asked for, not that of the command."""
    asked = "--help" in arguments or "-h" in arguments
    return asked and any(argument.startswith("mode=") for argument in arguments)


def _describe_chosen_mode() -> str:
    """Return the help of the mode of the command line, with the options chosen there."""
    cfg = _compose_choices()
    own = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    choices, node = map(OmegaConf.to_container, (cfg.hydra.runtime.choices, own))
    assert isinstance(choices, dict) and isinstance(node, dict)
    return describe_mode(
        {str(key): value for key, value in choices.items()},
        {str(key): value for key, value in node.items()},
        shutil.get_terminal_size().columns,
    )


def _compose_choices() -> DictConfig:
    """Compose the options that the command line chooses, without its values.

    Of a sweep's options the first is taken. Options that do not compose are left out, up to the
    mode: the message of an error then lists what the mode has by itself.
    """
    groups = {option.group for option in registry.list_options()}
    chosen: list[str] = []
    for override in OverridesParser.create().parse_overrides(
        [argument for argument in sys.argv[1:] if "=" in argument and argument[0] != "-"]
    ):
        if override.key_or_group not in groups:
            continue
        line = str(override.input_line)
        if override.is_sweep_override():
            line = f"{line.partition('=')[0]}={next(iter(override.sweep_string_iterator()))}"
        chosen.append(line)
    modes = [line for line in chosen if line.startswith("mode=")]
    with hydra.initialize_config_module("conf", version_base="1.3"):
        try:
            return hydra.compose("config", overrides=chosen, return_hydra_config=True)
        except (HydraException, OmegaConfBaseException):
            return hydra.compose("config", overrides=modes[-1:], return_hydra_config=True)


def _read_mode_name(cfg: DictConfig) -> str:
    return str(cfg._target_).split(".")[-2]


def _format_resolved(cfg: DictConfig) -> str:
    """Return the text of `resolved.yaml`, which runs again in a new folder."""
    values = OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))
    values.session.out = "???"
    settings = {"defaults": [{"hydra": "brokk"}, "_self_"]}
    return (
        "# Runs again: brokk --config-dir <this folder> --config-name resolved\n"
        + OmegaConf.to_yaml(OmegaConf.merge(settings, values))
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
