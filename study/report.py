"""The pages of a study: the plan to print, and the report with its pictures and tables for other programs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Literal

import pandas as pd

from brokk_rl.plot import save_figure
from brokk_rl.report import embed_picture, render_page
from brokk_rl.session import write_text
from study import pictures
from study.analysis import LOADS, TITLES, Analysis
from study.guidance_effect import (
    LARGE_DZ,
    SUFFICIENT_POWER,
    estimate_power,
    find_smallest_size,
    get_smallest_p,
)
from study.measures import COMPARED, GUIDED_ONLY, MEASURES
from study.study_folder import NOTICE, StudyData

PLAN_PAGE = Path(__file__).with_name("plan.html.jinja")
REPORT = Path(__file__).with_name("results.html.jinja")
SIZES = (8, 12, 16, 20, 24)
"""Numbers of participants in the table of a plan."""
EFFECTS_DZ = (0.5, LARGE_DZ, 1.2)
"""A medium, a large and a very large effect, in standard deviations of a person's difference."""
SHOWN = (
    "time_s",
    "path_m",
    "several_joints",
    "joint_switches",
    "lever_movements",
    "control_effort",
)
"""Measures of which each participant's line is drawn."""


def write_plan_page(data: StudyData, notice: str) -> None:
    """Write `plan.html` into the study's folder; `notice` is said on top.

    Raises:
        StorageError: it could not be written.
    """
    design, sizes = data.design, []
    # The plan's own number stands among the usual ones.
    for num in sorted({*SIZES, design.num_participants}):
        powers = {dz: estimate_power(num, dz, design.alpha) for dz in EFFECTS_DZ}
        sizes.append({"num": num, "smallest_p": get_smallest_p((num + 1) // 2), "powers": powers})
    values = {
        "title": f"Plan of a study on {data.plan['machine']}",
        "notice": notice,
        "seed": data.plan["seed"],
        "design": design,
        "sizes": sizes,
        "effects_dz": EFFECTS_DZ,
        "large_dz": LARGE_DZ,
        "sufficient_power": SUFFICIENT_POWER,
        "smallest_size": find_smallest_size(design.alpha),
        "planned": data.planned,
    }
    write_text(data.folder / "plan.html", render_page(PLAN_PAGE, values))


def write_report(folder: Path, found: Analysis) -> Path:
    """Write `report.html`, its pictures, `trials.csv`, `means.csv` and `effects.csv`; returns the page's path.

    Raises:
        StorageError: a file could not be written.
    """
    data, trials, means = found.data, found.trials, found.means
    effects = pd.DataFrame(map(asdict, found.effects.values()), index=list(found.effects))
    effects["p_holm"] = pd.Series(found.holm, dtype=float)
    tables = {
        "trials": trials.drop(columns="tip_in_base_m"),
        "means": means,
        "effects": effects.reset_index(names="measure"),
    }
    for name, table in tables.items():
        text = table.assign(simulated=data.is_simulated).to_csv(index=False)
        write_text(folder / f"{name}.csv", text)
    drawn = {
        "paths": pictures.draw_paths(found),
        "pairs": pictures.draw_pairs(found, (*SHOWN, "tlx_raw")),
    }
    embedded = {}
    for name, figure in drawn.items():
        if data.is_simulated:
            # Every picture says so by itself: pictures leave the report.
            figure.suptitle("SIMULATED OPERATORS", fontsize=9, color="#b3261e", x=0.02, ha="left")
        save_figure(figure, folder / f"{name}.png")
        embedded[name] = embed_picture(folder / f"{name}.png")
    first, counted = means[means.period == 1], trials[trials.counts]
    guided = means[means.condition == "guided"]
    values = {
        "title": "Does guidance help?" + (" (simulated operators)" if data.is_simulated else ""),
        "verdict": judge_primary(found),
        "notice": NOTICE if data.is_simulated else "",
        "design": data.design,
        "smallest_p": get_smallest_p(first.pair.nunique()),
        "num_participants": len(first),
        "num_guided_first": int((first.condition == "guided").sum()),
        "num_trials": len(trials),
        "num_counted": len(counted),
        "num_inserted": int(counted.success.sum()),
        "titles": TITLES,
        "effects": found.effects,
        "holm": found.holm,
        "compared": COMPARED,
        "loads": LOADS,
        "advice_error": guided[GUIDED_ONLY].mean(),
        "remarks": data.remarks,
        "pictures": embedded,
        "three": _format_number,
    }
    path = folder / "report.html"
    write_text(path, render_page(REPORT, values))
    return path


def judge_primary(found: Analysis) -> Literal["unknown", "unshown", "helps", "harms"]:
    """Return whether guidance helps by the primary measure, or no effect is shown, or nothing can be said."""
    design = found.data.design
    effect = found.effects[design.primary]
    if effect.difference is None or effect.p is None:
        return "unknown"
    if effect.p > design.alpha:
        return "unshown"
    # Measures differ in which direction is better.
    better = next(each.better for each in MEASURES if each.name == design.primary)
    return "helps" if effect.difference * better > 0 else "harms"


def _format_number(value: float | None) -> str:
    """Return three digits, without an exponent up to a million; a dash for a missing number."""
    if value is None or value != value:
        return "–"
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
