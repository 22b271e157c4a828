"""`effects.yaml`: the effects of an answer as options for training, `effect=@<file>`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from brokk_rl.session import write_text
from diagnosis.answer import Answer, Selected
from diagnosis.effect_library import EffectType

EFFECTS_FILE = "effects.yaml"


def write_effects(answer: Answer, kinds: Sequence[EffectType], path: Path) -> None:
    """Write the selected effects, the one nearest to the machine first; a note alone where nothing was selected.

    Effects inside of an MJCF file are named in a note: training has no simulator around which they are.

    Raises:
        StorageError: it could not be written.
    """
    by_name = {kind.name: kind for kind in kinds}
    around = [
        one
        for one in answer.selected
        if one.effect in by_name and by_name[one.effect].target.side != "simulator"
    ]
    chosen = sorted(around, key=lambda one: by_name[one.effect].order)
    lines = [
        "# @package effect",
        f"# {answer.verdict}: {answer.reason}",
        "# taken by effect=@<this file>",
    ]
    for one in answer.selected:
        if one not in around:
            lines.append(f"# {one.effect}: a number of the MJCF file, see mode=change_simulator")
    nodes = {}
    for one in chosen:
        values = {}
        for name, estimates in one.parameters.items():
            values[name] = {joint: float(f"{v.mean:.6g}") for joint, v in estimates.items()}
        nodes[one.effect] = build_node(one, by_name[one.effect], values)
    text = yaml.safe_dump(nodes, sort_keys=False) if nodes else ""
    write_text(path, "\n".join(lines) + "\n" + text)


def build_node(
    one: Selected, kind: EffectType, values: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return an effect as its option file holds it.

    Args:
        one: The effect with its joints.
        kind: The effect of the registry.
        values: Value or range of each number by joint; a number without stays neutral.
    """
    target = kind.target
    node: dict[str, Any] = {"_target_": f"{target.__module__}.{target.__name__}"}
    if "joints" in target.__annotations__:
        node["joints"] = list(one.joints) or "all"
    for name, number in target.numbers.items():
        off = number.typical if number.none is None else number.none
        own = dict(values.get(name, {}))
        if not own:
            node[name] = off
        elif number.per_joint:
            node[name] = own | {"other": off}
        else:
            node[name] = next(iter(own.values()))
    return node
