"""Examination of one run: code, task and actuator are judged in this order, each by its evidence.

Code comes first: a policy that sees or commands something else than its contract says also moves
otherwise and ends up elsewhere. Task and actuator are told apart by what they rest on: the range of
the training's observations, and the motion under the recorded commands.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from brokk_rl.contracts.actuator import Actuator, Effect
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_json
from diagnosis.deployment import distortions
from diagnosis.deployment.contract import LoadedPolicy, PolicyContract
from diagnosis.deployment.fault_search import (
    LEAST_ROWS,
    NUM_RANKED,
    FittedDistortion,
    Predict,
    ReplayStage,
    StageResult,
    judge_stage,
)
from diagnosis.deployment.motion_check import MotionEvidence, check_motion
from diagnosis.deployment.replay import (
    SPREAD_FACTOR,
    TOLERANCE,
    VECTOR_TOLERANCE,
    PolicyReplay,
    RunLog,
    read_run_log,
)
from diagnosis.deployment.training_range import RangeEvidence, compare_with_training

DoctorVerdict = Literal["code", "actuator", "task", "nothing", "cannot_tell"]
WAYS = {
    "observation": ("log", "vector"),
    "network": ("vector", "command"),
    "policy": ("log", "command"),
    "delivery": ("answer", "command"),
}
"""First and last point of each part of the way from log to valve."""
UNLISTED = "unlisted"
"""Kind of a departure that no distortion explains."""
SCHEMA = 1
ANSWER_FILE = "doctor.json"
RATE_TOLERANCE = 0.02
"""Relative difference of rates that is a clock's; chosen by hand."""


@dataclass(frozen=True)
class Finding:
    """A mistake that was found in the code, as `doctor.json` holds it.

    Attributes:
        kind: Kind of mistake (`diagnosis.deployment.distortions`), or `unlisted`.
        field: Where it acts.
        stage: Part of the way where the log departs.
        text: The mistake in words.
        time_s: When it shows first and last, s.
        explained: Share of the rows that it explains.
        parameters: Its number, by name.
        same_as: Kinds and fields that explain the log as well.
    """

    kind: str
    field: str
    stage: str
    text: str
    time_s: tuple[float, float]
    explained: float = 1.0
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)
    same_as: Sequence[Mapping[str, str]] = ()


@dataclass(frozen=True)
class RunExamination:
    """Result of one log.

    Attributes:
        log: The log.
        stages: Parts of the way from log to valve, as far as the log holds them.
        findings: Mistakes in the code, in the order of the way.
        task: Whether the run lies where training has been.
        cannot_tell: What the log lacks, in words.
    """

    log: RunLog
    stages: tuple[StageResult, ...]
    findings: tuple[Finding, ...]
    task: RangeEvidence
    cannot_tell: tuple[str, ...]

    @property
    def is_judged(self) -> bool:
        """True if at least the way from observation to command could be replayed."""
        whole = [one for one in self.stages if one.stage.name in ("policy", "network")]
        return any(one.num_rows >= LEAST_ROWS for one in whole)

    def to_json(self) -> dict[str, Any]:
        """Return it as plain JSON data, as `doctor.json` holds it."""
        path = self.log.recording.path
        return {
            "path": str(path) if path else None,
            "findings": [vars(finding) for finding in self.findings],
            "code": [stage.to_json(self.log.t_s) for stage in self.stages],
            "task": {
                "blamed": self.task.blamed,
                "outside": [vars(one) for one in self.task.outside],
                "cannot_tell": self.task.cannot_tell or None,
            },
            "cannot_tell": self.cannot_tell,
        }


@dataclass(frozen=True)
class DoctorAnswer:
    """Answer of the deployment doctor.

    Attributes:
        verdict: `code`, `actuator`, `task`, `nothing` or `cannot_tell`.
        reason: The verdict in a sentence or two.
        runs: Result of each log.
        motion: Motion of all logs against the simulator.
    """

    verdict: DoctorVerdict
    reason: str
    runs: tuple[RunExamination, ...]
    motion: MotionEvidence

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Mistakes of all logs."""
        return tuple(finding for run in self.runs for finding in run.findings)

    def to_json(self) -> dict[str, Any]:
        """Return the answer as plain JSON data, as `doctor.json` holds it."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "reason": self.reason,
            "named": bool(self.findings) and all(one.kind != UNLISTED for one in self.findings),
            "logs": [run.to_json() for run in self.runs],
            "actuator": {
                "horizon_s": self.motion.horizon_s,
                "cannot_tell": self.motion.cannot_tell or None,
                "joints": {one.joint: one.to_json() for one in self.motion.joints},
            },
        }  # fmt: skip

    def write(self, folder: Path) -> None:
        """Write `doctor.json` into a folder."""
        write_json(folder / ANSWER_FILE, self.to_json())


