"""The report of a diagnosis: sentences, tables and figures in one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from brokk_rl.machine import Machine
from brokk_rl.report import Cell, Report, Tone
from diagnosis import plots
from diagnosis.answer import Answer, Estimate, Gap, Outcome, Selected, format_error
from diagnosis.error_growth import READINGS

GOOD_CLOSED = 0.5
"""A closed part of the gap from which the news are good."""


def write_headline(answer: Answer) -> tuple[str, Tone]:
    """Return the answer in two or three sentences, and whether it is good news."""
    gap = answer.gap
    told = ""
    if gap is not None:
        told = f" Error over 5 s free runs: {format_error(gap.before, gap.unit)} before"
        told += f", {format_error(gap.after, gap.unit)} after" if answer.selected else ""
        told += "; " + _describe_floor(gap) + "."
    told += _describe_tool(answer)
    if answer.verdict == "none":
        return (
            f"No gap: the simulator is as right about these recordings as about its own.{told}",
            "good",
        )
    if answer.verdict == "unknown":
        place = _describe_place(answer)
        because = (
            f" {answer.reason[0].upper()}{answer.reason[1:].rstrip('.')}." if answer.reason else ""
        )
        start = (
            f"There is a gap that no effect of the library explains{place}"
            if place
            else "There is no telling"
        )
        return f"{start}.{because}{told}", "warn"
    names = join_words([describe_selected(one) for one in answer.selected])
    closed = gap.closed if gap else None
    left_over = answer.more.get("unknown_remainder")
    rest = (
        f" An unknown remainder is left on {join_words(left_over['joints'])}." if left_over else ""
    )
    tone: Tone = "good" if closed is not None and closed.ci95[0] > GOOD_CLOSED else "warn"
    if closed is None:
        return f"The simulator lacks {names}.{told}{rest}", tone
    it = "it" if len(answer.selected) == 1 else "them"
    share = f"{100 * closed.mean:.0f} % of the gap (95 %: {_format_percent_range(closed)})"
    return f"The simulator lacks {names}; adding {it} closes {share}.{told}{rest}", tone


def _describe_tool(answer: Answer) -> str:
    """Return the error of the tool, where a named effect moves the tool only."""
    cause = str((answer.more.get("geometry") or {}).get("cause") or "").split(" ")[0]
    if cause not in {one.effect for one in answer.selected}:
        return ""
    texts = [
        stage["text"] for stage in answer.more.get("stages", ()) if stage["stage"] == "kinematics"
    ]
    return "".join(f" {text[0].upper()}{text[1:]}." for text in texts)


def _describe_floor(gap: Gap) -> str:
    if gap.floor is None:
        return "without a reference, and with too little data for a flexible model, the floor is not known"
    whose = (
        ""
        if gap.floor_of == "reference"
        else f", that of a {gap.floor_of} on field recordings it was not fitted to"
    )
    return f"the floor is {format_error(gap.floor, gap.unit)}{whose}"


def describe_selected(one: Selected) -> str:
    """Return an effect with its joints and probability."""
    return (
        f"{name_effect(one.effect)}{list_on_joints(one.joints)} (probability {one.probability:.2f})"
    )


def name_effect(effect: str) -> str:
    """Return the name of an effect as words."""
    return effect.replace("_", " ")


def list_on_joints(joints: Sequence[str]) -> str:
    """Return ` on q3 and q4`, nothing for an effect of the whole machine."""
    return f" on {join_words(joints)}" if joints else ""


def join_words(names: Sequence[str]) -> str:
    """Return `a, b and c`."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def describe_class(one: Selected) -> str:
    """Return the indistinguishable effects and the measurement that would decide, or nothing."""
    if not one.same_as:
        return ""
    others = join_words([name_effect(name) for name in one.same_as])
    text = f"These recordings cannot tell {name_effect(one.effect)}{list_on_joints(one.joints)} from {others}: "
    text += f"the probability of {one.probability:.2f} is that of one of them."
    return f"{text} What would decide: {one.decided_by}." if one.decided_by else text


def describe_remainder(answer: Answer) -> str:
    """Return the error that remains above the floor after the selected effects."""
    gap = answer.gap
    if gap is None or not answer.selected:
        return ""
    remainder = answer.more.get("unknown_remainder")
    above = 0.0 if gap.floor is None else max(gap.after**2 - gap.floor**2, 0.0) ** 0.5
    beyond = (
        f"{format_error(above, gap.unit)} beyond the floor"
        if gap.floor is not None
        else format_error(gap.after, gap.unit)
    )
    if remainder:
        return (
            f"An unknown remainder is left on {join_words(remainder['joints'])} ({beyond}):"
            f" {remainder['reason']}, but no effect does."
        )
    return (
        f"What is left, {beyond}, is within what the simulator errs by anyway."
        if gap.floor is not None
        else ""
    )


