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

JSON_FILE = "scorecard.json"
TABLE_FILE = "scorecard.md"
REPORT_FILE = "scorecard.html"
PUBLIC_FIELDS = ("verdict", "reason", "selected", "gap", "rivals", "unseen")
"""Fields of `diagnosis.json` that a score needs."""
REFUSED = "refused"
"""Verdict of a diagnosis that refuses the recordings; an abstention."""
HORIZON_S = 5.0
"""Length of the free runs that `gap` of `diagnosis.json` is about, s."""
COLUMNS = (
    "machine", "verdict", "first pick", "known, named", "phantoms", "abstention", "closed",
    "error less by", "apart: less by", "error: before, after, floor", "rivals' error",
    "apart: before, after, hold", "seconds (CPU)",
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
    wanted = set()
    for effect, joints in known.effects.items():
        wanted |= {_name_pair(effect, joint) for joint in joints or ("",)}
    found, phantoms = set(), []
    for one in answer["selected"]:
        names = [one["effect"], *one.get("same_as", ())]
        effect = next((name for name in names if name in known.effects), None)
        if effect is None:
            if not set(names) & set(known.plausible):
                phantoms += [_name_pair(one["effect"], joint) for joint in one["joints"] or ("",)]
            continue
        pairs = [_name_pair(effect, joint) for joint in one["joints"] or ("",)]
        found |= wanted & set(pairs)
        phantoms += [pair for pair in pairs if pair not in wanted]
    first = answer["selected"][0] if answer["selected"] else None
    abstained = answer["verdict"] in ("unknown", REFUSED)
    return {
        "verdict": answer["verdict"],
        "reason": answer.get("reason", ""),
        "first": first and first["effect"],
        "first_right": _is_first_right(first, known),
        "known": sorted(wanted),
        "found": sorted(found),
        "phantoms": phantoms,
        "abstained": abstained,
        "abstention_right": abstained != known.explainable,
    }


def _name_pair(effect: str, joint: str) -> str:
    return f"{effect} {joint}".strip()


def _is_first_right(first: Mapping[str, Any] | None, known: KnownCauses) -> bool | None:
    if first is None:
        return False if known.explainable else None
    return bool({first["effect"], *first.get("same_as", ())} & set(known.effects))


def read_errors(answer: Mapping[str, Any], machine: Machine) -> dict[str, Any]:
    """Return errors and shares of an answer.

    Returns:
        `unit`; `before`, `after`, `floor`; `closed` and `reduced` as `{mean, ci95}` or `None`;
        `reduced_joints`; `apart`, on recordings apart: errors `before` and `after` over travel and
        `reduced`, `None` where the answer has none; `rivals`: errors by name.
    """
    empty = dict.fromkeys(("unit", "before", "after", "floor", "closed", "reduced"))
    found: dict[str, Any] = {**empty, "apart": _read_apart(answer, machine), "rivals": {}}
    found["reduced_joints"] = {}
    gap = answer.get("gap")
    if not gap:
        return found
    key = next(iter(gap["before"]))
    for name in ("before", "after", "floor"):
        found[name] = gap[name][key]
    found["unit"], found["closed"] = key.removeprefix("rmse_"), gap["closed"]
    reduced = 1.0 - found["after"] / found["before"] if found["before"] else 0.0
    found["reduced"] = gap.get("reduced") or {"mean": reduced, "ci95": None}
    for name, joint in gap.get("joints", {}).items():
        found["reduced_joints"][name] = joint["share"]
    for name, error in (answer.get("rivals") or {}).items():
        found["rivals"][name] = error[key]
    return found


def _read_apart(answer: Mapping[str, Any], machine: Machine) -> dict[str, Any] | None:
    unseen = answer.get("unseen")
    if not unseen:
        return None
    squares = {"before": 0.0, "after": 0.0}
    for name, size in zip(machine.joint_names, machine.upper - machine.lower, strict=True):
        for key in squares:
            squares[key] += float(unseen["joints"][name][key] / size) ** 2
    found = {key: (value / len(machine.joint_names)) ** 0.5 for key, value in squares.items()}
    reduced = 1.0 - found["after"] / found["before"] if found["before"] else 0.0
    joints = {name: one["share"] for name, one in unseen["joints"].items()}
    return {**found, "reduced": reduced, "joints": joints}


def add_hold_errors(
    errors: dict[str, Any], field: Sequence[Recording], apart: Sequence[Recording], machine: Machine
) -> None:
    """Add the error of standing still, as rival `hold` unless the answer has it, and to `apart`."""
    if errors["unit"] is not None and "hold" not in errors["rivals"]:
        errors["rivals"]["hold"] = compute_hold_error(field, machine, errors["unit"])
    if errors["apart"] is not None:
        errors["apart"]["hold"] = compute_hold_error(apart, machine, "travel")


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


def build_rows(cases: Mapping[str, Mapping[str, Any]]) -> list[list[str | Cell]]:
    """Return the rows of the table, one a case, with the columns `COLUMNS`."""
    rows: list[list[str | Cell]] = []
    for name, case in cases.items():
        if case["outcome"] != "answered":
            blanks: list[str | Cell] = [MISSING] * (len(COLUMNS) - 2)
            rows.append([name, case["outcome"], *blanks])
            continue
        scores, errors = case["scores"], case["errors"]
        rows.append(
            [
                name,
                scores["verdict"],
                _format_first(scores),
                _format_found(scores),
                Cell(str(len(scores["phantoms"])), ", ".join(scores["phantoms"])),
                _format_abstention(scores),
                _format_share(errors["closed"]),
                _format_reduced(errors),
                _format_apart(errors),
                _format_errors([errors[key] for key in ("before", "after", "floor")], errors),
                _format_rivals(errors),
                _format_errors_apart(errors),
                f"{case['seconds']:.0f} ({case['cpu_seconds']:.0f})",
            ]
        )
    return rows


def _format_first(scores: Mapping[str, Any]) -> Cell:
    if scores["first"] is None:
        return Cell(MISSING, "" if scores["first_right"] is None else "missed")
    return Cell(scores["first"], "right" if scores["first_right"] else "wrong")


def _format_found(scores: Mapping[str, Any]) -> Cell:
    if not scores["known"]:
        return Cell(MISSING)
    missed = sorted(set(scores["known"]) - set(scores["found"]))
    text = f"{len(scores['found'])} of {len(scores['known'])}"
    return Cell(text, f"missed: {', '.join(missed)}" if missed else "")


def _format_abstention(scores: Mapping[str, Any]) -> Cell:
    return Cell(
        "yes" if scores["abstained"] else "no", "right" if scores["abstention_right"] else "wrong"
    )


def _format_share(share: Mapping[str, Any] | None) -> Cell:
    if share is None:
        return Cell(MISSING)
    interval = share.get("ci95")
    note = f"{interval[0]:.2f} to {interval[1]:.2f}" if interval else ""
    return Cell(f"{share['mean']:.2f}", note)


def _format_reduced(errors: Mapping[str, Any]) -> Cell:
    if errors["reduced"] is None:
        return Cell(MISSING)
    return Cell(f"{errors['reduced']['mean']:.2f}", _format_joints(errors["reduced_joints"]))


def _format_apart(errors: Mapping[str, Any]) -> Cell:
    apart = errors["apart"]
    if apart is None:
        return Cell(MISSING)
    return Cell(f"{apart['reduced']:.2f}", _format_joints(apart["joints"]))


def _format_joints(shares: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {share:.2f}" for name, share in shares.items())


def _format_errors_apart(errors: Mapping[str, Any]) -> Cell:
    apart = errors["apart"]
    if apart is None:
        return Cell(MISSING)
    return _format_errors([apart[key] for key in ("before", "after", "hold")], {"unit": "travel"})


def _format_errors(values: Sequence[float | None], errors: Mapping[str, Any]) -> Cell:
    if errors["unit"] is None:
        return Cell(MISSING)
    factor, unit = UNITS[errors["unit"]]
    shown = [MISSING if value is None else f"{factor * value:.3g}" for value in values]
    return Cell(", ".join(shown), unit)


def _format_rivals(errors: Mapping[str, Any]) -> Cell:
    if errors["unit"] is None or not errors["rivals"]:
        return Cell(MISSING)
    factor, unit = UNITS[errors["unit"]]
    shown = [f"{name} {factor * value:.3g}" for name, value in errors["rivals"].items()]
    is_beaten = errors["after"] > errors["rivals"].get("hold", np.inf)
    return Cell(", ".join(shown), f"{unit}; standing still is better" if is_beaten else unit)


def format_markdown(cases: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table as Markdown."""
    lines = [list(COLUMNS), ["---"] * len(COLUMNS)]
    for row in build_rows(cases):
        lines.append([format_cell(cell) for cell in row])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def format_cell(cell: str | Cell) -> str:
    """Return a cell as plain text."""
    if isinstance(cell, str):
        return cell
    return f"{cell.value} ({cell.note})" if cell.note else str(cell.value)


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
    write_json(folder / JSON_FILE, {"schema": 1, "cases": dict(cases), "skipped": dict(skipped)})
    left_out = [f"{name} is skipped: {why}" for name, why in skipped.items()]
    for name, case in cases.items():
        if case["outcome"] != "answered":
            left_out.append(f"{name} {case['outcome']}: {case['reason']}")
    write_text(folder / TABLE_FILE, format_markdown(cases) + "".join(f"\n{t}\n" for t in left_out))
    page = Report("Scorecard of the diagnosis on real machines", _summarize_cases(cases))
    for text in left_out:
        page.add_text(text, "warn")
    page.add_table(
        COLUMNS,
        build_rows(cases),
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


def _summarize_cases(cases: Mapping[str, Mapping[str, Any]]) -> str:
    answered = [case["scores"] for case in cases.values() if case["outcome"] == "answered"]
    picks = [one["first_right"] for one in answered if one["first_right"] is not None]
    right = sum(one["abstention_right"] for one in answered)
    phantoms = sum(len(one["phantoms"]) for one in answered)
    return (
        f"{len(answered)} of {len(cases)} cases answered. First pick right in {sum(picks)} of "
        f"{len(picks)}; abstention right in {right} of {len(answered)}; {phantoms} phantoms."
    )
