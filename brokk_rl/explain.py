"""Explanations of errors: what was expected, what came, and which argument changes it."""

from __future__ import annotations

import contextlib
import errno
import re
import sys
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path

import hydra
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    InterpolationResolutionError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from brokk_rl import registry
from brokk_rl.arguments import (
    ROBOT_FILES,
    explain_robot,
    is_given_whole,
    is_list_group,
    list_names,
    parse_words,
)
from brokk_rl.errors import BrokkError, list_choices

CLOSE = 0.85
"""Likeness of two names from which one is taken for the other misspelt. Chosen by hand: `recording`
is close to `recordings`, `max_iterations` is not to `iterations`."""
BLOCKED = (errno.EEXIST, errno.ENOTDIR, errno.EACCES, errno.EPERM, errno.EROFS)
"""Errors of a path at which nothing can be written."""
MISSING_SKIPPED = RunMode.MULTIRUN
"""Mode in which Hydra leaves out groups that must be given: the jobs of a sweep bring them."""


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
        return str(ours)
    if blocked := next((e for e in chain if isinstance(e, OSError) and e.errno in BLOCKED), None):
        return f"cannot use {blocked.filename}: {blocked.strerror}. Choose session.out=<folder>."
    if missing:
        return explain_missing_value(str(missing.full_key or missing))
    lacking = next((e for e in chain if isinstance(e, ModuleNotFoundError) and e.name), None)
    if lacking:
        from brokk_rl import extras  # its parts take a while to import

        if text := extras.explain_missing_module(str(lacking.name), "this run"):
            return text
    if isinstance(error, MissingConfigException):
        return _explain_missing_option(error)
    if isinstance(error, ConfigCompositionException):
        return _explain_bad_override(error)
    if isinstance(error, InterpolationResolutionError):
        return _explain_interpolation(error)
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark:
        mark = error.problem_mark
        return f"{mark.name}, line {mark.line + 1}: no valid YAML ({error.problem})"
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return str(error)
    return None


def explain_missing_value(key: str) -> str:
    """Return the message about a value that must be given."""
    if "[" in key:  # an item of a list cannot be overridden
        return f"{key} has no value: fill in ??? in its file"
    return f"{key} has no default and must be given: {key}=<value>"


def _explain_interpolation(error: InterpolationResolutionError) -> str:
    """Explain a value that is taken from where there is none."""
    key = error.full_key or "a value"
    reason = str(error).splitlines()[0]
    taken = re.search(r"key '(\w+)\.(\w+)' not found", reason)
    for override in parse_words(sys.argv[1:]):
        if taken and override.key_or_group == taken[1]:
            group, name = taken.groups()
            return (
                f"{key}: expected {group}=… with a value '{name}', but {override.input_line} has "
                f"none; brokk mode=list list.group={group} lists the others"
            )
    return f"{key}: {reason}. A text with a dollar sign before a brace is written \\${{…}}"


def _iterate_causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _explain_missing_option(error: MissingConfigException) -> str:
    place = str(error.missing_cfg_file)
    groups = {option.group for option in registry.list_options()} | {"hydra/sweeper"}
    above = [group for group in groups if place.startswith(f"{group}/")]
    if not above:
        return str(error).split("\nConfig search path")[0]
    group = max(above, key=len)
    name = place.removeprefix(f"{group}/")
    if name.endswith(ROBOT_FILES):
        return f"{group}={name}: expected an option or a YAML file; {explain_robot(name)}"
    if Path(name).is_file():
        return f"there is no {group}={name}; a file is given by its path after @: {group}=@{name}"
    if group.startswith("hydra/sweeper"):
        return f"{group}={name} is not installed; Optuna comes with the extra: pip install 'brokk-rl[optuna]'"
    # Hydra lists none where a list of options was given.
    offered = error.options or [option.name for option in registry.list_options(group)]
    return f"there is no {group}={name}; {_list_options(group, name, offered)}"


def _explain_bad_override(error: ConfigCompositionException) -> str:
    """Explain an override of a key that the configuration does not have."""
    text = str(error)
    if lacking := re.search(r"must specify '([^']+)'", text):
        names = [option.name for option in registry.list_options(lacking[1])]
        return f"{explain_missing_value(lacking[1])}; {_list_options(lacking[1], '', names)}"
    if twice := re.search(r"(\S+) appears more than once", text):
        return f"{twice[1]} is chosen already; another option is given without the '+': {twice[1]}=<option>"
    found = re.search(
        r"(?:In '(.+?)': )?Could not (?:override|delete(?: from config\.)?) '(.+?)'", text
    )
    if not found:
        text = "\n".join(filter(None, (text, str(error.__cause__ or ""))))
        if "Cannot merge" in text:
            text += (
                "\nA list and a table do not merge: take the old value away, '~<key>' '+<key>=…'"
            )
        return text
    where = found[1]
    key, at, place = found[2].partition("@")
    if at:
        return f"'{key}@{place}' is not chosen yet; add it by a plus: +{key}@{place}=<option>"
    if is_given_whole(sys.argv[1:]):
        return (
            f"'{key}': a configuration given by --config-name was composed already and has neither "
            "groups nor this value; leave it out, or give session.out=, policy=<path> and values "
            "that stand in the file"
        )
    source = f"{where} changes" if where and where != "config" else "you gave"
    # The mode itself may not compose; the message is then shorter.
    with contextlib.suppress(Exception):
        cfg = compose_choices()
        return f"{source} '{key}', but {_explain_absence(cfg, key)}"
    return f"{source} '{key}', which this mode does not have; `brokk mode=<mode> --help` lists what it has"


