"""Explanations of errors: what was expected, what came, and which argument changes it."""

from __future__ import annotations

import contextlib
import errno
import re
import sys
from collections.abc import Iterator

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    InstantiationException,
    MissingConfigException,
)
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from brokk_rl import extras, registry
from brokk_rl.errors import BrokkError, list_choices


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
        return explain_missing_value(str(missing.full_key or missing))
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


def explain_missing_value(key: str) -> str:
    """Return the message about a value that must be given."""
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
        cfg = compose_choices()
        if "No match in the defaults list" in text or key in {
            option.group for option in registry.list_options()
        }:
            groups = []
            for k in cfg.hydra.runtime.choices:
                if not str(k).startswith("hydra"):
                    groups.append(str(k))
            return f"{source} '{key}', but mode={read_mode_name(cfg)} does not use such a group; {list_choices(key, groups)}"
        parent, _, leaf = key.rpartition(".")
        while (node := OmegaConf.select(cfg, parent, default=None) if parent else cfg) is None:
            parent, _, leaf = parent.rpartition(".")
        names = (
            [str(k) for k in node if str(k) not in ("hydra", "_target_")]
            if isinstance(node, DictConfig)
            else []
        )
        return f"{source} '{key}', but '{parent or f'mode={read_mode_name(cfg)}'}' has no '{leaf}'; {list_choices(leaf, names)}"
    return f"{source} '{key}', which this mode does not have; `brokk mode=<mode> --cfg job` shows what it has"


def compose_choices() -> DictConfig:
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


def read_mode_name(cfg: DictConfig) -> str:
    """Return the mode that a composed configuration runs."""
    return str(cfg._target_).split(".")[-2]
