"""The report of a diagnosis: sentences, tables and figures in one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from actuators.scales import choose_horizon_s
from brokk_rl.machine import Machine
from brokk_rl.report import Cell, Report, Tone
from diagnosis import plots, report_checks
from diagnosis.answer import Answer, Estimate, Gap, Outcome, Selected, format_error

GOOD_CLOSED = 0.5
"""Closed share of the gap from which the headline is good news; chosen by hand."""


def write_headline(answer: Answer) -> tuple[str, Tone]:
    """Return the answer in two or three sentences, and whether it is good news."""
    gap = answer.gap
    told = ""
    if gap is not None:
        told = f" Error over free runs: {format_error(gap.before, gap.unit)} before"
        told += f", {format_error(gap.after, gap.unit)} after" if answer.selected else ""
        told += "; " + _describe_floor(gap) + "."
    told += _describe_tool(answer)
    if answer.verdict == "none":
        return (
            f"No gap: the simulator errs as the unchanged machine would under this motion.{told}",
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
    it = "it" if len(answer.selected) == 1 else "them"
    if closed is None or gap is None:
        fewer = f" Adding {it} removes {_format_share(gap.reduction)} of the error." if gap else ""
        why = f" No share of the gap is told: {gap.closed_reason}." if gap else ""
        return f"The simulator lacks {names}.{fewer}{why}{told}{rest}", tone
    share = f"{_format_share(closed, ' of the gap')}"
    below = " The error is then below its floor." if closed.mean > 1.0 else ""
    return f"The simulator lacks {names}; adding {it} closes {share}.{below}{told}{rest}", tone


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
    interval = f"{low:{style}} to {high:{style}}" if value.has_interval else "no interval"
    return f"{factor * value.mean:{style}}", interval + (", at its bound" if value.at_bound else "")


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


def _format_share(value: Estimate, of: str = "") -> str:
    """Return a share in percent, with its interval where there is one."""
    low, high = (f"{100 * bound:.0f}" for bound in value.ci95)
    interval = f" (95 %: {low} to {high} %)" if value.has_interval else ""
    return f"{100 * value.mean:.0f} %{of}{interval}"


REPORT_FILE = "report.html"
SEVERITIES = {"bad": "severe", "warn": "check it", "note": "good to know"}
BEYOND_CHANCE = "beyond chance"
MAX_LISTED = 8
"""Most rows of a list; the rest is folded. Chosen by hand: a screen."""


def write_report(outcome: Outcome, folder: Path, machine: Machine) -> None:
    """Write `report.html` into `folder`; parts that the answer lacks are left out.

    Raises:
        StorageError: it could not be written.
    """
    answer, more = outcome.answer, outcome.answer.more
    text, tone = write_headline(answer)
    page = Report(f"Missing effects in the simulator of {machine.name}", text, tone)
    if machine.interface == "speed" and (curves := more.get("curves")):
        page.add_picture(
            plots.draw_speed_curves(curves, machine),
            "Speed over command, positive and negative side. Black: the machine; red: the simulator "
            "under the same commands, fitted in the same way. Bands: 95 % by a bootstrap over blocks "
            "of 30 s. Titles: what changes the red curve into the black one.",
        )
    if figure := plots.draw_gap_bars(answer):
        page.add_picture(
            figure,
            f"Error of free runs of {choose_horizon_s(machine):g} s on recordings that no effect was "
            "fitted to: before, after, and the floor.",
        )
    report_checks.add_rivals(page, answer)
    for remark in more.get("sanity", []):
        if remark["severity"] == "bad":
            page.add_text(_describe_remark(remark), "bad")
    units = {joint.name: joint.unit for joint in machine.joints}
    _add_effects(page, answer)
    report_checks.add_gates(page, answer)
    _add_errors_by_joint(page, answer, units)
    report_checks.add_motion_delays(page, answer)
    _add_residual_model(page, more)
    _add_where(page, outcome, machine, units)
    page.add_heading("Measured and simulated")
    page.add_picture(
        plots.draw_paths(outcome, machine),
        "Joints with the largest gaps. The simulator gets the recorded commands (grey, below) and "
        f"starts anew every {choose_horizon_s(machine):g} s (thin lines). Black: measured; red: simulated as it was; blue: "
        "simulated with the effects.",
    )
    _add_evidence(page, more)
    _add_stages(page, more)
    _add_next_experiment(page, answer)
    _add_sanity(page, more)
    page.write(folder / REPORT_FILE)


def _add_effects(page: Report, answer: Answer) -> None:
    page.add_heading("Effects")
    if answer.verdict == "none":
        page.add_text("No effect that exceeds chance.")
    elif answer.verdict == "unknown":
        page.add_text("No effect of the library explains the gap.")
    rows = []
    for one in answer.selected:
        rows += _list_effect_rows(one)
    if rows:
        page.add_table(
            ["effect", "joints", "probability", "closes, %", "parameter", "value"],
            rows,
            "With 95 % intervals. 'Closes' is the effect's part of the gap (Shapley value).",
        )
    for one in answer.selected:
        page.add_text(describe_class(one), "warn")
        page.add_text(report_checks.describe_bounds(one), "warn")
        page.add_text(report_checks.describe_edit(one), "warn")
    page.add_text(describe_remainder(answer))
    if answer.reason and answer.verdict == "none":
        page.add_text(f"{answer.reason[0].upper()}{answer.reason[1:].rstrip('.')}.")
    predicted = answer.more.get("predicted_closed")
    if predicted and answer.gap and answer.gap.closed:
        page.add_text(
            f"Predicted on the parts of the recordings that sizes were fitted to: "
            f"{100 * predicted['mean']:.0f} % closed. Achieved on the other parts: "
            f"{100 * answer.gap.closed.mean:.0f} %."
        )


def _list_effect_rows(one: Selected) -> list[list[str | Cell | None]]:
    """Return a row for each parameter of an effect; only the first names the effect."""
    others = f"or {', '.join(name_effect(name) for name in one.same_as)}" if one.same_as else ""
    head: list[str | Cell | None] = [
        Cell(name_effect(one.effect), others),
        ", ".join(one.joints) or "machine",
        f"{one.probability:.2f}",
        Cell(*format_estimate(one.gap_closed, 100.0, ".0f")),
    ]
    rows: list[list[str | Cell | None]] = []
    for parameter, by_joint in one.parameters.items():
        for joint, value in by_joint.items():
            rows.append([*head, f"{parameter} {joint}", Cell(*format_estimate(value))])
            head = [""] * len(head)
    return rows or [[*head, "", None]]


def _add_errors_by_joint(page: Report, answer: Answer, units: Mapping[str, str]) -> None:
    """Add errors before and after the effects by joint, on unseen recordings too."""
    gap, unseen = answer.gap, answer.more.get("unseen")
    if not answer.selected or gap is None or not gap.joints:
        return
    rows = []
    for name, one in gap.joints.items():
        row = [f"{name} [m{units[name]}]", _scale(one.before), _scale(one.after)]
        row += [_scale(one.floor), f"{100 * one.share:.0f}"]
        if unseen:
            other = unseen["joints"][name]
            row += [_scale(other["before"]), _scale(other["after"]), f"{100 * other['share']:.0f}"]
        rows.append(row)
    columns = ["joint", "before", "after", "floor", "% less"]
    caption = "Root mean square error of free runs, on parts that sizes were not fitted to"
    if unseen:
        columns += ["unseen: before", "after", "% less"]
        caption += f"; unseen: {unseen['recordings']} further recordings"
        caption += f" ({unseen['seconds']:.0f} s)"
    page.add_table(columns, rows, caption)


def _add_residual_model(page: Report, more: Mapping[str, Any]) -> None:
    """Add how well a flexible model predicts the remaining error."""
    left = more.get("remainder")
    for key, label in (("undecided", "Undecided"), ("remainder", "Remainder")):
        if isinstance(found := more.get(key), str):
            page.add_text(f"{label}: {found}")
    if not isinstance(left, Mapping) or not left:
        return
    rows = []
    for joint, one in left.items():
        gains = [None if one.get(key) is None else f"{one[key]:.1f}" for key in ("earned", "null")]
        rows.append([joint, one.get("clue"), *gains])
    page.add_table(
        ["joint", "best input", "gain", "gain by chance"],
        rows,
        "Gain of a flexible model on the remaining error, log likelihood",
    )


def _add_where(page: Report, outcome: Outcome, machine: Machine, units: Mapping[str, str]) -> None:
    location = outcome.answer.more.get("location")
    if not location:
        return
    page.add_heading("Location of the gap")
    page.add_picture(
        plots.draw_gap_map(outcome.answer, outcome.before, machine),
        "Left: share of the gap, all cells together are 100 %; an error counts at its origin. "
        "Right: error of free runs along the recordings.",
    )
    rows = []
    for name, joint in location["joints"].items():
        sure = BEYOND_CHANCE if joint["is_sure"] else ""
        row = [f"{name} [m{units[name]}]", _scale(joint["rmse"]), _scale(joint["floor"])]
        rows.append([*row, f"{100 * joint['error']:.0f}", Cell(f"{100 * joint['gap']:.0f}", sure)])
    columns = ["joint", "error", "floor", "% of the error", "% of the gap"]
    page.add_table(columns, rows, "Root mean square error of free runs")
    if not location["has_gap"]:
        page.add_text("No joint exceeds its floor beyond chance; the shares are noise.", "warn")
    with page.add_details("All parts of the gap"):
        page.add_table(
            ["joint", "regime", "% of the time", "% of the error", "% of the gap", "p"],
            _list_parts(location["parts"]),
            "Error and gap add up to 100; p: probability of so large an error by chance, by a permutation "
            "test over parts of 30 s of the recordings; false discovery rate of 5 %.",
        )


def _list_parts(parts: Sequence[Mapping[str, Any]]) -> list[list[str | Cell | None]]:
    rows: list[list[str | Cell | None]] = []
    for part in parts:
        if part["time"] <= 0:
            continue
        p = None
        if part["p"] is not None:
            p = Cell(f"{part['p']:.4f}", BEYOND_CHANCE if part["is_sure"] else "")
        shares = [f"{100 * part[key]:.1f}" for key in ("time", "error", "gap")]
        rows.append([part["joint"], part["category"], *shares, p])
    return rows


def _add_evidence(page: Report, more: Mapping[str, Any]) -> None:
    evidence = more.get("evidence")
    figure = plots.draw_rivals(evidence) if isinstance(evidence, Mapping) else None
    if figure:
        page.add_heading("Why these effects and not others")
        page.add_picture(figure, "Gain of each rival on held-out recordings; blue: chosen.")


def _add_stages(page: Report, more: Mapping[str, Any]) -> None:
    stages, tip = more.get("stages", []), more.get("tip")
    if not stages:
        return
    page.add_heading("At the tool, and by stage")
    if tip:
        rows = []
        for joint in tip["before"]["joint_part"]:
            parts = [f"{100 * one['joint_part'][joint]:.0f}" for one in tip.values()]
            rows.append([f"% by {joint}", *parts])
        rows.append(["RMS, mm", *(_scale(one["tip_rms_m"]) for one in tip.values())])
        page.add_table(
            ["", *tip],
            rows,
            "Distance of the simulated from the measured tool over free runs, and the parts of the "
            "joints in its square; one that cancels others is below 0",
        )
    rows = []
    for stage in stages:
        part = None if stage["part"] is None else f"{100 * stage['part']:.0f}"
        rows.append([stage["stage"], part, _scale(stage["rms_m"]), stage["text"]])
    page.add_table(["stage", "% of the joints' gap", "at the tool, mm", "why"], rows)


def _add_next_experiment(page: Report, answer: Answer) -> None:
    following = answer.next_experiment
    if following is None:
        return
    page.add_heading("Next experiment")
    text = following.why
    if following.separates:
        names = join_words([name_effect(name) for name in following.separates])
        text += f" It separates {names}."
    page.add_text(text.strip())
    page.add_code(following.excitation)


def _add_sanity(page: Report, more: Mapping[str, Any]) -> None:
    remarks = more.get("sanity")
    if remarks is None:
        return
    page.add_heading("Can the recordings be trusted?")
    if not remarks:
        page.add_text(
            "No finding about clocks, lost frames, interlocks, sensors or exclusive joints.", "good"
        )
        return
    columns, rows = ["finding", "joint", "place", "amount and meaning"], []
    for remark in remarks:
        place = f"{remark['from_s']:.1f} to {remark['to_s']:.1f} s, {remark['count']} ×"
        meaning = f"{remark['meaning']}. To do: {remark['advice']}"
        rows.append(
            [
                Cell(remark["name"], SEVERITIES[remark["severity"]]),
                remark["joint"] or "all",
                Cell(remark["recording"], place),
                Cell(remark["amount"], meaning),
            ]
        )
    page.add_table(columns, rows[:MAX_LISTED])
    if len(rows) > MAX_LISTED:
        with page.add_details(f"{len(rows) - MAX_LISTED} more"):
            page.add_table(columns, rows[MAX_LISTED:])


def _scale(value: float | None) -> str | None:
    """Return an error in rad or m as text in mrad or mm."""
    return None if value is None else f"{1e3 * value:.1f}"


def _describe_remark(remark: Mapping[str, Any]) -> str:
    joint = f" ({remark['joint']})" if remark["joint"] else ""
    place = f"{remark['name']}{joint} in {remark['recording']}"
    return f"{place}: {remark['amount']}. {remark['meaning']}; {remark['advice']}."
