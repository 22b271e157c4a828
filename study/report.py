"""The report of a study: one page, its pictures, and tables for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from brokk_rl.plot import save_figure
from brokk_rl.report import Cell, Report, Tone
from brokk_rl.session import write_json, write_text
from study import pictures
from study.analysis import LOADS, TITLES, Analysis
from study.guidance_effect import get_smallest_p
from study.measures import COMPARED, GUIDED_ONLY, MEASURES
from study.study_folder import NOTICE

SHOWN = ("time_s", "path_m", "efficiency", "several_joints", "joint_switches", "smoothness")
"""Measures of which each participant's line is drawn."""
METHOD = (
    "Guided minus unguided, by a linear model with a term for each person and for the period: what practice does between the first "
    "and the second period is not counted as guidance. p is exact, over all ways in which the order could have been drawn. The "
    "primary measure decides; the others are corrected for looking at many (Holm, within the measures and within the six scales). "
    "dz is in standard deviations of a person's difference. Means of a participant are over trials; a trial without insertion has "
    "the limit as its time and no efficiency."
)


def write_report(folder: Path, found: Analysis) -> Path:
    """Write `report.html`, three pictures, `trials.csv`, `means.csv` and `report.json`; returns the page's path.

    Raises:
        StorageError: a file could not be written.
    """
    data = found.data
    write_text(
        folder / "trials.csv", found.trials.drop(columns="tip_in_base_m").to_csv(index=False)
    )
    means = found.means.assign(simulated=data.is_simulated)
    write_text(folder / "means.csv", means.to_csv(index=False))
    facts = {
        "schema": 2,
        "primary": data.design.primary,
        "alpha": data.design.alpha,
        "simulated": data.is_simulated,
        "effects": {name: asdict(effect) for name, effect in found.effects.items()},
        "holm": found.holm,
        "remarks": [asdict(remark) for remark in data.remarks],
    }
    write_json(folder / "report.json", facts)
    drawn = {
        "paths": pictures.draw_paths(found),
        "tlx": pictures.draw_radar(found),
        "pairs": pictures.draw_pairs(found, (*SHOWN, "tlx_raw", "tlx_weighted")),
    }
    for name, figure in drawn.items():
        if data.is_simulated:
            # Every picture says so by itself: pictures leave the report.
            figure.suptitle("SIMULATED OPERATORS", fontsize=9, color="#b3261e", x=0.02, ha="left")
        save_figure(figure, folder / f"{name}.png")
    path = folder / "report.html"
    _build_page(folder, found).write(path)
    return path


def state_verdict(found: Analysis) -> tuple[str, Tone]:
    """Return the result of the primary measure in words, and whether it is good, bad or no news."""
    primary, alpha = found.data.design.primary, found.data.design.alpha
    effect = found.effects[primary]
    if effect.difference is None or effect.p is None or effect.ci95 is None:
        return (
            "Nothing can be said about guidance: each order of the conditions needs two participants"
            f" with both, here {effect.num_guided_first} and {effect.num_persons - effect.num_guided_first}.",
            "bad",
        )
    low, high = effect.ci95
    size = (
        f"{TITLES[primary]}: {effect.difference:+.3g} with guidance (95 % {low:+.3g} to {high:+.3g}),"
        f" exact p = {effect.p:.3g}; {effect.num_persons} participants."
    )
    if effect.p > alpha:
        return f"No effect of guidance is shown on the primary measure. {size}", "warn"
    # Measures differ in which direction is better.
    better = next(each.better for each in MEASURES if each.name == primary)
    helps = effect.difference * better > 0
    who = "In this simulation guidance" if found.data.is_simulated else "Guidance"
    return f"{who} {'helps' if helps else 'harms'}. {size}", "good" if helps else "bad"


def _build_page(folder: Path, found: Analysis) -> Report:
    data, design = found.data, found.data.design
    summary, tone = state_verdict(found)
    title = "Does guidance help?" + (" (simulated operators)" if data.is_simulated else "")
    page = Report(title, summary, tone)
    if data.is_simulated:
        page.add_text(f"{NOTICE[0].upper()}{NOTICE[1:]}.", "warn")
    first = found.means[found.means.period == 1]
    num_first = int((first.condition == "guided").sum())
    # With few people no result can be significant.
    least = get_smallest_p(first.pair.nunique())
    if least > design.alpha:
        page.add_text(
            f"With {len(first)} participants no test here can reach p = {design.alpha:g}: the smallest possible is {least:.3g}.",
            "bad",
        )
    counted = found.trials[found.trials.counts.astype(bool)]
    page.add_facts(
        {
            "participants": f"{len(first)}, {num_first} of them guided first",
            "trials that count": f"{len(counted)}, {int(counted.success.sum())} inserted",
            "trials kept that do not count": len(found.trials) - len(counted),
            "primary measure": TITLES[design.primary],
            "level": design.alpha,
        }
    )
    page.add_heading("What guidance does")
    page.add_text(METHOD)
    _add_effects(page, found, COMPARED, "of recordings; below each figure its 95 % interval")
    page.add_picture(folder / "pairs.png", "Every participant, and means with 95 % intervals")
    page.add_heading("Tool paths")
    page.add_picture(
        folder / "paths.png", "Guided solid, unguided dotted; stars: starts, dots: holes"
    )
    page.add_heading("Workload (NASA-TLX)")
    _add_effects(page, found, LOADS, "0 to 100, more is more load; below each its 95 % interval")
    page.add_picture(folder / "tlx.png", "Means of the six scales with 95 % intervals")
    page.add_heading("How the advice was followed")
    guided = found.means[found.means.condition == "guided"]
    rows = [[TITLES[name], _format_number(guided[name].mean())] for name in GUIDED_ONLY]
    page.add_table(["measure", "mean, guided"], rows)
    page.add_heading("What to beware of")
    if data.remarks:
        page.add_table(["where", "what"], [[one.where, one.text] for one in data.remarks])
    else:
        page.add_text("Nothing is missing, doubled or half filled.")
    return page


def _add_effects(page: Report, found: Analysis, names: Sequence[str], caption: str) -> None:
    columns = ["measure", "guided", "unguided", "difference", "dz", "p", "p, Holm"]
    columns.append("second period minus first")
    rows: list[list[str | float | Cell | None]] = []
    for name in names:
        # The primary measure decides alone and is not corrected.
        effect, is_primary = found.effects[name], name == found.data.design.primary
        note = f"{effect.num_persons} people" + ", the primary measure" * is_primary
        interval = " to ".join(map(_format_number, effect.ci95 or ()))
        rows.append(
            [
                Cell(TITLES[name], note),
                _format_number(effect.guided),
                _format_number(effect.unguided),
                Cell(_format_number(effect.difference), interval),
                _format_number(effect.dz),
                _format_number(effect.p),
                "decides" if is_primary else _format_number(found.holm.get(name)),
                Cell(_format_number(effect.period), f"p {_format_number(effect.period_p)}"),
            ]
        )
    page.add_table(columns, rows, caption)


def _format_number(value: float | None) -> str:
    """Return three digits, without an exponent up to a million; a dash for a missing number."""
    if value is None or value != value:
        return "–"
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
