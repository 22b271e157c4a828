"""From a study's folder to its results: a table of trials, a table of means, effects, and warnings.

During a sitting only the loop's capture is written, and the trial's file says from when to when it
counts. Its recording is made here, so that an interruption leaves nothing half converted.
"""

# pyright: reportArgumentType=false
# The stubs of pandas and SciPy name more types than are returned here.

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from brokk_rl.errors import RecordingError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.progress import track_items
from brokk_rl.record import Recording, read_recording, write_recording
from deploy.recorder.capture import MCAP
from deploy.recorder.conversion import CaptureLogReader
from study import tlx
from study.design import PERIODS, Hole
from study.guidance_effect import GuidanceEffect, adjust_by_holm, estimate_effect
from study.measures import COMPARED, MEASURES, measure_trial
from study.study_folder import RECORDINGS, StudyData

LOADS = tuple(f"tlx_{score}" for score in tlx.SCORES)
TITLES = {each.name: f"{each.title}, {each.unit}".removesuffix(", ") for each in MEASURES}
TITLES |= {f"tlx_{score}": f"TLX: {title}" for score, title in tlx.SCORES.items()}
"""Words for each measure and score, with the unit."""
FACTS = ("participant", "period", "condition", "number", "hole", "start", "outcome", "operator")
GAP_S = 0.2
"""Longest silence of the bus in a recording that is used; positions go straight from one end of it to
the other."""


@dataclass(frozen=True)
class Analysis:
    """Results of a study.

    Attributes:
        data: Contents of the study's folder, with the remarks of the analysis.
        trials: A row for each trial that is there: facts of its file, `counts` (practice and spare
            trials do not), the measures, NaN where the recording does not tell, and the tool's path
            `tip_in_base_m`, `(T, 3)`, until the trial ended.
        means: A row for each participant and condition: `participant`, `pair` (in which the
            sequence was drawn), `period`, `condition`, the mean of each measure, NaN where there is
            none, and the workload as `tlx_<score>`.
        effects: By measure, and by `tlx_<score>`.
        holm: p adjusted within its family by the same names: secondary measures, and the six
            scales.
    """

    data: StudyData
    trials: pd.DataFrame
    means: pd.DataFrame
    effects: dict[str, GuidanceEffect]
    holm: dict[str, float]


def analyse(data: StudyData, machine: Machine) -> Analysis:
    """Return the results of a study of the machine."""
    rows, num_at_twin = [], 0
    everything = track_items([*data.trials.values(), *data.spare], "measuring trials")
    for number, trial in enumerate(everything):
        # Practice and spare trials do not count.
        counts = number < len(data.trials) and trial["period"] > 0
        num_at_twin += counts and bool(trial.get("twin"))
        rows.append(_read_measures(data, trial, machine) | {"counts": counts})
    names = [each.name for each in MEASURES]
    columns = [*FACTS, "counts", *names, "tip_in_base_m"]
    trials = pd.DataFrame(rows, columns=columns).astype({"counts": bool})
    # Said in the results: a twin is no machine.
    if num_at_twin:
        data.note("study", f"{num_at_twin} trials that count were done at a simulated machine")
    own = trials[trials.counts].groupby(["participant", "condition"])[names].mean()
    means = _list_periods(data).join(own, on=["participant", "condition"])
    means = means.join(_score_questionnaires(data), on=["participant", "period"])
    effects = {name: estimate_effect(means, name) for name in (*COMPARED, *LOADS)}
    secondary = [name for name in COMPARED if name != data.design.primary]
    scales = [f"tlx_{scale}" for scale in tlx.SCALES]
    # Holm within each family: the scales are no more tests of the recordings.
    holm = adjust_by_holm(effects, secondary) | adjust_by_holm(effects, scales)
    return Analysis(data, trials, means, effects, holm)


def _list_periods(data: StudyData) -> pd.DataFrame:
    """Return a row for each participant and period; sequences were drawn in pairs of the plan."""
    rows = []
    for number, (who, conditions) in enumerate(data.plan["participants"].items()):
        if who not in data.erased:
            for period, condition in zip(PERIODS, conditions, strict=True):
                rows.append((who, number // 2, period, condition))
    return pd.DataFrame(rows, columns=["participant", "pair", "period", "condition"])


def _score_questionnaires(data: StudyData) -> pd.DataFrame:
    rows = []
    for (who, period), answers in data.questionnaires.items():
        scores, faults = tlx.compute_scores(answers)
        rows.append([who, period, *scores.values()])
        for text in faults:
            data.note(f"{who} period {period}", f"questionnaire: {text}")
    frame = pd.DataFrame(rows, columns=["participant", "period", *LOADS])
    return frame.set_index(["participant", "period"])


def _read_measures(data: StudyData, trial: dict[str, Any], machine: Machine) -> dict[str, Any]:
    """Return a row of the table of trials; without a recording the outcome is still evidence."""
    name = f"{trial.get('participant')} {trial.get('period')}.{trial.get('number')}"
    # The holes and the criterion of the plan, not of today's configuration.
    design, outcome = data.design, trial.get("outcome")
    row = {key: trial.get(key) for key in FACTS} | {"tip_in_base_m": np.zeros((0, 3))}
    try:
        hole = design.holes[trial["hole"]]
        recording = read_trial(data.folder, trial, hole, machine)
    except (RecordingError, KeyError, TypeError, ValueError) as error:
        data.note(name, f"its recording cannot be used ({error}); only its outcome is known")
        if outcome in ("inserted", "time limit", "stopped"):
            row["success"] = float(outcome == "inserted")
            # What was not inserted counts with the time limit; else the conductor's clock tells.
            is_in = outcome == "inserted"
            row["time_s"] = trial.get("seconds", math.nan) if is_in else design.limit_s
        return row
    values = measure_trial(recording, machine, hole, design.success, design.limit_s)
    # The recording is the measurement; the note of the outcome may be wrong.
    if outcome in ("inserted", "time limit") and (outcome == "inserted") != bool(values["success"]):
        seen = "an insertion" if values["success"] else "none"
        text = f"written down as '{outcome}', but the recording shows {seen}; the recording counts"
        data.note(name, text)
    # Only the path up to the end: afterwards the arm is moved away.
    num = int(np.searchsorted(recording.t_s - recording.t_s[0], values["time_s"], side="right"))
    tip = compute_tool_kinematics(machine, recording.q[:num]).tip_in_base_m
    return row | values | {"tip_in_base_m": tip}


def read_trial(folder: Path, trial: dict[str, Any], hole: Hole, machine: Machine) -> Recording:
    """Return the recording of a trial, made from its capture where there is none yet.

    It gets the hole as constant columns, as recordings of other tools have it, and loses advice that
    was not shown.

    Raises:
        RecordingError: there is no recording, or it cannot be used.
    """
    if "recording" in trial:
        return read_recording(folder / trial["recording"], machine)
    if "capture" not in trial:
        raise RecordingError("the trial names none")
    path = folder / RECORDINGS / f"{Path(trial['capture']).name}.parquet"
    if not path.exists():
        reader = CaptureLogReader(longest_gap_s=GAP_S, shortest_s=0.0)
        found = reader.between(folder / trial["capture"] / MCAP, machine, *trial["window_s"])
        extra = {}
        for name, values in found.extra.items():
            if trial["condition"] == "guided" or not name.startswith("advice_"):
                extra[name] = values
        for axis, value in zip("xyz", hole.center_in_base_m, strict=True):
            extra[f"target_{axis}_m"] = np.full(len(found.t_s), value, np.float32)
        write_recording(replace(found, extra=extra), path)
    return read_recording(path, machine)
