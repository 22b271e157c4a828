"""The doctor's page: verdict, where and when the log departs, and what to change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from brokk_rl.plot import BLUE, GREY, ORANGE, RED, add_legend, make_figure, remove_frame
from brokk_rl.report import Cell, Report, Tone
from diagnosis.deployment.doctor import DoctorAnswer
from diagnosis.deployment.examination import UNLISTED, Finding, RunExamination
from diagnosis.deployment.fault_search import StageResult
from diagnosis.deployment.motion_check import MotionEvidence

PAGE_FILE = "doctor.html"
EVIDENCE_FILE = "evidence.png"
"""Picture of the verdict: the departing command, or the motion of the joints."""
TITLES = {
    "code": "The deployed code does something else than the contract says",
    "actuator": "The machine moves otherwise than those of the training",
    "task": "The run lies outside of the training",
    "nothing": "Nothing found",
    "cannot_tell": "The log does not suffice",
}
TONES: dict[str, Tone] = {
    "code": "bad", "actuator": "bad", "task": "warn", "nothing": "good", "cannot_tell": "warn"
}  # fmt: skip
STAGE_TITLES = {
    "observation": "from the log's signals to the observation",
    "network": "from the observation to the command",
    "policy": "from the log's signals to the command",
    "delivery": "from the policy's command to the command in force",
}
REMEDIES = {
    "order": "Compare the order of joints, terms and samples with `joints` and `observation` of policy.json.",
    "sign": "Turn the sign where the signal enters the program, and check it with one joint moved by hand.",
    "scale": "Compare units, `mean` and `std` of the field with policy.json.",
    "frame": "Give the point in the base frame of the machine: x ahead, y to the left, z up.",
    "rate": "Run the loop at `rate_hz`, take one sample of history a period, and send each command.",
    "delay": "Take the newest sample when the policy decides; look for queues on the way.",
    "stale": "Look for a signal that is not subscribed or has stopped, and refuse values that are too old.",
    "clip": "Take the clip away, or train with it.",
    "default_pose": "Check the zero of the joint, and the default pose or mean that is subtracted.",
    "history": "Fill the history as `history` of policy.json says before the first command.",
    "filter": "Take the filter away, or train with it.",
    "network": "Compare policy.onnx on the machine with the one that was meant, and with golden.json.",
    UNLISTED: "Log the observation vector too (obs_0, obs_1, …): then the doctor says which number departs first.",
}
"""Next step by kind of mistake."""
SEEN_REMEDY = "Look where the numbers are made that depart first; the picture shows them."
"""Next step for a mistake without a name in an observation that was logged."""
NUM_BANDS = 24
"""Numbers of the vector that the picture shows at most."""
LARGEST_RATIO = 1e4
"""End of the colour scale, in floors."""


def write_page(answer: DoctorAnswer, folder: Path) -> None:
    """Write `doctor.html`.

    Raises:
        StorageError: It could not be written.
    """
    page = Report(
        f"Deployment doctor: {TITLES[answer.verdict]}", answer.reason, TONES[answer.verdict]
    )
    for run in answer.runs:
        if len(answer.runs) > 1:
            page.add_heading(f"Log {_name_run(run)}")
        _add_code(page, run)
        _add_task(page, run)
    _add_motion(page, answer.motion)
    page.write(folder / PAGE_FILE)


def draw_evidence(answer: DoctorAnswer) -> Figure | None:
    """Draw what the verdict rests on: a departing command, the joints' motion, or the best replay."""
    stages = [(stage, run) for run in answer.runs for stage in run.stages]
    departing = [one for one in stages if one[0].departs]
    if not departing and answer.motion.joints:
        return _draw_motion(answer.motion)
    replayed = [one for one in stages if one[0].stage in ("policy", "network")]
    for stage, run in (*departing, *replayed):
        return _draw_departure(stage, run.log.t_s)
    return None


def describe_remedies(findings: Sequence[Finding]) -> list[str]:
    """Return what to change, one text for each kind of mistake."""
    texts = []
    for finding in findings:
        is_seen = finding.kind == UNLISTED and finding.stage == "observation"
        texts.append(SEEN_REMEDY if is_seen else REMEDIES[finding.kind])
    return list(dict.fromkeys(texts))


def _name_run(run: RunExamination) -> str:
    path = run.log.recording.path
    return path.name if path else "without a name"


def _add_code(page: Report, run: RunExamination) -> None:
    page.add_heading("Code")
    if run.findings:
        rows = []
        for one in run.findings:
            same = ", ".join(f"{kind} of {field}" for kind, field in one.alike)
            share = f"{one.explained:.1%}" if one.is_named and one.explained else None
            shows = f"{one.begin_s:.2f} to {one.end_s:.2f} s"
            text = Cell(one.text, f"the log shows as well: {same}" if same else "")
            rows.append([one.kind, one.field, shows, share, text])
        page.add_table(["kind", "field", "shows", "rows explained", "mistake"], rows)
        page.add_list(describe_remedies(run.findings))
    for stage in run.stages:
        departs = stage.departs
        share = f"{len(stage.departed)} of {stage.num_rows} rows depart"
        page.add_heading(f"The way {STAGE_TITLES[stage.stage]}: {share}", 3)
        if departs or stage.stage in ("policy", "network"):
            page.add_picture(
                _draw_departure(stage, run.log.t_s),
                "Above: difference between log and replay in floors, the rounding of log and network; "
                "white: below it. Below: the command in which most rows depart, or that moves most.",
            )
        if departs:
            _add_ranking(page, stage)
    for text in (*run.cannot_tell, *run.notes):
        page.add_text(f"Not judged: {text}.", "warn")


