"""Report of an identification: one HTML page, the verdict first, pictures beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from actuators.identify.results import HOLD
from actuators.identify.scores import FreeRunScores
from actuators.motion_panels import MotionWindow, draw_motion_panels
from actuators.recordings.split import COMMANDED
from brokk_rl import report
from brokk_rl.plot import BLUE, GREY, ORANGE, OTHERS, save_figure
from brokk_rl.session import write_text

PAGE = "identification.html"
TEMPLATE = Path(__file__).with_name("identification.html.jinja")


def write_page(folder: Path, result: Mapping[str, Any], scores: FreeRunScores) -> None:
    """Write the page `identification.html` and its picture `prediction.png`.

    Args:
        folder: Where to.
        result: Fields of `identification.json`.
        scores: Free runs, of which some are drawn.

    Raises:
        StorageError: something could not be written.
    """
    path, machine = folder / "prediction.png", scores.machine
    save_figure(draw_prediction(scores, result["model"]), path)
    values = {
        **result,
        "title": f"{result['model']}, actuator model of {machine.name}",
        "prediction": report.embed_picture(path),
        "headings": [f"{horizon} s" for horizon in result["overall"][result["model"]]],
        "units": {joint.name: joint.unit for joint in machine.joints},
        "rivals": sorted(result["against"], key=lambda name: name == HOLD),
        "find_least": find_least,
        "has_mjcf": machine.mjcf is not None,
        "dead_time_s": machine.dead_time_s,
    }
    write_text(folder / PAGE, report.render_page(TEMPLATE, values))


def find_least(models: Mapping[str, Any], horizon: str) -> float:
    """Return the smallest error of all models at a horizon, % of travel."""
    rows = [model[horizon] for model in models.values()]
    return min((row["percent"] for row in rows if row), default=0.0)


COLOURS = {"hold": GREY, "arx": ORANGE}


def draw_prediction(scores: FreeRunScores, model: str) -> Figure:
    """Draw measured and predicted positions over commands: three windows per joint.

    Typical: the window of median error among those in which the joint is commanded; liveliest: of
    the longest way; worst: of the largest error of the model (the paper's figure 2).
    """
    machine = scores.machine
    rows = {}
    for joint in range(machine.num_joints):
        chosen = _select_windows(scores, model, joint)
        rows[joint] = [_show_window(scores, model, joint, *one) for one in chosen.items()]
    return draw_motion_panels(rows, machine, (1.0, 1.0, 1.0))


def _show_window(
    scores: FreeRunScores, model: str, joint: int, title: str, window: int
) -> MotionWindow:
    cut = scores.cut
    measured = cut.measured[window, :, joint]
    given = np.isfinite(measured)
    t_s = scores.machine.period_s * np.arange(1, len(measured) + 1)[given]
    paths, others = [], iter(OTHERS * len(scores.predicted))
    colour = {name: COLOURS.get(name) or next(others) for name in scores.predicted if name != model}
    for name in sorted(scores.predicted, key=lambda name: name == model):
        style = {"color": colour.get(name, BLUE), "label": name, "lw": 1.0, "ls": "--"}
        if name == model:
            style |= {"lw": 1.6, "ls": "-"}
        paths.append((t_s, scores.predicted[name][window, given, joint], style))
    run = str(cut.run[window]).rsplit("/", 1)[-1].removesuffix(".parquet")
    u = cut.u[window, cut.num_before - 1 :, joint][given]
    return MotionWindow(f"{title}: {run}", t_s, measured[given], u, paths, paths[-1][1])


def _select_windows(scores: FreeRunScores, model: str, joint: int) -> dict[str, int]:
    measured = scores.cut.measured[..., joint]
    u = scores.cut.u[:, scores.cut.num_before - 1 :, joint]
    length = np.isfinite(measured).sum(1)
    whole = length == length.max()
    moving = whole & (np.abs(u) > COMMANDED).any(1)
    among = np.flatnonzero(moving if moving.any() else whole)
    error = np.sqrt(np.nanmean(scores.error[model][among, :, joint] ** 2, 1))
    way = np.nansum(np.abs(np.diff(measured[among], axis=1)), 1)
    typical = np.argsort(error, kind="stable")[len(error) // 2]
    return {
        "typical": int(among[typical]),
        "liveliest": int(among[way.argmax()]),
        "worst": int(among[error.argmax()]),
    }
