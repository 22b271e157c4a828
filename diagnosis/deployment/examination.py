"""Examination of one run: code, task and actuator are judged in this order, each by its evidence.

Code comes first: a policy that sees or commands something else than its contract says also moves
otherwise and ends up elsewhere. Task and actuator are told apart by what they rest on: the range of
the training's observations, and the motion under the recorded commands.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from diagnosis.deployment import distortions
from diagnosis.deployment.contract import LoadedPolicy, PolicyContract
from diagnosis.deployment.distortions import Distortion
from diagnosis.deployment.fault_search import (
    FittedDistortion,
    ReplayStage,
    StageResult,
    judge_stage,
)
from diagnosis.deployment.motion_check import MotionEvidence
from diagnosis.deployment.orders import match_order
from diagnosis.deployment.replay import SPREAD_FACTOR, TOLERANCE, VECTOR_TOLERANCE, PolicyReplay
from diagnosis.deployment.run_log import RunLog, read_run_log
from diagnosis.deployment.training_range import RangeEvidence, compare_with_training

DoctorVerdict = Literal["code", "actuator", "task", "nothing", "cannot_tell"]
UNLISTED = "unlisted"
"""Kind of a departure that no distortion explains."""
GOLDEN = "golden.json"
RATE_TOLERANCE = 0.02
"""Relative difference of rates that is a clock's; chosen by hand."""
NUM_RANKED = 5
"""Mistakes of the ranking that are told."""


@dataclass(frozen=True)
class Finding:
    """A mistake that was found in the code.

    Attributes:
        kind: Kind of mistake (`diagnosis.deployment.distortions`), or `unlisted`.
        field: Where it acts.
        stage: Part of the way where the log departs.
        text: The mistake in words.
        parameters: Its number, by name.
        begin_s: When it shows first, s.
        end_s: When it shows last.
        explained: Share of the rows that it explains.
        alike: Kinds and fields that explain the log as well.
    """

    kind: str
    field: str
    stage: str
    text: str
    parameters: Mapping[str, float]
    begin_s: float
    end_s: float
    explained: float
    alike: tuple[tuple[str, str], ...] = ()

    @property
    def is_named(self) -> bool:
        """True if the mistake has a name."""
        return self.kind != UNLISTED

    def to_json(self) -> dict[str, Any]:
        """Return the finding as plain JSON data."""
        same = [{"kind": kind, "field": field} for kind, field in self.alike]
        return {
            "kind": self.kind, "field": self.field, "stage": self.stage, "text": self.text,
            "parameters": dict(self.parameters), "time_s": [self.begin_s, self.end_s],
            "explained": self.explained, "same_as": same,
        }  # fmt: skip


@dataclass(frozen=True)
class RunExamination:
    """Result of one log.

    Attributes:
        log: The log.
        stages: Parts of the way from log to valve, as far as the log holds them.
        findings: Mistakes in the code, in the order of the way.
        task: Whether the run lies where training has been.
        cannot_tell: What the log lacks, in words.
        notes: Further remarks.
    """

    log: RunLog
    stages: tuple[StageResult, ...]
    findings: tuple[Finding, ...]
    task: RangeEvidence
    cannot_tell: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def is_judged(self) -> bool:
        """True if at least the way from observation to command could be replayed."""
        return any(stage.stage in ("policy", "network") for stage in self.stages)


