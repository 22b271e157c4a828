"""Everything under `conf` composes."""

from __future__ import annotations

import hydra
import pytest
from composed import every
from omegaconf import DictConfig, OmegaConf

from brokk_rl import registry
from brokk_rl.build import build_node

OVERRIDES = ("experiment", "preset", "search", "exam_protocol")
ASKING_FOR_A_POLICY = ("doctor_policy", "export", "why")
"""Modes without a policy of their own; `test_values` holds what they answer without one."""
PARTS = [
    (entry.group, entry.name)
    for entry in registry.list_options()
    if entry.group not in (*OVERRIDES, "mode")
]


def composed(*overrides: str) -> DictConfig:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        return hydra.compose("config", overrides=list(overrides), return_hydra_config=True)


@pytest.mark.parametrize(("group", "name"), PARTS)
def test_every_option_composes_and_is_what_its_spec_says(group: str, name: str) -> None:
    if group == "deploy":  # its parts come from the mode
        cfg = composed("mode=deploy", f"deploy={name}").deploy
    else:
        cfg = composed("~mode", "+machine=brokk170", f"+{group}@subject={name}").subject
    if "_target_" in cfg and not OmegaConf.missing_keys(cfg) - {"out"}:
        given = {"out": "somewhere"} if group == "session" else {}
        build_node({**OmegaConf.to_container(cfg, resolve=True), **given}, group)


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


@pytest.mark.parametrize(
    "entry", registry.list_options(), ids=lambda entry: f"{entry.group}={entry.name}"
)
def test_every_option_says_in_one_line_what_it_is(entry: registry.Option) -> None:
    assert len(entry.summary()) > 10


def test_the_default_is_to_train() -> None:
    assert composed().run == "brokk_rl.modes.train.Train"