def _list_options(group: str, name: str, offered: Sequence[str]) -> str:
    """Return the end of a message about an option that there is not."""
    path = "; or the path of a run or policy folder, or of a checkpoint"
    return list_choices(name, offered) + path * (group == "policy")


def _explain_absence(cfg: DictConfig, key: str) -> str:
    """Return what a configuration has in the place of a key that it does not have."""
    mode = f"mode={cfg.hydra.runtime.choices['mode']}"
    groups = [str(group) for group in cfg.hydra.runtime.choices if str(group)[:5] != "hydra"]
    keys = sorted({*_list_keys(cfg), *groups}, key=lambda one: one.count("."))
    if fields := _list_inside(keys, key):
        return f"'{key}' is a table, whose values are given as {key}.<name>=…; {list_choices('', fields)}"
    for option in registry.list_options():
        place = f"{option.group}.{option.name}"
        if option.name == key and option.group in groups:
            return f"'{key}' is an option: {option.group}={key}"
        if f"{key}.".startswith(f"{place}.") and place not in keys:
            chosen = f"[{option.name}]" if is_list_group(option.group) else option.name
            return f"'{option.name}' is not chosen: add {option.group}={chosen}"
    parent, _, leaf = key.rpartition(".")
    while parent and parent not in keys:
        parent, _, leaf = parent.rpartition(".")
    lacks = f"'{parent or mode}' has no '{leaf}'"
    inside = _list_inside(keys, parent)
    typed = re.split("[./]", key)[-1].lower()
    by_name: dict[str, list[str]] = {}
    for one in keys:
        name = one.rpartition(".")[2]
        initials = "".join(word[:1] for word in name.split("_"))  # `lr` of `learning_rate`
        for word in (name, initials):
            by_name.setdefault(word, []).append(one)
    near = get_close_matches(typed, by_name, n=1, cutoff=CLOSE)
    if near and (typed in by_name or not get_close_matches(leaf, inside)):
        return f"{lacks}; did you mean {' or '.join(by_name[near[0]][:3])}?"
    return f"{lacks}; {list_choices(leaf, inside)}; `brokk {mode} --help` lists all values"


def _list_keys(cfg: DictConfig) -> set[str]:
    """Return the keys of all values and tables of a configuration, with dots between."""
    keys = set()
    for place, _ in registry.iterate_leaves(OmegaConf.to_container(cfg)):
        if place[0] not in ("hydra", "run"):
            keys.update(".".join(place[:end]) for end in range(1, len(place) + 1))
    return {key for key in keys if not key.endswith("_target_")}


def _list_inside(keys: Sequence[str], table: str) -> list[str]:
    """Return the names of what a table holds; the empty table is the whole."""
    return [key.rpartition(".")[2] for key in keys if key.rpartition(".")[0] == table]


def compose_choices() -> DictConfig:
    """Compose the options that the command line chooses, without its values.

    Options that do not compose are left out, up to the mode: the message of an error then lists
    what the mode has by itself.
    """
    chosen = list_chosen_options(sys.argv[1:])
    modes = [line for line in chosen if line.startswith("mode=")]
    with hydra.initialize_config_module("conf", version_base="1.3"):
        command = GlobalHydra.instance().hydra
        assert command is not None
        try:
            return command.compose_config("config", chosen, MISSING_SKIPPED, from_shell=False)
        except (HydraException, OmegaConfBaseException):
            return command.compose_config("config", modes[-1:], MISSING_SKIPPED, from_shell=False)


def list_sources() -> list[tuple[str, Path]]:
    """Return package and file of each option that the command line chooses, as they are composed."""
    files = {f"{option.group}/{option.name}": option.path for option in registry.list_options()}
    files |= {path.stem: path for path in registry.find_packages()[registry.CORE].glob("*.yaml")}
    found = []
    with hydra.initialize_config_module("conf", version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        chosen = list_chosen_options(sys.argv[1:])
        for entry in loader.compute_defaults_list("config", chosen, MISSING_SKIPPED).defaults:
            if path := files.get(str(entry.config_path)):
                found.append((entry.package or "", path))
    return found


def list_chosen_options(arguments: Sequence[str]) -> list[str]:
    """Return the arguments that choose options; of a sweep's options the first is taken."""
    groups = {option.group for option in registry.list_options()}
    chosen: list[str] = []
    for override in parse_words(arguments):
        names = list_names(override)
        if override.key_or_group.split("@")[0] not in groups or not names:
            continue
        line = str(override.input_line)
        if override.is_sweep_override():
            line = f"{line.partition('=')[0]}={next(iter(override.sweep_string_iterator()))}"
        chosen.append(line)
    return chosen
