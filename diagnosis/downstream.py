"""What a diagnosis is worth to a policy: success before and after retraining in the simulator, the repaired one, on the machine.

The dictionary that `compare` returns is `close_gap.json`. Policies are `before` (as it was),
`after` (retrained), and any others beside them; plants are `simulator` (as it was), `repaired`
(with the found effects) and `machine` (or what stands in for it).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from brokk_rl.intervals import compute_wilson_interval
from brokk_rl.report import Tone

FILE = "close_gap.json"
PLANTS = ("simulator", "repaired", "machine")
BEFORE, AFTER = "before", "after"

Share = dict[str, Any]
"""`mean` and `ci95` of a rate or of a difference of two."""


def compare(evaluations: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Returns success by policy and plant, what it lost and regained on the machine, and how well simulators foretold it.

    Args:
        evaluations: `evaluation.json` of each plant, all of the same policies.

    Returns:
        Plain JSON data. `fall`: success of the old policy in the simulator less that on the
            machine; `return`: of the new policy on
        the machine less that of the old one; `predicted` and `achieved`: the new policy in the
        repaired simulator and on the machine; `agreement`: of each simulator with the machine about
        the policies.
    """
    rows = {plant: evaluations[plant]["policies"] for plant in PLANTS}
    policies = list(rows["machine"])
    success = {
        policy: {plant: _share(rows[plant][policy]) for plant in PLANTS} for policy in policies
    }
    return {
        "schema": 1,
        "episodes": evaluations["machine"]["episodes"],
        "success": success,
        "time_to_insert_s": {
            policy: {plant: rows[plant][policy]["time_to_insert_s"]["median"] for plant in PLANTS}
            for policy in policies
        },
        "fall": difference(success[BEFORE]["simulator"], success[BEFORE]["machine"]),
        "return": difference(success[AFTER]["machine"], success[BEFORE]["machine"]),
        "left": difference(success[BEFORE]["simulator"], success[AFTER]["machine"]),
        "predicted": success[AFTER]["repaired"],
        "achieved": success[AFTER]["machine"],
        "agreement": {plant: agreement(success, plant) for plant in PLANTS[:2]},
    }


def _share(row: Mapping[str, Any]) -> Share:
    """Returns a rate with its Wilson interval."""
    episodes = int(row["episodes"])
    rate = float(row["success_strict"]["mean"])
    low, high = compute_wilson_interval(round(rate * episodes), episodes)
    return {"mean": rate, "ci95": [low, high]}


def difference(first: Share, second: Share) -> Share:
    """Returns `first` less `second` with its 95 % interval.

    Source: Newcombe 1998, Statistics in Medicine 17, method 10, from two Wilson intervals. Policies
    meet the same starts, so their outcomes go together and the interval is rather too wide.
    """
    mean = first["mean"] - second["mean"]
    (low, high), (lower, higher) = first["ci95"], second["ci95"]
    below = math.hypot(first["mean"] - low, higher - second["mean"])
    above = math.hypot(high - first["mean"], second["mean"] - lower)
    return {"mean": mean, "ci95": [max(-1.0, mean - below), min(1.0, mean + above)]}


def agreement(success: Mapping[str, Mapping[str, Share]], plant: str) -> dict[str, float | None]:
    """Returns how well `plant` says which policies do better on the machine, and how well they do.

    Returns:
        `kendall`: Kendall's tau-b of the two orders, 1 when they are the same, `None` when one of
        them knows no order; `rank_violation`: what a wrong order costs in success on the machine,
        mean over policies of the worst pair (mean maximum rank violation; Li et al. 2024, SIMPLER),
        0 at best; `error`: mean absolute difference of success.
    """
    simulated, real = (
        np.array([success[policy][place]["mean"] for policy in success])
        for place in (plant, "machine")
    )
    known = np.ptp(simulated) > 0 and np.ptp(real) > 0
    tau: Any = stats.kendalltau(simulated, real) if known else None
    return {
        "kendall": float(tau.statistic) if known else None,
        "rank_violation": rank_violation(simulated, real),
        "error": float(np.abs(simulated - real).mean()),
    }


def rank_violation(
    simulated: Sequence[float] | np.ndarray, real: Sequence[float] | np.ndarray
) -> float:
    """Returns the mean over policies of the largest real difference to a policy that the simulator ranks the other way round."""
    simulated, real = np.asarray(simulated, dtype=float), np.asarray(real, dtype=float)
    swapped = (simulated[:, None] < simulated[None]) != (real[:, None] < real[None])
    return float((swapped * np.abs(real[:, None] - real[None])).max(1).mean())


def headline(found: Mapping[str, Any]) -> tuple[str, Tone]:
    """Returns what happened in two or three sentences, and whether it is good news."""
    success = found["success"]
    before, after = success[BEFORE], success[AFTER]
    fall, back, left = found["fall"], found["return"], found["left"]
    if fall["ci95"][0] <= 0.0:
        return (
            f"Nothing to regain: the policy succeeds in {said(before['simulator'])} in the simulator and in "
            f"{said(before['machine'])} on the machine. Retrained, it succeeds in {said(after['machine'])}.",
            "bad" if back["ci95"][1] < 0.0 else "plain",
        )
    text = f"Success fell from {said(before['simulator'])} in the simulator to {said(before['machine'])} on the machine."
    foretold = f"the repaired simulator foretold {said(found['predicted'])}"
    if back["ci95"][0] > 0.0:
        whole = "It is back" if left["ci95"][0] <= 0.0 else "A part is back"
        text += f" {whole}: retrained with the found effects, the policy succeeds in {said(after['machine'])}; {foretold}."
        return text, "good"
    return f"{text} Retraining did not bring it back: {said(after['machine'])}; {foretold}.", "bad"


def said(share: Share) -> str:
    """Returns `91 % (88 to 93)`."""
    low, high = (100 * bound for bound in share["ci95"])
    return f"{100 * share['mean']:.0f} % ({low:.0f} to {high:.0f})"
