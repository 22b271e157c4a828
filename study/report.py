"""The report of a study: one page, its pictures, and tables for other programs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from brokk_rl.errors import StorageError
from brokk_rl.plot import save_figure
from brokk_rl.report import Cell, Report
from brokk_rl.session import write_json, write_text
from study import plots, tlx
from study.analysis import Analysis
from study.crossover import get_smallest_p
from study.measures import GUIDED_ONLY, MEASURES
from study.simulation import NOTICE
from study.study_folder import StudyData

COMPARED = tuple(each.name for each in MEASURES if each.name not in GUIDED_ONLY)
LOADS = tuple(f"tlx_{scale}" for scale in (*tlx.SCALES, "raw", "weighted"))
SHOWN = ("time_s", "path_m", "efficiency", "several_joints", "joint_switches", "smoothness")
"""Measures of which each participant's line is drawn."""


def write_report(folder: Path, data: StudyData, found: Analysis) -> Path:
    """Write `report.html`, three pictures, `trials.csv`, `means.csv` and `report.json`; returns the page's path.

    Raises:
        StorageError: a file could not be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / "trials.csv", _format_trials(found))
        write_text(folder / "means.csv", _format_means(found, data.is_simulated))
        effects = {name: asdict(effect) for name, effect in found.effects.items()}
        remarks = [asdict(remark) for remark in found.remarks]
        facts = {
            "primary": found.primary,
            "alpha": found.alpha,
            "simulated": data.is_simulated,
            "participants": found.participants,
        }
        # JSON has no NaN, so missing figures are null.
        write_json(
            folder / "report.json",
            _convert_plain(
                {"schema": 1, **facts, "effects": effects, "holm": found.holm, "remarks": remarks}
            ),
        )
        drawn = {
            "paths": plots.draw_paths(found),
            "tlx": plots.draw_radar(found),
            "pairs": plots.draw_pairs(found, (*SHOWN, "tlx_raw", "tlx_weighted")),
        }
        for name, figure in drawn.items():
            if data.is_simulated:
                # Every picture says so by itself: pictures leave the report.
                figure.suptitle(
                    "SIMULATED OPERATORS", fontsize=9, color="#b3261e", x=0.02, ha="left"
                )
            save_figure(figure, folder / f"{name}.png")
    except OSError as error:
        raise StorageError(
            f"cannot write the report into {folder}: {error.strerror or error}"
        ) from error
    path = folder / "report.html"
    _build_page(folder, data, found).write(path)
    return path


def state_verdict(found: Analysis, is_simulated: bool = False) -> tuple[str, str]:
    """Return the result of the primary measure in words, and whether it is good, bad or no news."""
    effect, title = found.effects[found.primary], plots.get_title(found.primary)
    # Measures differ in which direction is better.
    better = next(each.better for each in MEASURES if each.name == found.primary)
    if effect.difference is None or effect.p is None or effect.ci95 is None:
        # Four persons are the least for a test over sequences.
        why = (
            "all had the same order, so guidance and order cannot be told apart"
            if effect.num_persons >= 4
            else "too few participants"
        )
        return f"Nothing can be said about guidance: {why}.", "bad"
    low, high = effect.ci95
    size = f"{title}: {effect.difference:+.3g} with guidance (95 % {low:+.3g} to {high:+.3g}), exact p = {effect.p:.3g}"
    if effect.p > found.alpha:
        return (
            f"No effect of guidance is shown on the primary measure. {size}; {effect.num_persons} participants.",
            "warn",
        )
    # The sign says whether the change is for the better.
    helps = effect.difference * better > 0
    who = "In this simulation guidance" if is_simulated else "Guidance"
    return (
        f"{who} {'helps' if helps else 'harms'}. {size}; {effect.num_persons} participants.",
        "good" if helps else "bad",
    )


def _build_page(folder: Path, data: StudyData, found: Analysis) -> Report:
    summary, tone = state_verdict(found, data.is_simulated)
    title = "Does guidance help?" + (" (simulated operators)" if data.is_simulated else "")
    page = Report(title, summary, tone)  # type: ignore[arg-type]
    if data.is_simulated:
        page.add_text(f"{NOTICE[0].upper()}{NOTICE[1:]}.", "warn")
    num, num_first = len(found.participants), int(found.guided_first.sum())
    # Both tests bound the attainable p: with few people no result can be significant.
    num_pairs = len(set(found.pairs.tolist()))
    least = get_smallest_p(num_pairs) if 0 < num_first < num else 1.0
    if least > found.alpha:
        page.add_text(
            f"With {num} participants no test here can reach p = {found.alpha:g}: the smallest possible is {least:.3g}.",
            "bad",
        )
    counted = []
    for trial in found.trials:
        if trial.counts:
            counted.append(trial)
    page.add_facts(
        {
            "participants": f"{num}, {num_first} of them guided first",
            "trials that count": f"{len(counted)}, {sum(trial.values['success'] > 0 for trial in counted)} inserted",
            "trials kept that do not count": len(found.trials) - len(counted),
            "primary measure": plots.get_title(found.primary),
            "level": found.alpha,
        }
    )
    _add_effects(page, folder, found)
    _add_paths_and_workload(page, folder, found)
    _add_comparisons(page, found)
    return page


def _add_effects(page: Report, folder: Path, found: Analysis) -> None:
    page.add_heading("What guidance does")
    page.add_text(
        "Guided minus unguided, with the period in the model: what practice does between the first and the second period is not "
        "counted as guidance. p is exact, over all ways in which the order could have been drawn. The primary measure decides; the "
        "others are corrected for looking at many (Holm, within the measures and within the six scales). dz is in standard "
        "deviations of a person's difference. Means of a participant are over trials; a trial without insertion has the limit as "
        "its time and no efficiency."
    )
    page.add_table(
        *_build_table(found, COMPARED), "of recordings; below each figure its 95 % interval"
    )
    page.add_picture(folder / "pairs.png", "Every participant, and means with 95 % intervals")


def _add_paths_and_workload(page: Report, folder: Path, found: Analysis) -> None:
    page.add_heading("Tool paths")
    page.add_picture(
        folder / "paths.png",
        "Paths of the tool, guided solid and unguided dotted; stars: starts, spheres: holes",
    )
    page.add_heading("Workload (NASA-TLX)")
    page.add_table(
        *_build_table(found, LOADS),
        "0 to 100, more is more load; below each figure its 95 % interval",
    )
    page.add_picture(folder / "tlx.png", "Means of the six scales with 95 % intervals")


def _add_comparisons(page: Report, found: Analysis) -> None:
    """Add the following of the advice, and the remarks."""
    page.add_heading("How the advice was followed")
    page.add_table(
        ["measure", "mean, guided"],
        [[plots.get_title(name), _format_mean(found, name)] for name in GUIDED_ONLY],
    )
    page.add_heading("What to beware of")
    if found.remarks:
        page.add_table(["where", "what"], [[remark.where, remark.text] for remark in found.remarks])
    else:
        page.add_text("Nothing is missing, doubled or half filled.")


def _build_table(found: Analysis, names: Sequence[str]) -> tuple[list[str], list[list[str | Cell]]]:
    columns = ["measure", "guided", "unguided", "difference", "dz", "p", "p, Holm"]
    columns.append("second period minus first")
    rows: list[list[str | Cell]] = []
    for name in names:
        # The primary measure decides alone and is not corrected.
        effect, is_primary = found.effects[name], name == found.primary
        note = f"{effect.num_persons} people" + ", the primary measure" * is_primary
        row: list[str | Cell] = [Cell(plots.get_title(name), note)]
        row += [_format_number(effect.guided), _format_number(effect.unguided)]
        row.append(Cell(_format_number(effect.difference), _format_interval(effect.ci95)))
        row += [_format_number(effect.dz), _format_p(effect.p)]
        row.append("decides" if is_primary else _format_p(found.holm.get(name)))
        row.append(Cell(_format_number(effect.period), f"p {_format_p(effect.period_p)}"))
        rows.append(row)
    return columns, rows


def _format_mean(found: Analysis, name: str) -> str:
    values = []
    for value in found.means[name]["guided"]:
        if not math.isnan(value):
            values.append(value)
    # Participants without a value are left out, not counted as 0.
    return _format_number(sum(values) / len(values) if values else None)


def _format_number(value: float | None) -> str:
    return (
        "–"
        if value is None or math.isnan(value)
        else f"{value:.0f}"
        if abs(value) >= 1000
        else f"{value:.3g}"
    )


def _format_p(value: float | None) -> str:
    return (
        "–"
        if value is None or math.isnan(value)
        else f"{value:.4f}"
        if value >= 0.0001
        else f"{value:.1e}"
    )


def _format_interval(value: tuple[float, float] | None) -> str:
    return "" if value is None else f"{_format_number(value[0])} to {_format_number(value[1])}"


def _format_trials(found: Analysis) -> str:
    keys = ("participant", "period", "condition", "number", "outcome", "simulated", "operator")
    head = [*keys, "hole", "start", "counts", *(each.name for each in MEASURES)]
    rows = []
    for trial in found.trials:
        rows.append(
            [
                *(trial.facts.get(key, "") for key in keys),
                (trial.facts.get("hole") or {}).get("name", ""),
                trial.facts.get("start", ""),
                trial.counts,
                *(_blank(trial.values[each.name]) for each in MEASURES),
            ]
        )
    return _format_csv(head, rows)


def _format_means(found: Analysis, is_simulated: bool) -> str:
    columns = found.means | {f"tlx_{name}": values for name, values in found.loads.items()}
    rows = []
    for i, (name, first) in enumerate(zip(found.participants, found.guided_first, strict=True)):
        for condition in ("guided", "unguided"):
            rows.append(
                [
                    name,
                    is_simulated,
                    condition,
                    "first" if (condition == "guided") == bool(first) else "second",
                    *(_blank(values[condition][i]) for values in columns.values()),
                ]
            )
    return _format_csv(["participant", "simulated", "condition", "period", *columns], rows)


def _blank(value: float) -> float | str:
    return "" if math.isnan(value) else value


def _format_csv(head: Sequence[str], rows: Sequence[Sequence]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return text.getvalue()


def _convert_plain(value: Any) -> Any:
    """Return plain data with `None` in place of NaN, which JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _convert_plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_convert_plain(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value
