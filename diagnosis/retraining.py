"""Success of a policy before and after retraining, in the simulators and on the machine.

`compare_policies` returns the content of `close_gap.json`. Policies are `before` (as it was),
`after` (retrained), and any others beside them. Plants are `simulator` (as it was), `repaired`
(with the effects of the diagnosis) and `machine` (or its stand-in).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from brokk_rl.plot import BLUE, GREY, RED, add_legend, make_figure, remove_frame, save_figure
from brokk_rl.report import Cell, Report, Tone
from brokk_rl.statistics import compute_wilson_interval

COMPARISON_FILE = "close_gap.json"
PLANTS = ("simulator", "repaired", "machine")
BEFORE, AFTER = "before", "after"

SuccessRate = dict[str, Any]
"""`mean` and `ci95` of a rate or of a difference of two."""


def compare_policies(evaluations: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return success by policy and plant, its loss and recovery, and the agreement of simulators.

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
        "agreement": {plant: measure_rank_agreement(success, plant) for plant in PLANTS[:2]},
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


def measure_rank_agreement(
    success: Mapping[str, Mapping[str, SuccessRate]], plant: str
) -> dict[str, float | None]:
    """Return how well the ranking of policies on `plant` agrees with that on the machine.

    Returns:
        `kendall`: Kendall's tau-b of the two orders, 1 when they are the same, `None` when one of
        them knows no order; `rank_violation`: loss of success on the machine by a wrong order,
        mean over policies of the worst pair (mean maximum rank violation; Li et al. 2024, SIMPLER),
        0 at best; `error`: mean absolute difference of success.
    """
    simulated = np.array([rates[plant]["mean"] for rates in success.values()])
    real = np.array([rates["machine"]["mean"] for rates in success.values()])
    # Tau divides by the number of pairs that differ: it has no value where all are equal.
    known = np.ptp(simulated) > 0 and np.ptp(real) > 0
    tau: Any = stats.kendalltau(simulated, real) if known else None
    return {
        "kendall": float(tau.statistic) if known else None,
        "rank_violation": compute_rank_violation(simulated, real),
        "error": float(np.abs(simulated - real).mean()),
    }


def compute_rank_violation(
    simulated: Sequence[float] | np.ndarray, real: Sequence[float] | np.ndarray
) -> float:
    """Return the mean over policies of the largest real difference that is ranked wrongly."""
    simulated, real = np.asarray(simulated, dtype=float), np.asarray(real, dtype=float)
    swapped = (simulated[:, None] < simulated[None]) != (real[:, None] < real[None])
    return float((swapped * np.abs(real[:, None] - real[None])).max(1).mean())


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
PICTURE_FILE = "close_gap.png"
PLANT_NAMES = {
    "simulator": "simulator as it was",
    "repaired": "repaired simulator",
    "machine": "machine",
}
POLICY_NAMES = {BEFORE: "policy as it was", AFTER: "retrained"}
COLOURS = {BEFORE: RED, AFTER: BLUE}


def write_report(found: Mapping[str, Any], folder: Path) -> None:
    """Write `close_gap.html` and `close_gap.png` into `folder`.

    Raises:
        StorageError: something could not be written.
    """
    text, tone = write_headline(found)
    page = Report("Success of the policy before and after retraining", text, tone)
    figure = draw_success(found)
    save_figure(figure, folder / PICTURE_FILE)
    page.add_picture(
        figure,
        "Share of episodes that end in strict success, with Wilson's 95 % intervals; all meet the same starts.",
    )
    add_success_table(page, found)
    page.add_heading("Predicted and achieved")
    fall, back = found["fall"], found["return"]
    page.add_table(
        ["", "success", "95 %"],
        [
            ["lost between simulator and machine", *_format_points(fall)],
            ["regained on the machine by retraining", *_format_points(back)],
            ["still missing", *_format_points(found["left"])],
            ["predicted: retrained, repaired simulator", *_format_percent(found["predicted"])],
            ["achieved: retrained, machine", *_format_percent(found["achieved"])],
        ],
        "Percentage points and per cent",
    )
    _add_agreement_table(page, found)
    if "retraining" in found:
        page.add_heading("How it was made")
        plants = {PLANT_NAMES[name]: text for name, text in found["plants"].items()}
        page.add_facts(plants | found["retraining"])
    page.write(folder / REPORT_FILE)


def _add_agreement_table(page: Report, found: Mapping[str, Any]) -> None:
    """Add the agreement of each simulator with the machine about the order of policies."""
    page.add_heading("Does the simulator know which policy is better?")
    rows = []
    for plant, one in found["agreement"].items():
        tau = None if one["kendall"] is None else f"{one['kendall']:.2f}"
        rows.append(
            [PLANT_NAMES[plant], tau, f"{one['rank_violation']:.3f}", f"{one['error']:.3f}"]
        )
    names = ", ".join(map(_name_policy, found["success"]))
    page.add_table(
        ["", "Kendall's tau", "cost of wrong orders", "mean error of success"],
        rows,
        f"Over {len(found['success'])} policies: {names}",
    )


def add_success_table(page: Report, found: Mapping[str, Any]) -> None:
    """Add success and time to insert of each policy on each plant."""
    best = max(found["success"].values(), key=lambda shares: shares["machine"]["mean"])
    rows = []
    for policy, shares in found["success"].items():
        times = found["time_to_insert_s"][policy]
        row: list[Any] = [_name_policy(policy)]
        for plant in PLANTS:
            text = f"{100 * shares[plant]['mean']:.1f}"
            # Only the machine decides which policy is the best.
            is_best = shares is best and plant == "machine"
            row.append(Cell(text, _note_interval(shares[plant], times[plant]), best=is_best))
        rows.append(row)
    page.add_table(
        ["", *(PLANT_NAMES[plant] for plant in PLANTS)],
        rows,
        f"Strict success, %, of {found['episodes']} episodes",
    )


def draw_success(found: Mapping[str, Any]) -> Figure:
    """Draw success of each policy on each plant."""
    figure = make_figure(9.5, 3.8)
    axis = figure.add_subplot()
    policies = list(found["success"])
    width = 0.8 / len(policies)
    for number, policy in enumerate(policies):
        shares = [found["success"][policy][plant] for plant in PLANTS]
        mean = np.array([share["mean"] for share in shares])
        low, high = np.array([share["ci95"] for share in shares]).T
        place = np.arange(len(PLANTS)) + (number - (len(policies) - 1) / 2) * width
        # Rounding must not make it negative.
        error = 100 * np.maximum(0.0, [mean - low, high - mean])
        axis.bar(
            place,
            100 * mean,
            0.92 * width,
            color=COLOURS.get(policy, GREY),
            label=_name_policy(policy),
        )
        axis.errorbar(
            place, 100 * mean, yerr=error, fmt="none", ecolor="black", elinewidth=1.0, capsize=2.5
        )
        for x, share in zip(place, shares, strict=True):
            axis.annotate(
                f"{100 * share['mean']:.0f}",
                (x, 100 * share["ci95"][1]),
                (0, 3),
                textcoords="offset points",
                ha="center",
            )
    axis.set_xticks(range(len(PLANTS)), [PLANT_NAMES[plant] for plant in PLANTS])
    axis.set_ylabel("strict success [%]")
    axis.set_ylim(0.0, 112.0)
    axis.set_yticks(range(0, 101, 20))
    axis.tick_params(axis="x", length=0)
    remove_frame(axis)
    add_legend(figure, axis)
    return figure


def _name_policy(policy: str) -> str:
    return POLICY_NAMES.get(policy, policy)


def _note_interval(share: Mapping[str, Any], time_s: float | None) -> str:
    text = format_rate(dict(share)).partition("(")[2].rstrip(")")
    return text if time_s is None else f"{text}; {time_s:.1f} s"


def _format_percent(share: Mapping[str, Any]) -> tuple[str, str]:
    low, high = share["ci95"]
    return f"{100 * share['mean']:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %"


def _format_points(share: Mapping[str, Any]) -> tuple[str, str]:
    low, high = share["ci95"]
    return f"{100 * share['mean']:+.1f}", f"{100 * low:+.1f} to {100 * high:+.1f}"
