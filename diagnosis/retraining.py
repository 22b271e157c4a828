"""Success of a policy before and after retraining, in the simulators and on the machine.

`compare_policies` returns the content of `close_gap.json`. Policies are `before` (as it was),
`after` (retrained), and any others beside them. Plants are `simulator` (as it was), `repaired`
(with the effects of the diagnosis) and `machine` (or its stand-in).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from brokk_rl.report import Tone, render_page
from brokk_rl.session import write_text
from brokk_rl.statistics import compute_wilson_interval

COMPARISON_FILE = "close_gap.json"
PLANTS = ("simulator", "repaired", "machine")
BEFORE, AFTER = "before", "after"

SuccessRate = dict[str, Any]
"""`mean` and `ci95` of a rate or of a difference of two."""


def compare_policies(evaluations: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return success by policy and plant, its loss and recovery.

    Args:
        evaluations: `evaluation.json` of each plant, all of the same policies.

    Returns:
        Plain JSON data. `fall`: success of the old policy in the simulator less that on the
            machine; `return`: of the new policy on the machine less that of the old one; `predicted` and
            `achieved`: the new policy in the repaired simulator and on the machine.
    """
    rows = {plant: evaluations[plant]["policies"] for plant in PLANTS}
    policies = list(rows["machine"])
    success: dict[str, dict[str, SuccessRate]] = {}
    times: dict[str, dict[str, Any]] = {}
    for policy in policies:
        success[policy], times[policy] = {}, {}
        for plant in PLANTS:
            row = rows[plant][policy]
            success[policy][plant] = _compute_rate(row)
            times[policy][plant] = row["time_to_insert_s"]["median"]
    return {
        "schema": 1,
        "episodes": evaluations["machine"]["episodes"],
        "success": success,
        "time_to_insert_s": times,
        "fall": subtract_rates(success[BEFORE]["simulator"], success[BEFORE]["machine"]),
        "return": subtract_rates(success[AFTER]["machine"], success[BEFORE]["machine"]),
        "left": subtract_rates(success[BEFORE]["simulator"], success[AFTER]["machine"]),
        "predicted": success[AFTER]["repaired"],
        "achieved": success[AFTER]["machine"],
    }


def _compute_rate(row: Mapping[str, Any]) -> SuccessRate:
    """Return a rate with its Wilson interval."""
    episodes = int(row["episodes"])
    rate = float(row["success_strict"]["mean"])
    low, high = compute_wilson_interval(round(rate * episodes), episodes)
    return {"mean": rate, "ci95": [low, high]}


def subtract_rates(first: SuccessRate, second: SuccessRate) -> SuccessRate:
    """Return `first` less `second` with its 95 % interval.

    Source: Newcombe 1998, Statistics in Medicine 17, method 10, from two Wilson intervals. Policies
    meet the same starts, so their outcomes go together and the interval is rather too wide.
    """
    mean = first["mean"] - second["mean"]
    (low, high), (lower, higher) = first["ci95"], second["ci95"]
    below = math.hypot(first["mean"] - low, higher - second["mean"])
    above = math.hypot(high - first["mean"], second["mean"] - lower)
    return {"mean": mean, "ci95": [max(-1.0, mean - below), min(1.0, mean + above)]}


def write_headline(found: Mapping[str, Any]) -> tuple[str, Tone]:
    """Return the outcome in two or three sentences, and its tone."""
    success = found["success"]
    before, after = success[BEFORE], success[AFTER]
    fall, back, left = found["fall"], found["return"], found["left"]
    # An interval that holds 0 shows no loss: the headline must not promise a recovery.
    if fall["ci95"][0] <= 0.0:
        return (
            f"Nothing to regain: the policy succeeds in {format_rate(before['simulator'])} in the simulator and in "
            f"{format_rate(before['machine'])} on the machine. Retrained, it succeeds in {format_rate(after['machine'])}.",
            "bad" if back["ci95"][1] < 0.0 else "plain",
        )
    text = f"Success fell from {format_rate(before['simulator'])} in the simulator"
    text += f" to {format_rate(before['machine'])} on the machine."
    foretold = f"the repaired simulator foretold {format_rate(found['predicted'])}"
    if back["ci95"][0] > 0.0:
        whole = "It is back" if left["ci95"][0] <= 0.0 else "A part is back"
        text += f" {whole}: retrained with the found effects, the policy succeeds in {format_rate(after['machine'])}; {foretold}."
        return text, "good"
    return (
        f"{text} Retraining did not bring it back: {format_rate(after['machine'])}; {foretold}.",
        "bad",
    )


def format_rate(share: SuccessRate) -> str:
    """Return `91 % (88 to 93)`."""
    low, high = (100 * bound for bound in share["ci95"])
    return f"{100 * share['mean']:.0f} % ({low:.0f} to {high:.0f})"


REPORT_FILE = "close_gap.html"
TEMPLATE = Path(__file__).with_name("close_gap.html.jinja")
PLANT_NAMES = {
    "simulator": "simulator as it was",
    "repaired": "repaired simulator",
    "machine": "machine",
}
POLICY_NAMES = {BEFORE: "policy as it was", AFTER: "retrained"}


def write_report(found: Mapping[str, Any], folder: Path) -> None:
    """Write `close_gap.html` into `folder`.

    Raises:
        StorageError: it could not be written.
    """
    headline, tone = write_headline(found)
    values = {
        "title": "Success of the policy before and after retraining",
        "headline": headline,
        "tone": tone,
        "found": found,
        "plants": PLANT_NAMES,
        "policies": POLICY_NAMES,
    }
    write_text(folder / REPORT_FILE, render_page(TEMPLATE, values))
