"""Each key, mode and option that a message tells its reader to type exists."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import hydra
import yaml
from composed import names
from omegaconf import DictConfig

from brokk_rl import registry

ROOT = Path(__file__).parents[2]
ROOMS = ("brokk_rl", "tasks", "actuators", "perception", "deploy", "diagnosis", "exam", "study")
KEY = re.compile(r"(?<![\w.@/{])((?:[a-z_]+\.)+[a-z_]+)=(?!=)")
OPTION = re.compile(r"(?<![\w.@/{<])([a-z_]+)=([a-z]\w*)\b(?!=|[.:(])")
NEEDS_POLICY = ("doctor_policy", "export", "why")
ELSEWHERE = {
    "hydra.job.config.override_dirname.exclude_keys": "a key of Hydra",
    "none": "the command leaves out a group that is given so",
    "my_trace": "the example package, which the page beside this advice installs",
}
"""Keys and options that are not the package's, and whose they are."""


@functools.cache
def list_texts() -> list[str]:
    """Returns the texts of the package that are no docstrings; `{}` stands for what is filled in."""
    found = []
    for room in ROOMS:
        found += [path.read_text() for path in (ROOT / room).rglob("*.jinja")]
        for path in (ROOT / room).rglob("*.py"):
            tree = ast.parse(path.read_text())
            passed = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            for node in ast.walk(tree):
                if isinstance(node, ast.JoinedStr):
                    passed.update(map(id, node.values))
                    parts = [getattr(part, "value", "{}") for part in node.values]
                    found.append("".join(p if isinstance(p, str) else "{}" for p in parts))
                elif isinstance(node, ast.Constant) and id(node) not in passed:
                    found.append(str(node.value))
    return found


def list_keys(node: DictConfig, place: str = "") -> Iterator[str]:
    """Yields the path of each key."""
    for name in node:
        yield f"{place}{name}"
        inner = node._get_node(name)
        if isinstance(inner, DictConfig) and not inner._is_missing() and not inner._is_none():
            yield from list_keys(inner, f"{place}{name}.")


def test_every_key_that_a_message_advises_is_one_of_a_mode_or_of_an_option() -> None:
    known = set[str]()
    with hydra.initialize_config_module("conf", version_base="1.3"):
        for mode in names("mode"):
            policy = ["policy=trained"] if mode in NEEDS_POLICY else []
            known.update(list_keys(hydra.compose("config", overrides=[f"mode={mode}", *policy])))
    for one in registry.list_options():
        group = one.group.replace("/", ".")
        known.update(f"{group}.{name}" for name in yaml.safe_load(one.path.read_text()) or ())
    advised = {key for text in list_texts() for key in KEY.findall(text)}
    assert len(advised) > 50
    assert sorted(advised - known - ELSEWHERE.keys()) == []


def test_every_option_that_a_message_advises_is_there() -> None:
    known = {(one.group, one.name) for one in registry.list_options()}
    groups = {group for group, _ in known} - {"world"}
    advised = {found for text in list_texts() for found in OPTION.findall(text)}
    wrong = {one for one in advised - known if one[0] in groups and one[1] not in ELSEWHERE}
    assert sorted(wrong) == []
