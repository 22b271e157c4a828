"""Report of a plan: `plan.json`, `plan.png`, and the notes that recordings carry."""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from actuators.excite.player import Sample
from actuators.excite.schedule import ExcitationPlan
from actuators.recordings.preview import PreviewResult
from actuators.recordings.preview_report import draw_preview, measure_picture_height
from brokk_rl.contracts.actuator import Segment
from brokk_rl.machine import Machine
from brokk_rl.plot import make_figure, remove_frame, save_figure

BEFORE, PLAYING, AWAY, AFTER = range(4)
"""On the way to the start of a segment and resting there; in its program; brought home meanwhile;
after the last one."""
STAGE = np.array([BEFORE, BEFORE, PLAYING, AWAY, AWAY, AFTER])
"""By phase of the runner."""


class PlanTrack:
    """All samples of a run as arrays.

    Attributes:
        t_s: Time, `(T,)`.
        q: Positions, `(T, N, J)`.
        u: Commands, `(T, N, J)`.
        stage: `BEFORE`, `PLAYING`, `AWAY` or `AFTER`, `(T, N)`.
        segment: Number of the segment, `(T, N)`.
        played: Control periods since its program began, `(T, N)`.
    """

    def __init__(self, samples: Iterable[Sample]) -> None:
        kept = list(samples)
        self.t_s = np.array([sample.t_s for sample in kept])
        self.q, self.u = (
            np.stack([sample.q for sample in kept]),
            np.stack([sample.u for sample in kept]),
        )
        self.stage = STAGE[np.stack([sample.phase for sample in kept])]
        self.segment = np.stack([sample.segment for sample in kept])
        self.played = np.stack([sample.played for sample in kept])


def describe_run(
    track: PlanTrack, run: int, segments: tuple[Segment, ...], period_s: float
) -> list[dict[str, Any]]:
    """Return the actions of one run on this track, in order, as plain JSON data.

    Times count from the first sample.

    Each entry: `name` of the segment; `part`: `approach` (with the rest after it) or `program`;
    `start_s` and `end_s`; for programs `offset_s`, how far the program was at `start_s` (0 unless a
    file begins in the middle), `away_s`, pairs of times between which the machine was brought home
    instead, and `repeat_of` where it repeats another segment.
    """
    t_s, stage, number = track.t_s - track.t_s[0], track.stage[:, run], track.segment[:, run]
    ends_s = np.append(t_s[1:], t_s[-1] + period_s)
    found = []
    for begin, end in split_stretches(number * 2 + (stage != BEFORE)):
        if stage[begin] == AFTER:
            continue
        segment = segments[number[begin]]
        entry: dict[str, Any] = {
            "name": segment.name,
            "part": "approach" if stage[begin] == BEFORE else "program",
        }
        entry |= {"start_s": _round_ms(t_s[begin]), "end_s": _round_ms(ends_s[end - 1])}
        if stage[begin] != BEFORE:
            entry["offset_s"] = _round_ms(track.played[begin, run] * period_s)
            away = []
            for i, k in split_stretches(stage[begin:end] == AWAY):
                if stage[begin + i] == AWAY:
                    away.append((begin + i, begin + k))
            entry["away_s"] = [[_round_ms(t_s[i]), _round_ms(ends_s[k - 1])] for i, k in away]
            if segment.repeat_of:
                entry["repeat_of"] = segment.repeat_of
        found.append(entry)
    return found


def summarise_plan(plan: ExcitationPlan, track: PlanTrack, machine: Machine) -> dict[str, Any]:
    """Return `plan.json`: segments of each run with predicted times, travel and commands."""
    used = (track.stage != AFTER).sum(0)
    return {
        "schema": 1,
        "machine": machine.name,
        "excitation": list(plan.names),
        "run_s": plan.run_s,
        "num_runs": len(plan.runs),
        "predicted": "by a nominal machine: dead time, full speed times command",
        "runs": [_summarise_run(run, track, n, machine) for n, run in enumerate(plan.runs)],
        "run_time_unused_s": [_round_ms(plan.run_s - machine.period_s * count) for count in used],
    }


