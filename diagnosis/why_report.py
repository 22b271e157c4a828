"""The page of `mode=why`: the answer, its pictures and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brokk_rl import registry
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, GREY, RED, add_legend, make_figure, remove_frame
from brokk_rl.report import Cell, Report
from brokk_rl.session import read_record
from diagnosis import answer, report
from diagnosis.deployment.page import EVIDENCE_FILE, PAGE_FILE
from diagnosis.retraining import format_rate
from diagnosis.why_answer import (
    ALL_EFFECTS,
    BEFORE,
    DIAGNOSIS,
    DOCTOR,
    WhyRequest,
    WhyResult,
    judge_suspects,
    list_changes,
    list_records,
    read_result,
    write_summary,
)

WHY_PAGE = "why.html"
LOW_SUCCESS = 0.8
"""Success without the effects below which the simulator is doubted; chosen by hand."""


def write_why_page(
    folder: Path,
    titles: Mapping[str, str],
    machine: Machine | None = None,
    request: WhyRequest | None = None,
) -> None:
    """Write `why.html` from what the stages have left so far.

    Raises:
        StorageError: it could not be written.
    """
    result = read_result(folder, request)
    page = Report(result.title, write_summary(result), result.tone)
    page.add_table(["suspect", "result", "evidence"], _list_suspects(result))
    _add_evidence(page, result, machine)
    _add_effects(page, result, machine.joint_names if machine else ())
    _add_costs(page, result, titles)
    for title, steps in (
        ("What to change", list_changes(result)),
        ("What to record next", list_records(result)),
    ):
        if steps:
            page.add_heading(title)
            for text, command in steps:
                page.add_text(text)
                if command:
                    page.add_code(command)
    page.add_heading("How this was found")
    links = {f"Code, task and motion in detail: {PAGE_FILE}": f"{DOCTOR}/{PAGE_FILE}"}
    if result.diagnosis is not None:
        links[f"The diagnosis in detail: {report.REPORT_FILE}"] = (
            f"{DIAGNOSIS}/{report.REPORT_FILE}"
        )
    page.add_links(links)
    with page.add_details("Stages and their commands"):
        _add_stages(page, folder, titles)
    page.write(folder / WHY_PAGE)


def _list_suspects(result: WhyResult) -> list[list[str | Cell]]:
    rows: list[list[str | Cell]] = []
    names = ("deployed code", "machine", "task")
    for name, (state, evidence) in zip(names, judge_suspects(result), strict=True):
        rows.append([name, state, evidence])
    return rows


def _add_evidence(page: Report, result: WhyResult, machine: Machine | None) -> None:
    """Add the picture that shows the cause."""
    if result.cause != "code" and result.has_effects and machine is not None:
        figure = draw_motion(result.folder, machine)
        if figure is not None:
            page.add_picture(
                figure,
                "The joint with the largest gap under the recorded commands: the machine (black), the "
                "simulator as it is (orange), and with the found effects (blue). A simulated line begins "
                "at the measured position.",
            )
            return
    picture = result.folder / DOCTOR / EVIDENCE_FILE
    if picture.is_file():
        caption = (
            "What the replay of the policy commands (blue) and what the log holds (orange). Colours "
            "above: size of the difference."
            if result.cause == "code" or result.doctor["actuator"]["cannot_tell"]
            else "Departure of each joint from the simulator: this machine, and the machines of the training."
        )
        page.add_picture(picture, caption)


def draw_motion(folder: Path, machine: Machine) -> Figure | None:
    """Draw the worst free run of the joint with the largest gap; `None` where there is none.

    Args:
        folder: Run folder of `mode=why`.
        machine: The machine.
    """
    try:
        outcome = answer.load_outcome(folder / DIAGNOSIS, machine)
    except RecordingError:
        return None
    located = outcome.answer.where.joints
    if not located or outcome.after is None:
        return None
    name = max(located, key=lambda joint: located[joint].share)
    joint, before = machine.joint_names.index(name), outcome.before
    window = int(np.argmax(np.nan_to_num(np.mean(before.error[:, :, joint] ** 2, axis=1))))
    recording = before.recordings[int(before.source[window])]
    begin = int(before.row[window])
    end = min(begin + before.simulated.shape[1], recording.num_samples)
    t_s = recording.t_s[begin:end]
    figure = make_figure(6.4, 3.2)
    axis, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    axis.plot(t_s, recording.q[begin:end, joint], color="black", lw=2, label="machine")
    for runs, colour, label in (
        (before, RED, "simulator as it is"),
        (outcome.after, BLUE, "simulator with the effects"),
    ):
        axis.plot(t_s, runs.simulated[window, : end - begin, joint], color=colour, label=label)
    axis.set_ylabel(f"{name}, {machine.joints[joint].unit}")
    below.fill_between(t_s, recording.u[begin:end, joint], step="post", color=GREY, alpha=0.5, lw=0)
    below.set_ylabel("command")
    below.set_xlabel("time in the log, s")
    for one in (axis, below):
        remove_frame(one)
    add_legend(figure, axis)
    return figure


def _add_effects(page: Report, result: WhyResult, names: Sequence[str]) -> None:
    found = result.diagnosis
    if found is None or not found.selected:
        return
    page.add_heading("Which effect")
    summaries = {
        option.name: option.summary()
        for option in registry.list_options()
        if option.group == "effect"
    }
    numbers = [value for one in found.selected for value in one.parameters.values()]
    joints = list(dict.fromkeys(joint for by_joint in numbers for joint in by_joint))
    joints.sort(key=lambda name: names.index(name) if name in names else -1)
    rows: list[list[str | Cell | None]] = []
    for one in found.selected:
        same = ", ".join(report.name_effect(name) for name in one.same_as)
        head: list[str | Cell | None] = [
            Cell(report.name_effect(one.effect), summaries.get(one.effect, "")),
            Cell(f"{one.probability:.2f}", f"that, or {same}" if same else ""),
        ]
        for parameter, by_joint in one.parameters.items():
            row = [Cell(*report.format_estimate(by_joint.get(joint))) for joint in joints]
            rows.append([*head, parameter, *row])
            head = ["", ""]
    page.add_table(
        ["effect", "probability", "number", *joints],
        rows,
        "Numbers of each joint with 95 % intervals; units stand in the names; a gain of 1 means no change",
    )


def _add_costs(page: Report, result: WhyResult, titles: Mapping[str, str]) -> None:
    if not result.has_effects:
        return
    page.add_heading("What it costs in success")
    if result.costs:
        page.add_picture(
            draw_costs(result, titles),
            "Share of simulated episodes that succeed, from the same starts; bars: 95 % intervals.",
        )
        order = list(titles)
        rows = [[titles.get(BEFORE, BEFORE), format_rate(result.success[BEFORE]), None]]
        for name in sorted(result.costs, key=lambda one: order.index(one) if one in order else -1):
            loss = result.costs[name]
            high, low = (-100 * bound for bound in loss["ci95"])
            change = Cell(f"{-100 * loss['mean']:+.0f}", f"{low:+.0f} to {high:+.0f}")
            rows.append([titles.get(name, name), format_rate(result.success[name]), change])
        page.add_table(["simulator", "strict success", "change, points"], rows)
        if result.success[BEFORE]["mean"] < LOW_SUCCESS:
            page.add_text(
                "The policy often fails in this simulator even without the effects. Is it the one that it was trained in?",
                "warn",
            )
    if result.unmeasured:
        names = report.join_words([report.name_effect(name) for name in result.unmeasured])
        page.add_text(f"Not measured: the cost of {names}. {_explain_unmeasured(result)}", "warn")


def _explain_unmeasured(result: WhyResult) -> str:
    if ALL_EFFECTS in result.success:
        return "It is a number inside of the MJCF file, which mode=change_simulator changes."
    record = read_record(result.folder / BEFORE)
    if record is not None and record.get("outcome") != "finished":
        return "The evaluation failed; the messages of the command say why."
    return (
        "Success is measured with policies that mode=train or mode=export wrote, and effects that "
        "act around the simulator."
    )


def draw_costs(result: WhyResult, titles: Mapping[str, str]) -> Figure:
    """Draw the success as trained, with each effect, and with all."""
    names = [BEFORE, *(name for name in titles if name in result.costs)]
    figure = make_figure(6.4, 0.9 + 0.45 * len(names))
    axis = figure.subplots()
    for place, name in enumerate(names):
        rate = result.success[name]
        mean, (low, high) = 100 * rate["mean"], (100 * bound for bound in rate["ci95"])
        colour = GREY if name == BEFORE else RED
        axis.barh(place, mean, color=colour, height=0.6)
        axis.errorbar(mean, place, xerr=[[mean - low], [high - mean]], color="black", capsize=3)
        axis.annotate(
            f"{mean:.0f} %", (high, place), (8, 0), textcoords="offset points", va="center"
        )
    axis.set_yticks(range(len(names)), [titles[name] for name in names])
    axis.invert_yaxis()
    axis.set_xlim(0, 112)
    axis.set_xticks(range(0, 101, 20))
    axis.set_xlabel("strict success, %")
    remove_frame(axis)
    return figure


def _add_stages(page: Report, folder: Path, titles: Mapping[str, str]) -> None:
    """Add purpose, outcome, minutes and commands of the stages, whose purposes are `titles`."""
    page.add_heading("Stages")
    rows, whole_s = [], 0.0
    for name, title in titles.items():
        record = read_record(folder / name)
        if record is None:
            rows.append([name, title, None])
            continue
        seconds = _measure_seconds(record)
        whole_s += seconds or 0.0
        rows.append(
            [
                name,
                Cell(title, f"{record['outcome']}; {record['mode']}"),
                None if seconds is None else f"{seconds / 60:.1f}",
            ]
        )
    rows.append(["", "all", f"{whole_s / 60:.1f}"])
    page.add_table(["stage", "purpose", "minutes"], rows)
    with page.add_details("The commands"):
        records = (read_record(folder / name) for name in titles)
        page.add_code(
            "\n\n".join(f"brokk {' '.join(record['command'][1:])}" for record in records if record)
        )


def _measure_seconds(record: Mapping[str, Any]) -> float | None:
    """Return the duration of a stage by its `session.json`; `None` where it has not ended."""
    if not record.get("ended"):
        return None
    begun, ended = (datetime.fromisoformat(record[key]) for key in ("started", "ended"))
    return (ended - begun).total_seconds()
