"""Registries: the options of each config group, of this package and of installed extensions.

A registry is a folder of YAML files. Nothing here imports the target of an option. Its summary is
the first comment of its file, else the first docstring line in the source of its target. Listing
is therefore cheap, and a broken option can be listed too.
"""

from __future__ import annotations

import ast
import copy
import inspect
import json
import re
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata, resources, util
from pathlib import Path
from typing import Any

import yaml

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
        """Return the first sentence of the file's comment, else the first line of its target."""
        text = self.path.read_text()
        target = (yaml.safe_load(text) or {}).get("_target_")
        comment = re.split(r"(?<=\.) ", _read_comment(text))[0]
        return comment or (_read_docstring(target).split("\n")[0] if target else "")

    def comment(self) -> str:
        """Return the whole comment at the top of the file, in one line."""
        return _read_comment(self.path.read_text())


def find_packages() -> dict[str, Path]:
    """Return the folder of each config package: this one first, then installed extensions.

    Raises:
        ConfigError: An extension names a package that cannot be found.
    """
    found = {CORE: _find_folder(CORE, "brokk_rl")}
    for point in sorted(metadata.entry_points(group=ENTRY_POINTS), key=lambda point: point.name):
        found[point.value] = _find_folder(
            point.value, f"entry point '{point.name}' of {ENTRY_POINTS}"
        )
    return found


def list_options() -> list[Option]:
    """Return every option of every group, sorted by group and name.

    Raises:
        ConfigError: Two packages offer the same option.
    """
    found: dict[tuple[str, str], Option] = {}
    for package, folder in find_packages().items():
        for path in sorted(folder.rglob("*.yaml")):
            group, name = path.parent.relative_to(folder).as_posix(), path.stem
            if group == "." or group.split("/")[0] in SETTINGS:
                continue
            if other := found.get((group, name)):
                raise ConfigError(
                    f"{group}={name} is offered twice, by {other.package} ({other.path}) and by {package} ({path}): rename one"
                )
            found[group, name] = Option(group, name, package, path)
    return [found[key] for key in sorted(found)]


def list_targets() -> frozenset[str]:
    """Return every class that the file of an option names."""
    found: set[str] = set()
    for option in list_options():
        found.update(re.findall(r"_target_['\"]?:\s*['\"]?([\w.]+)", option.path.read_text()))
    return frozenset(found)


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


@lru_cache
def load_renamed_targets() -> dict[str, str]:
    """Return the current target of each target that an earlier version had."""
    return json.loads((Path(__file__).parent / "renamed_targets.json").read_text())


@lru_cache
def load_renamed_fields() -> dict[str, str]:
    """Return the current name of each field and group of fields that an earlier version had."""
    return json.loads((Path(__file__).parent / "renamed_fields.json").read_text())


def find_renamed_field(key: str) -> tuple[str, str] | None:
    """Return the earlier and the current name of the longest renamed part at the head of `key`.

    `None` where no part of `key` was renamed.
    """
    renamed = load_renamed_fields()
    parts = key.split(".")
    for count in range(len(parts), 0, -1):
        head = ".".join(parts[:count])
        if head in renamed:
            return head, renamed[head]
    return None


def rename_targets(text: str) -> str:
    """Return YAML text with current targets, so that files of earlier versions still load."""
    renamed = load_renamed_targets()

    def rename(found: re.Match[str]) -> str:
        return found[1] + renamed.get(found[2], found[2])

    return re.sub(r"(_target_['\"]?:\s*['\"]?)([\w.]+)", rename, text)


def upgrade_fields(node: Any) -> None:
    """Write fields of earlier versions as the current ones, so that their `resolved.yaml` still runs.

    Changes the plain data `node` in place, at each `_target_` of `earlier_fields.json`: a field that
    the earlier version did not have gets the value by which it acted, and a field that moved is put
    to its new place. Where a true or false became a term, false switches the term off (`null`).
    """
    if isinstance(node, list):
        for value in node:
            upgrade_fields(value)
    if not isinstance(node, dict):
        return
    for value in node.values():
        upgrade_fields(value)
    for change in _load_earlier_fields():
        if node.get("_target_") not in change["targets"]:
            continue
        for name, value in change["added"].items():
            node.setdefault(name, copy.deepcopy(value))
        for name in change["moved"].keys() & node.keys():
            *path, last = change["moved"][name].split(".")
            place, value = node, node.pop(name)
            for part in path:
                place = place[part]
            if not isinstance(value, bool):
                place[last] = value
            elif not value:
                place[last] = None


@lru_cache
def _load_earlier_fields() -> list[dict[str, Any]]:
    return json.loads((Path(__file__).parent / "earlier_fields.json").read_text())


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
    _, _, section = inspect.cleandoc(_read_docstring(target)).partition("\nAttributes:\n")
    found = {}
    for entry in re.split(r"\n(?= {4}\S)", "\n" + section.split("\n\n")[0]):
        name, colon, text = entry.strip().partition(":")
        if colon and name.isidentifier():
            found[name] = " ".join(text.split())
    return found


def _read_docstring(target: str) -> str:
    """Return the docstring of the class or function `target` from its source, or an empty string."""
    module, _, name = str(target).rpartition(".")
    try:
        place = util.find_spec(module)
    except (ImportError, ValueError):
        return ""
    if place is None or not place.origin:
        return ""
    for node in ast.parse(Path(place.origin).read_text()).body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name:
            return ast.get_docstring(node) or ""
    return ""


def _read_comment(text: str) -> str:
    """Return the comment at the top of a file in one line, or an empty string."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if not line.lstrip("# ").startswith("@package"):
            lines.append(line.lstrip("#").strip())
    return " ".join(lines).strip()
