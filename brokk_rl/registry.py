"""Registries: the options of each config group, of this package and of installed extensions.

A registry is a folder of YAML files. Nothing here imports the target of an option. Its summary is
the first comment of its file. Listing is therefore cheap, and a broken option can be listed too.
"""

from __future__ import annotations

import ast
import functools
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata, resources, util
from itertools import takewhile
from pathlib import Path
from typing import Any

from brokk_rl.errors import ConfigError

ENTRY_POINTS = "brokk_rl.conf"
CORE = "conf"
SETTINGS = ("hydra",)
"""Groups that hold settings of Hydra and are no registries."""


@dataclass(frozen=True)
class Option:
    """One option of a config group.

    Attributes:
        group: Config group, `task`, `actuator`, …
        name: Name of the option, as in `group=name`.
        package: Import name of the config package that offers it.
        path: Its file.
    """

    group: str
    name: str
    package: str
    path: Path

    def summary(self) -> str:
        """Return the first sentence of the file's comment."""
        return re.split(r"(?<=\.) ", self.comment())[0]

    def comment(self) -> str:
        """Return the whole comment at the top of the file, in one line."""
        head = takewhile(lambda line: line[:1] == "#", self.path.read_text().splitlines())
        lines = [line.strip("# ") for line in head]
        return " ".join(line for line in lines if not line.startswith("@package")).strip()

    @property
    def target(self) -> str | None:
        """Class that its file names; `None` where it holds several, or values alone."""
        return _find_word(r"^_target_: *([\w.]+)", self.path.read_text())

    @property
    def place(self) -> str | None:
        """Place in the configuration that its file states; `None` for that of its group."""
        return find_place(self.path.read_text())


def find_place(text: str) -> str | None:
    """Return the place in the configuration that the text of an option file states."""
    return _find_word(r"^#\s*@package\s+(\S+)", text)


def _find_word(pattern: str, text: str) -> str | None:
    found = re.search(pattern, text, re.MULTILINE)
    return found[1] if found else None


def find_packages() -> dict[str, Path]:
    """Return the folder of each config package: this one first, then installed extensions.

    Raises:
        ConfigError: An extension names a package that cannot be found.
    """
    return dict(_find_packages(tuple(sys.path)))


@functools.cache  # the metadata of all that is installed takes 8 ms to read
def _find_packages(paths: tuple[str, ...]) -> dict[str, Path]:
    """Return the packages that can be imported from these paths."""
    found = {CORE: _find_folder(CORE, "brokk_rl")}
    for point in sorted(metadata.entry_points(group=ENTRY_POINTS), key=lambda point: point.name):
        found[point.value] = _find_folder(
            point.value, f"entry point '{point.name}' of {ENTRY_POINTS}"
        )
    return found


def list_options(only: str | None = None) -> list[Option]:
    """Return every option of every group, or of one group, sorted by group and name."""
    found = []
    for package, folder in find_packages().items():
        for path in sorted(folder.rglob("*.yaml")):
            group = path.parent.relative_to(folder).as_posix()
            if group != "." and group.split("/")[0] not in SETTINGS and only in (None, group):
                found.append(Option(group, path.stem, package, path))
    return sorted(found, key=lambda option: (option.group, option.name))


def read_mode_name(cfg: Mapping[Any, Any]) -> str:
    """Return the mode that a composed configuration runs."""
    return str(cfg["run"]).split(".")[-2]


def list_targets() -> frozenset[str]:
    """Return every class that the file of an option names."""
    return _read_targets(tuple(list_options()))


@functools.cache
def _read_targets(options: tuple[Option, ...]) -> frozenset[str]:
    text = "\n".join(option.path.read_text() for option in options)
    return frozenset(re.findall(r"_target_['\"]?:\s*['\"]?([\w.]+)", text))


def resolve_package_path(name: str) -> Path:
    """Return the path of a file or folder: a path, or `package:path` in an installed package.

    Raises:
        ConfigError: There is no such package.
    """
    package, colon, inside = name.partition(":")
    if not colon or Path(name).exists():
        return Path(name)
    try:
        return Path(str(resources.files(package))) / inside
    except (ModuleNotFoundError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{name}: there is no package '{package}' ({error}); give a path, or package:path"
        ) from error


def iterate_leaves(node: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield each leaf with the keys that lead to it; items of a list have the keys of their list."""
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from iterate_leaves(value, (*place, str(key)))
    elif isinstance(node, list) and node:
        for value in node:
            yield from iterate_leaves(value, place)
    else:
        yield place, node


def _find_folder(package: str, who: str) -> Path:
    try:
        place = util.find_spec(package)
    except ModuleNotFoundError:
        place = None
    if place is None or not place.submodule_search_locations:
        raise ConfigError(
            f"{who}: no package '{package}' with config folders; install it again or uninstall it"
        )
    return Path(next(iter(place.submodule_search_locations)))


def read_attributes(target: str) -> dict[str, str]:
    """Return the meaning of each field under `Attributes:` in the docstring of the class `target`."""
    _, _, section = _read_docstring(target).partition("\nAttributes:\n")
    found = {}
    for entry in re.split(r"\n(?= {4}\S)", "\n" + section.split("\n\n")[0]):
        name, colon, text = entry.strip().partition(":")
        if colon and name.isidentifier():
            found[name] = " ".join(text.split())
    return found


def _read_docstring(target: str) -> str:
    """Return the docstring of the class or function `target` from its source, or an empty string.

    The module is not imported.
    """
    module, _, name = str(target).rpartition(".")
    try:
        place = util.find_spec(module)
    except (ImportError, ValueError):
        return ""
    if place is None or not str(place.origin).endswith(".py"):
        return ""
    for node in ast.parse(Path(str(place.origin)).read_text()).body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name:
            return ast.get_docstring(node) or ""
    return ""
