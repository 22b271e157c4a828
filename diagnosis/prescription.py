"""`effects.yaml`: the found effects as a config that `effect=@<file>` takes, so that training simulates the machine as it is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from brokk_rl.errors import StorageError
from brokk_rl.session import write_text
from diagnosis.answer import Answer, Selected
from diagnosis.library import Kind

FILE = "effects.yaml"


def write(answer: Answer, kinds: Sequence[Kind], path: Path) -> None:
    """Writes the selected effects, the one nearest to the machine first; a note alone where nothing was selected.

    Raises:
        StorageError: it could not be written.
    """
    by_name = {kind.name: kind for kind in kinds}
    chosen = sorted(answer.selected, key=lambda one: by_name[one.effect].order)
    lines = [
        "# @package effect",
        f"# {answer.verdict}: {answer.reason}",
        "# taken by effect=@<this file>",
    ]
    text = (
        yaml.safe_dump(
            {one.effect: _node(one, by_name[one.effect]) for one in chosen}, sort_keys=False
        )
        if chosen
        else ""
    )
    try:
        write_text(path, "\n".join(lines) + "\n" + text)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error


def _node(one: Selected, kind: Kind) -> dict:
    target = kind.target
    node: dict = {"_target_": f"{target.__module__}.{target.__name__}"}
    if "joints" in target.__annotations__:
        node["joints"] = list(one.joints) or "all"
    for name, number in kind.numbers.items():
        values = {
            joint: float(f"{value.mean:.6g}")
            for joint, value in one.parameters.get(name, {}).items()
        }
        if not values:
            node[name] = number.typical if number.none is None else number.none
        elif number.per_joint:
            node[name] = values | {"other": number.typical if number.none is None else number.none}
        else:
            node[name] = next(iter(values.values()))
    return node
