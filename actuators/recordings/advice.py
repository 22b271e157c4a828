"""Advice of messages about logs: the key that reads a log, written as it is typed.

A test follows each entry: with the key the same log is read, or refused for another reason.
"""

from __future__ import annotations

from pathlib import Path

import yaml

_TEXTS = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
ADVICE: dict[str, str] = _TEXTS["advice"]
"""Texts by the key that they advise; numbers and names are filled in."""
FOREIGN: dict[str, str] = _TEXTS["foreign"]
"""Files that are no logs yet, and what makes logs of them, by their ending."""


def advise(key: str, **values: object) -> str:
    """Return the advice of a key with its values."""
    return ADVICE[key].format(**values)


def format_joints(pairs: dict[str, tuple[str, str]]) -> str:
    """Return joints with their columns as `log.joints` takes them, without the outer braces."""
    return ", ".join(f'{joint}: ["{u}", "{q}"]' for joint, (u, q) in pairs.items())
