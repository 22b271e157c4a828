"""Measurements of actuator models, fitted to recordings."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

CODE = ("actuators", "conf/fit", "conf/actuator", "conf/excitation", "conf/machine")
IMPORT = "brokk mode=convert machine=mini_excavator import=mini_excavator convert.input=logs/*.csv"


def read_joints(folder: Path) -> Table:
    """Return the error after 5 s of each joint, % of its travel, for each model."""
    joints = load_json(folder / "fit/identification.json")["joints"]
    rows: Table = []
    for model in next(iter(joints.values())):
        row = {"model": model}
        row |= {name: round(joint[model]["5"]["percent"], 1) for name, joint in joints.items()}
        rows.append(row)
    return rows


MEASUREMENTS = (
    Measurement(
        name="real_excavator",
        title="A real 1:12 excavator",
        conditions="Nine real logs of several operators, 21 minutes. Each is judged by a model fitted to the other eight, free runs of 5 s; error in % of the travel. The baselines are `hold` and `arx`. The logs are not included.",
        commands=(
            f"{IMPORT} session.out={{out}}/read",
            "brokk mode=identify machine=mini_excavator 'identify.recordings={out}/read/recordings/*' identify.folds=9 session.device=cpu session.out={out}/fit",
        ),
        code=CODE,
        read=read_joints,
        where="two cores, and the logs in `logs`, 15 min",
    ),
)
