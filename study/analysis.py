"""From a study's folder to its results: every trial measured, means of each person and condition, effects, and warnings.

Axes: `P` participants in the order of the plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl import record
from brokk_rl.errors import RecordingError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from study import tlx
from study.crossover import GuidanceEffect, adjust_by_holm, estimate_effect
from study.design import CONDITIONS, PERIODS, Hole, Success
from study.measures import GUIDED_ONLY, MEASURES, measure
from study.study_folder import Remark, StudyData

FEW_TRIALS = 2
"""Trials of a condition below which a participant's mean is pointed out."""


@dataclass(frozen=True)
class MeasuredTrial:
    """A trial with its numbers.

    Attributes:
        facts: Contents of its file.
        values: By measure, NaN where the recording does not tell.
        tip_in_base_m: Path of the tool until the trial ended, `(T, 3)`; empty where there is no
            recording.
        counts: Whether it enters the means; practice and spare trials do not.
    """

    facts: dict[str, Any]
    values: dict[str, float]
    tip_in_base_m: np.ndarray
    counts: bool


@dataclass
class Analysis:
    """Results of a study.

    Attributes:
        participants: Pseudonyms, `P` of them.
        guided_first: Who was guided in the first period, `(P,)` bool.
        pairs: Number of the pair in which each participant's sequence was drawn, `(P,)`.
        trials: Every trial that is there.
        means: By measure and condition, one mean a participant, `(P,)`, NaN where there is none.
        loads: NASA-TLX by scale (and `raw`, `weighted`) and condition, `(P,)`.
        effects: By measure; those of `loads` as `tlx_<scale>`.
        holm: p adjusted within its family by the same names: secondary measures, and the six
            scales.
        primary: Name of the measure that decides.
        alpha: Level.
        remarks: Warnings to the reader.
    """

    participants: list[str]
    guided_first: np.ndarray
    pairs: np.ndarray
    trials: list[MeasuredTrial]
    means: dict[str, dict[str, np.ndarray]]
    loads: dict[str, dict[str, np.ndarray]]
    primary: str
    alpha: float
    effects: dict[str, GuidanceEffect] = field(default_factory=dict)
    holm: dict[str, float] = field(default_factory=dict)
    remarks: list[Remark] = field(default_factory=list)


