"""`brokk mode=why`: why a policy works in simulation and not on the machine, on one page.

It runs the modes that exist, each in a folder of its own: `doctor_policy`, then `diagnose` unless the
code is to blame, then `evaluate` with the effects that were found.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from brokk_rl.errors import BrokkError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.report import Cell, Report, Tone
from brokk_rl.rl.settings import Evaluation
from brokk_rl.session import Session, write_json, write_text
from brokk_rl.spec import spec
from brokk_rl.story import HANDED_ON_FOLDER, StoryStage, add_stages, run_story, write_groups
from diagnosis import answer, report
from diagnosis.answer import Answer
from diagnosis.deployment.page import PAGE_FILE, REMEDIES, TITLES, TONES
from diagnosis.retraining import format_rate

log = logging.getLogger(__name__)

WHY_FILE, WHY_PAGE = "why.json", "why.html"
DOCTOR, DIAGNOSIS, BEFORE = "doctor", "diagnosis", "as_trained"
ALL_EFFECTS = "with_effects"
HANDED_ON_GROUPS = ("machine", "evaluation")
EFFECT_HEAD = "# @package effect\n"


@spec
class Why:
    """Say why a policy fails on the machine: code, actuator or task, and what each costs.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        evaluation: How to evaluate what an effect costs.
        log: Glob or globs of recordings of the policy's runs.
        policy: `folder`: the policy.
        simulator: Actuator of the simulator that trained it, as `actuator=` takes it; or a simulator of
            your own, `module:function` or an MJCF file.
        sent: The commands of the log are those that the policy's loop sent.
        target_in_base_m: Target where the log has none.
        resume: Run folder of an interrupted run to go on with; the same as `session.out`.
    """

    session: Session
    machine: Machine
    evaluation: Evaluation
    log: str | tuple[str, ...]
    policy: dict[str, str]
    simulator: str
    sent: bool
    target_in_base_m: tuple[float, float, float] | None
    resume: str | None

    def run(self) -> None:
        """Write `why.json` and `why.html`.

        Raises:
            BrokkError: a stage failed; what came before it is kept.
        """
        folder = self.session.folder.resolve()
        write_groups(folder, HANDED_ON_GROUPS, {"machine": "", "evaluation": ""})
        stages = {DOCTOR: self._examine()}
        self._play(stages)
        told = json.loads((folder / DOCTOR / "doctor.json").read_text())
        if told["verdict"] not in ("code", "cannot_tell"):
            stages[DIAGNOSIS] = self._diagnose()
            try:
                self._play(stages)
            except BrokkError as error:  # short logs may not do for it; the rest still holds
                log.warning("%s", error)
            found = _read_diagnosis(folder)
            if found is not None and found.selected:
                stages |= self._list_evaluations(folder)
                self._play(stages)
        result = _collect(folder)
        write_json(folder / WHY_FILE, result.to_json())
        console = Console()
        console.print(
            f"{result.doctor['verdict']}: {result.doctor['reason']}",
            style="bold",
            highlight=False,
            markup=False,
        )
        for line in result.changes:
            console.print(line, highlight=False, markup=False)
        console.print(f"page: {self.session.folder / WHY_PAGE}", highlight=False)

    def _play(self, stages: Mapping[str, StoryStage]) -> None:
        folder = self.session.folder.resolve()
        titles = {name: stage.title for name, stage in stages.items()}
        run_story(self.session, stages, lambda: write_why_page(folder, titles))

    def _choose_simulator(self) -> list[str]:
        """Return the overrides that choose the simulator."""
        if ":" in self.simulator or self.simulator.endswith(".xml"):
            return ["actuator=own", f"actuator.source={json.dumps(self.simulator)}"]
        return [f"actuator={self.simulator}"]

    def _examine(self) -> StoryStage:
        command = [
            "mode=doctor_policy", f"doctor.log={_quote(self.log)}",
            f"doctor.policy={self.policy['folder']}", *self._choose_simulator(),
            f"doctor.sent={str(self.sent).lower()}",
        ]  # fmt: skip
        if self.target_in_base_m is not None:
            command.append(f"doctor.target_in_base_m={list(self.target_in_base_m)}")
        return _make_stage("Is the code, the task or the actuator to blame?", command, ("machine",))

    def _diagnose(self) -> StoryStage:
        command = [
            "mode=diagnose", f"diagnosis.field={_quote(self.log)}", *self._choose_simulator()
        ]  # fmt: skip
        return _make_stage("Which effect does the simulator lack?", command, ("machine", "device"))

    def _list_evaluations(self, folder: Path) -> dict[str, StoryStage]:
        """Return the stages that measure success: as trained, with each effect, with all."""
        effects = yaml.safe_load((folder / DIAGNOSIS / "effects.yaml").read_text()) or {}
        stages = {BEFORE: self._evaluate("Success as trained", "[library]")}
        for name, node in effects.items() if len(effects) > 1 else ():
            path = folder / HANDED_ON_FOLDER / f"found_{name}.yaml"
            write_text(path, EFFECT_HEAD + yaml.safe_dump({name: node}, sort_keys=False))
            title = f"Success with {report.name_effect(name)}"
            stages[f"with_{name}"] = self._evaluate(title, f"[library,@{path}]")
        path = folder / DIAGNOSIS / "effects.yaml"
        stages[ALL_EFFECTS] = self._evaluate("Success with all found", f"[library,@{path}]")
        return stages

    def _evaluate(self, title: str, effects: str) -> StoryStage:
        command = [
            "mode=evaluate", f"policy.folder={self.policy['folder']}", *self._choose_simulator(),
            f"effect={effects}", "~policy@rivals.classical", "+rivals={}",
        ]  # fmt: skip
        return _make_stage(title, command, ("machine", "evaluation", "device"))


@dataclass(frozen=True)
class WhyResult:
    """Results of the stages.

    Attributes:
        doctor: `doctor.json`.
        diagnosis: Answer of the diagnosis; `None` where it did not run.
        success: Strict success by stage of evaluation.
        changes: What to change.
        record: What to record next.
    """

    doctor: dict[str, Any]
    diagnosis: Answer | None
    success: dict[str, dict[str, Any]]
    changes: list[str]
    record: list[str]

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain JSON data, as `why.json` holds it."""
        found = self.diagnosis
        return {
            "verdict": self.doctor["verdict"],
            "reason": self.doctor["reason"],
            "diagnosis": found.verdict if found else None,
            "effects": [{"effect": one.effect, "joints": list(one.joints)} for one in found.selected] if found else [],
            "success": self.success,
            "change": self.changes,
            "record": self.record,
        }  # fmt: skip


