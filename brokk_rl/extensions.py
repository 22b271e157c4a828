"""Options of other packages, and single option files named on the command line.

A package offers options by one entry point, `[project.entry-points."brokk_rl.conf"] mine =
"mine.conf"`. A file is one option of a group by `group=@<path>`; it lies in Hydra's own store under
that name, so lists, sweeps and launchers treat it as any other option. Importing this module has no
effect; the command calls `register_options`.
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from brokk_rl import registry
from brokk_rl.arguments import ROBOT_FILES, explain_robot, list_names, parse_words
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.explain import explain_missing_value
from brokk_rl.plain_files import read_plain_file

MOST_BYTES = 1 << 20
"""Size beyond which a file holds no option."""
MOST_VALUES = 20_000
"""Values of a file with its aliases written out: the largest that the commands write has some hundred."""
EVERYWHERE = "_global_"
"""Package of options that may change any part of the configuration, such as experiments."""


class Extensions(SearchPathPlugin):
    """Search path plugin that appends the config package of every installed extension."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the packages; Hydra calls this while it builds its search path."""
        for package in registry.find_packages():
            if package != registry.CORE:
                search_path.append(provider=package, path=f"pkg://{package}")


def register_options(arguments: Sequence[str]) -> None:
    """Make Hydra know the options of extensions and the option files in `arguments`.

    Raises:
        ConfigError: A file is invalid, or several packages offer an option.
    """
    groups = {option.group for option in registry.list_options()}
    Plugins.instance().register(Extensions)
    for override in parse_words(arguments):
        group, names = override.key_or_group, list_names(override)
        if group in groups:
            twice = [name for name in names if names.count(name) > 1]
            if twice and isinstance(override.value(), list):
                raise ConfigError(f"{group}: the list names '{twice[0]}' twice; name it once")
            refuse_ambiguous({group: ",".join(names)})
            for name in names:
                if name.startswith("@"):
                    store_option(group, name, *_read(group, name[1:]))


def store_option(group: str, name: str, node: Any, package: str | None = None) -> None:
    """Put an option into Hydra's store; a name with slashes is one, as that of a path."""
    *folders, stem = [part for part in name.split("/") if part]
    ConfigStore.instance().store(stem, node, "/".join([group, *folders]), package, "brokk")


def refuse_ambiguous(choices: Mapping[str, Any]) -> None:
    """Refuse options that several extensions offer by one name: Hydra would take the first.

    Args:
        choices: Option, or options with commas between, by group, with or without `@package`.
    """
    options = registry.list_options()
    for key, value in choices.items():
        group = key.partition("@")[0]
        for name in re.split(r"[\[\],]", str(value)):
            offered = [one for one in options if (one.group, one.name) == (group, name)]
            if len(offered) > 1 and registry.CORE not in {one.package for one in offered}:
                files = " or ".join(f"{key}=@{one.path}" for one in offered)
                raise ConfigError(f"{key}={value}: several packages offer '{name}'; give {files}")


def load_option(group: str, name: str, **fields: object) -> Any:
    """Return the spec of one option, for tests and notebooks: `load_option("machine", "brokk170")`.

    Args:
        group: Config group.
        name: Name of the option, of this package or of an installed extension; or `@<path>` of a file.
        fields: Values that replace those of its file.

    Raises:
        ConfigError: There is no such option or file, or it is not valid.
    """
    register_options([f"{group}='{name}'"])
    known = {option.name for option in registry.list_options(group)}
    if not name.startswith("@") and name not in known:
        raise ConfigError(f"there is no {group}={name}; {list_choices(name, known)}")
    changes = [f"subject.{field}={value}" for field, value in fields.items()]
    words = ["~mode", f"+{group}@subject='{name}'", *changes]
    return _build(_compose("config", words).subject, group)


def load_part(name: str) -> Any:
    """Return the spec of a part that has no other options, of `conf/<name>.yaml`.

    Raises:
        ConfigError: A value is refused.
    """
    return _build(_compose(name, ()), name)


def load_mode(*words: str) -> Any:
    """Return the mode of a command, for tests and programs: `load_mode("mode=evaluate", "sim=native")`.

    Args:
        words: Arguments of the command, `session.out=<folder>` among them.

    Raises:
        ConfigError: A value is refused, or one that must be given is not.
    """
    from brokk_rl.build import build_mode

    register_options(words)
    return build_mode(*read_values(_compose("config", words)))


def _compose(name: str, words: Sequence[str]) -> DictConfig:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return hydra.compose(name, overrides=list(words))


def _build(node: DictConfig, place: str) -> Any:
    from brokk_rl.build import build_node  # the command composes without it

    return build_node(OmegaConf.to_container(node, resolve=True), place)


