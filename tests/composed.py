"""Options of the shipped configuration, for tests that run over all of them."""

from __future__ import annotations

from typing import Any

import hydra
import pytest
from hydra.utils import instantiate

from brokk_rl import extensions, registry

extensions.register_options([])  # the exam's options are those of an extension


def option(group: str, name: str, **fields: object) -> Any:
    """Returns the spec of one option with these fields, instantiated by itself."""
    changes = [f"subject.{field}={value}" for field, value in fields.items()]
    with hydra.initialize_config_module("conf", version_base="1.3"):
        cfg = hydra.compose("config", overrides=["~mode", f"+{group}@subject={name}", *changes])
    return instantiate(cfg.subject, _convert_="all")


def names(group: str) -> list[str]:
    """Returns the names of the options of a group; empty where there are none."""
    return [entry.name for entry in registry.list_options() if entry.group == group]


def every(group: str) -> pytest.MarkDecorator:
    """Runs a test once for each option of a group, as its argument `name`."""
    return pytest.mark.parametrize("name", names(group))