@dataclass(frozen=True)
class Deployment:
    """A policy that was deployed on a machine.

    Attributes:
        policy: The policy that should have run.
        machine: The machine.
        others: Further policies that may have run instead, by folder.
        target_m: Target where the logs do not hold it.
        is_sent: The commands in force are those that the policy's loop sent: nobody at levers.
    """

    policy: LoadedPolicy
    machine: Machine
    others: Mapping[str, LoadedPolicy] = dataclasses.field(default_factory=dict)
    target_m: tuple[float, ...] | None = None
    is_sent: bool = True

    def examine(
        self,
        recordings: Sequence[Recording],
        actuator: Actuator | None,
        effects: Mapping[str, Effect],
        seed: int,
    ) -> DoctorAnswer:
        """Return the doctor's answer.

        Args:
            recordings: Logs of its run or runs.
            actuator: The simulator's actuator; `None`: motion is not judged.
            effects: Effects that the training draws, by name.
            seed: Of all draws.
        """
        generator = np.random.default_rng(seed)
        runs = [self.examine_run(recording, generator) for recording in recordings]
        if any(run.findings for run in runs):
            motion = MotionEvidence((), 0.0, "the code is to be mended first")
        else:
            motion = check_motion(recordings, self.machine, actuator, effects, seed)
        verdict, reason = decide_verdict(runs, motion)
        return DoctorAnswer(verdict, reason, tuple(runs), motion)

    def examine_run(self, recording: Recording, generator: np.random.Generator) -> RunExamination:
        """Examine one log; the generator draws its rounding."""
        contract = self.policy.contract
        log = read_run_log(recording, contract, self.target_m)
        is_sent = self.is_sent and not log.is_measured
        lacking, stages = list(_list_lacking(log, is_sent)), list[StageResult]()
        findings = _check_without_replay(contract, log)
        is_other = any(finding.kind == "network" for finding in findings)
        for stage in () if is_other else self._list_stages(log, is_sent, generator):
            result = judge_stage(stage)
            stages.append(result)
            if result.num_rows < LEAST_ROWS:
                lacking.append(f"the log is too short for a history of {contract.num_samples} rows")
            if result.departs:
                findings += _describe_findings(result, log)
        task = compare_with_training(log, contract)
        return RunExamination(log, tuple(stages), tuple(findings), task, tuple(lacking))

    def _list_stages(
        self, log: RunLog, is_sent: bool, generator: np.random.Generator
    ) -> Iterator[ReplayStage]:
        """Yield the parts of the way that the log lets one judge."""
        contract = self.policy.contract
        replay = PolicyReplay(self.policy, log, generator)
        every = distortions.list_distortions(self.policy, self.others)

        def make_stage(
            name: str, predict: Predict, logged: np.ndarray, floor: np.ndarray | float
        ) -> ReplayStage:
            begin, end = WAYS[name]
            some = [one for one in every if one.acts_between(begin, end)]
            nominal = predict((), np.arange(len(logged)))
            some += distortions.list_matched_orders(contract, end, nominal, logged)
            labels = contract.labels if end == "vector" else contract.joints
            num_start = contract.num_samples if begin == "log" else 0
            floor = np.broadcast_to(floor, logged.shape)
            return ReplayStage(name, predict, logged, floor, labels, some, num_start)

        if log.is_complete and log.observed is not None:
            floor = VECTOR_TOLERANCE + SPREAD_FACTOR * replay.spread[0]
            yield make_stage("observation", replay.encode, log.observed, floor)
        commanded = log.in_force if log.commanded is None and is_sent else log.commanded
        if commanded is not None and log.observed is not None:
            yield make_stage("network", replay.command, commanded, TOLERANCE)
        elif commanded is not None and log.is_complete:
            floor = TOLERANCE + SPREAD_FACTOR * replay.spread[1]
            yield make_stage("policy", replay.command, commanded, floor)
        if log.commanded is not None and log.in_force is not None and is_sent:
            yield make_stage("delivery", replay.deliver, log.in_force, TOLERANCE)


