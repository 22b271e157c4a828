"""Learning curves as a picture."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

PANELS = (
    (
        "Success",
        (("episode/success_strict", "strict"), ("episode/success_paper", "paper's criterion")),
        (0.0, 1.0),
    ),
    ("Return", (("episode/return", "return per episode"),), None),
    ("Episode length (control steps)", (("episode/length", "length"),), None),
    ("Peak contact force (N)", (("episode/peak_force_n", "mean over episodes"),), None),
    ("Exploration", (("policy/action_std", "standard deviation of the action"),), None),
    ("Rate (control steps per second)", (("rate/env_steps_per_s", "training"),), None),
)


def draw_curves(progress: Path, picture: Path) -> None:
    """Draws `progress.csv` over control steps into a PNG; does nothing where there is nothing to draw."""
    with progress.open(newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    if not rows:
        return
    figure, axes = plt.subplots(2, 3, figsize=(13, 6.5), layout="constrained")
    steps = [row["env_steps"] / 1e6 for row in rows]
    for axis, (title, series, limits) in zip(axes.flat, PANELS, strict=True):
        for name, label in series:
            axis.plot(steps, [row[name] for row in rows], label=label, linewidth=1.2)
        axis.set_title(title, loc="left", fontsize=10)
        axis.grid(alpha=0.3)
        if limits:
            axis.set_ylim(*limits)
        if len(series) > 1:
            axis.legend(frameon=False, fontsize=8)
    for axis in axes[1]:
        axis.set_xlabel("control steps, millions")
    figure.suptitle(
        f"{progress.parent.name}: {rows[-1]['seconds'] / 60:.1f} minutes of training",
        x=0.01,
        ha="left",
    )
    figure.savefig(picture, dpi=130)
    plt.close(figure)