def _summarise_run(
    run: tuple[Segment, ...], track: PlanTrack, n: int, machine: Machine
) -> list[dict[str, Any]]:
    """Return the segments of one run; one that finds no time has no `start_s`."""
    period_s, found = machine.period_s, []
    for i, segment in enumerate(run):
        mine = track.segment[:, n] == i
        before, inside = (
            mine & (track.stage[:, n] == BEFORE),
            mine & np.isin(track.stage[:, n], (PLAYING, AWAY)),
        )
        rows, planned = np.flatnonzero(inside), len(segment.u)
        entry: dict[str, Any] = {
            "name": segment.name,
            "repeat_of": segment.repeat_of,
            "program_s": _round_ms(planned * period_s),
        }
        entry["approach_s"] = _round_ms(before.sum() * period_s)
        entry["start_s"] = _round_ms(track.t_s[rows[0]]) if len(rows) else None
        entry["end_s"] = _round_ms(track.t_s[rows[-1]] + period_s) if len(rows) else None
        entry["away_s"] = _round_ms(int((track.stage[inside, n] == AWAY).sum()) * period_s)
        entry["cut_s"] = _round_ms((planned - len(rows)) * period_s)
        entry["joints"] = {}
        for j, joint in enumerate(machine.joints):
            q = track.q[inside, n, j]
            entry["joints"][joint.name] = {
                f"travel_{joint.unit}": round(float(np.abs(np.diff(q)).sum()), 4),
                f"range_{joint.unit}": [round(float(q.min()), 4), round(float(q.max()), 4)]
                if len(q)
                else None,
                "commanded": round(float((track.u[inside, n, j] != 0).mean()), 4)
                if len(q)
                else 0.0,
            }
        found.append(entry)
    return found