def decide_verdict(
    runs: Sequence[RunExamination], motion: MotionEvidence
) -> tuple[DoctorVerdict, str]:
    """Return the verdict over all logs, and its reason in a sentence or two."""
    findings = [finding for run in runs for finding in run.findings]
    if findings:
        texts = list(dict.fromkeys(finding.text for finding in findings))
        return "code", "; ".join(texts) + "."
    outside = [one for run in runs if run.task.blamed for one in run.task.outside]
    form = "{} from {:.3g} to {:.3g}, in training {:.3g} to {:.3g}"
    places = ", ".join(form.format(one.field, *one.log, *one.training) for one in outside[:3])
    is_judged = all(run.is_judged for run in runs)
    code = "The code does what the contract says. " if is_judged else ""
    if motion.blamed and not outside:
        moved = (
            f"{', '.join(motion.blamed)} moved otherwise than all machines that the training draws"
        )
        return "actuator", f"{code}Under the recorded commands {moved}."
    if outside:
        also = f" {', '.join(motion.blamed)} moved otherwise too." if motion.blamed else ""
        return "task", f"{code}The run lies outside of the training: {places}.{also}"
    if not is_judged:
        reasons = "; ".join(dict.fromkeys(text for run in runs for text in run.cannot_tell))
        return "cannot_tell", f"The policy cannot be replayed: {reasons}."
    if motion.cannot_tell:
        return "nothing", f"{code}Motion was not judged: {motion.cannot_tell}."
    moves = "the machine moves as those of the training, as far as could be judged"
    return "nothing", f"{code}The run lies within the training's range, and {moves}."


def _describe_findings(result: StageResult, log: RunLog) -> list[Finding]:
    """Return the mistakes of a stage that departs."""
    stage, departed = result.stage.name, result.departed
    found = [_describe_named(one, result, log) for one in result.named]
    if found:
        alike = [(one.distortion.kind, one.distortion.field) for one in result.alike]
        others = [one for one in dict.fromkeys(alike) if one != (found[0].kind, found[0].field)]
        same = [{"kind": kind, "field": field} for kind, field in others[:NUM_RANKED]]
        return [dataclasses.replace(found[0], same_as=same), *found[1:]]
    time_s = _find_times(log, departed)
    if stage == "network":
        text = "the commands do not follow from what the network saw"
        text += ", and no change of the command explains them: another network"
        return [Finding("network", "network", stage, text, time_s, 0.0)]
    labels = [label for label, _ in result.rank_labels()[:3]]
    departing = "observation" if stage == "observation" else "command"
    share = f"{len(departed) / result.num_rows:.0%} of the rows, most in {', '.join(labels)}"
    text = f"the {departing} departs in {share}, by none of the mistakes that are known here"
    return [Finding(UNLISTED, labels[0] if labels else stage, stage, text, time_s, 0.0)]


def _describe_named(one: FittedDistortion, result: StageResult, log: RunLog) -> Finding:
    """Return a mistake with its number."""
    distortion, number = one.distortion, one.value
    inside = result.departed[(result.departed >= one.begin) & (result.departed <= one.end)]
    # Not `format`: names of columns and folders may hold braces.
    text = distortion.text.replace("{value}", f"{number:.4g}")
    parameters = {distortion.parameter: number} if distortion.parameter else {}
    if distortion.parameter == "row":
        parameters = {"since_s": float(log.t_s[int(number)])}
        text = distortion.text.replace("row {value}", f"{parameters['since_s']:.2f} s")
    times_s = _find_times(log, inside if len(inside) else result.departed)
    told = (distortion.kind, distortion.field, result.stage.name, text)
    return Finding(*told, times_s, one.explained, parameters)


def _find_times(log: RunLog, rows: np.ndarray) -> tuple[float, float]:
    """Return the times of the first and the last row."""
    return float(log.t_s[rows[0]]), float(log.t_s[rows[-1]])


def _list_lacking(log: RunLog, is_sent: bool) -> list[str]:
    """Return what the log lacks, in words."""
    found = []
    missing = f"the log has no column {', '.join(log.missing)}"
    if log.missing and log.observed is None:
        mend = "give doctor.target_in_base_m where only the target is missing, or record it"
        found.append(f"{missing}; {mend}")
    elif log.missing:
        found.append(f"the observation cannot be checked: {missing}")
    if log.commanded is None and not is_sent:
        found.append("the log has no advice_<joint>, and its commands are not the policy's own")
    if log.is_measured:
        found.append("the way from advice to valve: the log holds the valves' feedback")
    return found


def _check_without_replay(contract: PolicyContract, log: RunLog) -> list[Finding]:
    """Return what rate and length of the logged vector show."""
    found = list[Finding]()
    whole_s = (float(log.t_s[0]), float(log.t_s[-1]))
    rate_hz = 1.0 / float(np.median(np.diff(log.t_s)))
    if abs(contract.rate_hz / rate_hz - 1.0) > RATE_TOLERANCE:
        trained = f"the policy was trained at {contract.rate_hz:g} Hz"
        text = f"the loop ran at {rate_hz:.4g} Hz, {trained}"
        number = {"rate_hz": rate_hz}
        found.append(Finding("rate", "loop", "policy", text, whole_s, parameters=number))
    if log.observed is not None and log.observed.shape[1] != contract.size:
        stated = f"the contract has {contract.size}: another policy ran"
        text = f"the network got {log.observed.shape[1]} numbers, {stated}"
        found.append(Finding("network", "observation", "observation", text, whole_s))
    return found
