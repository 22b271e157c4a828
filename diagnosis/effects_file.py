"""Effects of an answer as options for training: their sizes, `effect=@effects.yaml`, or ranges around them.

Effects inside of an MJCF file are comments there: training has no simulator around which they are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml

from actuators.effects.simulator import EFFECTS as INSIDE_EFFECTS
from brokk_rl.session import write_text
from diagnosis.answer import Answer, Estimate, Selected
from diagnosis.effect_library import EffectType

EFFECTS_FILE = "effects.yaml"
RANGES_FILE = "randomisation.yaml"
# Chosen by hand: an interval says how sure a number is on the day of the recordings; a machine changes.
LEAST_SPREAD = 0.2
"""Half width of a range at least, over the distance from the neutral value."""
WIDER = 2.0
"""Half width of a range over that of the 95 % interval."""

Sizes = dict[str, dict[str, Any]]
"""Value or range by name of the number and joint."""


def write_effects(answer: Answer, kinds: Sequence[EffectType], path: Path) -> None:
    """Write the selected effects, the one nearest to the machine first; a note alone where nothing was selected.

    Raises:
        StorageError: it could not be written.
    """
    notes = [f"{answer.verdict}: {answer.reason}", "taken by effect=@<this file>"]
    _write(answer, kinds, path, notes, lambda kind, number, joint, size: _round(size.mean))


def write_ranges(answer: Answer, kinds: Sequence[EffectType], path: Path) -> None:
    """Write ranges around the sizes for domain randomisation, `effect=[library,@<file>]`.

    Raises:
        StorageError: it could not be written.
    """
    notes = ["Ranges for domain randomisation; the effect that closes most of the gap first:"]
    notes += describe_parts(answer)
    _write(answer, kinds, path, notes, widen_size)


def describe_parts(answer: Answer) -> list[str]:
    """Return which part of the gap each effect closes, the largest first."""
    ranked = []
    for one in answer.selected:
        if one.gap_closed is None:
            ranked.append((0.0, f"{one.effect}: free runs do not show it"))
        else:
            part = one.gap_closed.mean
            ranked.append((part, f"{one.effect}: closes {part:.2f} of the gap"))
    return [text for _, text in sorted(ranked, key=lambda pair: -pair[0])]


def widen_size(kind: EffectType, number: str, joint: str, size: Estimate) -> list[float]:
    """Return the range of a size within the bounds of its number; `joint`: `machine` for one that joints do not have."""
    neutral = kind.numbers[number].none or 0.0
    interval = size.ci95[1] - size.ci95[0]
    half = max(WIDER * 0.5 * interval, LEAST_SPREAD * abs(size.mean - neutral))
    lowest, highest = kind.limits(number)
    place = 0
    if joint in kind.machine.joint_names and len(lowest) > 1:
        place = kind.machine.joint_names.index(joint)
    low = max(float(lowest[place]), size.mean - half)
    high = min(float(highest[place]), size.mean + half)
    return [_round(low), _round(high)]


def _write(
    answer: Answer,
    kinds: Sequence[EffectType],
    path: Path,
    notes: Sequence[str],
    choose: Callable[[EffectType, str, str, Estimate], Any],
) -> None:
    """Write each effect with what `choose` returns for its sizes."""
    by_name = {kind.name: kind for kind in kinds}
    lines = ["# @package effect", *(f"# {note}" for note in notes)]
    nodes = {}
    known = [one for one in answer.selected if one.effect in by_name]
    for one in sorted(known, key=lambda one: by_name[one.effect].order):
        kind, sizes = by_name[one.effect], {}
        for number, values in one.parameters.items():
            sizes[number] = {j: choose(kind, number, j, size) for j, size in values.items()}
        if one.effect in INSIDE_EFFECTS:
            lines.append(
                f"# {one.effect}: {sizes}, numbers of the MJCF file, see mode=change_simulator"
            )
        else:
            nodes[one.effect] = _build_node(one, kind, sizes)
    text = yaml.safe_dump(nodes, sort_keys=False) if nodes else ""
    write_text(path, "\n".join(lines) + "\n" + text)


def _build_node(one: Selected, kind: EffectType, sizes: Sizes) -> dict[str, Any]:
    """Return an effect as its option file holds it; a number without a size stays neutral."""
    target = kind.target
    node: dict[str, Any] = {"_target_": f"{target.__module__}.{target.__name__}"}
    if "joints" in target.__annotations__:
        node["joints"] = list(one.joints) or "all"
    for name, number in target.numbers.items():
        off = number.typical if number.none is None else number.none
        own = sizes.get(name)
        if not own:
            node[name] = off
        elif number.per_joint:
            node[name] = own | {"other": off}
        else:
            node[name] = next(iter(own.values()))
    return node


def _round(value: float) -> float:
    return float(f"{value:.6g}")
