"""From a study's folder to its results: a table of trials, a table of means, effects, and warnings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from brokk_rl.errors import RecordingError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording, read_recording
from study import tlx
from study.design import PERIODS, Hole
from study.guidance_effect import GuidanceEffect, adjust_by_holm, estimate_effect
from study.measures import COMPARED, MEASURES, measure_trial
from study.study_folder import StudyData

LOADS = tuple(f"tlx_{score}" for score in tlx.SCORES)
TITLES = {each.name: f"{each.title}, {each.unit}".removesuffix(", ") for each in MEASURES}
TITLES |= {f"tlx_{score}": f"TLX: {title}" for score, title in tlx.SCORES.items()}
"""Words for each measure and score, with the unit."""
FACTS = ("participant", "period", "condition", "number", "outcome", "simulated", "operator")


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


def analyse(data: StudyData, machine: Machine, progress: Callable[[list], Any] = iter) -> Analysis:
    """Return the results of the study.

    Args:
        data: Contents of the study's folder.
        machine: The machine of the plan.
        progress: Wraps the list of trials while their recordings are read.
    """
    rows = []
    for trial in progress([*data.trials.values(), *data.spare]):
        key = trial.get("participant"), trial.get("period"), trial.get("number")
        counts = bool(trial.get("period")) and data.trials.get(key) is trial
        rows.append(_read_measures(data, trial, machine) | {"counts": counts})
    names = list(TITLES)[: len(MEASURES)]
    trials = pd.DataFrame(rows, columns=[*FACTS, "hole", "start", "twin", "counts", *names, "tip_in_base_m"])  # fmt: skip
    # Said in the results: a twin is no machine.
    if at_twin := int((trials.counts.astype(bool) & (trials.twin == True)).sum()):  # noqa: E712
        data.note(
            "study", f"{at_twin} trials that count were done at a simulated machine, the twin"
        )
    own = trials[trials.counts.astype(bool)].groupby(["participant", "condition"])[names].mean()
    means = _list_periods(data).join(own, on=["participant", "condition"])
    means = means.join(_score_questionnaires(data), on=["participant", "period"])
    effects = {name: estimate_effect(means, name) for name in (*COMPARED, *LOADS)}
    secondary = [name for name in COMPARED if name != data.design.primary]
    scales = [f"tlx_{scale}" for scale in tlx.SCALES]
    # Holm within each family: the scales are no more tests of the recordings.
    holm = _adjust_family(effects, secondary) | _adjust_family(effects, scales)
    return Analysis(data, trials, means, effects, holm)


def _adjust_family(effects: dict[str, GuidanceEffect], family: Iterable[str]) -> dict[str, float]:
    p = {}
    for name in family:
        deciding = effects[name].p
        if deciding is not None:
            p[name] = deciding
    return dict(zip(p, adjust_by_holm(list(p.values())), strict=True))


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
    problem, outcome = trial.get("recording_problem"), trial.get("outcome")
    where = trial.get("hole") or {}
    row = {key: trial.get(key) for key in (*FACTS, "start", "twin")}
    row |= {"hole": where.get("name", "?"), "tip_in_base_m": np.zeros((0, 3))}
    try:
        if "recording" not in trial:
            raise RecordingError(problem or "the trial names none")
        recording: Recording = read_recording(data.folder / trial["recording"], machine)
        hole = Hole(
            center_in_base_m=tuple(where["center_in_base_m"]), radius_m=float(where["radius_m"])
        )
        limit_s = float(trial["limit_s"])
    except (RecordingError, KeyError, TypeError, ValueError) as error:
        data.note(name, f"its recording cannot be used ({error}); only its outcome is known")
        if outcome in ("inserted", "time limit", "stopped"):
            row["success"] = float(outcome == "inserted")
            # What was not inserted counts with the time limit.
            row["time_s"] = math.nan if outcome == "inserted" else trial.get("limit_s", math.nan)
        return row
    if problem:
        data.note(name, f"{problem}; it counts")
    # The criterion of the plan, not of today's configuration.
    values = measure_trial(recording, machine, hole, data.design.success, limit_s)
    # The recording is the measurement; the note of the outcome may be wrong.
    if outcome in ("inserted", "time limit") and (outcome == "inserted") != bool(values["success"]):
        seen = "an insertion" if values["success"] else "none"
        data.note(
            name,
            f"written down as '{outcome}', but the recording shows {seen}; the recording counts",
        )
    # Only the path up to the end: afterwards the arm is moved away.
    num = int(np.searchsorted(recording.t_s - recording.t_s[0], values["time_s"], side="right"))
    tip = compute_tool_kinematics(machine, recording.q[:num]).tip_in_base_m
    return row | values | {"tip_in_base_m": tip}