def _add_ranking(page: Report, stage: StageResult) -> None:
    with page.add_details("Mistakes that come nearest"):
        rows = []
        for one in stage.ranking[:8]:
            number = f"{one.value:.4g}" if one.distortion.parameter else None
            rows.append(
                [
                    f"{one.distortion.kind} of {one.distortion.field}",
                    number,
                    f"{one.explained:.1%}",
                    f"{one.gain:.1%}",
                ]
            )
        page.add_table(["mistake", "number", "rows explained", "difference removed"], rows)


def _draw_departure(stage: StageResult, t_s: np.ndarray) -> Figure:
    """Return a figure: differences in floors over time, and one number of log and replay."""
    labels, ratio = _group_numbers(stage)
    figure = make_figure(9.0, 2.6 + 0.24 * len(labels) + 2.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[0.6 + 0.24 * len(labels), 2.2])
    # Columns are at least as wide as a pixel of the page.
    edges = np.append(t_s, t_s[-1] + (t_s[-1] - t_s[0]) / max(1, len(t_s) - 1))
    mesh = upper.pcolormesh(
        edges, np.arange(len(labels) + 1), np.ma.masked_less(ratio.T, 1.0),
        norm=LogNorm(1.0, LARGEST_RATIO), cmap="inferno_r",
    )  # fmt: skip
    upper.set_yticks(np.arange(len(labels)) + 0.5, labels)
    upper.invert_yaxis()
    figure.colorbar(mesh, ax=upper, label="difference, floors", fraction=0.04, pad=0.01)
    column = _choose_column(stage)
    logged = stage.logged[:, column]
    replayed = logged + stage.residual[:, column]
    lower.plot(t_s, replayed, color=BLUE, label="replay of the contract")
    lower.plot(t_s, logged, color=ORANGE, linestyle="--", label="log")
    departed = np.zeros(len(t_s), bool)
    departed[stage.departed] = True
    low, high = lower.get_ylim()
    lower.fill_between(
        t_s, low, high, where=departed, color=RED, alpha=0.12, label="departs", linewidth=0
    )
    lower.set_ylim(low, high)
    lower.set_xlabel("time, s")
    lower.set_ylabel(stage.labels[column])
    remove_frame(lower)
    add_legend(figure, lower)
    return figure


def _group_numbers(stage: StageResult) -> tuple[list[str], np.ndarray]:
    """Return names and differences in floors, `(T, B)`: samples of one column share a band."""
    ratio = np.nan_to_num(np.abs(stage.residual) / stage.floor)
    names = [label.partition("[")[0] for label in stage.labels]
    bands = list(dict.fromkeys(names))
    grouped = np.stack(
        [ratio[:, [i for i, name in enumerate(names) if name == band]].max(1) for band in bands], 1
    )
    if len(bands) > NUM_BANDS:
        kept = np.sort(np.argsort(-grouped.mean(0), kind="stable")[:NUM_BANDS])
        bands, grouped = [bands[i] for i in kept], grouped[:, kept]
    return bands, grouped


def _choose_column(stage: StageResult) -> int:
    ranked = stage.rank_labels()
    if ranked:
        return stage.labels.index(ranked[0][0])
    return int(np.argmax(np.nan_to_num(np.nanstd(stage.logged, axis=0))))


def _add_task(page: Report, run: RunExamination) -> None:
    page.add_heading("Task: the range of the training")
    if run.task.cannot_tell:
        page.add_text(f"Not judged: {run.task.cannot_tell}.", "warn")
        return
    if not run.task.outside:
        page.add_text("Target and positions lie within the range of the training's observations.")
        return
    rows = [
        [
            one.field,
            f"{one.share:.0%}",
            f"{run.log.t_s[one.begin]:.2f} s",
            f"{one.lowest:.3g} to {one.highest:.3g}",
            f"{one.low:.3g} to {one.high:.3g}",
        ]
        for one in run.task.outside
    ]
    page.add_table(["value", "rows outside", "since", "log", "training"], rows, "rad and m")


def _add_motion(page: Report, motion: MotionEvidence) -> None:
    page.add_heading("Actuator: motion under the recorded commands")
    if motion.cannot_tell:
        page.add_text(f"Not judged: {motion.cannot_tell}.", "warn")
        return
    page.add_picture(
        _draw_motion(motion),
        f"Departure from the simulator over free runs of {motion.horizon_s:g} s, RMS. Machines of the "
        "training differ from it too; a joint that departs by 30 % more than 98 % of them is blamed.",
    )


def _draw_motion(motion: MotionEvidence) -> Figure:
    figure = make_figure(6.4, 2.8)
    axis = figure.subplots()
    places = np.arange(len(motion.joints))
    largest = [one.largest for one in motion.joints]
    axis.bar(places - 0.2, [one.recorded for one in motion.joints], 0.36, label="log",
             color=[RED if one.blamed else BLUE for one in motion.joints])  # fmt: skip
    axis.bar(places + 0.2, largest, 0.36, color=GREY, alpha=0.45, label="training, 98 % of them")
    axis.bar(
        places + 0.2,
        [one.typical for one in motion.joints],
        0.36,
        color=GREY,
        label="training, median",
    )
    names = [one.joint if one.moves else f"{one.joint}\n(rests)" for one in motion.joints]
    axis.set_xticks(places, names)
    axis.set_ylabel("RMS, rad or m")
    remove_frame(axis)
    add_legend(figure, axis)
    return figure
