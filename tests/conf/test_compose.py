"""Everything under `conf` composes."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import pytest
import yaml
from composed import every, names
from omegaconf import DictConfig, OmegaConf

from brokk_rl import registry
from brokk_rl.build import build_node

OVERRIDES = ("experiment", "preset", "search", "exam_protocol")
ASKING_FOR_A_POLICY = ("doctor_policy", "export", "why")
"""Modes without a policy of their own; `test_messages` holds what they answer without one."""
PARTS = [one for one in registry.list_options() if one.group not in (*OVERRIDES, "mode")]
BASE = ("~mode", "+machine=brokk170")


def composed(*overrides: str) -> DictConfig:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return hydra.compose("config", overrides=list(overrides), return_hydra_config=True)


def stands_alone(part: registry.Option) -> bool:
    """Returns whether an option names a place in the configuration, or has others beside it."""
    text = part.path.read_text()
    return "@package _global_" in text.partition("\n")[0] or "\ndefaults:" in text


def build_part(group: str, cfg: Any) -> None:
    if "_target_" in cfg and not OmegaConf.missing_keys(cfg) - {"out"}:
        given = {"out": "somewhere"} if group == "session" else {}
        build_node({**OmegaConf.to_container(cfg, resolve=True), **given}, group)


@pytest.mark.parametrize("group", dict.fromkeys(part.group for part in PARTS))
def test_every_option_composes_and_is_what_its_spec_says(group: str) -> None:
    """Options of a group compose together, each at a place of its own: it takes less time."""
    parts = [part for part in PARTS if part.group == group]
    together = [part for part in parts if group != "deploy" and not stands_alone(part)]
    cfg = composed(*BASE, *(f"+{group}@{part.name}_part={part.name}" for part in together))
    for part in parts:
        if part in together:
            build_part(group, cfg[f"{part.name}_part"])
        elif group in ("deploy", "bench"):  # its parts come from the mode
            mode = "bringup" if part.name == "operator" else "deploy"
            build_part(group, composed(f"mode={mode}", f"{group}={part.name}")[group])
        elif "@package _global_" in part.path.read_text():
            assert composed(*BASE, f"+{group}={part.name}")
        else:
            build_part(group, composed(*BASE, f"+{group}@part={part.name}").part)


@every("mode")
def test_every_mode_composes(name: str) -> None:
    # `import` is a word of Python's and cannot name a module
    module = "import_logs" if name == "import" else name
    policy = ["policy=trained"] if name in ASKING_FOR_A_POLICY else []
    assert f".modes.{module}." in composed(f"mode={name}", *policy).run


@pytest.mark.parametrize("group", ["experiment", "preset"])
def test_every_experiment_and_preset_composes(group: str) -> None:
    assert all(composed(f"{group}={name}").run for name in names(group))


@every("exam_protocol")
def test_every_exam_protocol_composes(name: str) -> None:
    cfg = composed("mode=exam", f"exam_protocol={name}")
    assert cfg.exam.sealed is (name == "sealed")


def test_every_option_says_in_one_line_what_it_is() -> None:
    assert [one for one in registry.list_options() if len(one.summary()) <= 10] == []


ROOT = Path(__file__).parents[2]
ROOMS = ("brokk_rl", "tasks", "actuators", "perception", "deploy", "diagnosis", "exam", "study")
KEY = re.compile(r"(?<![\w.@/{])((?:[a-z_]+\.)+[a-z_]+)=(?!=)")
OPTION = re.compile(r"(?<![\w.@/{<])([a-z_]+)=([a-z]\w*)\b(?!=|[.:(])")
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
            policy = ["policy=trained"] if mode in ASKING_FOR_A_POLICY else []
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
