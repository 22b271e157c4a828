"""The doctor's page: verdict, where and when the log departs, and what to change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml
from matplotlib.figure import Figure

from brokk_rl.plot import BLUE, ORANGE, RED, add_legend, make_figure, remove_frame
from brokk_rl.report import Tone, embed_picture, render_page
from brokk_rl.session import write_text
from diagnosis.deployment.examination import UNLISTED, DoctorAnswer, DoctorVerdict, Finding
from diagnosis.deployment.fault_search import StageResult

PAGE_FILE = "doctor.html"
TEMPLATE = Path(__file__).with_name("doctor.html.jinja")
TITLES: dict[DoctorVerdict, tuple[str, Tone]] = {
    "code": ("The deployed code does something else than the contract says", "bad"),
    "actuator": ("The machine moves otherwise than those of the training", "bad"),
    "task": ("The run lies outside of the training", "warn"),
    "nothing": ("Nothing found", "good"),
    "cannot_tell": ("The log does not suffice", "warn"),
}
REMEDIES: dict[str, str] = yaml.safe_load(Path(__file__).with_name("remedies.yaml").read_text())
"""Next step by kind of mistake."""
SEEN_REMEDY = "Look where the numbers are made that depart first; the picture shows them."
"""Next step for a mistake without a name in an observation that was logged."""


def write_page(answer: DoctorAnswer, folder: Path) -> None:
    """Write `doctor.html`.

    Raises:
        StorageError: It could not be written.
    """
    title, tone = TITLES[answer.verdict]
    pictures = {}
    for number, run in enumerate(answer.runs):
        for result in run.stages:
            name = result.stage.name
            if result.departs or name in ("policy", "network"):
                pictures[number, name] = embed_picture(_draw_departure(result, run.log.t_s))
    values = {
        "title": f"Deployment doctor: {title}",
        "tone": tone,
        "answer": answer,
        "pictures": pictures,
        "describe_remedies": describe_remedies,
    }
    write_text(folder / PAGE_FILE, render_page(TEMPLATE, values))


def describe_remedies(findings: Sequence[Finding]) -> list[str]:
    """Return what to change, one text for each kind of mistake."""
    texts = []
    for finding in findings:
        is_seen = finding.kind == UNLISTED and finding.stage == "observation"
        texts.append(SEEN_REMEDY if is_seen else REMEDIES[finding.kind])
    return list(dict.fromkeys(texts))


def _draw_departure(result: StageResult, t_s: np.ndarray) -> Figure:
    """Return a figure of the number in which most rows depart, or that moves most, in log and replay."""
    stage, ranked = result.stage, result.rank_labels()
    column = int(np.argmax(np.nan_to_num(np.nanstd(stage.logged, axis=0))))
    if ranked:
        column = stage.labels.index(ranked[0][0])
    logged = stage.logged[:, column]
    figure = make_figure(9.0, 2.8)
    axis = figure.subplots()
    axis.plot(t_s, logged + result.residual[:, column], color=BLUE, label="replay of the contract")
    axis.plot(t_s, logged, color=ORANGE, linestyle="--", label="log")
    departed = np.zeros(len(t_s), bool)
    departed[result.departed] = True
    low, high = axis.get_ylim()
    axis.fill_between(
        t_s, low, high, where=departed, color=RED, alpha=0.12, label="departs", linewidth=0
    )
    axis.set_ylim(low, high)
    axis.set_xlabel("time, s")
    axis.set_ylabel(stage.labels[column])
    remove_frame(axis)
    add_legend(figure, axis)
    return figure
