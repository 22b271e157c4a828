"""Options from elsewhere: config folders of other packages, and single files named on the command line.

A package offers options by one entry point, `[project.entry-points."brokk_rl.conf"] mine =
"mine.conf"`. A file is one option of a group by `group=@<path>`; it lies in Hydra's own store under
just that name, so lists, sweeps and launchers take it as any other. Importing this module does
nothing; the command calls `register`.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from brokk_rl import registry
from brokk_rl.errors import ConfigError, list_choices

GROUP = re.compile(r"\+{0,2}(?P<group>[\w/]+)(?:@[\w.:]*)?=(?P<value>.*)", re.DOTALL)
"""An override of a config group: group, package, value."""
FILE = re.compile(
    r"""(?:^|[\[,(])\s*(?:"@(?P<double>[^"]+)"|'@(?P<single>[^']+)'|@(?P<plain>[^,\])]+))"""
)
"""A file in the value of an override: alone, in a list, or among the choices of a sweep; quoted
where its name needs it."""
PACKAGE = re.compile(r"^#\s*@package\s+(\S+)", re.MULTILINE)
EVERYWHERE = "_global_"
"""Package of options that may change any part of the configuration, such as experiments."""


class Extensions(SearchPathPlugin):
    """Appends the config package of every installed extension."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Called by Hydra while it looks for the configuration."""
        for package in registry.find_packages():
            if package != registry.CORE:
                search_path.append(provider=package, path=f"pkg://{package}")


def register_options(arguments: Sequence[str]) -> None:
    """Makes the options of installed extensions, and the files that `arguments` name, known to Hydra.

    Raises:
        ConfigError: two packages offer the same option (Hydra itself would silently take the
            first), or a file cannot be used.
    """
    options = registry.list_options()
    Plugins.instance().register(Extensions)
    groups = {option.group for option in options}
    for argument in arguments:
        override = GROUP.fullmatch(argument)
        if override and override["group"] in groups:
            for found in FILE.finditer(override["value"]):
                _offer_file(
                    override["group"],
                    (found["double"] or found["single"] or found["plain"]).strip(),
                    options,
                )


def _offer_file(group: str, name: str, options: Sequence[registry.Option]) -> None:
    """Puts the file `name` into Hydra's store as the option `@<name>` of `group`."""
    node, package = _read(group, name, options)
    folder, _, stem = f"@{name}".rpartition("/")
    ConfigStore.instance().store(
        stem, node, "/".join(filter(None, (group, folder))), package, provider="file"
    )


def _read(
    group: str, name: str, options: Sequence[registry.Option]
) -> tuple[dict[str, Any], str | None]:
    """Returns what a file holds and its package, `None` for the group's own.

    A file may come from someone else. So it holds plain values: `_target_`s are ours or an
    extension's, as the options of the group have them, and nothing in it is resolved.
    """
    where = f"{group}=@{name}"
    try:
        text = Path(name).expanduser().read_text()
        loaded = OmegaConf.create(text)
    except FileNotFoundError as error:
        raise ConfigError(f"{where}: there is no such file (seen from {Path.cwd()})") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{where}: cannot be read as text ({getattr(error, 'strerror', None) or error})"
        ) from error
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f"line {error.problem_mark.line + 1}: "
        raise ConfigError(f"{where}: {line}no valid YAML ({error.problem})") from error
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        raise ConfigError(f"{where}: no valid YAML ({error})") from error
    node = OmegaConf.to_container(loaded, resolve=False) if isinstance(loaded, DictConfig) else None
    if not isinstance(node, dict) or not node:
        raise ConfigError(f"{where}: expected a mapping, as in a file of conf/{group}")
    for place, value in _iterate_leaves(node):
        _check_plain(where, place, value)
    mine = {
        str(shipped["_target_"]): package
        for shipped, package in _iterate_shipped(options, group)
        if "_target_" in shipped
    }
    ours = {
        str(target)
        for shipped, _ in _iterate_shipped(options)
        for place, target in _iterate_leaves(shipped)
        if place[-1] == "_target_"
    }
    package = _find_package(
        where, group, text, node, mine, {package for _, package in _iterate_shipped(options, group)}
    )
    for place, target in _iterate_leaves(node):
        if place[-1] == "_target_":
            # the option itself, or those of a file that holds several by name
            itself = package != EVERYWHERE and len(place) == (1 if "_target_" in node else 2)
            known = set(mine) if itself else ours
            if target not in known:
                kind = f"no {group}" if itself else "nothing of ours"
                raise ConfigError(
                    f"{where}: '{'.'.join(place)}: {target}' is {kind}; {list_choices(str(target), known)}"
                )
    return {str(key): value for key, value in node.items()}, package


def _check_plain(where: str, place: tuple[str, ...], value: Any) -> None:
    """Raises a `ConfigError` for what only our own files may say."""
    named = f"{where}: '{'.'.join(place)}'"
    for text in (*place, value):
        if isinstance(text, str) and "${" in text:
            raise ConfigError(
                f"{named} holds an interpolation, {text}; a file given by @ holds plain values"
            )
    if any(key.startswith("_") and key != "_target_" for key in place):
        raise ConfigError(
            f"{named} is a setting of Hydra's; a file given by @ has none but _target_"
        )
    if "hydra" in place or (
        place[0] == "defaults" and any("hydra/" in str(text) for text in (*place, value))
    ):
        raise ConfigError(f"{named} changes Hydra's own settings, which a file given by @ cannot")


def _find_package(
    where: str,
    group: str,
    text: str,
    node: dict[Any, Any],
    mine: dict[str, str | None],
    used: set[str | None],
) -> str | None:
    """Returns where in the configuration a file belongs: where it says, or where its like among the options does."""
    stated = PACKAGE.search(text)
    if stated:
        if stated[1] not in used | {group, "_group_"} and not stated[1].startswith(f"{group}."):
            raise ConfigError(
                f"{where}: '# @package {stated[1]}' lies outside '{group}'; leave that line out"
            )
        return stated[1]
    if "_target_" in node:
        return mine.get(str(node["_target_"]))
    return EVERYWHERE if used == {EVERYWHERE} else None


def _iterate_shipped(
    options: Sequence[registry.Option], group: str | None = None
) -> Iterator[tuple[dict[Any, Any], str | None]]:
    """Yields content and stated package of each option, of one group or of all."""
    for option in options:
        if group in (None, option.group):
            text = option.path.read_text()
            stated = PACKAGE.search(text)
            yield yaml.safe_load(text) or {}, stated[1] if stated else None


def _iterate_leaves(
    node: Any, place: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yields what is neither mapping nor list (or an empty one) with the keys that lead to it; list items have their list's."""
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from _iterate_leaves(value, (*place, str(key)))
    elif isinstance(node, list) and node:
        for value in node:
            yield from _iterate_leaves(value, place)
    else:
        yield place, node
