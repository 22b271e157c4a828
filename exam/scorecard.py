"""The scorecard of the diagnosis on real machines: scores of its answers, table, report.

Only public fields of `diagnosis.json` are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from actuators import open_loop
from brokk_rl.console_table import MISSING
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.report import Cell, Report
from brokk_rl.session import write_json, write_text
from exam.real_cases import KnownCauses
from exam.report import format_markdown

JSON_FILE, TABLE_FILE, REPORT_FILE = "scorecard.json", "scorecard.md", "scorecard.html"
PUBLIC_FIELDS = ("verdict", "reason", "selected", "gap", "rivals", "unseen")
"""Fields of `diagnosis.json` that a score needs."""
REFUSED = "refused"
"""Verdict of a diagnosis that refuses the recordings; an abstention."""
HORIZON_S = 5.0
"""Length of the free runs that `gap` of `diagnosis.json` is about, s."""
BETTER_RIVAL = 1.5
"""Error of the repaired simulator over that of a rival from which the rival is the better explanation."""
COLUMNS = (
    "machine", "verdict", "first pick", "known, named", "phantoms", "abstention", "closed",
    "error: before, after, floor", "rivals' error", "apart: less by", "seconds (CPU)",
)  # fmt: skip
UNITS = {"rad": (1e3, "mrad"), "m": (1e3, "mm"), "travel": (1e2, "% of travel")}
"""Factor and unit of printed errors, by the unit of `gap`."""


def score_answer(answer: Mapping[str, Any], known: KnownCauses) -> dict[str, Any]:
    """Return the scores of an answer by the knowledge about its machine.

    A name counts as the known one if that is in its class (`same_as`).

    Returns:
        `verdict`, `reason`; `first` and `first_right` (`None` where none was asked for and none
        given); `known`, `found` and `phantoms` as lists of `<effect> <joint>`; `abstained` and
        `abstention_right`.
    """
    wanted: set[str] = set()
    for effect, joints in known.effects.items():
        wanted.update(_name_pairs(effect, joints))
    found, phantoms, stands_for = set(), [], []
    for one in answer["selected"]:
        names = [one["effect"], *one.get("same_as", ())]
        effect = next((name for name in names if name in known.effects), None)
        stands_for.append(effect)
        pairs = _name_pairs(effect or one["effect"], one["joints"])
        found.update(wanted.intersection(pairs))
        if effect is not None or not set(names) & set(known.plausible):
            phantoms += [pair for pair in pairs if pair not in wanted]
    first_right = False if known.explainable else None
    if stands_for:
        first_right = stands_for[0] is not None
    abstained = answer["verdict"] in ("unknown", REFUSED)
    return {
        "verdict": answer["verdict"],
        "reason": answer.get("reason", ""),
        "first": answer["selected"][0]["effect"] if stands_for else None,
        "first_right": first_right,
        "known": sorted(wanted),
        "found": sorted(found),
        "phantoms": phantoms,
        "abstained": abstained,
        "abstention_right": abstained != known.explainable,
    }


def _name_pairs(effect: str, joints: Sequence[str]) -> list[str]:
    return [f"{effect} {joint}".strip() for joint in joints or ("",)]


def read_errors(answer: Mapping[str, Any], machine: Machine) -> dict[str, Any]:
    """Return errors and shares of an answer.

    Returns:
        `unit`, `None` without a gap; `before`, `after`, `floor`; `closed` as `{mean, ci95}` or
        `None`; `apart`, the share of the error over travel that goes on recordings apart, `None`
        where the answer has none; `rivals`: errors by name.
    """
    found: dict[str, Any] = dict.fromkeys(("unit", "before", "after", "floor", "closed", "apart"))
    found["rivals"] = {}
    if answer.get("unseen"):
        size = dict(zip(machine.joint_names, machine.upper - machine.lower, strict=True))
        before, after = (
            np.linalg.norm([answer["unseen"]["joints"][name][key] / size[name] for name in size])
            for key in ("before", "after")
        )
        found["apart"] = float(1.0 - after / before) if before else 0.0
    if gap := answer.get("gap"):
        key = next(iter(gap["before"]))
        for name in ("before", "after", "floor"):
            found[name] = gap[name][key]
        found["unit"], found["closed"] = key.removeprefix("rmse_"), gap["closed"]
        for name, error in (answer.get("rivals") or {}).items():
            found["rivals"][name] = error[key]
    return found


def compute_hold_error(recordings: Sequence[Recording], machine: Machine, unit: str) -> float:
    """Return the error of standing still over free runs, all joints together.

    Args:
        recordings: The recordings.
        machine: Their machine.
        unit: That of `gap`: `rad`, `m`, or `travel`.

    Raises:
        RecordingError: no recording is long enough.
    """
    cut = open_loop.cut_windows(recordings, machine, HORIZON_S, HORIZON_S)
    size = machine.upper - machine.lower if unit == "travel" else 1.0
    still = cut.q[:, cut.num_before - 1 : cut.num_before]
    return float(np.sqrt(np.square((cut.measured - still) / size).mean()))


def list_better_rivals(scores: Mapping[str, Any], errors: Mapping[str, Any]) -> list[str]:
    """Return the rivals that contradict named effects: standing still, and others by `BETTER_RIVAL`."""
    if scores["verdict"] != "effects" or errors["after"] is None:
        return []
    better = []
    for name, error in errors["rivals"].items():
        factor = 1.0 if name == "hold" else BETTER_RIVAL
        if errors["after"] > factor * error:
            better.append(name)
    return better


def build_rows(cases: Mapping[str, Mapping[str, Any]]) -> list[list[str | Cell]]:
    """Return the rows of the table, one a case, with the columns `COLUMNS`."""
    rows: list[list[str | Cell]] = []
    for name, case in cases.items():
        if case["outcome"] != "answered":
            rows.append([name, case["outcome"], *[MISSING] * (len(COLUMNS) - 2)])
            continue
        scores, errors = case["scores"], case["errors"]
        phantoms, missed = scores["phantoms"], sorted({*scores["known"]} - {*scores["found"]})
        first = {True: "right", False: "wrong", None: ""}[scores["first_right"]]
        known = MISSING
        if scores["known"]:
            known = f"{len(scores['found'])} of {len(scores['known'])}"
        closed, apart = errors["closed"], errors["apart"]
        factor, unit = UNITS.get(errors["unit"], (1.0, ""))
        sizes = [errors[key] for key in ("before", "after", "floor")]
        better = list_better_rivals(scores, errors)
        contradiction = f"{', '.join(better)} explains the motion better" if better else unit
        rivals = [f"{rival} {factor * value:.3g}" for rival, value in errors["rivals"].items()]
        rows.append(
            [
                name,
                scores["verdict"],
                Cell(scores["first"] or MISSING, first),
                Cell(known, f"missed: {', '.join(missed)}" if missed else ""),
                Cell(str(len(phantoms)), ", ".join(phantoms)),
                Cell(
                    "yes" if scores["abstained"] else "no",
                    "right" if scores["abstention_right"] else "wrong",
                ),
                MISSING if closed is None else f"{closed['mean']:.2f}",
                Cell(", ".join(_format_error(size, factor) for size in sizes), unit),
                Cell(", ".join(rivals) or MISSING, contradiction),
                MISSING if apart is None else f"{apart:.2f}",
                f"{case['seconds']:.0f} ({case['cpu_seconds']:.0f})",
            ]
        )
    return rows


def _format_error(value: float | None, factor: float) -> str:
    return MISSING if value is None else f"{factor * value:.3g}"


def write_scorecard(
    folder: Path, cases: Mapping[str, Mapping[str, Any]], skipped: Mapping[str, str]
) -> None:
    """Write `scorecard.json`, `scorecard.md` and `scorecard.html`.

    Args:
        folder: Where to.
        cases: Results by name of the case, as `scorecard.json` holds them.
        skipped: Reasons why cases were skipped, by name.

    Raises:
        StorageError: a file could not be written.
    """
    write_json(folder / JSON_FILE, {"schema": 2, "cases": dict(cases), "skipped": dict(skipped)})
    left_out = [f"{name} is skipped: {why}" for name, why in skipped.items()]
    for name, case in cases.items():
        if case["outcome"] != "answered":
            left_out.append(f"{name} {case['outcome']}: {case['reason']}")
    rows = build_rows(cases)
    notes = "".join(f"\n{text}\n" for text in left_out)
    write_text(folder / TABLE_FILE, format_markdown(list(COLUMNS), rows) + notes)
    page = Report("Scorecard of the diagnosis on real machines", summarize_cases(cases))
    for text in left_out:
        page.add_text(text, "warn")
    page.add_table(
        COLUMNS,
        rows,
        "Errors are those of free runs on field recordings outside the fit; apart: "
        "recordings to which nothing was fitted; hold: standing still",
    )
    for name, case in cases.items():
        page.add_heading(name)
        page.add_text(case["title"])
        page.add_text(f"Known: {case['known']}")
        if case["outcome"] == "answered":
            page.add_text(f"Answer: {case['scores']['reason']}")
        page.add_text(f"Files of the case: {folder / name}")
    page.write(folder / REPORT_FILE)


def summarize_cases(cases: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the sentence above the table."""
    answered = [case for case in cases.values() if case["outcome"] == "answered"]
    scores = [case["scores"] for case in answered]
    picks = [one["first_right"] for one in scores if one["first_right"] is not None]
    right = sum(one["abstention_right"] for one in scores)
    phantoms = sum(len(one["phantoms"]) for one in scores)
    beaten = sum(bool(list_better_rivals(case["scores"], case["errors"])) for case in answered)
    return (
        f"{len(answered)} of {len(cases)} cases answered. First pick right in {sum(picks)} of "
        f"{len(picks)}; abstention right in {right} of {len(answered)}; {phantoms} phantoms; effects "
        f"named where a rival explains the motion better: {beaten}."
    )