def format_estimate(
    value: Estimate | None, factor: float = 1.0, style: str = ".3g"
) -> tuple[str, str]:
    """Return a number and its interval as texts."""
    if value is None:
        return "–", ""
    low, high = (factor * bound for bound in value.ci95)
    return f"{factor * value.mean:{style}}", f"{low:{style}} to {high:{style}}"


def _describe_place(answer: Answer) -> str:
    if not answer.where.joints:
        return ""
    joint, gap = max(answer.where.joints.items(), key=lambda pair: pair[1].share)
    regime = next((one for one in answer.where.regimes if one.joint == joint), None)
    text = f"; {100 * gap.share:.0f} % of it lies in {joint}"
    return text + (
        f", most of that ({100 * regime.share:.0f} %) {describe_regime(regime.regime)}"
        if regime
        else ""
    )


def describe_regime(regime: str) -> str:
    """Return a regime as a phrase of a sentence."""
    phrases = {
        "hold": "at rest",
        "stop": "just after stops",
        "start": "at starts",
        "creep": "at small commands",
    }
    phrases |= {
        "cruise": "at larger commands, alone",
        "several joints at once": "while several joints move",
    }
    return phrases.get(regime, regime)


def _format_percent_range(value: Estimate) -> str:
    return f"{100 * value.ci95[0]:.0f} to {100 * value.ci95[1]:.0f} %"


REPORT_FILE = "report.html"
TONES: dict[str, Tone] = {"bad": "bad", "warn": "warn", "note": "plain"}
MAX_LISTED = 8
"""Regimes, probes and rivals that are listed; the rest stands in details."""


def write_report(outcome: Outcome, folder: Path, machine: Machine) -> None:
    """Write `report.html` into `folder`.

    Parts of the answer that a diagnosis left out are left out here as well.

    Raises:
        StorageError: it could not be written.
    """
    answer, more = outcome.answer, outcome.answer.more
    text, tone = write_headline(answer)
    page = Report(f"What the simulator of {machine.name} lacks", text, tone)
    if figure := plots.draw_gap_bars(answer):
        page.add_picture(
            figure,
            "Error over free runs of 5 s on recordings that no effect was fitted to: before, after, and the floor.",
        )
    for remark in more.get("sanity", []):
        if remark["severity"] == "bad":
            page.add_text(_describe_remark(remark), "bad")
    _add_effects(page, outcome, machine)
    _add_where(page, outcome, machine)
    _add_paths(page, outcome, machine)
    _add_growth(page, outcome, machine)
    _add_evidence(page, more)
    _add_stages(page, more)
    _add_next_experiment(page, outcome)
    _add_sanity(page, more)
    _add_details(page, more)
    page.write(folder / REPORT_FILE)


def _add_effects(page: Report, outcome: Outcome, machine: Machine) -> None:
    answer = outcome.answer
    page.add_heading("Effects")
    if not answer.selected:
        page.add_text(
            {
                "none": "Nothing that could be told from chance.",
                "unknown": "Nothing that the library of effects knows.",
            }.get(answer.verdict, "")
        )
    rows = []
    for one in answer.selected:
        closed, interval = format_estimate(one.gap_closed, 100.0, ".0f")
        name = Cell(
            name_effect(one.effect),
            f"or {', '.join(name_effect(name) for name in one.same_as)}" if one.same_as else "",
        )
        first = True
        for number, by_joint in one.parameters.items():
            for joint, value in by_joint.items():
                size, range_ = format_estimate(value)
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
        page.add_table(
            columns,
            rows,
            "With 95 % intervals. 'Closes' is the effect's part of what all of them close together (Shapley value).",
        )
    for one in answer.selected:
        if text := describe_class(one):
            page.add_text(text, "warn")
    if text := describe_remainder(answer):
        page.add_text(text)
    if answer.reason and answer.verdict == "none":
        page.add_text(f"{answer.reason[0].upper()}{answer.reason[1:].rstrip('.')}.")
    if (foretold := answer.more.get("predicted_closed")) and answer.gap and answer.gap.closed:
        page.add_text(
            f"Foretold, by the parts of the recordings that sizes were fitted to: {100 * foretold['mean']:.0f} % closed. "
            f"Achieved, on parts that they were not fitted to: {100 * answer.gap.closed.mean:.0f} %."
        )
    _add_errors_by_joint(page, outcome, machine)
    for key, saying in (("undecided", "Left undecided"), ("remainder", "Remainder")):
        if isinstance(found := answer.more.get(key), str):
            page.add_text(f"{saying}: {found}")

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
        page.add_table(["joint", "best from", "earned", "by chance"], rows, caption)


def _add_errors_by_joint(page: Report, outcome: Outcome, machine: Machine) -> None:
    """Report errors before and after joint by joint, and on recordings apart."""
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
    page.add_table(columns, rows, caption)