def examine_run(
    policy: LoadedPolicy,
    recording: Recording,
    machine: Machine,
    others: Mapping[str, LoadedPolicy],
    target_m: tuple[float, ...] | None,
    is_sent: bool,
    generator: np.random.Generator,
) -> RunExamination:
    """Examine one log.

    Args:
        policy: The policy that should have run.
        recording: The log.
        machine: The machine.
        others: Further policies that may have run instead, by name.
        target_m: Target where the log does not hold it.
        is_sent: The commands in force are those that the policy's loop sent: nobody at levers.
        generator: Draws the log's rounding.
    """
    contract = policy.contract
    log = read_run_log(recording, contract, target_m)
    is_sent = is_sent and not log.is_measured
    lacking, notes = _list_lacking(log, is_sent), list[str]()
    findings = [*_check_golden(policy), *_check_rate(policy, log), *_check_size(policy, log)]
    stages = []
    is_other = any(finding.kind == "network" for finding in findings)
    for stage in () if is_other else _list_stages(policy, log, others, is_sent, generator):
        result = judge_stage(stage)
        stages.append(result)
        if result.departs:
            rests = log.rests_at_start(machine.dead_time_s, machine.upper - machine.lower)
            if result.only_start and not result.named and not rests:
                notes.append(
                    "the log begins while the machine moves: its first "
                    f"{contract.num_samples / contract.rate_hz:.2g} s cannot be judged"
                )
            else:
                findings += _describe_findings(result, log, rests)
    return RunExamination(
        log=log,
        stages=tuple(stages),
        findings=tuple(findings),
        task=compare_with_training(log, contract),
        cannot_tell=tuple(lacking),
        notes=tuple(notes),
    )


def decide_verdict(
    runs: Sequence[RunExamination], motion: MotionEvidence
) -> tuple[DoctorVerdict, str]:
    """Return the verdict over all logs, and its reason in a sentence or two."""
    findings = [finding for run in runs for finding in run.findings]
    if findings:
        texts = list(dict.fromkeys(finding.text for finding in findings))
        return "code", "; ".join(texts) + "."
    outside = [one for run in runs if run.task.blamed for one in run.task.outside]
    places = ", ".join(
        f"{one.field} from {one.lowest:.3g} to {one.highest:.3g}, in training {one.low:.3g} to {one.high:.3g}"
        for one in outside[:3]
    )
    is_judged = all(run.is_judged for run in runs)
    code = "The code does what the contract says. " if is_judged else ""
    if motion.blamed and not outside:
        joints = ", ".join(motion.blamed)
        return "actuator", (
            f"{code}Under the recorded commands {joints} moved otherwise than all machines that the "
            "training draws."
        )
    if outside:
        also = f" {', '.join(motion.blamed)} moved otherwise too." if motion.blamed else ""
        return "task", f"{code}The run lies outside of the training: {places}.{also}"
    if not is_judged:
        reasons = "; ".join(dict.fromkeys(text for run in runs for text in run.cannot_tell))
        return "cannot_tell", f"The policy cannot be replayed: {reasons}."
    return "nothing", (
        f"{code}The run lies within the training's range, and the machine moves as those of the "
        "training, as far as could be judged."
        if not motion.cannot_tell
        else f"{code}Motion was not judged: {motion.cannot_tell}."
    )


def _list_stages(
    policy: LoadedPolicy,
    log: RunLog,
    others: Mapping[str, LoadedPolicy],
    is_sent: bool,
    generator: np.random.Generator,
) -> list[ReplayStage]:
    """Return the parts of the way that the log lets one judge."""
    stages, contract = list[ReplayStage](), policy.contract
    commanded = log.commanded
    if commanded is None and is_sent:
        commanded = log.in_force
    replay = PolicyReplay(policy, log, generator) if log.is_complete else None
    start = contract.num_samples
    after = distortions.list_command_distortions(policy)
    networks = distortions.list_network_distortions(policy, others)
    if replay is not None and log.observed is not None:
        floor = VECTOR_TOLERANCE + SPREAD_FACTOR * replay.vector_spread
        labels = [name for term in contract.terms for name in term.list_numbers()]
        encoded = replay.encode()
        known = _Known(encoded, replay)
        rows = _find_first_departure(encoded, log.observed, floor)
        inputs = [
            *distortions.list_frame_distortions(policy),
            *distortions.list_input_distortions(policy, log.signals, rows),
            *distortions.list_matched_orders(policy, log.signals, log.observed),
        ]
        stages.append(
            ReplayStage("observation", known.encode, log.observed, floor, tuple(labels), tuple(inputs), start)
        )  # fmt: skip
    if commanded is not None and log.observed is not None:
        answer = _Answered(policy, log.observed)
        floor = np.full(commanded.shape, TOLERANCE)
        after += _match_commands(contract, answer.command((), np.arange(len(commanded))), commanded)
        stages.append(
            ReplayStage("network", answer.command, commanded, floor, contract.joints, (*networks, *after), 0)
        )  # fmt: skip
    elif commanded is not None and replay is not None:
        floor = TOLERANCE + SPREAD_FACTOR * replay.command_spread
        rows = _find_first_departure(replay.nominal, commanded, floor)
        inputs = [
            *distortions.list_frame_distortions(policy),
            *distortions.list_input_distortions(policy, log.signals, rows),
        ]
        known = _Known(None, replay)
        after += _match_commands(contract, replay.nominal, commanded)
        stages.append(
            ReplayStage("policy", known.command, commanded, floor, contract.joints, (*inputs, *after, *networks), start)
        )  # fmt: skip
    if log.commanded is not None and log.in_force is not None and is_sent:
        sent = _Delivered(log.commanded)
        after += _match_commands(contract, log.commanded, log.in_force)
        floor = np.full(log.in_force.shape, TOLERANCE)
        stages.append(
            ReplayStage(
                "delivery", sent.deliver, log.in_force, floor, contract.joints, tuple(after), 0
            )
        )
    return stages


