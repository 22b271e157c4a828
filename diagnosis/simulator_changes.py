"""Findings of a diagnosis as ranges for domain randomisation, the effect that closes most of the gap first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from brokk_rl.session import write_text
from diagnosis.answer import Answer
from diagnosis.effect_library import EffectType
from diagnosis.effects_file import build_node

# Chosen by hand: an interval says how sure a number is on the day of the recordings; a machine changes.
LEAST_SPREAD = 0.2
"""Half width of a range at least, over the distance from the neutral value."""
WIDER = 2.0
"""Half width of a range over that of the 95 % interval."""


@dataclass(frozen=True)
class RandomisationRange:
    """Range of one number of an effect on one joint.

    Attributes:
        effect: The effect.
        joint: The joint; `machine` for a number that joints do not have.
        number: The number, with its unit in its name.
        low: Lower end.
        high: Upper end.
        gap_closed: Its part of the gap; `None` where free runs do not show it.
    """

    effect: str
    joint: str
    number: str
    low: float
    high: float
    gap_closed: float | None


def list_ranges(answer: Answer, kinds: Sequence[EffectType]) -> list[RandomisationRange]:
    """Return the ranges, the effect that closes most of the gap first."""
    by_name = {kind.name: kind for kind in kinds}
    found = []
    for one in answer.selected:
        closed = None if one.gap_closed is None else one.gap_closed.mean
        for number, values in one.parameters.items():
            for joint, value in values.items():
                low, high = _widen(by_name[one.effect], number, joint, value)
                found.append(RandomisationRange(one.effect, joint, number, low, high, closed))
    return sorted(found, key=lambda one: -(one.gap_closed or 0.0))


def _widen(kind: EffectType, number: str, joint: str, value: Any) -> tuple[float, float]:
    facts = kind.numbers[number]
    neutral = facts.none or 0.0
    half = max(
        WIDER * 0.5 * (value.ci95[1] - value.ci95[0]), LEAST_SPREAD * abs(value.mean - neutral)
    )
    lowest, highest = kind.limits(number)
    place = 0
    if joint in kind.machine.joint_names and len(lowest) > 1:
        place = kind.machine.joint_names.index(joint)
    low = max(float(lowest[place]), value.mean - half)
    high = min(float(highest[place]), value.mean + half)
    return float(f"{low:.6g}"), float(f"{high:.6g}")


def write_randomisation(
    answer: Answer, kinds: Sequence[EffectType], ranges: Sequence[RandomisationRange], path: Path
) -> None:
    """Write the ranges as effects for training, `effect=[library,@<file>]`.

    An effect inside of an MJCF file is a comment: training has no simulator around which it is.

    Raises:
        StorageError: The file could not be written.
    """
    by_name = {kind.name: kind for kind in kinds}
    order = list(dict.fromkeys(one.effect for one in ranges))
    nodes = {}
    lines = [
        "# @package effect",
        "# Ranges for domain randomisation, the effect that closes most of the gap first.",
    ]
    for name in order:
        own = [one for one in ranges if one.effect == name]
        selected = next(one for one in answer.selected if one.effect == name)
        lines.append(f"# {name}: {describe_part(own[0])}")
        if by_name[name].target.side == "simulator":
            lines.append("#   a number of the MJCF file: its range is in randomisation.json")
        else:
            values: dict[str, dict[str, list[float]]] = {}
            for row in own:
                values.setdefault(row.number, {})[row.joint] = [row.low, row.high]
            nodes[name] = build_node(selected, by_name[name], values)
    text = yaml.safe_dump(nodes, sort_keys=False) if nodes else ""
    write_text(path, "\n".join(lines) + "\n" + text)


def describe_part(one: RandomisationRange) -> str:
    """Return in words by what an effect is ranked."""
    if one.gap_closed is None:
        return "free runs do not show it"
    return f"closes {one.gap_closed:.2f} of the gap"
