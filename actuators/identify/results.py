"""Stages of an identification, and its results: the fields of `identification.json` and the verdict.

A stage is a fit, stored when done, so that a run can resume. With one split there is one; with cross-validation
one for each fold, and a last one that fits the model that is kept.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from actuators import open_loop
from actuators.contracts import ActuatorFit, FitTask
from actuators.identify import dead_time
from actuators.identify.scores import FreeRunScores, average_joints
from actuators.recordings.split import list_sources
from brokk_rl.errors import StorageError
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_bytes

HORIZONS_S = (1.0, 2.0, 5.0, 10.0)
"""Horizons of `identification.json`."""
HOLD, LINEAR = "hold", "arx"
"""The baselines that stand beside every model."""
HEADLINE_S = 5.0
"""The horizon by which models are compared, where the recordings are long enough."""
FEW_RUNS = 6
"""Runs to judge by below which an interval from resampling them is coarse."""
DELAY_TOLERANCE_S = 0.05
"""The machine's dead time may differ from that of its joints by this much, s: a control period at
20 Hz."""


@dataclass(frozen=True)
class VerdictSentence:
    """A sentence of the verdict.

    Attributes:
        tone: Whether it is good news.
        text: The sentence.
    """

    tone: Literal["good", "bad", "warn", "plain"]
    text: str


def write_verdict(result: Mapping[str, Any], machine: Machine) -> list[VerdictSentence]:
    """Return the sentences of the verdict on an `identification.json`, the answer first."""
    overall = result["overall"][result["model"]]
    given = [horizon for horizon, value in overall.items() if value is not None]
    horizon = f"{HEADLINE_S:g}" if f"{HEADLINE_S:g}" in given else given[-1]
    return [
        _judge_comparison(result, horizon),
        *_judge_dead_time(result, machine),
        *(VerdictSentence("warn", text) for text in _list_test_doubts(result)),
    ]


def _judge_comparison(result: Mapping[str, Any], horizon: str) -> VerdictSentence:
    model, joints = result["model"], list(result["joints"])
    overall = {name: rows[horizon]["percent"] for name, rows in result["overall"].items()}
    mine = f"{model}: {overall[model]:.2f} % of travel after {horizon} s in a free run, mean over joints"
    if model == HOLD:
        text = f"{mine}; this is the error of a machine that stands still, and no model."
        return VerdictSentence("plain", text)
    rival = LINEAR if model != LINEAR else HOLD
    against = result["against"][rival]
    total, change = against["overall"][horizon], against["overall"][horizon]["reduction_percent"]
    word = "less" if change >= 0 else "more"
    text = f"{mine}, against {overall[rival]:.2f} % of {rival}: {abs(change):.0f} % {word}"
    if total["ci95"] is None:
        text += ". Judged by one run only, so there is no saying whether that holds for others."
        return VerdictSentence("warn", text)
    low, high = total["reduction_ci95"]
    text += f" (95 %: {low:.0f} to {high:.0f} % less)"
    # an interval that excludes 0 leaves no doubt
    intervals = {joint: against[joint][horizon]["ci95"] or (-np.inf, np.inf) for joint in joints}
    better = [joint for joint, (_, high) in intervals.items() if high < 0]
    worse = [joint for joint, (low, _) in intervals.items() if low > 0]
    text += f". Better beyond doubt on {len(better)} of {len(joints)} joints"
    text += f", worse on {', '.join(worse)}." if worse else "."
    if total["ci95"][1] < 0 and not worse:
        return VerdictSentence("good", text)
    is_bad = total["ci95"][0] > 0 or len(worse) > len(better)
    return VerdictSentence("bad" if is_bad else "warn", text)


def _judge_dead_time(result: Mapping[str, Any], machine: Machine) -> list[VerdictSentence]:
    known = {joint: delay for joint, delay in result["delay_s"].items() if delay is not None}
    history_s, stated_s = machine.num_history * machine.period_s, machine.dead_time_s
    lost = [joint for joint, delay in known.items() if not delay["found"]]
    long = [one for one in known if one not in lost and known[one]["ci95"][1] > history_s]
    off = [one for one in known if abs(known[one]["value"] - stated_s) > DELAY_TOLERANCE_S]
    found: list[VerdictSentence] = []
    if lost:
        text = f"The dead time of {', '.join(lost)} is not found: the motion does not follow the command."
        found.append(VerdictSentence("warn", text))
    if long:
        count = int(np.ceil(max(known[joint]["ci95"][1] for joint in long) / machine.period_s)) + 2
        text = (
            f"The dead time of {', '.join(long)} may exceed the history of {history_s:.2f} s: models miss the command that acts. "
            f"Set num_history of machine '{machine.name}' to {count} or more and fit again."
        )
        found.append(VerdictSentence("bad", text))
    if off:
        said = ", ".join(f"{known[joint]['value']:.2f} s on {joint}" for joint in off)
        text = f"Dead time {said}, but machine '{machine.name}' says {stated_s:g} s: correct dead_time_s."
        found.append(VerdictSentence("warn", text))
    if known and not found:
        text = f"The dead times are as machine '{machine.name}' says, {stated_s:g} s, and inside the history of {history_s:.2f} s."
        found.append(VerdictSentence("good", text))
    return found


def _list_test_doubts(result: Mapping[str, Any]) -> Iterator[str]:
    runs = result["data"]["test"]["runs"]
    if runs < FEW_RUNS:
        yield f"Judged by {runs} runs: intervals from so few are coarse, most likely too narrow."
    for horizon, reason in result["missing"].items():
        yield f"No figure at {horizon} s: {reason}."


Draw = Callable[[str], np.random.Generator]


def build_results(
    machine: Machine,
    model: str,
    stages: Sequence[FitStage],
    horizons_s: Sequence[float],
    draw: Draw,
) -> tuple[dict[str, Any], FreeRunScores]:
    """Return `identification.json` with its verdict, and the errors behind them.

    Args:
        machine: The machine.
        model: Name of the model that is kept; the others are compared with it.
        stages: Fits in their order; the last one made the model that is kept.
        horizons_s: Those of `HORIZONS_S` that fit into the recordings judged by.
        draw: Returns the generator of a purpose.

    Raises:
        RecordingError: no recording is long enough to search for a dead time in.
    """
    judging = [(stage.cut, stage.fitted) for stage in stages if stage.cut is not None]
    predicted = {}
    for name in judging[0][1]:
        predicted[name] = np.concatenate([fitted[name].predicted for _, fitted in judging])
    cut = open_loop.join_windows([one for one, _ in judging])
    scores = FreeRunScores(predicted, cut, machine, draw("resample"))
    last = stages[-1]
    fitted_to = list_recordings(last.train) + list_recordings(last.validation)
    judged = []
    for stage in stages:
        judged += list_recordings(stage.test)
    delays = dead_time.estimate_dead_times(fitted_to, machine, draw("delay"))
    kept = last.fitted[model]
    result: dict[str, Any] = {
        "schema": 1, "machine": machine.name, "model": model, "fit_seconds": round(kept.seconds, 2), "use": kept.use,
    }  # fmt: skip
    result |= _tabulate_errors(scores, model, horizons_s)
    longest_s = open_loop.find_longest_horizon_s(judged, machine)
    before_s = open_loop.count_samples_before(machine) * machine.period_s
    reason = f"the longest recording judged by leaves {longest_s:.1f} s after the {before_s:.2f} s before a free run"
    result["missing"] = {f"{h:g}": reason for h in HORIZONS_S if h not in horizons_s}
    result["delay_s"] = {joint: delay and delay.plain() for joint, delay in delays.items()}
    result["data"] = _describe_data(stages, judged, len(cut.q))
    result["verdict"] = [asdict(sentence) for sentence in write_verdict(result, machine)]
    return result, scores


def _tabulate_errors(
    scores: FreeRunScores, model: str, horizons_s: Sequence[float]
) -> dict[str, Any]:
    """Return `joints`, `overall` and `against`; `None` at a horizon that does not fit."""
    machine = scores.machine
    names, units = machine.joint_names, [joint.unit for joint in machine.joints]
    fitting = {f"{horizon_s:g}": horizon_s for horizon_s in horizons_s}
    absent = dict.fromkeys(f"{horizon_s:g}" for horizon_s in HORIZONS_S)
    joints: dict[str, Any] = {joint: {} for joint in names}
    overall, against = {}, {}
    for name in scores.predicted:
        rows = {key: scores.at(name, h) for key, h in fitting.items()}
        overall[name] = absent | {key: average_joints(row, units) for key, row in rows.items()}
        for j, joint in enumerate(names):
            joints[joint][name] = absent | {key: row[j] for key, row in rows.items()}
        if name != model:
            compared = {key: scores.against(model, name, h) for key, h in fitting.items()}
            against[name] = {}
            for j, joint in enumerate((*names, "overall")):
                against[name][joint] = absent | {key: row[j] for key, row in compared.items()}
    return {"joints": joints, "overall": overall, "against": against}


def _describe_data(
    stages: Sequence[FitStage], judged: Sequence[Recording], num_windows: int
) -> dict[str, Any]:
    """Return facts on the data: amount, and runs of each part."""
    last = stages[-1]
    tested, runs = set(), []
    for stage in stages:
        tested.update(stage.test)
        parts = {part: list(getattr(stage, part)) for part in ("train", "validation", "test")}
        runs.append({"stage": stage.name or "fit"} | parts)
    return {
        "train": _count_recordings(list_recordings(last.train), len(last.train)),
        "validation": _count_recordings(list_recordings(last.validation), len(last.validation)),
        "test": _count_recordings(judged, len(tested)),
        "windows": num_windows,
        "runs": runs,
    }


def _count_recordings(recordings: Sequence[Recording], num_runs: int) -> dict[str, Any]:
    return {
        "runs": num_runs,
        "recordings": len(recordings),
        "minutes": round(sum(recording.duration_s for recording in recordings) / 60.0, 1),
        "sources": list_sources(recordings),
    }


log = logging.getLogger(__name__)

FREE_RUNS = "free_runs"
"""Folder of what a stage's models predicted."""