def _match_commands(
    contract: PolicyContract, known: np.ndarray, seen: np.ndarray
) -> list[Distortion]:
    """Return the order of the joints, whatever it is, in which commands come out as they were logged."""
    order = match_order(known, seen)
    names = list(contract.joints)
    return [] if order is None else [distortions.make_command_order(names, order)]


@dataclass(frozen=True)
class _Known:
    """A replay whose plain result is known."""

    encoded: np.ndarray | None
    replay: PolicyReplay

    def encode(self, changes: Sequence[Any], rows: np.ndarray) -> np.ndarray:
        if not changes and self.encoded is not None:
            return self.encoded[rows]
        return self.replay.encode(changes, rows)

    def command(self, changes: Sequence[Any], rows: np.ndarray) -> np.ndarray:
        return self.replay.command(changes, rows) if changes else self.replay.nominal[rows]


class _Answered:
    """Answers of networks to the logged observations."""

    def __init__(self, policy: LoadedPolicy, observed: np.ndarray) -> None:
        self._observed = observed
        self._own = policy.network.answer(observed)

    def command(self, changes: Sequence[Any], rows: np.ndarray) -> np.ndarray:
        commands = self._own
        for change in changes:
            if change.network is not None:
                commands = change.network(self._observed)
        for change in changes:
            if change.command is not None:
                commands = change.command(commands)
        return commands[rows]


@dataclass(frozen=True)
class _Delivered:
    """The policy's logged commands on their way to the valve."""

    commanded: np.ndarray

    def deliver(self, changes: Sequence[Any], rows: np.ndarray) -> np.ndarray:
        commands = self.commanded
        for change in changes:
            commands = change.command(commands)
        return commands[rows]


def _find_first_departure(
    nominal: np.ndarray, logged: np.ndarray, floor: np.ndarray
) -> tuple[int, ...]:
    """Return rows up to the first departure, at which something may have begun to be stale."""
    with np.errstate(invalid="ignore"):
        departed = np.flatnonzero((np.abs(nominal - logged) > floor).any(1))
    if not len(departed):
        return (0,)
    first = int(departed[0])
    return tuple(range(max(0, first - distortions.MAX_DELAY), first + 1))


def _describe_findings(result: StageResult, log: RunLog, rests: bool) -> list[Finding]:
    """Return the mistakes of a stage that departs."""
    t_s, departed = log.t_s, result.departed
    if result.named:
        return [
            _describe_named(one, result, t_s, index == 0) for index, one in enumerate(result.named)
        ]
    begin_s, end_s = float(t_s[departed[0]]), float(t_s[departed[-1]])
    labels = [label for label, _ in result.rank_labels()[:3]]
    if result.only_start and rests:
        text = "only the beginning departs: the history did not begin as the contract says"
        return [Finding("history", "observation", result.stage, text, {}, begin_s, end_s, 1.0)]
    if result.stage == "network":
        text = (
            "the commands do not follow from what the network saw, and no change of the command "
            "explains them: another network"
        )
        return [Finding("network", "network", result.stage, text, {}, begin_s, end_s, 0.0)]
    share = len(departed) / result.num_rows
    departing = "observation" if result.stage == "observation" else "command"
    text = (
        f"the {departing} departs in {share:.0%} of the rows, most in {', '.join(labels)}, by none "
        "of the mistakes that are known here"
    )
    return [
        Finding(
            UNLISTED,
            labels[0] if labels else result.stage,
            result.stage,
            text,
            {},
            begin_s,
            end_s,
            0.0,
        )
    ]


