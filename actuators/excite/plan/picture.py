"""`plan.png`: what a run will do, before anything moves."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from actuators.excite.plan.account import BEFORE, PLAYING, Track, stretches
from actuators.excite.plan.schedule import Plan
from brokk_rl.machine import Machine

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import Patch

COLORS = ("#4e79a7", "#f28e2b", "#59a14f", "#b07aa1", "#76b7b2", "#edc948", "#9c755f")
"""One for each excitation of a plan."""
WAY = "#d9d9d9"
ALONE = "#e15759"
LETTER = 0.0075
"""Width of a letter of a segment's name, as a part of the time axis."""


def draw_plan(
    plan: Plan,
    track: Track,
    machine: Machine,
    tool_speed_m_s: np.ndarray | None,
    path: Path,
    run: int = 0,
) -> None:
    """Draws one run into a PNG: segments, command and predicted position of each joint between its stops, predicted tool speed.

    Args:
        plan: Gives names.
        track: The prediction.
        machine: Limits.
        tool_speed_m_s: Predicted speed of the tool point in this run, `(T,)`, where the geometry is
            known.
        path: Where to write.
        run: Which of the runs.
    """
    rows = machine.num_joints + (tool_speed_m_s is not None)
    ratios = [0.55, *[1.0] * machine.num_joints, *([0.8] if tool_speed_m_s is not None else [])]
    figure, axes = plt.subplots(
        rows + 1,
        1,
        figsize=(17, 1.0 + 1.65 * rows),
        sharex=True,
        height_ratios=ratios,
        layout="constrained",
    )
    minutes = track.t_s / 60.0
    spans = _spans(plan, track, run)
    _draw_segments(axes[0], spans)
    for j, axis in enumerate(axes[1 : machine.num_joints + 1]):
        _draw_joint(axis, minutes, track.q[:, run, j], track.u[:, run, j], machine, j)
    if tool_speed_m_s is not None:
        axes[-1].fill_between(minutes, tool_speed_m_s, color="#555555", linewidth=0)
        axes[-1].set_ylabel("tool\nm/s", rotation=0, ha="right", va="center")
        axes[-1].set_ylim(0.0, max(0.1, 1.1 * float(tool_speed_m_s.max())))
    for axis in axes[1:]:
        for span in spans:
            axis.axvspan(span["start"], span["end"], color=span["color"], alpha=0.13, linewidth=0)
        axis.grid(axis="x", alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
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
        handles=_legend(plan, machine),
        loc="outside lower left",
        ncols=12,
        frameon=False,
        fontsize=9,
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _spans(plan: Plan, track: Track, run: int) -> list[dict[str, Any]]:
    """Returns start and end in minutes, name and colour of the ways and the programs of a run."""
    stage, number = track.stage[:, run], track.segment[:, run]
    period_s = float(np.median(np.diff(track.t_s))) if len(track.t_s) > 1 else 0.0
    found = []
    for begin, end in stretches(
        number * 4 + np.where(stage > PLAYING, PLAYING, stage) + 2 * (stage == BEFORE)
    ):
        segment = plan.runs[run][number[begin]]
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


def _draw_segments(axis: plt.Axes, spans: list[dict[str, Any]]) -> None:
    """Draws the strip of segments on top, with the names that find room."""
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
    axis: plt.Axes, minutes: np.ndarray, q: np.ndarray, u: np.ndarray, machine: Machine, joint: int
) -> None:
    """Draws command (grey, from the middle: full command is half the height), position and stops of one joint."""
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


def _legend(plan: Plan, machine: Machine) -> list[Any]:
    handles: list[Any] = [
        Patch(facecolor=COLORS[i % len(COLORS)], label=name)
        for i, name in enumerate(plan.names)
        if name != "repeat"
    ]
    if any(segment.repeat_of for segment in plan.runs[0]):
        handles.append(Patch(facecolor="white", edgecolor="black", hatch="////", label="repeat"))
    handles.append(Patch(facecolor=WAY, label="way to the start, rest"))
    handles.append(plt.Line2D([], [], color="black", label="predicted position"))
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
    handles.append(plt.Line2D([], [], color="#b00020", linestyle=(0, (5, 3)), label="stop"))
    return handles
