"""The answer of `mode=why` (`why.json`): cause, evidence, cost, and the next steps, in words.

It is read from the files that the stages left: `doctor.json`, `diagnosis.json`, `evaluation.json`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from brokk_rl.errors import RecordingError
from brokk_rl.report import Tone
from diagnosis import answer, effects_file, report
from diagnosis.answer import Answer
from diagnosis.deployment.page import REMEDIES
from diagnosis.retraining import SuccessRate, subtract_rates
from diagnosis.story import HANDED_ON_FOLDER

WHY_FILE = "why.json"
DOCTOR, DIAGNOSIS = "doctor", "diagnosis"
BEFORE, ALL_EFFECTS = "as_trained", "with_effects"

Cause = Literal["code", "actuator", "task", "nothing", "cannot_tell"]
TITLES: Mapping[Cause, str] = {
    "code": "The deployed code is the cause",
    "actuator": "The machine is the cause: it moves otherwise than in training",
    "task": "The task is the cause: it lies outside of the training",
    "nothing": "No cause found in these logs",
    "cannot_tell": "These logs do not suffice for an answer",
}
TONES: Mapping[Cause, Tone] = {
    "code": "bad", "actuator": "bad", "task": "bad", "nothing": "good", "cannot_tell": "warn"
}  # fmt: skip
NO_TELLING = "cannot tell"
"""Begins the reason of a diagnosis whose recordings do not suffice."""


@dataclass(frozen=True)
class WhyRequest:
    """Words of the command that its next steps repeat.

    Attributes:
        policy: Folder of the policy.
        simulator: The simulator, as `simulator=` takes it.
        is_own: It is a simulator of one's own, a function or an MJCF file.
    """

    policy: str
    simulator: str
    is_own: bool


@dataclass(frozen=True)
class WhyResult:
    """Results of the stages.

    Attributes:
        folder: Run folder of `mode=why`.
        doctor: `doctor.json`.
        diagnosis: Answer of the diagnosis; `None` where it did not run.
        success: Strict success by stage of evaluation.
        unmeasured: Selected effects whose cost no stage could measure.
        request: Words of the command; `None` for results without one.
    """

    folder: Path
    doctor: Mapping[str, Any]
    diagnosis: Answer | None
    success: Mapping[str, SuccessRate]
    unmeasured: tuple[str, ...] = ()
    request: WhyRequest | None = field(default=None)

    @property
    def costs(self) -> dict[str, SuccessRate]:
        """Loss of success by stage, with 95 % intervals."""
        if BEFORE not in self.success:
            return {}
        return {
            name: subtract_rates(self.success[BEFORE], rate)
            for name, rate in self.success.items()
            if name != BEFORE
        }

    @property
    def has_effects(self) -> bool:
        """True if the diagnosis names effects."""
        return self.diagnosis is not None and bool(self.diagnosis.selected)

    @property
    def has_unknown_gap(self) -> bool:
        """True if the diagnosis finds a gap that no effect of the library explains."""
        found = self.diagnosis
        return (
            found is not None
            and found.verdict == "unknown"
            and not found.reason.startswith(NO_TELLING)
        )

    @property
    def cause(self) -> Cause:
        """The cause over all stages.

        The doctor's verdict stands, unless it finds nothing and a named effect costs success for sure.
        """
        told: Cause = self.doctor["verdict"]
        cost = self.costs.get(ALL_EFFECTS)
        if told in ("nothing", "cannot_tell") and cost is not None and cost["ci95"][0] > 0.0:
            return "actuator"
        return told

    @property
    def title(self) -> str:
        """The answer in a few words."""
        if self.cause == "nothing" and self.has_effects:
            if ALL_EFFECTS in self.costs:
                return "No cause found: what differs costs no success for sure"
            return "No sure cause: the machine differs from the simulator"
        if self.cause == "nothing" and not self.is_complete:
            return "No cause found, but not all could be judged"
        return TITLES[self.cause]

    @property
    def is_complete(self) -> bool:
        """True if machine and effects could be judged."""
        found = self.diagnosis
        return (
            found is not None
            and found.verdict != "unknown"
            and not self.doctor["actuator"]["cannot_tell"]
        )

    @property
    def tone(self) -> Tone:
        """Tone of the first paragraph."""
        return "warn" if self.title != TITLES[self.cause] else TONES[self.cause]

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain JSON data, as `why.json` holds it."""
        found = self.diagnosis
        effects = found.selected if found else ()
        return {
            "verdict": self.cause,
            "reason": write_summary(self),
            "doctor": self.doctor["verdict"],
            "diagnosis": found.verdict if found else None,
            "effects": [{"effect": one.effect, "joints": list(one.joints)} for one in effects],
            "success": dict(self.success),
            "cost": self.costs,
            "change": [f"{text} {command}".strip() for text, command in list_changes(self)],
            "record": [f"{text} {command}".strip() for text, command in list_records(self)],
        }


