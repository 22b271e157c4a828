"""Report of an identification: one HTML page, the verdict first, pictures beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from actuators.identify.results import HOLD
from brokk_rl import report
from brokk_rl.machine import Machine
from brokk_rl.plot import save_figure
from brokk_rl.session import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "identification.html"
TEMPLATE = Path(__file__).with_name("identification.html.jinja")


def write_page(
    folder: Path, result: Mapping[str, Any], prediction: Figure, machine: Machine
) -> None:
    """Write the page `identification.html` and its picture `prediction.png`.

    Args:
        folder: Where to.
        result: Fields of `identification.json`.
        prediction: The picture.
        machine: The machine.

    Raises:
        StorageError: something could not be written.
    """
    path = folder / "prediction.png"
    save_figure(prediction, path)
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
