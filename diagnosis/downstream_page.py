"""The report of `mode=close_gap`: success before and after, in the simulators and on the machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brokk_rl.plot import BLUE, GREY, RED, clean
from brokk_rl.report import Cell, Page
from diagnosis.downstream import AFTER, BEFORE, PLANTS, headline, said

PAGE = "close_gap.html"
PICTURE = "close_gap.png"
WORDS = {"simulator": "simulator as it was", "repaired": "repaired simulator", "machine": "machine"}
NAMES = {BEFORE: "policy as it was", AFTER: "retrained"}
COLOURS = {BEFORE: RED, AFTER: BLUE}


def write(found: Mapping[str, Any], folder: Path) -> None:
    """Writes `close_gap.html` and `close_gap.png` into `folder`.

    Raises:
        StorageError: something could not be written.
    """
    text, tone = headline(found)
    page = Page("What the diagnosis is worth to the policy", text, tone)
    figure = picture(found)
    figure.savefig(folder / PICTURE, dpi=150)
    page.picture(
        figure,
        "Share of episodes that end in strict success, with Wilson's 95 % intervals; all meet the same starts.",
    )
    table(page, found)
    page.heading("Predicted and achieved")
    fall, back = found["fall"], found["return"]
    page.table(
        ["", "success", "95 %"],
        [
            ["lost between simulator and machine", *_points(fall)],
            ["regained on the machine by retraining", *_points(back)],
            ["still missing", *_points(found["left"])],
            ["predicted: retrained, repaired simulator", *_percent(found["predicted"])],
            ["achieved: retrained, machine", *_percent(found["achieved"])],
        ],
        "Percentage points and per cent",
    )
    page.heading("Does the simulator know which policy is better?")
    page.table(
        ["", "Kendall's tau", "cost of wrong orders", "mean error of success"],
        [
            [
                WORDS[plant],
                None if one["kendall"] is None else f"{one['kendall']:.2f}",
                f"{one['rank_violation']:.3f}",
                f"{one['error']:.3f}",
            ]
            for plant, one in found["agreement"].items()
        ],
        f"Over {len(found['success'])} policies: {', '.join(_name(policy) for policy in found['success'])}",
    )
    if "retraining" in found:
        page.heading("How it was made")
        page.facts(
            {
                **{f"{WORDS[name]}": what for name, what in found["plants"].items()},
                **found["retraining"],
            }
        )
    page.write(folder / PAGE)


def table(page: Page, found: Mapping[str, Any]) -> None:
    """Adds success and time to insert of each policy on each plant."""
    best = max(found["success"].values(), key=lambda shares: shares["machine"]["mean"])
    rows = []
    for policy, shares in found["success"].items():
        times = found["time_to_insert_s"][policy]
        cells = [
            Cell(
                f"{100 * shares[plant]['mean']:.1f}",
                _note(shares[plant], times[plant]),
                best=shares is best and plant == "machine",
            )
            for plant in PLANTS
        ]
        rows.append([_name(policy), *cells])
    page.table(
        ["", *(WORDS[plant] for plant in PLANTS)],
        rows,
        f"Strict success, %, of {found['episodes']} episodes",
    )


def picture(found: Mapping[str, Any]) -> Figure:
    """Draws success of each policy on each plant."""
    figure = Figure(figsize=(9.5, 3.8), layout="constrained")
    axis = figure.add_subplot()
    policies = list(found["success"])
    width = 0.8 / len(policies)
    for number, policy in enumerate(policies):
        shares = [found["success"][policy][plant] for plant in PLANTS]
        mean = np.array([share["mean"] for share in shares])
        low, high = np.array([share["ci95"] for share in shares]).T
        place = np.arange(len(PLANTS)) + (number - (len(policies) - 1) / 2) * width
        error = 100 * np.maximum(
            0.0, [mean - low, high - mean]
        )  # rounding must not make it negative
        axis.bar(
            place, 100 * mean, 0.92 * width, color=COLOURS.get(policy, GREY), label=_name(policy)
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
    axis.set_xticks(range(len(PLANTS)), [WORDS[plant] for plant in PLANTS])
    axis.set_ylabel("strict success [%]")
    axis.set_ylim(0.0, 112.0)
    axis.set_yticks(range(0, 101, 20))
    axis.tick_params(axis="x", length=0)
    clean(axis)
    figure.legend(
        *axis.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(policies),
        frameon=False,
    )
    return figure


def _name(policy: str) -> str:
    return NAMES.get(policy, policy)


def _note(share: Mapping[str, Any], time_s: float | None) -> str:
    text = said(dict(share)).partition("(")[2].rstrip(")")
    return text if time_s is None else f"{text}; {time_s:.1f} s"


def _percent(share: Mapping[str, Any]) -> tuple[str, str]:
    low, high = share["ci95"]
    return f"{100 * share['mean']:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %"


def _points(share: Mapping[str, Any]) -> tuple[str, str]:
    low, high = share["ci95"]
    return f"{100 * share['mean']:+.1f}", f"{100 * low:+.1f} to {100 * high:+.1f}"