def read_result(folder: Path, request: WhyRequest | None = None) -> WhyResult:
    """Return what the stages have left in a run folder so far."""
    doctor = json.loads((folder / DOCTOR / "doctor.json").read_text())
    try:
        found = answer.read_answer(folder / DIAGNOSIS / answer.ANSWER_FILE)
    except RecordingError:  # it did not run
        found = None
    success = {}
    for path in sorted(folder.glob("*/evaluation.json")):
        success[path.parent.name] = json.loads(path.read_text())["success_strict"]
    unmeasured = ()
    if found is not None:
        measurable = read_effects(folder) if ALL_EFFECTS in success else {}
        unmeasured = tuple(one.effect for one in found.selected if one.effect not in measurable)
    return WhyResult(folder, doctor, found, success, unmeasured, request)


def read_effects(folder: Path) -> dict[str, Any]:
    """Return the found effects that an evaluation can take, by name."""
    path = folder / DIAGNOSIS / effects_file.EFFECTS_FILE
    return yaml.safe_load(path.read_text()) or {} if path.is_file() else {}


def write_summary(result: WhyResult) -> str:
    """Return the answer in a few sentences: cause, effect, cost, and what is not the cause."""
    cause, doctor = result.cause, result.doctor
    if cause == "code":
        start = (
            "The deployed code departs from the contract of the policy: " if doctor["named"] else ""
        )
        return f"{start}{doctor['reason']} Mend this first, then ask again about the machine."
    if doctor["verdict"] in ("task", "cannot_tell") and cause == doctor["verdict"]:
        return f"{doctor['reason']}{_append(_describe_effects(result))}"
    texts = [_describe_effects(result)]
    if cause == "nothing":
        texts.append(doctor["reason"])
    else:
        code, _, task = judge_suspects(result)
        cleared = [
            words
            for (state, _), words in ((code, "the deployed code"), (task, "the task"))
            if state == CLEARED
        ]
        if cleared:
            verb = "is" if len(cleared) == 1 else "are"
            told = report.join_words(cleared)
            texts.append(f"{told[0].upper()}{told[1:]} {verb} not the cause.")
    return " ".join(filter(None, texts))


def _append(text: str) -> str:
    return f" {text}" if text else ""


def _describe_effects(result: WhyResult) -> str:
    """Return what the machine does otherwise, and what that costs."""
    found = result.diagnosis
    blamed = [name for name, one in result.doctor["actuator"]["joints"].items() if one["blamed"]]
    if found is None or not found.selected:
        if result.has_unknown_gap:
            place = report.list_on_joints(blamed)
            return f"The machine moves otherwise than the simulator{place}, by an effect that is unknown to the library."
        if blamed:
            names = report.join_words(blamed)
            return (
                f"{names} moved otherwise than nearly all machines of the training. Which effect it is "
                "could not be told."
            )
        return ""
    names = report.join_words([report.describe_selected(one) for one in found.selected])
    text = f"The machine shows an effect that the simulator lacks: {names}."
    if len(found.selected) > 1:
        text = f"The machine shows effects that the simulator lacks: {names}."
    cost = result.costs.get(ALL_EFFECTS)
    if cost is None:
        return f"{text} Its cost in success was not measured."
    before, after = (
        f"{100 * result.success[name]['mean']:.0f} %" for name in (BEFORE, ALL_EFFECTS)
    )
    it = "It" if len(found.selected) == 1 else "Together they"
    if cost["ci95"][0] > 0.0:
        lowers = "lowers" if it == "It" else "lower"
        return f"{text} {it} {lowers} the success of the policy in simulation from {before} to {after}."
    return (
        f"{text} That costs no success for sure: {before} without, {after} with it in simulation."
    )


CLEARED, GUILTY, UNJUDGED, POSSIBLE = "cleared", "cause", "not judged", "possible"
Judgement = tuple[str, str]
"""Result for a suspect, and the evidence for it."""


def judge_suspects(result: WhyResult) -> tuple[Judgement, Judgement, Judgement]:
    """Return result and evidence for code, machine and task."""
    doctor, logs = result.doctor, result.doctor["logs"]
    findings = [one for log in logs for one in log["findings"]]
    replayed = [one for log in logs for one in log["code"] if one["stage"] in ("policy", "network")]
    rows = sum(one["rows"] for one in replayed)
    runs = f"{len(logs)} log" + ("s" if len(logs) > 1 else "")
    if findings:
        texts = []
        for one in findings:
            begin_s, end_s = one["time_s"]
            texts.append(f"{one['text']} ({one['field']}, {begin_s:.2f} to {end_s:.2f} s)")
        code = (GUILTY, "; ".join(dict.fromkeys(texts)))
    elif replayed:
        code = (CLEARED, f"replayed on {rows:,} rows of {runs}: each command is the policy's own")
    else:
        reasons = dict.fromkeys(text for log in logs for text in log["cannot_tell"])
        code = (UNJUDGED, "; ".join(reasons) or "the policy could not be replayed")
    return code, _judge_machine(result), _judge_task(doctor)


