"""`brokk mode=rehearse`: run several modes in a row on a machine with withheld effects, and report.

The report is `story.html`. It is made from the files of the stages; parts of unfinished stages are
left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from brokk_rl import story
from brokk_rl.contracts.actuator import Effect
from brokk_rl.contracts.task import Task
from brokk_rl.contracts.world import Simulator
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.report import Cell, Report, Tone
from brokk_rl.rl.settings import Evaluation, TrainingConfig
from brokk_rl.session import Session
from brokk_rl.spec import spec
from diagnosis import answer, plots, report, retraining
from diagnosis.answer import Answer
from diagnosis.retraining import format_rate

STORY_FILE = "story.html"
EVALUATED = {
    "policy": "in the simulator, machines drawn at random",
    "believed": "on the machine as it is believed to be",
    "changed": "on the machine that has changed",
}
"""Stages that leave an `evaluation.json`, and where it was."""


def write_story(folder: Path, stages: Mapping[str, str], withheld: Mapping[str, Any]) -> None:
    """Write `story.html`.

    Args:
        folder: Run folder of the story, with one folder a stage.
        stages: Purpose of each.
        withheld: The withheld effects, as configured.

    Raises:
        StorageError: it could not be written.
    """
    found, repair = (
        _read_diagnosis(folder / "diagnosis"),
        _read_json(folder / "repair" / retraining.COMPARISON_FILE),
    )
    text, tone = _summarize_story(found, repair, withheld)
    page = Report("A gap, found and closed", text, tone)
    if repair:
        figure = retraining.draw_success(repair)
        page.add_picture(
            figure,
            "Strict success with Wilson's 95 % intervals; all policies meet the same starts.",
        )
    story.add_stages(page, folder, stages)
    _add_simulator(page, _read_json(folder / "simulator" / "identification.json"))
    _add_policy(page, {name: _read_json(folder / name / "evaluation.json") for name in EVALUATED})
    if found:
        _add_diagnosis(page, found, withheld)
    if repair:
        page.add_heading("Success after retraining")
        retraining.add_success_table(page, repair)
        page.add_text(
            "The repaired simulator predicted for the retrained policy a success of "
            f"{format_rate(repair['predicted'])}. On the machine it succeeds in "
            f"{format_rate(repair['achieved'])}. More in the reports of the stages: "
            "simulator/identification.html, diagnosis/report.html, "
            f"repair/{retraining.REPORT_FILE}."
        )
    page.write(folder / STORY_FILE)


def _summarize_story(
    found: Answer | None, repair: Mapping[str, Any] | None, withheld: Mapping[str, Any]
) -> tuple[str, Tone]:
    if found is None:
        return "The story goes on.", "plain"
    if not found.selected:
        verdict = "nothing" if found.verdict == "none" else "something that it does not know"
        return (
            f"The diagnosis found {verdict}; the machine has {_list_withheld(withheld)}. {found.reason}",
            "bad",
        )
    named = {name for one in found.selected for name in (one.effect, *one.same_as)}
    right = (
        "as it is"
        if set(withheld) <= named and len(found.selected) == len(withheld)
        else f"but the machine has {_list_withheld(withheld)}"
    )
    told = f"The diagnosis names {report.join_words([report.describe_selected(one) for one in found.selected])}, {right}."
    if repair is None:
        return told, "plain"
    text, tone = retraining.write_headline(repair)
    return f"{text} {told}", tone


def _list_withheld(withheld: Mapping[str, Any]) -> str:
    return report.join_words(
        [
            report.name_effect(name) + report.list_on_joints(_get_joints(node))
            for name, node in withheld.items()
        ]
    )


def _get_joints(node: Mapping[str, Any]) -> list[str]:
    joints = node.get("joints", [])
    return [] if isinstance(joints, str) else list(joints)


def _add_simulator(page: Report, found: Mapping[str, Any] | None) -> None:
    if not found:
        return
    page.add_heading("The simulator")
    models = list(next(iter(found["joints"].values())))
    rows = [
        [joint, *(f"{1e3 * one[model]['5']['rmse']:.1f}" for model in models)]
        for joint, one in found["joints"].items()
    ]
    page.add_table(
        ["joint", *models],
        rows,
        f"Error after 5 s in a free run through recordings that it was not fitted to, RMS, mrad; {models[0]} is the simulator, "
        f"fitted in {found['fit_seconds']:.0f} s, the others are baselines",
    )


def _add_policy(page: Report, evaluations: Mapping[str, Mapping[str, Any] | None]) -> None:
    rows = []
    for name, found in evaluations.items():
        if found:
            time_s = found["time_to_insert_s"]["median"]
            classical = found["policies"].get("classical")
            rows.append(
                [
                    EVALUATED[name],
                    format_rate(found["success_strict"]),
                    None if time_s is None else f"{time_s:.1f} s",
                    None if classical is None else format_rate(classical["success_strict"]),
                ]
            )
    if rows:
        page.add_heading("The policy")
        page.add_table(["", "strict success", "time to insert", "classical controller"], rows)


def _add_diagnosis(page: Report, found: Answer, withheld: Mapping[str, Any]) -> None:
    page.add_heading("The diagnosis")
    page.add_text(*report.write_headline(found))
    rows = []
    for one in found.selected:
        for number, by_joint in one.parameters.items():
            for joint, value in by_joint.items():
                size, interval = report.format_estimate(value)
                rows.append(
                    [
                        report.name_effect(one.effect),
                        joint,
                        number,
                        Cell(size, interval),
                        _get_true_number(withheld, one.effect, number, joint),
                    ]
                )
    if rows:
        page.add_table(["effect", "joint", "number", "found", "withheld"], rows)
    if figure := plots.draw_gap_bars(found):
        page.add_picture(
            figure, "Error over free runs of 5 s on recordings that no effect was fitted to."
        )


def _get_true_number(
    withheld: Mapping[str, Any], effect: str, number: str, joint: str
) -> str | None:
    """Return the number that the machine really has."""
    node = withheld.get(effect)
    if node is None or (_get_joints(node) and joint not in _get_joints(node)):
        return None
    value = node.get(number)
    if isinstance(value, Mapping):
        value = value.get(joint, value.get("other"))
    return None if value is None else f"{value:g}"


def _read_json(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.is_file() else None


def _read_diagnosis(folder: Path) -> Answer | None:
    try:
        return answer.read_answer(folder / answer.ANSWER_FILE)
    except RecordingError:  # not there yet
        return None


HANDED_ON_GROUPS = ("sim", "task", "rl", "evaluation")
"""Groups that a stage can take from the story."""


@spec
class Rehearse:
    """Run several modes in a row, each in a folder of its own, and report the outcome.

    Attributes:
        session: Folder, seed, device.
        sim: Physics of the stages.
        task: Task of the stages.
        rl: How stages train.
        evaluation: How stages evaluate.
        withheld: Effects that the machine has and that no stage but it is told of:
            `<folder>/given/withheld.yaml`.
        stages: The story, in order.
        resume: Run folder of an interrupted story; finished stages are kept. The same as
            `session.out`.
    """

    session: Session
    sim: Simulator
    task: Task
    rl: TrainingConfig
    evaluation: Evaluation
    withheld: dict[str, Effect]
    stages: dict[str, story.StoryStage]
    resume: str | None

    def check(self) -> None:
        if not self.stages:
            raise ConfigError(
                "mode=rehearse has no story of its own; give one, as in experiment=gap_loop"
            )
        story.check_story(self.session, self.stages, self.resume, HANDED_ON_GROUPS)

    def run(self) -> None:
        """Run the stages that are not finished; writes `story.html` after each of them.

        Raises:
            BrokkError: a stage failed; the story goes on from there with `resume=`.
        """
        folder = self.session.folder.resolve()
        heads = {"withheld": "# @package effect\n"}
        given = story.write_groups(folder, (*HANDED_ON_GROUPS, "withheld"), heads)
        told = {name: stage.title for name, stage in self.stages.items()}

        def write_page() -> None:
            write_story(folder, told, given["withheld"])

        story.run_story(self.session, self.stages, write_page)
        Console().print(f"story: {self.session.folder / STORY_FILE}", highlight=False)