def analyse(data: StudyData, machine: Machine, progress: Callable[[list], Any] = iter) -> Analysis:
    """Return the results of the study.

    Args:
        data: Contents of the study's folder.
        machine: The machine of the plan.
        progress: Wraps the list of trials while their recordings are read.
    """
    design, plan = data.plan["design"], data.plan["participants"]
    erased = data.plan.get("erased", {})
    names = [name for name in plan if name not in erased]
    found = Analysis(
        participants=names,
        guided_first=np.array([plan[name][0] == "guided" for name in names], bool),
        # Sequences were drawn in pairs of the plan; who was erased leaves the partner alone.
        pairs=np.array(
            [number // 2 for number, name in enumerate(plan) if name not in erased], int
        ),
        trials=[],
        means={},
        loads={},
        primary=design["primary"],
        alpha=design["alpha"],
        remarks=list(data.remarks),
    )
    everything = []
    for trial in data.trials.values():
        everything.append((trial, bool(trial["period"])))
    for trial in data.spare:
        everything.append((trial, False))
    # Said in the results: a twin is no machine.
    if at_twin := sum(bool(trial.get("twin")) for trial, counts in everything if counts):
        found.remarks.append(
            Remark(
                "study", f"{at_twin} trials that count were done at a simulated machine, the twin"
            )
        )
    # The criterion of the plan, not of today's configuration.
    success = Success(**design["success"])
    for trial, counts in progress(everything):
        found.trials.append(
            _measure_trial(data.folder, trial, counts, machine, success, found.remarks)
        )
    for each in MEASURES:
        found.means[each.name] = {}
        for which in CONDITIONS:
            found.means[each.name][which] = _average_participants(found, each.name, which)
    _note_few(found)
    _add_loads(found, data)
    _estimate_effects(found)
    return found


def _estimate_effects(found: Analysis) -> None:
    """Add the effect of guidance on each measure and scale, and p adjusted within its family."""
    for name, by_condition in (
        *found.means.items(),
        *((f"tlx_{scale}", value) for scale, value in found.loads.items()),
    ):
        if name not in GUIDED_ONLY:
            found.effects[name] = estimate_effect(
                by_condition["guided"], by_condition["unguided"], found.guided_first, found.pairs
            )
    secondary = []
    for each in MEASURES:
        if each.name in found.effects and each.name != found.primary:
            secondary.append(each.name)
    # Holm within each family: the scales are no more tests of the recordings.
    for family in (secondary, [f"tlx_{scale}" for scale in tlx.SCALES]):
        p = []
        for name in family:
            deciding = found.effects[name].p
            p.append(math.nan if deciding is None else deciding)
        adjusted = adjust_by_holm(np.array(p))
        found.holm |= dict(zip(family, adjusted.tolist(), strict=True))


def _measure_trial(
    folder: Path,
    trial: dict[str, Any],
    counts: bool,
    machine: Machine,
    success: Success,
    remarks: list[Remark],
) -> MeasuredTrial:
    name = f"{trial.get('participant')} {trial.get('period')}.{trial.get('number')}"
    empty = MeasuredTrial(
        trial, dict.fromkeys((each.name for each in MEASURES), math.nan), np.zeros((0, 3)), counts
    )
    # Without a recording the outcome is still evidence.
    where = trial.get("hole")
    if not trial.get("recording") or not isinstance(where, dict):
        why = f" ({trial['recording_problem']})" if trial.get("recording_problem") else ""
        remarks.append(Remark(name, f"names no recording{why}; only its outcome is known"))
        return _keep_outcome(empty)
    if trial.get("recording_problem"):
        remarks.append(Remark(name, f"{trial['recording_problem']}; it counts"))
    try:
        recording: Recording = record.read_recording(folder / trial["recording"], machine)
        hole = Hole(
            center_in_base_m=tuple(where["center_in_base_m"]), radius_m=float(where["radius_m"])
        )
    except (RecordingError, KeyError, TypeError, ValueError) as error:
        remarks.append(
            Remark(name, f"its recording cannot be used ({error}); only its outcome is known")
        )
        return _keep_outcome(empty)
    values = measure(recording, machine, hole, success, float(trial["limit_s"]))
    said = trial.get("outcome")
    # The recording is the measurement; the note of the outcome may be wrong.
    if said in ("inserted", "time limit") and (said == "inserted") != bool(values["success"]):
        seen = "an insertion" if values["success"] else "none"
        remarks.append(
            Remark(
                name,
                f"written down as '{said}', but the recording shows {seen}; the recording counts",
            )
        )
    # Only the path up to the end: afterwards the arm is moved away.
    num = int(np.searchsorted(recording.t_s - recording.t_s[0], values["time_s"], side="right"))
    return MeasuredTrial(
        trial, values, compute_tool_kinematics(machine, recording.q[:num]).tip_in_base_m, counts
    )


def _keep_outcome(trial: MeasuredTrial) -> MeasuredTrial:
    """Return a trial without a recording by its noted outcome; not inserted counts with the time limit."""
    outcome = trial.facts.get("outcome")
    if outcome not in ("inserted", "time limit", "stopped"):
        return trial
    known = {"success": float(outcome == "inserted")}
    if outcome != "inserted":
        known["time_s"] = float(trial.facts["limit_s"])
    return MeasuredTrial(trial.facts, trial.values | known, trial.tip_in_base_m, trial.counts)


def _average_participants(found: Analysis, measure_name: str, condition: str) -> np.ndarray:
    """Return each participant's mean over the trials with a value, `(P,)`."""
    means = np.full(len(found.participants), np.nan)
    for index, name in enumerate(found.participants):
        own = []
        for trial in found.trials:
            if _is_of(trial, name, condition):
                own.append(trial.values[measure_name])
        values = np.array(own)
        # NaN: the recording does not show this measure.
        values = values[~np.isnan(values)]
        means[index] = values.mean() if len(values) else math.nan
    return means


def _is_of(trial: MeasuredTrial, participant: str, condition: str) -> bool:
    return (
        trial.counts
        and trial.facts["participant"] == participant
        and trial.facts["condition"] == condition
    )


def _note_few(found: Analysis) -> None:
    for name in found.participants:
        for condition in CONDITIONS:
            num = sum(_is_of(trial, name, condition) for trial in found.trials)
            if num < FEW_TRIALS:
                what = "is in no comparison" if not num else "their mean rests on it"
                found.remarks.append(Remark(name, f"{num} trials {condition}: {what}"))


def _add_loads(found: Analysis, data: StudyData) -> None:
    keys = (*tlx.SCALES, "raw", "weighted")
    for key in keys:
        found.loads[key] = {}
        for which in CONDITIONS:
            found.loads[key][which] = np.full(len(found.participants), np.nan)
    for (name, period), answers in data.questionnaires.items():
        if name not in found.participants:
            continue
        # The condition of the period follows from the plan.
        condition = data.plan["participants"][name][PERIODS.index(period)]
        values = tlx.read_ratings(answers) | {
            "raw": tlx.compute_raw_tlx(answers),
            "weighted": tlx.compute_weighted_tlx(answers),
        }
        for key, value in values.items():
            found.loads[key][condition][found.participants.index(name)] = value
        for text in tlx.check(answers):
            found.remarks.append(Remark(f"{name} period {period}", f"questionnaire: {text}"))