def _judge_machine(result: WhyResult) -> Judgement:
    motion, found = result.doctor["actuator"], result.diagnosis
    joints = [name for name, one in motion["joints"].items() if one["blamed"]]
    texts = []
    if motion["cannot_tell"]:
        texts.append(f"against the training: {motion['cannot_tell']}")
    elif joints:
        texts.append(
            f"{report.join_words(joints)} moved otherwise than 98 % of the training's machines"
        )
    else:
        texts.append("moved as the machines of the training do")
    if found is not None and found.selected:
        names = [
            report.name_effect(one.effect) + report.list_on_joints(one.joints)
            for one in found.selected
        ]
        texts.append(f"the simulator lacks {report.join_words(names)}")
    elif found is not None:
        texts.append(f"effects: {found.verdict}{f', {found.reason}' if found.reason else ''}")
    if result.cause == "actuator":
        return GUILTY, "; ".join(texts)
    if result.has_effects and ALL_EFFECTS not in result.costs:
        return POSSIBLE, "; ".join(texts)
    return (UNJUDGED if motion["cannot_tell"] else CLEARED), "; ".join(texts)


def _judge_task(doctor: Mapping[str, Any]) -> Judgement:
    blamed = [log["task"] for log in doctor["logs"] if log["task"]["blamed"]]
    outside = dict.fromkeys(one["field"] for task in blamed for one in task["outside"])
    reasons = [log["task"]["cannot_tell"] for log in doctor["logs"] if log["task"]["cannot_tell"]]
    if outside:
        return GUILTY, f"outside of the training: {', '.join(outside)}"
    if reasons:
        return UNJUDGED, reasons[0]
    return CLEARED, "target and positions lie within the range that the policy saw in training"


def list_changes(result: WhyResult) -> list[tuple[str, str]]:
    """Return what to change: a sentence, and the command for it or nothing."""
    if result.cause == "code":
        kinds = [one["kind"] for log in result.doctor["logs"] for one in log["findings"]]
        return [(REMEDIES[kind], "") for kind in dict.fromkeys(kinds)]
    changes, asked = [], result.request
    policy = asked.policy if asked else "<policy>"
    simulator = asked.simulator if asked else "<simulator>"
    if result.cause == "task":
        changes.append(
            ("Ask the policy for what it was trained for, or widen the ranges of the task (task.…) and train on:",
             f"brokk mode=train policy={policy}")
        )  # fmt: skip
    if not result.has_effects:
        return changes
    machine = f"machine=@{result.folder / HANDED_ON_FOLDER / 'machine.yaml'}"
    effects = f"@{result.folder / DIAGNOSIS / effects_file.EFFECTS_FILE}"
    if asked is not None and asked.is_own:
        form = "changes of the file and as " if simulator.endswith(".xml") else ""
        changes.append(
            (f"Put the effects into your simulator, and train in it again. This writes them as {form}ranges for randomisation:",
             f"brokk mode=change_simulator {machine} simulator={simulator} changes.diagnosis={result.folder / DIAGNOSIS} "
             f"changes.why={result.folder / WHY_FILE} session.out={result.folder / 'changes'}")
        )  # fmt: skip
    else:
        changes.append(
            ("Train on with the effects that were found, then run this command again with the new policy:",
             f"brokk mode=train {machine} actuator={simulator} policy={policy} 'effect=[library,{effects}]'")
        )  # fmt: skip
    return changes


def list_records(result: WhyResult) -> list[tuple[str, str]]:
    """Return what to record next: a sentence, and the command for it or nothing."""
    doctor, found = result.doctor, result.diagnosis
    records = [(f"Log what could not be judged: {text}.", "") for log in doctor["logs"] for text in log["cannot_tell"]]  # fmt: skip
    if doctor["verdict"] == "code" and not doctor["named"]:
        records.append(
            ("Log the observation vector too (obs_0, obs_1, …): the first wrong number tells the place.", "")
        )  # fmt: skip
    machine = f"machine=@{result.folder / HANDED_ON_FOLDER / 'machine.yaml'}"
    if found is not None and found.next_experiment is not None:
        following = found.next_experiment
        names = report.join_words([report.name_effect(name) for name in following.separates])
        records.append((
            f"These recordings cannot tell {names} apart. The motions '{following.excitation}' can; the plan of them:",
            f"brokk mode=collect {machine} excitation={following.excitation} collect.only_plan=true",
        ))  # fmt: skip
    elif result.cause != "code" and (found is None or (not found.selected and found.reason)):
        why = f" ({found.reason})" if found is not None else ""
        records.append((
            f"The diagnosis had too little to name an effect{why}. Log more runs, a minute or more in two files; "
            "motions made for it tell most:" if found is None or not result.has_unknown_gap
            else f"No effect of the library explains the gap{why}. Motions made for it tell more:",
            f"brokk mode=collect {machine} 'excitation=[levels,ramps,holds,reversals]' collect.only_plan=true",
        ))  # fmt: skip
    if doctor["actuator"]["cannot_tell"] and result.cause != "code":
        records.append((f"The motion was not compared with training: {doctor['actuator']['cannot_tell']}.", ""))  # fmt: skip
    return list(dict.fromkeys(records))