@dataclass
class FitStage:
    """Recordings by run for one fit, the folder of its results, and what came of it.

    Attributes:
        name: Name in the log.
        folder: Where the fitted model goes; rivals have folders of their own within it.
        seed: Of the fit.
        train: To fit to.
        validation: To stop the fit by.
        test: To judge by; none where a model is only made to be kept.
        cut: Windows of `test`; `None` where it judges nothing.
        fitted: Results of its fits, by model.
    """

    name: str
    folder: Path
    seed: int
    train: Mapping[str, Sequence[Recording]]
    validation: Mapping[str, Sequence[Recording]]
    test: Mapping[str, Sequence[Recording]]
    cut: open_loop.FreeRunWindows | None = None
    fitted: dict[str, FittedModel] = field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """Hash of all that is in the recordings, by part."""
        state = hashlib.sha256(str(self.seed).encode())
        for part in (self.train, self.validation, self.test):
            state.update(b"part")
            for recording in list_recordings(part):
                state.update(recording.u.tobytes() + recording.q.tobytes())
        return state.hexdigest()

    def fit(
        self, name: str, fit: ActuatorFit, folder: Path, machine: Machine, device: torch.device
    ) -> None:
        """Fit a model and roll it out through the windows, or restore an earlier result.

        Raises:
            StorageError: another fit, or one to other recordings, has been done in this folder.
            RecordingError: too little data to fit to.
        """
        path = folder / FREE_RUNS / f"{name}.npz"
        shape = () if self.cut is None else self.cut.q.shape
        stamp = repr((fit, machine.fingerprint(), self.digest, shape))
        key = hashlib.sha256(stamp.encode()).hexdigest()
        if path.exists():
            self.fitted[name] = _restore(path, key)
            return
        where = f"{self.name}: " if self.name else ""
        log.info("%sfitting %s to %d runs", where, name, len(self.train))
        folder.mkdir(parents=True, exist_ok=True)
        began = time.monotonic()
        train, validation = list_recordings(self.train), list_recordings(self.validation)
        actuator = fit.fit(FitTask(machine, train, validation, folder, self.seed, device))
        seconds = time.monotonic() - began
        predicted = np.zeros((0, 0, machine.num_joints))
        if self.cut is not None:
            predicted = open_loop.roll_out(actuator, machine, self.cut, device)
        option, content = folder / f"{name}.yaml", BytesIO()
        use = f"actuator=@{option}" if option.exists() else ""
        self.fitted[name] = FittedModel(predicted, seconds, use)
        predicted = predicted.astype(np.float32)
        np.savez_compressed(content, predicted=predicted, seconds=seconds, use=use, key=key)
        write_bytes(path, content.getvalue())


@dataclass(frozen=True)
class FittedModel:
    """Result of a fit.

    Attributes:
        predicted: Positions in free runs through the stage's windows, `(W, K, J)`.
        seconds: Time the fit took in the process that finished it.
        use: Override that makes other modes use the model; empty where its fit left no option.
    """

    predicted: np.ndarray
    seconds: float
    use: str


def list_recordings(part: Mapping[str, Sequence[Recording]]) -> list[Recording]:
    """Return the recordings of all runs."""
    return list(chain.from_iterable(part.values()))


def _restore(path: Path, key: str) -> FittedModel:
    try:
        with np.load(path) as stored:
            values = {name: stored[name] for name in stored.files}
        if str(values["key"]) != key:
            raise StorageError(
                f"{path} is of another fit, or of other recordings or windows. To go on, give the settings of the interrupted run; "
                "for others choose another session.out"
            )
        return FittedModel(values["predicted"], float(values["seconds"]), str(values["use"]))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise StorageError(
            f"{path} cannot be read ({error}); delete it, and this fit is done again"
        ) from error