def _describe_named(
    one: FittedDistortion, result: StageResult, t_s: np.ndarray, is_first: bool
) -> Finding:
    distortion, value = one.distortion, one.value
    inside = result.departed[(result.departed >= one.begin) & (result.departed <= one.end)]
    shown = inside if len(inside) else result.departed
    alike = list[tuple[str, str]]()
    for other in result.alike if is_first else ():
        pair = (other.distortion.kind, other.distortion.field)
        if pair != (distortion.kind, distortion.field) and pair not in alike:
            alike.append(pair)
    parameters = {distortion.parameter: value} if distortion.parameter else {}
    if distortion.kind == "stale" and distortion.parameter == "row":
        parameters = {"since_s": float(t_s[int(value)])}
        text = distortion.text.replace("row {value}", f"{t_s[int(value)]:.2f} s")
    else:
        text = distortion.text.format(value=f"{value:.4g}")
    return Finding(
        kind=distortion.kind,
        field=distortion.field,
        stage=result.stage,
        text=text,
        parameters=parameters,
        begin_s=float(t_s[shown[0]]),
        end_s=float(t_s[shown[-1]]),
        explained=one.explained,
        alike=tuple(alike[:NUM_RANKED]),
    )


def _list_lacking(log: RunLog, is_sent: bool) -> list[str]:
    """Return what the log lacks, in words."""
    found = []
    if log.missing and log.observed is None:
        found.append(
            f"the log has no column {', '.join(log.missing)}; give doctor.target_in_base_m where "
            "only the target is missing, or record it"
        )
    elif log.missing:
        found.append(
            f"the observation cannot be checked: the log has no column {', '.join(log.missing)}"
        )
    if log.commanded is None and not is_sent:
        found.append("the log has no advice_<joint>, and its commands are not the policy's own")
    if log.is_measured:
        found.append("the way from advice to valve: the log holds the valves' feedback")
    return found


def _check_golden(policy: LoadedPolicy) -> list[Finding]:
    """Compare the network with the answers that its training recorded."""
    path = policy.contract.source.parent / GOLDEN
    if not path.is_file():
        return []
    golden = json.loads(path.read_text())
    found = policy.network.answer(np.array(golden["observation"]))
    difference = np.abs(found - np.array(golden["command"])).max()
    if difference <= TOLERANCE:
        return []
    text = f"the bundle is mixed: its network departs from {GOLDEN} by {difference:.2g}"
    return [Finding("network", "bundle", "network", text, {}, 0.0, 0.0, 1.0)]


def _check_size(policy: LoadedPolicy, log: RunLog) -> list[Finding]:
    """Compare the length of the logged vector with that of the contract."""
    size, found = policy.contract.size, log.num_observed
    if found in (0, size):
        return []
    text = f"the network got {found} numbers, the contract has {size}: another policy ran"
    begin_s, end_s = float(log.t_s[0]), float(log.t_s[-1])
    return [Finding("network", "observation", "observation", text, {}, begin_s, end_s, 1.0)]


def _check_rate(policy: LoadedPolicy, log: RunLog) -> list[Finding]:
    """Compare the rate of the log with that of the policy."""
    period_s = float(np.median(np.diff(log.t_s)))
    ratio = period_s * policy.contract.rate_hz
    if abs(ratio - 1.0) <= RATE_TOLERANCE:
        return []
    text = f"the loop ran at {1 / period_s:.4g} Hz, the policy was trained at {policy.contract.rate_hz:g} Hz"
    return [
        Finding(
            "rate", "loop", "policy", text, {"rate_hz": 1 / period_s},
            float(log.t_s[0]), float(log.t_s[-1]), 1.0,
        )
    ]  # fmt: skip