def read_values(cfg: DictConfig) -> tuple[dict[str, Any], set[str]]:
    """Return the configuration as plain data, and the nodes that others take in.

    An option can thus bring groups of its own: `link=simulated` holds `actuator: ${actuator}`, the
    actuator that it simulates, which is chosen like any other.

    Raises:
        ConfigError: A value that must be given is not, or no class of a mode is named.
    """
    if "run" not in cfg:
        raise ConfigError("there is no mode to run: expected run: <module>.<class> in its YAML")
    if missing := OmegaConf.missing_keys(cfg) - {"session.out"}:
        raise ConfigError(explain_missing_value(min(missing)))
    shared = set[str]()
    for _, value in registry.iterate_leaves(OmegaConf.to_container(cfg)):
        shared |= {name for name in re.findall(r"\$\{(\w+)[.}]", str(value)) if name in cfg}
    values: Any = OmegaConf.to_container(cfg, resolve=True)
    return values, shared


def _read(group: str, name: str) -> tuple[dict[str, Any], str | None]:
    """Return the content of an option file and its package, `None` for the package of its group.

    A file may come from somebody else, so it holds plain values only. Each `_target_` must be one
    that a registered option has, and nothing in the file is resolved.
    """
    where = f"{group}=@{name}"
    if name.endswith(ROBOT_FILES):
        raise ConfigError(f"{where}: expected a YAML file; {explain_robot(name)}")
    try:
        text = read_plain_file(Path(name).expanduser(), MOST_BYTES).decode()
        # aliases are written out one by one, so that a file of millions is refused soon
        plain = yaml.load(text, Loader=yaml.BaseLoader)
        values = itertools.islice(registry.iterate_leaves(plain), MOST_VALUES + 1)
        if sum(1 for _ in values) > MOST_VALUES:
            raise ValueError(f"expected at most {MOST_VALUES} values, aliases written out")
        loaded = OmegaConf.create(text)
    except (OSError, yaml.YAMLError, OmegaConfBaseException, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{where}: no plain YAML (seen from {Path.cwd()}): {reason}") from error
    node = OmegaConf.to_container(loaded, resolve=False) if isinstance(loaded, DictConfig) else None
    if not isinstance(node, dict) or not node:
        raise ConfigError(f"{where}: expected a mapping, as in a file of conf/{group}")
    for place, value in registry.iterate_leaves(node):
        _check_plain(where, place, value)
    beside = Path(name).expanduser().parent / str(node.get("mjcf"))
    if group == "machine" and beside.is_file():
        node["mjcf"] = str(beside.resolve())
    packages = {one.target or one.name: one.place for one in registry.list_options(group)}
    package = _find_package(where, group, text, node, packages)
    targets = registry.list_targets()
    module = str(node.get("_target_")).rpartition(".")[0]
    for place, target in registry.iterate_leaves(node):
        if place[-1] != "_target_":
            continue
        # the option itself, or those of a file that holds several by name
        itself = package != EVERYWHERE and len(place) == (1 if "_target_" in node else 2)
        known = packages.keys() if itself else targets
        # a part's class lies beside that of the option, and its annotation names it
        is_part = not itself and str(target).rpartition(".")[0] == module
        if target not in known and not is_part:
            kind = f"no {group}" if itself else "nothing of ours"
            raise ConfigError(
                f"{where}: '{'.'.join(place)}: {target}' is {kind}; {list_choices(str(target), known)}"
            )
    from brokk_rl.build import drop_targets  # the command composes without it

    return {str(key): value for key, value in drop_targets(node, targets).items()}, package


def _check_plain(where: str, place: tuple[str, ...], value: Any) -> None:
    """Refuse interpolations and Hydra settings, which only registered options may hold."""
    words = [word for word in (*place, value) if isinstance(word, str)]
    is_setting = any(key.startswith("_") and key != "_target_" for key in place)
    is_setting |= "hydra" in place or (place[0] == "defaults" and "hydra/" in " ".join(words))
    if is_setting or any("${" in word for word in words):
        raise ConfigError(
            f"{where}: '{'.'.join(place)}: {value}': a file given by @ holds plain values, without "
            "interpolations and settings of Hydra"
        )


def _find_package(
    where: str, group: str, text: str, node: dict[Any, Any], packages: dict[str, str | None]
) -> str | None:
    """Return the config package of a file: as stated, else that of an option with its target."""
    used = set(packages.values())
    if stated := registry.find_place(text):
        if stated not in used | {group, "_group_"} and not stated.startswith(f"{group}."):
            raise ConfigError(
                f"{where}: '# @package {stated}' lies outside '{group}'; leave that line out"
            )
        return stated
    if "_target_" in node:
        return packages.get(str(node["_target_"]))
    named = [place[-1] for place, _ in registry.iterate_leaves(node)]
    classes = [name for name in packages if "." in name]
    if classes and not {"_target_", "defaults"} & {*named, *node}:
        raise ConfigError(f"{where}: expected _target_: <class>; {list_choices('', classes)}")
    return EVERYWHERE if EVERYWHERE in used else None
