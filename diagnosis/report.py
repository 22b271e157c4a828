"""The report of a diagnosis: sentences, tables and figures in one HTML page.

In figures black is the measurement, red the simulator as it was, blue the one with the effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from actuators.motion_panels import MotionWindow, draw_motion_panels
from actuators.recordings.recording_checks import name_recording
from actuators.scales import choose_horizon_s
from brokk_rl.machine import Machine
from brokk_rl.plot import BLUE, RED
from brokk_rl.report import Tone, embed_picture, render_page
from brokk_rl.session import write_text
from diagnosis.answer import Answer, Estimate, Gap, Outcome, Selected, format_error
from diagnosis.closure import MIN_RESTORED
from diagnosis.where import REGIMES

REPORT_FILE = "report.html"
TEMPLATE = Path(__file__).with_name("diagnosis.html.jinja")
GOOD_CLOSED = 0.5
"""Closed share of the gap from which the headline is good news; chosen by hand."""
SEVERITIES = {"bad": "severe", "warn": "check it", "note": "good to know"}
MAX_RIVALS = 14
"""Most rivals of the table. Chosen by hand: a screen."""
MAX_LISTED = 8
"""Most remarks in sight; the rest is folded. Chosen by hand: a screen."""
RIVALS = {
    "hold": "standing still",
    "arx": "ARX with dead-band hinges, fitted to other parts of the field",
}
"""Rivals in words."""


def write_headline(answer: Answer) -> tuple[str, Tone]:
    """Return the answer in two or three sentences, and whether it is good news."""
    gap = answer.gap
    told = ""
    if gap is not None:
        told = f" Error over free runs: {format_error(gap.before, gap.unit)} before"
        told += f", {format_error(gap.after, gap.unit)} after" if answer.selected else ""
        told += "; " + _describe_floor(gap) + "."
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
    tone: Tone = "good" if closed is not None and closed.ci95[0] > GOOD_CLOSED else "warn"
    it = "it" if len(answer.selected) == 1 else "them"
    if closed is None:
        return f"The simulator lacks {names}.{told}", tone
    share = _format_share(closed)
    below = " The error is then below its floor." if closed.mean > 1.0 else ""
    return f"The simulator lacks {names}; adding {it} closes {share}.{below}{told}", tone


def _describe_floor(gap: Gap) -> str:
    whose = "" if gap.floor_of == "reference" else ", that of an ARX or of the repaired simulator"
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


def describe_edit(one: Selected) -> str:
    """Return that an effect failed the edit test, or nothing."""
    if one.identified is not False or one.edit is None:
        return ""
    effect = one.effect.replace("_", " ")
    return (
        f"Not identified: without {effect} the repaired simulator's error rises by "
        f"{100 * one.edit['restored']:.0f} % of this effect's part; "
        f"{100 * MIN_RESTORED:.0f} % or more are expected, and an interval that is above 0."
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
    where = answer.where
    if not where.joints:
        return ""
    joint, told = max(where.joints.items(), key=lambda pair: pair[1]["share"])
    place = f"; {100 * told['share']:.0f} % of it lies in {joint}"
    if where.regimes:
        first = where.regimes[0]
        place += f", most of all {first.regime} of {first.joint}"
    return place


def _format_share(value: Estimate) -> str:
    """Return a share of the gap in percent, with its interval where there is one."""
    low, high = (f"{100 * bound:.0f}" for bound in value.ci95)
    interval = f" (95 %: {low} to {high} %)" if value.has_interval else ""
    return f"{100 * value.mean:.0f} % of the gap{interval}"


def write_report(outcome: Outcome, folder: Path, machine: Machine) -> None:
    """Write `report.html` into `folder`; parts that the answer lacks are left out.

    Raises:
        StorageError: it could not be written.
    """
    answer, more = outcome.answer, outcome.answer.more
    headline, tone = write_headline(answer)
    values = {
        "title": f"Missing effects in the simulator of {machine.name}",
        "headline": headline,
        "tone": tone,
        "said": answer,
        "more": more,
        "picture_of_paths": embed_picture(draw_paths(outcome, machine)),
        "horizon_s": choose_horizon_s(machine),
        "units": {joint.name: joint.unit for joint in machine.joints},
        "regimes": list(REGIMES),
        "rivals": RIVALS,
        "severities": SEVERITIES,
        "max_listed": MAX_LISTED,
        "earned": more.get("evidence", {}).get("rivals", ())[:MAX_RIVALS],
        "describe_class": describe_class,
        "describe_edit": describe_edit,
        "name_effect": name_effect,
        "list_on_joints": list_on_joints,
        "join_words": join_words,
        "format_error": format_error,
        "format_estimate": format_estimate,
    }
    write_text(folder / REPORT_FILE, render_page(TEMPLATE, values))


MAX_JOINTS = 3
"""Joints whose paths are drawn."""


def draw_paths(outcome: Outcome, machine: Machine) -> Figure:
    """Draw measured and simulated positions of the joints with the largest gaps."""
    before = outcome.before
    error = np.sqrt(np.nanmean(before.error**2, 1))  # (W, J)
    joints = outcome.answer.where.joints
    foremost = [-joints[name]["share"] if joints else 0.0 for name in machine.joint_names]
    rows = {}
    for joint in np.argsort(foremost, kind="stable")[:MAX_JOINTS].tolist():
        worst = np.argsort(-np.nan_to_num(error[:, joint]))
        whole = np.flatnonzero(before.source == before.source[worst[0]])
        rows[joint] = [
            _show_windows(outcome, joint, "a whole recording", whole),
            _show_windows(outcome, joint, "worst window", worst[:1]),
        ]
    return draw_motion_panels(rows, machine, (1.9, 1.0))


def _show_windows(outcome: Outcome, joint: int, title: str, windows: np.ndarray) -> MotionWindow:
    """Return some windows of one recording on one time axis."""
    before = outcome.before
    recording = before.recordings[int(before.source[windows[0]])]
    steps, count = before.simulated.shape[1], recording.num_samples
    first = int(before.row[windows].min())
    last = min(int(before.row[windows].max()) + steps, count)
    paths = []
    for runs, colour, label in (
        (before, RED, "simulated before"),
        (outcome.after, BLUE, "simulated after"),
    ):
        if runs is None:
            continue
        for number, window in enumerate(windows):
            begin = int(before.row[window])
            end = min(begin + steps, count)
            style = {"color": colour, "lw": 1.3, "label": None if number else label}
            paths.append(
                (recording.t_s[begin:end], runs.simulated[window, : end - begin, joint], style)
            )
    shown = slice(first, last)
    return MotionWindow(
        title=f"{title}: {name_recording(recording)}",
        t_s=recording.t_s[shown],
        measured=recording.q[shown, joint],
        u=recording.u[shown, joint],
        paths=paths,
        foremost=np.concatenate([path for _, path, _ in paths]),
    )
