"""Measurements of actuator models, fitted to recordings."""

from __future__ import annotations

from pathlib import Path

from measurement import Measurement, Table, load_json

CODE = ("actuators", "conf/fit", "conf/actuator", "conf/excitation", "conf/machine")
HORIZONS_S = ("1", "2", "5", "10")
TRAIN = "identify.recordings=[{out}/sine/recordings/*,{out}/levels/recordings/*]"
TEST = "identify.test={out}/unseen/recordings/*"
LEVELS = "brokk mode=collect excitation=levels collect.num_runs=12"
IMPORT = "brokk mode=convert machine=mini_excavator import=mini_excavator convert.input=logs/*.csv"


def read_errors(path: Path, head: dict[str, str]) -> Table:
    """Return the mean error of each model over the joints, % of the travel, for each horizon."""
    answer = load_json(path)
    joints = answer["joints"].values()
    rows: Table = []
    for model in next(iter(joints)):
        row = head | {"model": model}
        for horizon_s in HORIZONS_S:
            errors = [joint[model][horizon_s]["percent"] for joint in joints]
            row[f"{horizon_s} s, % of travel"] = round(sum(errors) / len(errors), 2)
        rows.append(row)
    return rows


def read_plant(folder: Path) -> Table:
    """Return the errors of the models that were fitted to sines, and to sines and levels."""
    sines = read_errors(folder / "fit_sine/identification.json", {"fitted to": "sines"})
    both = read_errors(folder / "fit_both/identification.json", {"fitted to": "sines and levels"})
    return sines + both


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
        name="identification",
        title="Models of the simulated machine",
        conditions="Error of free runs on an hour of random levels with another seed. Only the fit to sines meets another excitation than its own. The baselines are `hold` (the machine stands still) and `arx` (linear).",
        commands=(
            "brokk mode=collect session.out={out}/sine",
            f"{LEVELS} session.seed=1 collect.run_minutes=10 session.out={{out}}/levels",
            f"{LEVELS} session.seed=2 collect.run_minutes=5 session.out={{out}}/unseen",
            f"brokk mode=identify 'identify.recordings={{out}}/sine/recordings/*' '{TEST}' session.device=cpu session.out={{out}}/fit_sine",
            f"brokk mode=identify fit=valve +fit@baselines.mlp=mlp '{TRAIN}' '{TEST}' session.device=cpu session.out={{out}}/fit_both",
        ),
        code=CODE,
        read=read_plant,
        where="two cores, 15 min",
    ),
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