def _collect(folder: Path) -> WhyResult:
    """Read what the stages left."""
    told = json.loads((folder / DOCTOR / "doctor.json").read_text())
    found, success = _read_diagnosis(folder), {}
    for path in sorted(folder.glob("*/evaluation.json")):
        success[path.parent.name] = json.loads(path.read_text())["success_strict"]
    return WhyResult(told, found, success, _list_changes(told, found), _list_records(told, found))


def _read_diagnosis(folder: Path) -> Answer | None:
    try:
        return answer.read_answer(folder / DIAGNOSIS / answer.ANSWER_FILE)
    except RecordingError:  # not there
        return None


def _list_changes(told: Mapping[str, Any], found: Answer | None) -> list[str]:
    """Return what to change, in words."""
    if told["verdict"] == "code":
        kinds = [one["kind"] for log in told["logs"] for one in log["findings"]]
        return list(dict.fromkeys(REMEDIES[kind] for kind in kinds))
    changes = []
    if told["verdict"] == "task":
        changes.append(
            "Ask for what was trained, or widen the ranges of the task (task.…) and train on: "
            "mode=train start_from=<policy>."
        )
    if found is not None and found.selected:
        changes.append(
            "Retrain with the effects that were found: mode=close_gap "
            "'effect@found=[@<this folder>/diagnosis/effects.yaml]' policy.folder=<policy>."
        )
    return changes