def split_stretches(values: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end of each stretch of equal values."""
    edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
    return list(pairwise(edges))


def _round_ms(value_s: Any) -> float:
    return round(float(value_s), 3)


COLORS = ("#4e79a7", "#f28e2b", "#59a14f", "#b07aa1", "#76b7b2", "#edc948", "#9c755f")
"""One for each excitation of a plan."""
WAY = "#d9d9d9"
ALONE = "#e15759"
LETTER = 0.0075
"""Width of a letter of a segment's name, as a part of the time axis."""


def draw_plan(
    plan: ExcitationPlan,
    track: PlanTrack,
    machine: Machine,
    tool_speed_m_s: np.ndarray | None,
    path: Path,
    preview: PreviewResult | None = None,
) -> None:
    """Draw the first run as PNG: segments, commands, predicted positions, tool speed, and the preview.

    Args:
        plan: Gives names.
        track: The prediction.
        machine: Limits.
        tool_speed_m_s: Predicted speed of the tool point in this run, `(T,)`, where the geometry is
            known.
        path: Where to write.
        preview: Effects that the plan could tell.
    """
    rows = machine.num_joints + (tool_speed_m_s is not None)
    ratios = [0.55, *[1.0] * machine.num_joints, *([0.8] if tool_speed_m_s is not None else [])]
    heights = [1.0 + 1.65 * rows]
    if preview:
        heights.append(measure_picture_height(machine))
    whole = make_figure(17, sum(heights))
    parts = whole.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    figure = parts[0]
    axes = figure.subplots(rows + 1, 1, sharex=True, height_ratios=ratios)
    if preview:
        draw_preview(parts[1], preview, machine)
    minutes = track.t_s / 60.0
    spans = _find_spans(plan, track)
    _draw_segments(axes[0], spans)
    for j, axis in enumerate(axes[1 : machine.num_joints + 1]):
        _draw_joint(axis, minutes, track.q[:, 0, j], track.u[:, 0, j], machine, j)
    if tool_speed_m_s is not None:
        axes[-1].fill_between(minutes, tool_speed_m_s, color="#555555", linewidth=0)
        axes[-1].set_ylabel("tool\nm/s", rotation=0, ha="right", va="center")
        axes[-1].set_ylim(0.0, max(0.1, 1.1 * float(tool_speed_m_s.max())))
    for axis in axes[1:]:
        for span in spans:
            axis.axvspan(span["start"], span["end"], color=span["color"], alpha=0.13, linewidth=0)
        axis.grid(axis="x", alpha=0.25)
        remove_frame(axis)
    axes[-1].set_xlabel("time, minutes")
    axes[0].set_xlim(0.0, max(plan.run_s / 60.0, float(minutes[-1])))
    others = (
        f", the first of {len(plan.runs)} runs, each with draws of its own"
        if len(plan.runs) > 1
        else ""
    )
    title = f"{machine.name}: {', '.join(plan.names)}; {plan.run_s / 60.0:g} minutes{others}. Predicted by a nominal machine."
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    figure.legend(
        handles=_build_legend(plan, machine),
        loc="outside lower left",
        ncols=12,
        frameon=False,
        fontsize=9,
    )
    save_figure(whole, path)


def _find_spans(plan: ExcitationPlan, track: PlanTrack) -> list[dict[str, Any]]:
    """Return start and end in minutes, name and colour of the ways and the programs of the first run."""
    stage, number = track.stage[:, 0], track.segment[:, 0]
    period_s = float(np.median(np.diff(track.t_s))) if len(track.t_s) > 1 else 0.0
    found = []
    for begin, end in split_stretches(
        number * 4 + np.where(stage > PLAYING, PLAYING, stage) + 2 * (stage == BEFORE)
    ):
        segment = plan.runs[0][number[begin]]
        kind = (segment.repeat_of or segment.name).split("_")[0]
        on_way = stage[begin] == BEFORE
        color = (
            WAY
            if on_way
            else COLORS[plan.names.index(kind) % len(COLORS)]
            if kind in plan.names
            else COLORS[-1]
        )
        start, stop = track.t_s[begin] / 60.0, (track.t_s[end - 1] + period_s) / 60.0
        found.append(
            {
                "start": start,
                "end": stop,
                "name": "" if on_way else segment.name,
                "color": color,
                "repeat": segment.repeat_of,
            }
        )
    return found


def _draw_segments(axis: Axes, spans: list[dict[str, Any]]) -> None:
    """Draw the strip of segments on top, with the names that find room."""
    whole = spans[-1]["end"]
    for span in spans:
        width = span["end"] - span["start"]
        hatch = "////" if span["repeat"] and span["name"] else None
        axis.broken_barh(
            [(span["start"], width)],
            (0.0, 1.0),
            facecolor=span["color"],
            edgecolor="white",
            linewidth=0.6,
            hatch=hatch,
        )
        name = (span["repeat"] or span["name"]).replace("_", " ") if span["name"] else ""
        if not name:
            continue
        lies, stands = width > LETTER * 0.75 * whole * len(name), width > LETTER * 1.3 * whole
        if lies or stands:
            axis.text(
                span["start"] + 0.5 * width,
                0.5,
                name,
                ha="center",
                va="center",
                fontsize=8 if lies else 6,
                rotation=0 if lies else 90,
                bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
                if hatch
                else None,
                clip_on=True,
            )
    axis.set_yticks([])
    axis.set_ylim(0.0, 1.0)
    axis.spines[:].set_visible(False)


def _draw_joint(
    axis: Axes, minutes: np.ndarray, q: np.ndarray, u: np.ndarray, machine: Machine, joint: int
) -> None:
    """Draw command (grey; full is half the height), position and stops of one joint."""
    lower, upper, alone = machine.lower[joint], machine.upper[joint], machine.is_exclusive[joint]
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    color = ALONE if alone else "#8c8c8c"
    axis.fill_between(
        minutes, middle, middle + half * u, step="post", color=color, alpha=0.6, linewidth=0
    )
    axis.plot(minutes, q, color="black", linewidth=1.1)
    for stop in (lower, upper):
        axis.axhline(stop, color="#b00020", linewidth=0.9, linestyle=(0, (5, 3)))
    axis.set_ylim(middle - 1.12 * half, middle + 1.12 * half)
    axis.set_yticks(
        [lower, machine.home[joint], upper],
        [f"{lower:.2f}", f"home {machine.home[joint]:.2f}", f"{upper:.2f}"],
        fontsize=8,
    )
    unit = machine.joints[joint].unit
    axis.set_ylabel(
        f"{machine.joint_names[joint]}\n{unit}",
        rotation=0,
        ha="right",
        va="center",
        fontweight="bold",
    )


def _build_legend(plan: ExcitationPlan, machine: Machine) -> list[Any]:
    handles: list[Any] = [
        Patch(facecolor=COLORS[i % len(COLORS)], label=name)
        for i, name in enumerate(plan.names)
        if name != "repeat"
    ]
    if any(segment.repeat_of for segment in plan.runs[0]):
        handles.append(Patch(facecolor="white", edgecolor="black", hatch="////", label="repeat"))
    handles.append(Patch(facecolor=WAY, label="way to the start, rest"))
    handles.append(Line2D([], [], color="black", label="predicted position"))
    handles.append(Patch(facecolor="#8c8c8c", alpha=0.6, label="command (full: to the stops)"))
    if machine.is_exclusive.any():
        names = ", ".join(
            name
            for name, alone in zip(machine.joint_names, machine.is_exclusive, strict=True)
            if alone
        )
        handles.append(
            Patch(facecolor=ALONE, alpha=0.6, label=f"command of {names}: never with others")
        )
    handles.append(Line2D([], [], color="#b00020", linestyle=(0, (5, 3)), label="stop"))
    return handles
