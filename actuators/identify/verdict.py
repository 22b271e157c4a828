"""What an identification says, in sentences: is the model good, on which joint is it worst, and what to do about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from actuators.identify.dead_time import RESOLUTION_S
from brokk_rl.machine import Machine

HOLD, LINEAR = "hold", "arx"
"""The baselines that stand beside every model."""
HEADLINE_S = 5.0
"""The horizon by which models are compared, where the recordings are long enough."""
THIN_S = 120.0
"""A joint that is commanded for less than this in the recordings to fit to is too little
excited."""
THIN_TRAVEL = 0.4
"""So is one that saw less than this part of its travel, …"""
THIN_COMMAND = 0.5
"""… or no command larger than this both ways."""
FEW_RUNS = 6
"""Runs to judge by below which an interval from resampling them is coarse."""
DELAY_TOLERANCE_S = 0.05
"""The machine's dead time may differ from that of its joints by this much, s: a control period at
20 Hz."""


@dataclass(frozen=True)
class Finding:
    """A sentence of the verdict.

    Attributes:
        tone: Whether it is good news.
        text: The sentence.
    """

    tone: Literal["good", "bad", "warn", "plain"]
    text: str


def verdict(result: Mapping[str, Any], machine: Machine) -> list[Finding]:
    """Returns the sentences of the verdict on an `identification.json`, the answer first."""
    given = [
        horizon
        for horizon, value in result["overall"][result["model"]].items()
        if value is not None
    ]
    horizon = f"{HEADLINE_S:g}" if f"{HEADLINE_S:g}" in given else given[-1]
    findings = [_comparison(result, horizon), _worst(result, given[-1], machine)]
    findings += _dead_time(result, machine) + _excitation(result) + _judged_by(result)
    return findings


def _comparison(result: Mapping[str, Any], horizon: str) -> Finding:
    model, joints = result["model"], list(result["joints"])
    overall = {name: rows[horizon]["percent"] for name, rows in result["overall"].items()}
    mine = f"{model}: {overall[model]:.2f} % of travel after {horizon} s in a free run, mean over joints"
    rival = LINEAR if model != LINEAR else HOLD
    if model == HOLD:
        return Finding(
            "plain", f"{mine}; this is the error of a machine that stands still, and no model."
        )
    against = result["against"][rival]
    total, rows = against["overall"][horizon], [against[joint][horizon] for joint in joints]
    better = [
        joint for joint, row in zip(joints, rows, strict=True) if row["ci95"] and row["ci95"][1] < 0
    ]
    worse = [
        joint for joint, row in zip(joints, rows, strict=True) if row["ci95"] and row["ci95"][0] > 0
    ]
    change = total["reduction_percent"]
    text = f"{mine}, against {overall[rival]:.2f} % of {rival}: {abs(change):.0f} % {'less' if change >= 0 else 'more'}"
    if total["reduction_ci95"]:
        low, high = total["reduction_ci95"]
        text += f" (95 %: {low:.0f} to {high:.0f} % less)"
    if total["ci95"] is None:
        return Finding(
            "warn",
            f"{text}. Judged by one run only, so there is no saying whether that holds for others.",
        )
    text += f". Better beyond doubt on {_named(better, joints)}"
    text += f", worse on {_named(worse, joints)}." if worse else "."
    strongest = min(overall, key=lambda name: overall[name])
    if strongest not in (model, rival):
        text += f" The best of those compared is {strongest} with {overall[strongest]:.2f} %."
    tone = (
        "good"
        if total["ci95"][1] < 0 and not worse
        else "bad"
        if total["ci95"][0] > 0 or len(worse) > len(better)
        else "warn"
    )
    return Finding(tone, text)


def _worst(result: Mapping[str, Any], horizon: str, machine: Machine) -> Finding:
    model = result["model"]
    rows = {joint: models[model][horizon] for joint, models in result["joints"].items()}
    joint = max(rows, key=lambda name: rows[name]["percent"])
    unit = machine.joints[machine.joint_names.index(joint)].unit
    row = rows[joint]
    text = (
        f"Worst joint: {joint}, {row['percent']:.2f} % of its travel"
        f" ({row['rmse']:.2g} {unit}) after {horizon} s."
    )
    shares = {
        name: cell["models"][model]["share"] / cell["time"]
        for name, cell in result["regimes"][joint].items()
    }
    if shares:
        regime = max(shares, key=lambda name: shares[name])
        cell = result["regimes"][joint][regime]
        text += (
            f" It drifts most {_regime_phrase(regime)}: {100 * cell['time']:.0f} % of the time, "
            f"{100 * cell['models'][model]['share']:.0f} % of the squared drift."
        )
    return Finding("plain", text)


def _dead_time(result: Mapping[str, Any], machine: Machine) -> list[Finding]:
    known = {joint: delay for joint, delay in result["delay_s"].items() if delay is not None}
    if not known:
        return []
    history_s = machine.num_history * machine.period_s
    values = [delay["value"] for delay in known.values()]
    span = (
        f"{min(values):.2f} s"
        if max(values) - min(values) < RESOLUTION_S / 2
        else f"{min(values):.2f} to {max(values):.2f} s"
    )
    stated = f"machine '{machine.name}' says {machine.dead_time_s:g} s"
    found: list[Finding] = []
    lost = [joint for joint, delay in known.items() if not delay["found"]]
    if lost:
        found.append(
            Finding(
                "warn",
                f"The dead time of {', '.join(lost)} is not found: the motion does not follow the command.",
            )
        )
    long = [
        joint for joint, delay in known.items() if delay["found"] and delay["ci95"][1] > history_s
    ]
    if long:
        count = int(np.ceil(max(known[joint]["ci95"][1] for joint in long) / machine.period_s)) + 2
        text = f"The dead time of {', '.join(long)} may exceed the history of {history_s:.2f} s: models miss the command that acts."
        found.append(
            Finding(
                "bad",
                f"{text} Set num_history of machine '{machine.name}' to {count} or more and fit again.",
            )
        )
    off = [
        joint
        for joint, delay in known.items()
        if abs(delay["value"] - machine.dead_time_s) > DELAY_TOLERANCE_S
    ]
    if off:
        text = f"Dead time {span}, but {stated}: correct dead_time_s ({', '.join(off)})."
        found.append(Finding("warn", text))
    elif not found:
        text = f"Dead time {span}: inside the history of {history_s:.2f} s, and {stated}."
        found.append(Finding("good", text))
    return found


def _excitation(result: Mapping[str, Any]) -> list[Finding]:
    found = []
    for joint, facts in result["data"]["excitation"].items():
        lacks = []
        if facts["commanded_s"] < THIN_S:
            lacks.append(f"commanded for {facts['commanded_s']:.0f} s only")
        if facts["travel"] < THIN_TRAVEL:
            lacks.append(f"seen over {100 * facts['travel']:.0f} % of its travel")
        for sign, value in (
            ("+", facts["largest_command"][1]),
            ("-", -facts["largest_command"][0]),
        ):
            if value < THIN_COMMAND:
                lacks.append(f"no command beyond {sign}{value:.2g}")
        if lacks:
            found.append(
                Finding(
                    "warn",
                    f"{joint} is too little excited: {'; '.join(lacks)}. Record more of it before trusting its model.",
                )
            )
    return found


def _judged_by(result: Mapping[str, Any]) -> list[Finding]:
    found, data = [], result["data"]
    idle = [joint for joint, facts in data["excitation"].items() if facts["judged_s"] <= 0]
    if idle:
        found.append(
            Finding(
                "warn",
                f"{', '.join(idle)} never moves by command in the runs judged by: its errors there say nothing.",
            )
        )
    if data["test"]["runs"] < FEW_RUNS:
        found.append(
            Finding(
                "warn",
                f"Judged by {data['test']['runs']} runs: intervals from so few are coarse, most likely too narrow.",
            )
        )
    found += [
        Finding("warn", f"No figure at {horizon} s: {reason}.")
        for horizon, reason in result["missing"].items()
    ]
    return found


def _named(some: list[str], every: list[str]) -> str:
    if not some:
        return "no joint"
    return (
        f"all {len(every)} joints"
        if len(some) == len(every)
        else f"{len(some)} of {len(every)} joints ({', '.join(some)})"
    )


def _regime_phrase(regime: str) -> str:
    return {
        "at rest": "when it should rest",
        "alone": "when it moves alone",
        "with others": "when it moves with others",
    }.get(regime, regime if regime.startswith(("after", "near")) else f"at {regime}")
