"""Files of a fit: an option of the group `actuator`, and what is known about its numbers."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from brokk_rl.machine import Machine
from brokk_rl.session import write_json, write_text


def round_by_joint(machine: Machine, values: np.ndarray) -> dict[str, Any]:
    """Return numbers `(J,)`, or rows of them `(J, M)`, with five digits, by name of the joint."""
    found = {}
    for name, value in zip(machine.joint_names, values, strict=True):
        if np.ndim(value):
            found[name] = tuple(float(f"{one:.5g}") for one in value)
        else:
            found[name] = float(f"{value:.5g}")
    return found


def write_option(
    folder: Path, name: str, fitted: Any, comment: str, facts: Mapping[str, Any] | None = None
) -> None:
    """Write `<name>.yaml` for `actuator=@…`, and `<name>.json` with facts where there are some.

    Raises:
        StorageError: a file could not be written.
    """
    kind = type(fitted)
    # through JSON, which makes lists of tuples as YAML wants them
    numbers = json.loads(json.dumps(dataclasses.asdict(fitted)))
    node = {"_target_": f"{kind.__module__}.{kind.__qualname__}", **numbers}
    text = yaml.safe_dump(node, sort_keys=False, default_flow_style=None, width=130)
    lines = [f"# {line}" for line in comment.splitlines()]
    if facts is not None:
        write_json(folder / f"{name}.json", facts)
    write_text(folder / f"{name}.yaml", "\n".join(lines) + f"\n{text}")
