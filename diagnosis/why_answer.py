"""The answer of `mode=why`: cause, cost and next steps, as `why.json` and a page.

It is read from the files that the stages left: `doctor.json`, `diagnosis.json`, `evaluation.json`. Their own
pages show the evidence.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import yaml

from brokk_rl.errors import RecordingError
from brokk_rl.report import Tone, render_page
from brokk_rl.session import write_text
from diagnosis import answer, effects_file, own_simulator, report
from diagnosis.answer import Answer
from diagnosis.deployment.page import PAGE_FILE, REMEDIES
from diagnosis.story import HANDED_ON_FOLDER

WHY_FILE, WHY_PAGE = "why.json", "why.html"
TEMPLATE = Path(__file__).with_name("why.html.jinja")
DOCTOR, DIAGNOSIS = "doctor", "diagnosis"
BEFORE, ALL_EFFECTS = "as_trained", "with_effects"
LOW_SUCCESS = 0.8
"""Success without the effects below which the simulator is doubted; chosen by hand."""

Cause = Literal["code", "actuator", "task", "nothing", "cannot_tell"]
TITLES: Mapping[Cause, tuple[str, Tone]] = {
    "code": ("The deployed code is the cause", "bad"),
    "actuator": ("The machine is the cause: it moves otherwise than in training", "bad"),
    "task": ("The task is the cause: it lies outside of the training", "bad"),
    "nothing": ("No cause found in these logs", "good"),
    "cannot_tell": ("These logs do not suffice for an answer", "warn"),
}
SuccessRate = Mapping[str, Any]
"""`mean` and `ci95` of a rate or of a difference of two."""
NextStep = tuple[str, str]
"""A sentence, and the command for it or nothing."""


@dataclass(frozen=True)
class WhyResult:
    """Results of the stages.

    Attributes:
        folder: Run folder of `mode=why`.
        doctor: `doctor.json`.
        diagnosis: Answer of the diagnosis; `None` where it did not run.
        success: Strict success by stage of evaluation.
        policy: Folder of the policy, as the command has it.
        simulator: The simulator, as the command has it.
    """

    folder: Path
    doctor: Mapping[str, Any]
    diagnosis: Answer | None
    success: Mapping[str, SuccessRate]
    policy: str
    simulator: str

    @property
    def costs(self) -> dict[str, SuccessRate]:
        """Loss of success by stage, with 95 % intervals."""
        found = {}
        for name, rate in self.success.items():
            if name != BEFORE and BEFORE in self.success:
                found[name] = subtract_rates(self.success[BEFORE], rate)
        return found

    @property
    def has_effects(self) -> bool:
        """True if the diagnosis names effects."""
        return self.diagnosis is not None and bool(self.diagnosis.selected)

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
    def title(self) -> tuple[str, Tone]:
        """The answer in a few words, and its tone."""
        if self.cause != "nothing":
            return TITLES[self.cause]
        if self.has_effects:
            if ALL_EFFECTS in self.costs:
                return "No cause found: what differs costs no success for sure", "warn"
            return "No sure cause: the machine differs from the simulator", "warn"
        found = self.diagnosis
        if found is None or found.verdict == "unknown" or self.doctor["actuator"]["cannot_tell"]:
            return "No cause found, but not all could be judged", "warn"
        return TITLES["nothing"]

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


def subtract_rates(first: SuccessRate, second: SuccessRate) -> SuccessRate:
    """Return `first` less `second` with its 95 % interval.

    Source: Newcombe 1998, Statistics in Medicine 17, method 10, from two Wilson intervals. Policies
    meet the same starts, so their outcomes go together and the interval is rather too wide.
    """
    mean = first["mean"] - second["mean"]
    (low, high), (lower, higher) = first["ci95"], second["ci95"]
    below = math.hypot(first["mean"] - low, higher - second["mean"])
    above = math.hypot(high - first["mean"], second["mean"] - lower)
    return {"mean": mean, "ci95": [max(-1.0, mean - below), min(1.0, mean + above)]}


def format_rate(share: SuccessRate) -> str:
    """Return `91 % (88 to 93)`."""
    low, high = (100 * bound for bound in share["ci95"])
    return f"{100 * share['mean']:.0f} % ({low:.0f} to {high:.0f})"


def read_result(folder: Path, policy: str, simulator: str) -> WhyResult:
    """Return what the stages have left in a run folder so far."""
    doctor = json.loads((folder / DOCTOR / "doctor.json").read_text())
    try:
        found = answer.read_answer(folder / DIAGNOSIS / answer.ANSWER_FILE)
    except RecordingError:  # it did not run
        found = None
    success = {}
    for path in sorted(folder.glob("*/evaluation.json")):
        success[path.parent.name] = json.loads(path.read_text())["success_strict"]
    return WhyResult(folder, doctor, found, success, policy, simulator)


def read_effects(folder: Path) -> dict[str, Any]:
    """Return the found effects that an evaluation can take, by name."""
    path = folder / DIAGNOSIS / effects_file.EFFECTS_FILE
    return yaml.safe_load(path.read_text()) or {} if path.is_file() else {}


def write_summary(result: WhyResult) -> str:
    """Return what each stage says, in a few sentences."""
    texts = [result.doctor["reason"]]
    if result.cause == "code":
        texts.append("Mend this first, then ask again about the machine.")
    elif result.diagnosis is not None:
        texts += [report.write_headline(result.diagnosis)[0], _describe_cost(result)]
    return " ".join(filter(None, texts))


def _describe_cost(result: WhyResult) -> str:
    if not result.has_effects:
        return ""
    cost = result.costs.get(ALL_EFFECTS)
    if cost is None:
        return "The cost in success was not measured."
    before, after = (format_rate(result.success[name]) for name in (BEFORE, ALL_EFFECTS))
    if cost["ci95"][0] > 0.0:
        return f"It lowers the success of the policy in simulation from {before} to {after}."
    return f"It costs no success for sure: {before} without, {after} with it in simulation."


def list_changes(result: WhyResult) -> list[NextStep]:
    """Return what to change."""
    if result.cause == "code":
        kinds = [one["kind"] for log in result.doctor["logs"] for one in log["findings"]]
        return [(REMEDIES[kind], "") for kind in dict.fromkeys(kinds)]
    changes = []
    if result.cause == "task":
        text = "Ask the policy for what it was trained for, or widen the ranges of the task (task.…) and train on:"
        changes.append((text, f"brokk mode=train policy={result.policy}"))
    if not result.has_effects:
        return changes
    machine, simulator = _name_machine(result), result.simulator
    if own_simulator.is_named_in(simulator):
        text = "Put the effects into your simulator, and train in it again. This writes them as ranges and changes:"
        command = (
            f"brokk mode=change_simulator {machine} simulator={simulator} changes.diagnosis={result.folder / DIAGNOSIS} "
            f"session.out={result.folder / 'changes'}"
        )
        return [*changes, (text, command)]
    text = "Train on with the effects that were found, then run this command again with the new policy:"
    effects = f"@{result.folder / DIAGNOSIS / effects_file.EFFECTS_FILE}"
    command = f"brokk mode=train {machine} actuator={simulator} policy={result.policy} 'effect=[library,{effects}]'"
    return [*changes, (text, command)]


def list_records(result: WhyResult) -> list[NextStep]:
    """Return what to record next."""
    doctor, found = result.doctor, result.diagnosis
    texts = list(chain.from_iterable(log["cannot_tell"] for log in doctor["logs"]))
    if doctor["verdict"] == "code":
        if not doctor["named"]:
            texts.append("the observation vector (obs_0, obs_1, …), whose first wrong number tells the place")  # fmt: skip
    elif doctor["actuator"]["cannot_tell"]:
        texts.append(doctor["actuator"]["cannot_tell"])
    records = [(f"Not judged: {text}.", "") for text in dict.fromkeys(texts)]
    for one in found.selected if found else ():
        if one.same_as:
            records.append((report.describe_class(one), ""))
    if result.cause != "code" and not result.has_effects and (found is None or found.reason):
        text = "The diagnosis names no effect. Log a minute or more in two files; motions made for it tell most:"
        excitation = "'[levels,ramps,holds,reversals]'"
        command = f"brokk mode=collect {_name_machine(result)} excitation={excitation} collect.only_plan=true"
        records.append((text, command))
    return records


def _name_machine(result: WhyResult) -> str:
    return f"machine=@{result.folder / HANDED_ON_FOLDER / 'machine.yaml'}"


def write_page(result: WhyResult) -> None:
    """Write `why.html`: the answer, the cost of each effect, next steps, and where the evidence is.

    Raises:
        StorageError: it could not be written.
    """
    title, tone = result.title
    places = [f"{DOCTOR}/{PAGE_FILE}: code, task and motion"]
    if result.diagnosis is not None:
        places.append(f"{DIAGNOSIS}/{report.REPORT_FILE}: where the simulator errs, and which effects it lacks")  # fmt: skip
    before = result.success.get(BEFORE)
    values = {
        "title": title,
        "tone": tone,
        "summary": write_summary(result),
        "result": result,
        "often_fails": before is not None and before["mean"] < LOW_SUCCESS,
        "next_steps": {
            "What to change": list_changes(result),
            "What to record next": list_records(result),
        },
        "places": places,
        "format_rate": format_rate,
    }
    write_text(result.folder / WHY_PAGE, render_page(TEMPLATE, values))
