"""Options of the shipped configuration, for tests that run over all of them."""

from __future__ import annotations

import copy
import functools
import sys
from typing import Any

import pytest

from brokk_rl import extensions, registry
from brokk_rl.build import build_node, describe_spec
from brokk_rl.machine import Machine
from brokk_rl.policy_folder import find_policy

extensions.register_options([])  # the exam's options are those of an extension


def option(group: str, name: str, **fields: object) -> Any:
    """Returns the spec of one option with these fields, instantiated by itself.

    Composing takes a tenth of a second, so an option without fields is composed once.
    """
    if fields:
        return extensions.load_option(group, name, **fields)
    return copy.deepcopy(_load(group, name, tuple(sys.path)))


@functools.cache
def _load(group: str, name: str, paths: tuple[str, ...]) -> Any:
    """Loads an option; `paths` are where packages with options of their own may lie."""
    return extensions.load_option(group, name)


MACHINE: Machine = option("machine", "brokk170")
"""The default machine."""


def own_task(task: Any, policy: object) -> Any:
    """Returns a task's spec with the behaviour of the policy at a path."""
    own = find_policy(str(policy)).task
    return build_node(own.apply_to(describe_spec(task)), "task")


def names(group: str) -> list[str]:
    """Returns the names of the options of a group; empty where there are none."""
    return [entry.name for entry in registry.list_options() if entry.group == group]


def every(group: str) -> pytest.MarkDecorator:
    """Runs a test once for each option of a group, as its argument `name`."""
    return pytest.mark.parametrize("name", names(group))