def _add_where(page: Report, outcome: Outcome, machine: Machine) -> None:
    location = outcome.answer.more.get("location")
    if not location:
        return
    page.add_heading("Where the gap lies")
    page.add_picture(
        plots.draw_gap_map(outcome.answer, outcome.before, machine),
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
    page.add_table(
        ["joint", "error", "floor", "% of the error", "% of the gap"],
        rows,
        "Root mean square error of free runs of 5 s",
    )
    if not location["has_gap"]:
        page.add_text(
            "No joint exceeds its floor beyond what chance explains; shares of the gap are those of chance, then.",
            "warn",
        )
    if location["blocks"]:
        page.add_text(
            f"Tested by exchanging {location['blocks']} between field and reference, with at most 5 % false discoveries."
        )


def _add_paths(page: Report, outcome: Outcome, machine: Machine) -> None:
    page.add_heading("Measured and simulated")
    caption = (
        "Joints with the largest gaps. The simulator is given the recorded commands (grey, below) and begins "
        "anew every 5 s (thin lines). Black: measured; orange: simulated as it was; blue: with the effects that were found."
    )
    page.add_picture(plots.draw_paths(outcome, machine), caption)


def _add_growth(page: Report, outcome: Outcome, machine: Machine) -> None:
    location = outcome.answer.more.get("location")
    if not location:
        return
    page.add_heading("How the error grows")
    page.add_picture(
        plots.draw_growth(outcome, machine),
        "Error over the time of a free run; what exceeds the floor tells its kind.",
    )
    rows = []
    for name, growth in location["growth"].items():
        unit = machine.joints[machine.joint_names.index(name)].unit
        errors = [f"{1e3 * value:.2f}" for value in growth["rmse"]]
        whole = "–" if growth["whole_run"] is None else f"{1e3 * growth['whole_run']:.0f}"
        rows.append([f"{name} [m{unit}]", *errors, whole, READINGS[growth["reading"]]])
    horizons = [f"{value:g} s" for value in next(iter(location["growth"].values()))["horizon_s"]]
    page.add_table(
        ["joint", *horizons, "whole run", "reading"],
        rows,
        "Root mean square error at the end of free runs",
    )


def _add_evidence(page: Report, more: Mapping[str, Any]) -> None:
    evidence, probes = more.get("evidence"), more.get("probes", [])
    figure = plots.draw_rivals(evidence) if isinstance(evidence, Mapping) else None
    if figure or probes:
        page.add_heading("Why these effects and not others")
    if figure:
        page.add_picture(
            figure, "What each rival earns on recordings that it was not fitted to; blue: chosen."
        )
    if probes:
        page.add_text(
            "What the simulator's errors look like, by families of effects that leave such traces (compared with the reference):"
        )
        clear = [
            probe["text"] + f" – as {name_effect(probe['effect'])} does"
            for probe in probes
            if abs(probe["z"]) > 4.0
        ]
        page.add_list(clear[:MAX_LISTED] or ["no trace stands out"])


def _add_stages(page: Report, more: Mapping[str, Any]) -> None:
    stages, budget = more.get("stages", []), more.get("budget")
    if not stages:
        return
    page.add_heading("At the tool, and by stage")
    if budget:
        page.add_picture(
            plots.draw_tip_budget(budget),
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
        page.add_table(
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
    page.add_table(["stage", "% of the joints' gap", "at the tool, mm", "why"], rows)


def _add_next_experiment(page: Report, outcome: Outcome) -> None:
    following = outcome.answer.next_experiment
    if following is None:
        return
    page.add_heading("Next experiment")
    between = (
        f" It separates {join_words([name_effect(name) for name in following.separates])}."
        if following.separates
        else ""
    )
    page.add_text(f"{following.why}{between}".strip())
    page.add_code(following.excitation)


def _add_sanity(page: Report, more: Mapping[str, Any]) -> None:
    remarks = more.get("sanity")
    if remarks is None:
        return
    page.add_heading("Can the recordings be trusted?")
    if not remarks:
        page.add_text(
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
    page.add_table(["what", "joint", "where", "how much, and what it means"], rows[:MAX_LISTED])
    if len(rows) > MAX_LISTED:
        with page.add_details(f"{len(rows) - MAX_LISTED} more"):
            page.add_table(
                ["what", "joint", "where", "how much, and what it means"], rows[MAX_LISTED:]
            )


def _add_details(page: Report, more: Mapping[str, Any]) -> None:
    location = more.get("location")
    if not location:
        return
    page.add_heading("All parts of the gap")
    for name, parts in location["parts"].items():
        with page.add_details(f"by {name}"):
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
            page.add_table(
                ["joint", name, "% of the time", "% of the error", "% of the gap", "p"],
                rows,
                caption,
            )


def _describe_remark(remark: Mapping[str, Any]) -> str:
    joint = f" ({remark['joint']})" if remark["joint"] else ""
    return f"{remark['name']}{joint} in {remark['recording']}: {remark['amount']}. {remark['meaning']}; {remark['advice']}."
