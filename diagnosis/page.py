"""The report of a diagnosis: one HTML page that shows the answer, where the gap lies, and why to believe it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from brokk_rl.machine import Machine
from brokk_rl.report import Cell, Page, Tone
from diagnosis import pictures, wording
from diagnosis.growth import READINGS
from diagnosis.outcome import Outcome

PAGE = "report.html"
TONES: dict[str, Tone] = {"bad": "bad", "warn": "warn", "note": "plain"}
CAUSES = 8
"""Regimes, probes and rivals that are listed; the rest stands in details."""


def write(outcome: Outcome, folder: Path, machine: Machine) -> None:
    """Writes `report.html` into `folder`.

    Parts of the answer that a diagnosis left out are left out here as well.

    Raises:
        StorageError: it could not be written.
    """
    answer, more = outcome.answer, outcome.answer.more
    text, tone = wording.headline(answer)
    page = Page(f"What the simulator of {machine.name} lacks", text, tone)
    if figure := pictures.ladder(answer):
        page.picture(
            figure,
            "Error over free runs of 5 s on recordings that no effect was fitted to: before, after, and the floor.",
        )
    for remark in more.get("sanity", []):
        if remark["severity"] == "bad":
            page.text(_remark(remark), "bad")
    _causes(page, outcome, machine)
    _where(page, outcome, machine)
    _paths(page, outcome, machine)
    _growth(page, outcome, machine)
    _evidence(page, more)
    _stages(page, more)
    _next(page, outcome)
    _sanity(page, more)
    _details(page, more)
    page.write(folder / PAGE)


def _causes(page: Page, outcome: Outcome, machine: Machine) -> None:
    answer = outcome.answer
    page.heading("Effects")
    if not answer.selected:
        page.text(
            {
                "none": "Nothing that could be told from chance.",
                "unknown": "Nothing that the library of effects knows.",
            }.get(answer.verdict, "")
        )
    rows = []
    for one in answer.selected:
        closed, interval = wording.estimate(one.gap_closed, 100.0, ".0f")
        name = Cell(
            wording.said(one.effect),
            f"or {', '.join(wording.said(name) for name in one.same_as)}" if one.same_as else "",
        )
        first = True
        for number, by_joint in one.parameters.items():
            for joint, value in by_joint.items():
                size, range_ = wording.estimate(value)
                head = (
                    [
                        name,
                        ", ".join(one.joints) or "machine",
                        f"{one.probability:.2f}",
                        Cell(closed, interval),
                    ]
                    if first
                    else [""] * 4
                )
                rows.append([*head, f"{number} {joint}", Cell(size, range_)])
                first = False
        if first:
            rows.append(
                [
                    name,
                    ", ".join(one.joints) or "machine",
                    f"{one.probability:.2f}",
                    Cell(closed, interval),
                    "",
                    None,
                ]
            )
    if rows:
        columns = ["effect", "joints", "probability", "closes, %", "number", "value"]
        page.table(
            columns,
            rows,
            "With 95 % intervals. 'Closes' is the effect's part of what all of them close together (Shapley value).",
        )
    for one in answer.selected:
        if text := wording.same_as(one):
            page.text(text, "warn")
    if text := wording.left(answer):
        page.text(text)
    if answer.reason and answer.verdict == "none":
        page.text(f"{answer.reason[0].upper()}{answer.reason[1:].rstrip('.')}.")
    if (foretold := answer.more.get("predicted_closed")) and answer.gap and answer.gap.closed:
        page.text(
            f"Foretold, by the parts of the recordings that sizes were fitted to: {100 * foretold['mean']:.0f} % closed. "
            f"Achieved, on parts that they were not fitted to: {100 * answer.gap.closed.mean:.0f} %."
        )
    _how_far(page, outcome, machine)
    for key, saying in (("undecided", "Left undecided"), ("remainder", "Remainder")):
        if isinstance(found := answer.more.get(key), str):
            page.text(f"{saying}: {found}")

    if isinstance(left := answer.more.get("remainder"), Mapping) and left:
        rows = [
            [
                joint,
                one.get("clue"),
                *(
                    None if one.get(key) is None else f"{one[key]:.1f}"
                    for key in ("earned", "null")
                ),
            ]
            for joint, one in left.items()
        ]
        caption = "From what a flexible model still predicts the error that is left, log likelihood, and what it earns by chance"
        page.table(["joint", "best from", "earned", "by chance"], rows, caption)


def _how_far(page: Page, outcome: Outcome, machine: Machine) -> None:
    """Tells errors before and after joint by joint, and on recordings apart."""
    gap, unseen = outcome.answer.gap, outcome.answer.more.get("unseen")
    if not outcome.answer.selected or gap is None or not gap.joints:
        return
    units = {joint.name: joint.unit for joint in machine.joints}
    rows = []
    for name, one in gap.joints.items():
        floor = None if one.floor is None else f"{1e3 * one.floor:.1f}"
        row = [
            f"{name} [m{units[name]}]",
            f"{1e3 * one.before:.1f}",
            f"{1e3 * one.after:.1f}",
            floor,
            f"{100 * one.share:.0f}",
        ]
        if unseen:
            apart = unseen["joints"][name]
            row += [
                f"{1e3 * apart['before']:.1f}",
                f"{1e3 * apart['after']:.1f}",
                f"{100 * apart['share']:.0f}",
            ]
        rows.append(row)
    columns = ["joint", "before", "after", "floor", "% less"]
    caption = "Root mean square error of free runs of 5 s on parts of the recordings that sizes were not fitted to"
    if unseen:
        columns += ["unseen: before", "after", "% less"]
        caption += f"; unseen: {unseen['recordings']} recordings ({unseen['seconds']:.0f} s) that nothing was fitted to"
    page.table(columns, rows, caption)


def _where(page: Page, outcome: Outcome, machine: Machine) -> None:
    location = outcome.answer.more.get("location")
    if not location:
        return
    page.heading("Where the gap lies")
    page.picture(
        pictures.heat(outcome.answer, outcome.before, machine),
        "Left: where the gap arises; all cells together are 100 %. An error counts where it came in. "
        "Right: error of free runs of 5 s along the recordings.",
    )
    rows = []
    for name, joint in location["joints"].items():
        unit = machine.joints[machine.joint_names.index(name)].unit
        cells = [
            f"{1e3 * joint['rmse']:.1f}",
            f"{1e3 * joint['floor']:.1f}",
            f"{100 * joint['error']:.0f}",
        ]
        rows.append(
            [
                f"{name} [m{unit}]",
                *cells,
                Cell(f"{100 * joint['gap']:.0f}", "beyond chance" if joint["is_sure"] else ""),
            ]
        )
    page.table(
        ["joint", "error", "floor", "% of the error", "% of the gap"],
        rows,
        "Root mean square error of free runs of 5 s",
    )
    if not location["has_gap"]:
        page.text(
            "No joint exceeds its floor beyond what chance explains; shares of the gap are those of chance, then.",
            "warn",
        )
    if location["blocks"]:
        page.text(
            f"Tested by exchanging {location['blocks']} between field and reference, with at most 5 % false discoveries."
        )


def _paths(page: Page, outcome: Outcome, machine: Machine) -> None:
    page.heading("Measured and simulated")
    caption = (
        "Joints with the largest gaps. The simulator is given the recorded commands (grey, below) and begins "
        "anew every 5 s (thin lines). Black: measured; orange: simulated as it was; blue: with the effects that were found."
    )
    page.picture(pictures.paths(outcome, machine), caption)


def _growth(page: Page, outcome: Outcome, machine: Machine) -> None:
    location = outcome.answer.more.get("location")
    if not location:
        return
    page.heading("How the error grows")
    page.picture(
        pictures.growth(outcome, machine),
        "Error over the time of a free run; what exceeds the floor tells its kind.",
    )
    rows = []
    for name, growth in location["growth"].items():
        unit = machine.joints[machine.joint_names.index(name)].unit
        errors = [f"{1e3 * value:.2f}" for value in growth["rmse"]]
        whole = "–" if growth["whole_run"] is None else f"{1e3 * growth['whole_run']:.0f}"
        rows.append([f"{name} [m{unit}]", *errors, whole, READINGS[growth["reading"]]])
    horizons = [f"{value:g} s" for value in next(iter(location["growth"].values()))["horizon_s"]]
    page.table(
        ["joint", *horizons, "whole run", "reading"],
        rows,
        "Root mean square error at the end of free runs",
    )


def _evidence(page: Page, more: Mapping[str, Any]) -> None:
    evidence, probes = more.get("evidence"), more.get("probes", [])
    figure = pictures.rivals(evidence) if isinstance(evidence, Mapping) else None
    if figure or probes:
        page.heading("Why these effects and not others")
    if figure:
        page.picture(
            figure, "What each rival earns on recordings that it was not fitted to; blue: chosen."
        )
    if probes:
        page.text(
            "What the simulator's errors look like, by families of effects that leave such traces (compared with the reference):"
        )
        clear = [
            probe["text"] + f" – as {wording.said(probe['effect'])} does"
            for probe in probes
            if abs(probe["z"]) > 4.0
        ]
        page.items(clear[:CAUSES] or ["no trace stands out"])


def _stages(page: Page, more: Mapping[str, Any]) -> None:
    stages, budget = more.get("stages", []), more.get("budget")
    if not stages:
        return
    page.heading("At the tool, and by stage")
    if budget:
        page.picture(
            pictures.waterfall(budget),
            "Red steps: how the joints' errors add up to the error of the tip over free runs of 5 s (as squares; one that "
            "works against the others goes down). Then the error of the tip before, after, the floor, and other stages.",
        )
        names = [name for name in ("before", "after", "floor") if budget[name]]
        rows = [
            [
                joint,
                *(f"{budget[name]['joint_rms_mm'][joint]:.1f}" for name in names),
                f"{100 * part:.0f}",
            ]
            for joint, part in budget["before"]["joint_part"].items()
        ]
        rows.append(["tip", *(f"{budget[name]['tip_rms_mm']:.1f}" for name in names), "100"])
        page.table(
            ["", *(f"{name}, mm" for name in names), "% before"],
            rows,
            "What each joint's error alone moves the tool by, RMS",
        )
    rows = [
        [
            stage["stage"],
            None if stage["part"] is None else f"{100 * stage['part']:.0f}",
            None if stage["rms_m"] is None else f"{1e3 * stage['rms_m']:.1f}",
            stage["text"],
        ]
        for stage in stages
    ]
    page.table(["stage", "% of the joints' gap", "at the tool, mm", "why"], rows)


def _next(page: Page, outcome: Outcome) -> None:
    following = outcome.answer.next_experiment
    if following is None:
        return
    page.heading("Next experiment")
    between = (
        f" It separates {wording.listed([wording.said(name) for name in following.separates])}."
        if following.separates
        else ""
    )
    page.text(f"{following.why}{between}".strip())
    page.code(following.excitation)


def _sanity(page: Page, more: Mapping[str, Any]) -> None:
    remarks = more.get("sanity")
    if remarks is None:
        return
    page.heading("Can the recordings be trusted?")
    if not remarks:
        page.text(
            "Nothing was found against them: clocks, lost frames, interlocks, sensors, exclusive joints.",
            "good",
        )
        return
    rows = [
        [
            Cell(
                remark["name"],
                {"bad": "grave", "warn": "look at it", "note": "good to know"}[remark["severity"]],
            ),
            remark["joint"] or "all",
            Cell(
                remark["recording"],
                f"{remark['from_s']:.1f} to {remark['to_s']:.1f} s, {remark['count']} ×",
            ),
            Cell(remark["amount"], f"{remark['meaning']}. To do: {remark['advice']}"),
        ]
        for remark in remarks
    ]
    page.table(["what", "joint", "where", "how much, and what it means"], rows[:CAUSES])
    if len(rows) > CAUSES:
        with page.details(f"{len(rows) - CAUSES} more"):
            page.table(["what", "joint", "where", "how much, and what it means"], rows[CAUSES:])


def _details(page: Page, more: Mapping[str, Any]) -> None:
    location = more.get("location")
    if not location:
        return
    page.heading("All parts of the gap")
    for name, parts in location["parts"].items():
        with page.details(f"by {name}"):
            rows = [
                [
                    part["joint"],
                    part["category"],
                    *(f"{100 * part[key]:.1f}" for key in ("time", "error", "gap")),
                    None
                    if part["p"] is None
                    else Cell(f"{part['p']:.4f}", "beyond chance" if part["is_sure"] else ""),
                ]
                for part in parts
                if part["time"] > 0
            ]
            caption = "Each column of the error and the gap adds up to 100; p: how probable so much would be by chance."
            page.table(
                ["joint", name, "% of the time", "% of the error", "% of the gap", "p"],
                rows,
                caption,
            )


def _remark(remark: Mapping[str, Any]) -> str:
    joint = f" ({remark['joint']})" if remark["joint"] else ""
    return f"{remark['name']}{joint} in {remark['recording']}: {remark['amount']}. {remark['meaning']}; {remark['advice']}."
