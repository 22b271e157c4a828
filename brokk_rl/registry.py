"""The registries: which options each config group has, ours and those of installed extensions.

A registry is a folder of YAML files. Nothing here imports what an option stands for: the line that
describes an option is read from the source of its spec, so that listing costs nothing and a broken
option can be listed too.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path

import yaml

from brokk_rl.errors import ConfigError

ENTRY_POINTS = "brokk_rl.conf"
CORE = "conf"
SETTINGS = ("hydra",)
"""Groups of Hydra's own settings: no registry of ours."""
SAME_SPEC = ("machine", "rig", "scene", "session")
"""Groups whose options differ in their numbers only, so that the spec says nothing about one of
them."""


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
        """Returns one line about the option: of its spec, or the comment on top where the spec says nothing about it."""
        text = self.path.read_text()
        target = (yaml.safe_load(text) or {}).get("_target_")
        shared = self.group in SAME_SPEC
        return (_read_docstring_line(target) if target and not shared else "") or _read_comment(
            text
        )


def find_packages() -> dict[str, Path]:
    """Returns the folder of each config package: ours first, then those of installed extensions by entry point.

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
    """Returns every option of every group, sorted by group and name.

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


def _read_docstring_line(target: str) -> str:
    """Returns the first line of the docstring of the class or function `target`, '' where it cannot be found."""
    module, _, name = str(target).rpartition(".")
    try:
        place = util.find_spec(module)
    except (ImportError, ValueError):
        return ""
    if place is None or not place.origin:
        return ""
    for node in ast.parse(Path(place.origin).read_text()).body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name == name:
            return (ast.get_docstring(node) or "").split("\n")[0]
    return ""


def _read_comment(text: str) -> str:
    """Returns the first sentence of the comment on top of a file, '' where there is none."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if not line.lstrip("# ").startswith("@package"):
            lines.append(line.lstrip("#").strip())
    return re.split(r"(?<=\.) ", " ".join(lines).strip())[0]
