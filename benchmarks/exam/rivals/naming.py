"""The rule by which a fit of parameters becomes names of effects.

A rival returns every number it fits, and its error where it states one. A number counts as changed
when it moves further than `threshold` times its error and its spread where nothing was done; the
spread is in parts of the stated error. Spread and threshold come from a
development exam, `choose_rule.py`. Numbers that only grow with an effect count in that direction.
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from case_data import Change

ONE_WAY = {
    "dead_band": 1,
    "lag": 1,
    "dead_time": 1,
    "creep": 1,
    "flow_sharing": 1,
    "saturation": -1,
    "rate_limit": 1,
    "backlash": 1,
}
"""Effects that exist in one direction only, and the sign of their numbers' change."""
ALL_JOINTS = ("flow_sharing", "base_tilt")
"""Effects of the whole machine."""
SAME_AS = {"dead_band": ["stiction"]}
"""Effects that a rival has one number for: friction is either."""
TARGETS = {
    "flow_gain": "speed.FlowGain",
    "asymmetry": "speed.Asymmetry",
    "dead_band": "command.DeadBand",
    "saturation": "command.Saturation",
    "lag": "speed.Lag",
    "dead_time": "timing.DeadTime",
    "rate_limit": "command.RateLimit",
    "backlash": "speed.Backlash",
    "sag": "targets.Sag",
    "creep": "load.Creep",
    "flow_sharing": "load.FlowSharing",
    "encoder_bias": "measurement.EncoderBias",
    "encoder_scale": "measurement.EncoderScale",
    "link_length": "kinematics.LinkLength",
    "base_tilt": "kinematics.BaseTilt",
}
"""Effects of the library by name, nearest to the machine last."""
NOTHING = {"gain": 1.0, "extend_gain": 1.0, "retract_gain": 1.0, "level": 1.0, "scale": 1.0}
"""Values that change nothing; 0 for all others."""
FIXED = {"sag": {"load_rad": 0.0, "sag_slope": 0.0}}
"""Numbers of an effect that no rival fits, at the value that changes nothing."""
PROBABILITY = 0.9
"""Stated for each name: none of the rivals gives a probability."""


def measure_change(change: Change, spreads: dict[str, float]) -> float:
    """Return a change over the spread of its number, 0 in a direction that no effect has."""
    sign = ONE_WAY.get(change.effect, 0)
    if sign and change.change * sign <= 0:
        return 0.0
    return abs(change.change) / change.error / spreads[f"{change.effect}.{change.parameter}"]


def select_effects(
    changes: list[Change], spreads: dict[str, float], threshold: float
) -> dict[str, tuple[float, list[str]]]:
    """Return score and joints of each named effect, the largest score first."""
    scores: dict[str, dict[str, float]] = defaultdict(dict)
    for change in changes:
        score = measure_change(change, spreads)
        if score > threshold:
            joints = scores[change.effect]
            joints[change.joint] = max(score, joints.get(change.joint, 0.0))
    found = {effect: (max(joints.values()), list(joints)) for effect, joints in scores.items()}
    return dict(sorted(found.items(), key=lambda one: -one[1][0]))


def write_answer(changes: list[Change], rule: dict[str, Any], out: Path) -> None:
    """Write `diagnosis.json`, and `effects.yaml` for the examiner."""
    named = select_effects(changes, rule["spreads"], rule["threshold"])
    machine = sorted({change.joint for change in changes} - {"machine"})
    selected, ranking, nodes = [], [], {}
    for effect, (_, chosen) in named.items():
        joints = machine if effect in ALL_JOINTS else sorted(chosen)
        parameters: dict[str, dict[str, Any]] = defaultdict(dict)
        for change in changes:
            if change.effect == effect and change.joint in [*joints, "machine"]:
                spread = rule["spreads"][f"{effect}.{change.parameter}"]
                half = 1.96 * spread * change.error
                ci95 = [change.value - half, change.value + half]
                parameters[change.parameter][change.joint] = {"mean": change.value, "ci95": ci95}
        selected.append(
            {
                "effect": effect,
                "joints": joints,
                "probability": PROBABILITY,
                "parameters": parameters,
                "gap_closed": None,
                "same_as": SAME_AS.get(effect, []),
            }
        )
        ranking.append({"effect": effect, "joints": joints, "probability": PROBABILITY})
        nodes[effect] = build_node(effect, joints, parameters)
    answer = {
        "schema": 1,
        "verdict": "effects" if selected else "none",
        "selected": selected,
        "ranking": ranking or [{"effect": "none", "joints": [], "probability": PROBABILITY}],
        "where": {"joints": {}, "regimes": [], "stage": None},
        "gap": None,
        "rivals": {},
        "next_experiment": None,
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "diagnosis.json").write_text(json.dumps(answer, indent=1) + "\n")
    ordered = {effect: nodes[effect] for effect in reversed(TARGETS) if effect in nodes}
    # JSON is YAML
    (out / "effects.yaml").write_text(json.dumps(ordered, indent=1) + "\n")


def build_node(
    effect: str, joints: list[str], parameters: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Return the option of an effect for the examiner's simulation."""
    node: dict[str, Any] = {
        "_target_": f"actuators.effects.{TARGETS[effect]}",
        **FIXED.get(effect, {}),
    }
    if effect != "base_tilt":
        node["joints"] = joints
    for name, values in parameters.items():
        by_joint = {joint: value["mean"] for joint, value in values.items()}
        if "machine" in by_joint:
            node[name] = by_joint["machine"]
        else:
            node[name] = by_joint | {"other": NOTHING.get(name, 0.0)}
    return node
