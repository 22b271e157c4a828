"""Findings of a diagnosis as ranges for domain randomisation and as priors for sysid of MuJoCo.

Ranges are ranked by the success that each effect costs, where that was measured, else by its part of the
gap.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from brokk_rl.errors import RecordingError
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
        success_cost: Strict success that the effect takes from the policy; `None` where not measured.
        gap_closed: Its part of the gap; `None` where free runs do not show it.
    """

    effect: str
    joint: str
    number: str
    low: float
    high: float
    success_cost: float | None
    gap_closed: float | None


def read_success_costs(path: Path) -> dict[str, float]:
    """Return the success that each effect costs, from `why.json`.

    Raises:
        RecordingError: The file cannot be read.
    """
    try:
        told = json.loads(path.read_text())
        success = {name: float(rate["mean"]) for name, rate in told["success"].items()}
        effects = [one["effect"] for one in told["effects"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: expected a why.json with success rates ({error})") from error
    if "as_trained" not in success:
        return {}
    costs = {}
    for name in effects:
        # One effect alone is evaluated as the set of all.
        after = success.get(
            f"with_{name}", success.get("with_effects") if len(effects) == 1 else None
        )
        if after is not None:
            costs[name] = success["as_trained"] - after
    return costs


def list_ranges(
    answer: Answer, kinds: Sequence[EffectType], costs: Mapping[str, float]
) -> list[RandomisationRange]:
    """Return the ranges, the effect that costs most success first."""
    by_name = {kind.name: kind for kind in kinds}
    found = []
    for one in answer.selected:
        closed = None if one.gap_closed is None else one.gap_closed.mean
        for number, values in one.parameters.items():
            for joint, value in values.items():
                low, high = _widen(by_name[one.effect], number, joint, value)
                cost = costs.get(one.effect)
                found.append(RandomisationRange(one.effect, joint, number, low, high, cost, closed))
    return sorted(found, key=_rank)


def _rank(one: RandomisationRange) -> tuple[bool, float, float]:
    cost, closed = one.success_cost, one.gap_closed
    return cost is None, -(cost or 0.0), -(closed or 0.0)


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
        "# Ranges for domain randomisation, the effect that costs most first.",
    ]
    for name in order:
        own = [one for one in ranges if one.effect == name]
        selected = next(one for one in answer.selected if one.effect == name)
        lines.append(f"# {name}: {describe_cost(own[0])}")
        if by_name[name].target.side == "simulator":
            lines.append("#   a number of the MJCF file: its range is in randomisation.json")
        else:
            values: dict[str, dict[str, list[float]]] = {}
            for row in own:
                values.setdefault(row.number, {})[row.joint] = [row.low, row.high]
            nodes[name] = build_node(selected, by_name[name], values)
    text = yaml.safe_dump(nodes, sort_keys=False) if nodes else ""
    write_text(path, "\n".join(lines) + "\n" + text)


def describe_cost(one: RandomisationRange) -> str:
    """Return in words by what an effect is ranked."""
    if one.success_cost is not None:
        return f"costs {one.success_cost:.2f} of success"
    if one.gap_closed is not None:
        return f"success not measured; closes {one.gap_closed:.2f} of the gap"
    return "success not measured; free runs do not show it"


SYSID_HEAD = '''"""Priors for mujoco.sysid from a diagnosis: nominal value and bounds of each changed number.

    from sysid_parameters import build_parameters
    parameters = build_parameters()

It needs `pip install 'mujoco[sysid]'`. The nominal value is that of the diagnosis; bounds are twice its
95 % interval, at least a fifth of the change.
"""

import math

from mujoco import sysid


def _write(element, joint, attribute, index):
    def modify(spec, parameter):
        if element == "joint":
            owner = spec.joint(joint)
        else:
            owner = next(one for one in spec.actuators if one.target == joint)
        value = float(parameter.value[0])
        if attribute == "delay":  # its buffer holds the longest delay of the bounds
            owner.nsample = math.ceil(float(parameter.max_value[0]) / spec.option.timestep) + 2
            owner.interp = 1  # between time steps
        if index is None:
            setattr(owner, attribute, value)
        else:
            row = getattr(owner, attribute).copy()
            row[index] = value
            setattr(owner, attribute, row)

    return modify


def build_parameters():
    """Return a `mujoco.sysid.ParameterDict`; each parameter writes itself into an MjSpec."""
    parameters = sysid.ParameterDict()
'''
PRIOR = """    # {comment}
    parameters.add(
        sysid.Parameter(
            "{name}", {nominal!r}, {low!r}, {high!r},
            modifier=_write("{element}", "{joint}", "{attribute}", {index!r}),
        )
    )
"""


def write_sysid_priors(changes: Sequence[Any], path: Path) -> None:
    """Write `sysid_parameters.py` from changes of an MJCF file (`diagnosis.mjcf.changes.MjcfChange`).

    Raises:
        StorageError: The file could not be written.
    """
    text = SYSID_HEAD
    for one in changes:
        attribute, _, index = one.attribute.rstrip("]").partition("[")
        ends = one.interval or (one.after, one.after)
        half = max(WIDER * 0.5 * (ends[1] - ends[0]), LEAST_SPREAD * abs(one.after - one.before))
        low, high = one.after - half, one.after + half
        if one.before >= 0.0 and one.after >= 0.0:
            low = max(0.0, low)
        text += PRIOR.format(
            comment=f"{one.effect} on {one.joint}: {one.before:.6g} in the file",
            name=f"{one.joint}.{one.attribute}",
            nominal=float(f"{one.after:.6g}"),
            low=float(f"{low:.6g}"),
            high=float(f"{high:.6g}"),
            element=one.element,
            joint=one.joint,
            attribute=attribute,
            index=int(index) if index else None,
        )
    write_text(path, text + "    return parameters\n")
