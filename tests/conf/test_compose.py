"""Everything under `conf` composes."""

from __future__ import annotations

from typing import Any

import hydra
import pytest
from composed import every
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


@every("experiment")
def test_every_experiment_composes(name: str) -> None:
    assert composed(f"experiment={name}").run


@every("preset")
def test_every_preset_composes(name: str) -> None:
    assert composed(f"preset={name}").run


@every("exam_protocol")
def test_every_exam_protocol_composes(name: str) -> None:
    cfg = composed("mode=exam", f"exam_protocol={name}")
    assert cfg.exam.sealed is (name == "sealed")


def test_every_option_says_in_one_line_what_it_is() -> None:
    assert [one for one in registry.list_options() if len(one.summary()) <= 10] == []
