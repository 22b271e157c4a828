"""Help of one mode: its groups with their options, and its own values with their meaning."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from typing import Any

from brokk_rl import registry

NAME_WIDTH = 34
"""Columns of names; a longer one has its text in the next line."""


def describe_mode(choices: Mapping[str, Any], node: Mapping[str, Any], width: int) -> str:
    """Return the help of a mode as text of at most `width` columns where words allow.

    Args:
        choices: Chosen option of each group, as Hydra records them: `mode`, `machine`,
            `fit@baselines.arx`.
        node: The composed configuration as plain data; missing values are `???`.
        width: Columns of the terminal.
    """
    name, options = str(choices["mode"]), dict[str, list[registry.Option]]()
    for option in registry.list_options():
        options.setdefault(option.group, []).append(option)
    comment = next(option for option in options["mode"] if option.name == name).comment()
    lines = [
        f"usage: brokk mode={name} [group=option …] [name=value …]   (-m for a sweep)",
        "",
        *textwrap.wrap(comment, width),
        "",
        "Groups, as chosen, and their other options:",
    ]
    taken, groups = {"run"}, {key: [choices[key]] for key in reversed(list(choices))}
    # Hydra records no options that were chosen as a list; each is an entry of the node.
    # A mode's own values have a class, and may bear the name of a group: `bench`.
    lists = {}
    for key in node:
        if key in options and key not in groups and "_target_" not in (node[key] or ()):
            lists[key] = list(node[key])
    for key, chosen in (groups | lists).items():
        group, _, package = key.partition("@")
        taken.add(re.split("[./]", package or group)[0])
        if group != "mode" and group.split("/")[0] not in registry.SETTINGS:
            others = [one.name for one in options.get(group, []) if one.name not in chosen]
            text = f"[{','.join(chosen)}]" if key in lists else chosen[0] or "null"
            lines += _format_entry(f"{key}={text}", ", ".join(others), width)
    own = {key: value for key, value in node.items() if key not in taken}
    lines += ["", "Values of the mode:"]
    lines += _describe_values("", str(node["run"]), own, width)
    lines += [
        "",
        f"Values of a group: brokk mode={name} --cfg job --package <group>",
        "Every option with one line each: brokk mode=list",
    ]
    return "\n".join(lines) + "\n"


def _describe_values(prefix: str, target: str, node: Mapping[str, Any], width: int) -> list[str]:
    """Return a line for each value below `prefix`, with its meaning in the docstring of `target`."""
    meanings, lines = registry.read_attributes(target), []
    for key, value in node.items():
        if key == "_target_":
            continue
        if isinstance(value, dict) and "_target_" in value:
            lines += _describe_values(f"{prefix}{key}.", str(value["_target_"]), value, width)
            continue
        if isinstance(value, dict) and not value:
            continue  # filled by a group that was not chosen
        text = "null" if value is None else str(value).lower() if isinstance(value, bool) else value
        meaning = re.split(r"(?<=[.;]) ", meanings.get(key, ""))[0].rstrip(";.")
        lines += _format_entry(f"{prefix}{key}={text}", meaning, width)
    return lines


def _format_entry(name: str, text: str, width: int) -> list[str]:
    """Return a name and its text in two columns."""
    indent = NAME_WIDTH + 3
    lines = [" " * indent + line for line in textwrap.wrap(text, max(width - indent, 20))]
    head = f"  {name}"
    if lines and len(head) < indent:
        lines[0] = head + lines[0][len(head) :]
        return lines
    return [head, *lines]
