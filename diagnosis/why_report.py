"""The page of `mode=why`: the answer, its pictures and tables."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brokk_rl import registry
from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, GREY, RED, add_legend, make_figure, remove_frame
from brokk_rl.report import embed_picture, render_page
from brokk_rl.session import read_record, write_text
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
TEMPLATE = Path(__file__).with_name("why.html.jinja")
SUSPECTS = ("deployed code", "machine", "task")
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
    effects = result.diagnosis.selected if result.diagnosis else ()
    numbers = [value for one in effects for value in one.parameters.values()]
    named = dict.fromkeys(joint for by_joint in numbers for joint in by_joint)
    order = list(machine.joint_names) if machine else []
    options = [one for one in registry.list_options() if one.group == "effect"]
    links = {f"Code, task and motion in detail: {PAGE_FILE}": f"{DOCTOR}/{PAGE_FILE}"}
    if result.diagnosis is not None:
        file = report.REPORT_FILE
        links[f"The diagnosis in detail: {file}"] = f"{DIAGNOSIS}/{file}"
    values = {
        "title": result.title,
        "result": result,
        "summary": write_summary(result),
        "suspects": list(zip(SUSPECTS, judge_suspects(result), strict=True)),
        "evidence": _show_evidence(result, machine),
        "effects": effects,
        "summaries": {one.name: one.summary() for one in options},
        "joints": sorted(named, key=lambda name: order.index(name) if name in order else -1),
        "titles": titles,
        "is_doubted": result.costs and result.success[BEFORE]["mean"] < LOW_SUCCESS,
        "unmeasured": _explain_unmeasured(result) if result.unmeasured else "",
        "changes": list_changes(result),
        "records": list_records(result),
        "links": links,
        "stages": _list_stages(folder, titles),
        "name_effect": report.name_effect,
        "format_estimate": report.format_estimate,
        "format_rate": format_rate,
    }
    write_text(folder / WHY_PAGE, render_page(TEMPLATE, values))


def _show_evidence(result: WhyResult, machine: Machine | None) -> tuple[str, str] | None:
    """Return the picture that shows the cause, and its caption."""
    if result.cause != "code" and result.has_effects and machine is not None:
        figure = draw_motion(result.folder, machine)
        if figure is not None:
            return embed_picture(figure), (
                "The joint with the largest gap under the recorded commands: the machine (black), the "
                "simulator as it is (orange), and with the found effects (blue). A simulated line begins "
                "at the measured position."
            )
    picture = result.folder / DOCTOR / EVIDENCE_FILE
    if not picture.is_file():
        return None
    caption = (
        "What the replay of the policy commands (blue) and what the log holds (orange). Colours "
        "above: size of the difference."
        if result.cause == "code" or result.doctor["actuator"]["cannot_tell"]
        else "Departure of each joint from the simulator: this machine, and the machines of the training."
    )
    return embed_picture(picture), caption


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


def _list_stages(
    folder: Path, titles: Mapping[str, str]
) -> list[tuple[str, str, Mapping[str, Any] | None, float | None]]:
    """Return name, purpose, record and minutes of each stage, and the minutes of all."""
    rows, whole = [], 0.0
    for name, title in titles.items():
        record = read_record(folder / name)
        minutes = _measure_minutes(record)
        whole += minutes or 0.0
        rows.append((name, title, record, minutes))
    return [*rows, ("", "all", None, whole)]


def _measure_minutes(record: Mapping[str, Any] | None) -> float | None:
    """Return the duration of a stage by its `session.json`; `None` where it has not ended."""
    if record is None or not record.get("ended"):
        return None
    begun, ended = (datetime.fromisoformat(record[key]) for key in ("started", "ended"))
    return (ended - begun).total_seconds() / 60.0