def _list_records(told: Mapping[str, Any], found: Answer | None) -> list[str]:
    """Return what to record next, in words."""
    records = [text for log in told["logs"] for text in log["cannot_tell"]]
    if told["verdict"] == "code" and not told["named"]:
        records.append(
            "the observation vector (obs_0, obs_1, …), so that the first wrong number is told"
        )
    if found is None and told["verdict"] not in ("code", "cannot_tell"):
        records.append(
            "the machine under excitation, for the diagnosis: mode=collect, a quarter of an hour in "
            "files of some minutes"
        )
    elif found is not None:
        if found.next_experiment is not None:
            following = found.next_experiment
            names = report.join_words([report.name_effect(name) for name in following.separates])
            records.append(f"mode=collect excitation={following.excitation}: it separates {names}")
        elif not found.selected:
            records.append(f"the diagnosis says {found.verdict}: {found.reason}")
    if told["actuator"]["cannot_tell"]:
        records.append(told["actuator"]["cannot_tell"])
    return list(dict.fromkeys(records))


def write_why_page(folder: Path, titles: Mapping[str, str]) -> None:
    """Write `why.html` from what the stages have left so far.

    Raises:
        StorageError: it could not be written.
    """
    result = _collect(folder)
    told, found = result.doctor, result.diagnosis
    tone: Tone = TONES[told["verdict"]]
    page = Report(f"Why not on the machine: {TITLES[told['verdict']]}", told["reason"], tone)
    if result.changes:
        page.add_heading("What to change")
        page.add_list(result.changes)
    if result.record:
        page.add_heading("What to record next")
        page.add_list(result.record)
    page.add_heading("Code, actuator, task")
    page.add_table(["", "finding"], _list_evidence(told))
    page.add_text(f"Where and when the log departs: {DOCTOR}/{PAGE_FILE}.")
    if found is not None:
        page.add_heading("Which effect")
        page.add_text(*report.write_headline(found))
        page.add_text(f"More in {DIAGNOSIS}/{report.REPORT_FILE}.")
    if result.success:
        page.add_heading("What it costs in success")
        rows = [
            [titles.get(name, name), Cell(format_rate(rate), "")]
            for name, rate in sorted(
                result.success.items(), key=lambda one: list(titles).index(one[0])
            )
        ]
        page.add_table(["simulator", "strict success"], rows, "The same starts for all rows")
    add_stages(page, folder, titles)
    page.write(folder / WHY_PAGE)


def _list_evidence(told: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    findings = [one for log in told["logs"] for one in log["findings"]]
    for one in findings:
        begin_s, end_s = one["time_s"]
        rows.append(["code", f"{one['text']} ({one['field']}, {begin_s:.2f} to {end_s:.2f} s)"])
    if not findings:
        replayed = any(
            stage["stage"] in ("policy", "network") for log in told["logs"] for stage in log["code"]
        )
        rows.append(["code", "does what the contract says" if replayed else "not judged"])
    joints = [name for name, one in told["actuator"]["joints"].items() if one["blamed"]]
    unjudged = told["actuator"]["cannot_tell"]
    moved = (
        f"{', '.join(joints)} moved otherwise than in training"
        if joints
        else "moves as in training"
    )
    rows.append(["actuator", f"not judged: {unjudged}" if unjudged else moved])
    outside = [
        one["field"]
        for log in told["logs"]
        for one in log["task"]["outside"]
        if log["task"]["blamed"]
    ]
    reasons = [log["task"]["cannot_tell"] for log in told["logs"] if log["task"]["cannot_tell"]]
    placed = (
        f"outside of the training: {', '.join(dict.fromkeys(outside))}"
        if outside
        else "within the training"
    )
    rows.append(["task", f"not judged: {reasons[0]}" if reasons else placed])
    return rows


def _make_stage(title: str, command: list[str], takes: tuple[str, ...]) -> StoryStage:
    return StoryStage(
        title=title, command=tuple(command), takes=takes, links={}, needs=None, resumes=False
    )


def _quote(patterns: str | tuple[str, ...]) -> str:
    """Return globs as one value of the command; relative ones are seen from where it was typed."""
    if isinstance(patterns, str):
        return json.dumps(patterns)
    return json.dumps(list(patterns))
