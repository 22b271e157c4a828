"""Help of the command and of one mode: its groups, and every value with unit and meaning.

The meaning of a value is what its class says under `Attributes:` and what the comment beside it in
its YAML file adds, such as the unit.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from brokk_rl import registry

NAME_WIDTH = 34
"""Columns of names; a longer one has its text in the next line."""
LONGEST_VALUE = 40
NUM_WORDS = 4
"""Words of a comment that is more than a unit or a source."""
MAIN_MODES = ("play", "evaluate", "train", "check", "diagnose", "import", "deploy")
MOST_USED = ("session", "play", "rl", "evaluation", "tracking")
"""Nodes with the values that are changed most, after those of the mode itself."""
ENTRY = re.compile(r'( *)"?([\w/@ .]+)"?:(?: .*?)??(?:\s+#(.*))?')
"""Indentation, key and comment of a line that begins a value."""
NOISE = re.compile(r";? ?chosen by hand(; not searched)?")
"""End of a comment that says nothing about the meaning of a value."""
USAGE = """\
  brokk mode=train --help           groups and values of one mode
  brokk mode=list                   every mode and every option, one line each
  brokk mode=doctor                 what works on this computer
  brokk -m session.seed=0,1,2       a sweep: one job for each value
  brokk actuator=@lag.yaml          an option from a file of your own
  brokk --config-dir <run folder> --config-name resolved    run the same again
  eval "$(brokk -sc install=bash)"  the Tab key completes modes, options and values

Runs write into runs/, sweeps into multirun/; session.out=<folder> changes that. BROKK_TRACE=1 shows
full tracebacks. hydra/launcher=submitit_local gives each job of a sweep a process and a GPU.
"""


def describe_command() -> str:
    """Return the help of the command: the modes that people begin with, and where the rest is."""
    lines = [
        "brokk: learning control for heavy hydraulic machines.",
        "",
        "usage: brokk mode=<mode> [group=option …] [name=value …]   (-m for a sweep)",
        "",
    ]
    summaries = {one.name: one.summary() for one in registry.list_options("mode")}
    for name in MAIN_MODES:
        lines.append(f"  brokk mode={name:<12}  {summaries[name]}")
    return "\n".join([*lines, "", USAGE])


def describe_mode(
    choices: Mapping[str, Any], node: Mapping[str, Any], comments: Mapping[str, str], width: int
) -> str:
    """Return the help of a mode as text of at most `width` columns where words allow.

    Args:
        choices: Chosen option of each group, as Hydra records them: `mode`, `machine`,
            `fit@baselines.arx`.
        node: The composed configuration as plain data; missing values are `???`.
        comments: Comment of each value by dotted name, see `collect_comments`.
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
    groups, places = {key: [choices[key]] for key in reversed(list(choices))}, []
    # Hydra records no options that were chosen as a list; each is an entry of the node.
    # A mode's own values have a class, and may bear the name of a group: `bench`.
    lists = {}
    for key in node:
        if key in options and key not in groups and "_target_" not in (node[key] or ()):
            lists[key] = list(node[key])
    for key, chosen in (groups | lists).items():
        group, _, package = key.partition("@")
        places.append(re.split("[./]", package or group)[0])
        if group != "mode" and group.split("/")[0] not in registry.SETTINGS:
            others = [one.name for one in options.get(group, []) if one.name not in chosen]
            text = f"[{','.join(chosen)}]" if key in lists else chosen[0] or "null"
            lines += _format_entry(f"{key}={text}", ", ".join(others), width)
    own = [key for key in node if key not in places and key != "run"]
    ordered = dict.fromkeys([*own, *MOST_USED, *places, *node])
    lines += ["", "Values, those of the mode first:"]
    for key, text, meaning in _list_values(node, str(node["run"]), [*ordered], comments):
        lines += _format_entry(f"{key}={text}", meaning, width)
    lines += ["", "Every option of every group with one line: brokk mode=list"]
    return "\n".join(lines) + "\n"


def collect_comments(sources: Iterable[tuple[str, Path]]) -> dict[str, str]:
    """Return the comment beside each value of a composed configuration, by dotted name.

    Args:
        sources: Package and file of each part, as composed; a later one holds over an earlier.
    """
    comments: dict[str, str] = {}
    for package, path in sources:
        tables: dict[int, str] = {}  # the open tables by their indentation
        above: list[str] = []
        is_head = True  # the comment at the top is about the file
        for line in path.read_text().splitlines():
            if line.lstrip().startswith("# "):
                if not is_head:
                    above.append(line.strip("# "))
                continue
            if entry := ENTRY.fullmatch(line):
                indent, key, comment = entry.groups()
                outer = {place: name for place, name in tables.items() if place < len(indent)}
                tables = outer | {len(indent): key}
                words = [comment.strip()] if comment else above
                if words:
                    name = ".".join(filter(None, (package, *tables.values())))
                    comments[name] = NOISE.sub("", " ".join(words))
            above, is_head = [], False
    return comments


def _list_values(
    node: Mapping[str, Any],
    target: str,
    keys: Iterable[str],
    comments: Mapping[str, str],
    above: str = "",
) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and meaning of each value of a node, those of inner nodes last."""
    meanings, inner = registry.read_attributes(target), []
    for key in keys:
        value = node.get(key)
        if key in ("_target_", "run") or key not in node or value == {}:
            continue
        if isinstance(value, dict):
            inner.append((key, value))
            continue
        meaning = re.split(r"(?<=[.;]) ", meanings.get(key, ""))[0].rstrip(";.")
        comment = comments.get(f"{above}{key}", "")
        if len(comment.split()) >= NUM_WORDS or comment.lower() == meaning.lower():
            meaning = ""  # the comment says it itself
        text = "; ".join(filter(None, (meaning, comment)))
        yield f"{above}{key}", _format_value(value), text
    for key, value in inner:
        target = value.get("_target_", "")
        yield from _list_values(value, target, value, comments, f"{above}{key}.")


def _format_value(value: Any) -> str:
    if isinstance(value, list):
        text = f"[{','.join(map(_format_value, value))}]"
        return text if len(text) <= LONGEST_VALUE else f"[{len(value)} entries]"
    return value if isinstance(value, str) else json.dumps(value)


def _format_entry(name: str, text: str, width: int) -> list[str]:
    """Return a name and its text in two columns."""
    indent = NAME_WIDTH + 3
    lines = [" " * indent + line for line in textwrap.wrap(text, max(width - indent, 20))]
    head = f"  {name}"
    if lines and len(head) < indent:
        lines[0] = head + lines[0][len(head) :]
        return lines
    return [head, *lines]
