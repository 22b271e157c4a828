"""`story.html`: what came of a rehearsed story, from the files that its stages left; parts that are not there yet are left out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from brokk_rl.errors import RecordingError
from brokk_rl.report import Cell, Page, Tone
from brokk_rl.session import read_record
from diagnosis import answer, downstream, downstream_page, pictures, wording
from diagnosis.answer import Answer
from diagnosis.downstream import said

PAGE = "story.html"
EVALUATED = {
    "policy": "in the simulator, machines drawn at random",
    "believed": "on the machine as it is believed to be",
    "changed": "on the machine that has changed",
}
"""Stages that leave an `evaluation.json`, and where it was."""


def write(folder: Path, stages: Mapping[str, str], withheld: Mapping[str, Any]) -> None:
    """Writes `story.html`.

    Args:
        folder: Run folder of the story, with one folder a stage.
        stages: What each is for.
        withheld: The effects that nobody was told of, as configured.

    Raises:
        StorageError: it could not be written.
    """
    found, repair = _diagnosis(folder / "diagnosis"), _json(folder / "repair" / downstream.FILE)
    text, tone = _summary(found, repair, withheld)
    page = Page("A gap, found and closed", text, tone)
    if repair:
        figure = downstream_page.picture(repair)
        page.picture(
            figure,
            "Strict success with Wilson's 95 % intervals; all policies meet the same starts.",
        )
    _stages(page, folder, stages)
    _simulator(page, _json(folder / "simulator" / "identification.json"))
    _policy(page, {name: _json(folder / name / "evaluation.json") for name in EVALUATED})
    if found:
        _found(page, found, withheld)
    if repair:
        page.heading("What it is worth")
        downstream_page.table(page, repair)
        page.text(
            f"Retrained, the policy was predicted to succeed in {said(repair['predicted'])}, by the repaired simulator; on the "
            f"machine it succeeds in {said(repair['achieved'])}. The pages of the stages say more: simulator/identification.html, "
            f"diagnosis/report.html, repair/{downstream_page.PAGE}."
        )
    page.write(folder / PAGE)


def _summary(
    found: Answer | None, repair: Mapping[str, Any] | None, withheld: Mapping[str, Any]
) -> tuple[str, Tone]:
    if found is None:
        return "The story goes on.", "plain"
    if not found.selected:
        verdict = "nothing" if found.verdict == "none" else "something that it does not know"
        return (
            f"The diagnosis found {verdict}; the machine has {_listed(withheld)}. {found.reason}",
            "bad",
        )
    named = {name for one in found.selected for name in (one.effect, *one.same_as)}
    right = (
        "as it is"
        if set(withheld) <= named and len(found.selected) == len(withheld)
        else f"but the machine has {_listed(withheld)}"
    )
    told = f"The diagnosis names {wording.listed([wording.named(one) for one in found.selected])}, {right}."
    if repair is None:
        return told, "plain"
    text, tone = downstream.headline(repair)
    return f"{text} {told}", tone


def _listed(withheld: Mapping[str, Any]) -> str:
    return wording.listed(
        [wording.said(name) + wording.on(_joints(node)) for name, node in withheld.items()]
    )


def _joints(node: Mapping[str, Any]) -> list[str]:
    joints = node.get("joints", [])
    return [] if isinstance(joints, str) else list(joints)


def _stages(page: Page, folder: Path, stages: Mapping[str, str]) -> None:
    page.heading("Stages")
    rows, whole_s = [], 0.0
    for name, title in stages.items():
        record = read_record(folder / name)
        if record is None:
            rows.append([name, title, None])
            continue
        seconds = _seconds(record)
        whole_s += seconds or 0.0
        rows.append(
            [
                name,
                Cell(title, f"{record['outcome']}; {record['mode']}"),
                None if seconds is None else f"{seconds / 60:.1f}",
            ]
        )
    rows.append(["", "all", f"{whole_s / 60:.1f}"])
    page.table(["stage", "what for", "minutes"], rows)
    with page.details("The commands"):
        records = (read_record(folder / name) for name in stages)
        page.code(
            "\n\n".join(f"brokk {' '.join(record['command'][1:])}" for record in records if record)
        )


def _seconds(record: Mapping[str, Any]) -> float | None:
    if not record.get("ended"):
        return None
    begun, ended = (datetime.fromisoformat(record[key]) for key in ("started", "ended"))
    return (ended - begun).total_seconds()


def _simulator(page: Page, found: Mapping[str, Any] | None) -> None:
    if not found:
        return
    page.heading("The simulator")
    models = list(next(iter(found["joints"].values())))
    rows = [
        [joint, *(f"{1e3 * one[model]['5']['rmse']:.1f}" for model in models)]
        for joint, one in found["joints"].items()
    ]
    page.table(
        ["joint", *models],
        rows,
        f"Error after 5 s in a free run through recordings that it was not fitted to, RMS, mrad; {models[0]} is the simulator, "
        f"fitted in {found['fit_seconds']:.0f} s, the others are baselines",
    )


def _policy(page: Page, evaluations: Mapping[str, Mapping[str, Any] | None]) -> None:
    rows = []
    for name, found in evaluations.items():
        if found:
            time_s = found["time_to_insert_s"]["median"]
            classical = found["policies"].get("classical")
            rows.append(
                [
                    EVALUATED[name],
                    said(found["success_strict"]),
                    None if time_s is None else f"{time_s:.1f} s",
                    None if classical is None else said(classical["success_strict"]),
                ]
            )
    if rows:
        page.heading("The policy")
        page.table(["", "strict success", "time to insert", "classical controller"], rows)


def _found(page: Page, found: Answer, withheld: Mapping[str, Any]) -> None:
    page.heading("The diagnosis")
    page.text(*wording.headline(found))
    rows = []
    for one in found.selected:
        for number, by_joint in one.parameters.items():
            for joint, value in by_joint.items():
                size, interval = wording.estimate(value)
                rows.append(
                    [
                        wording.said(one.effect),
                        joint,
                        number,
                        Cell(size, interval),
                        _true(withheld, one.effect, number, joint),
                    ]
                )
    if rows:
        page.table(["effect", "joint", "number", "found", "withheld"], rows)
    if figure := pictures.ladder(found):
        page.picture(
            figure, "Error over free runs of 5 s on recordings that no effect was fitted to."
        )


def _true(withheld: Mapping[str, Any], effect: str, number: str, joint: str) -> str | None:
    """Returns the number that the machine really has."""
    node = withheld.get(effect)
    if node is None or (_joints(node) and joint not in _joints(node)):
        return None
    value = node.get(number)
    if isinstance(value, Mapping):
        value = value.get(joint, value.get("other"))
    return None if value is None else f"{value:g}"


def _json(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.is_file() else None


def _diagnosis(folder: Path) -> Answer | None:
    try:
        return answer.read(folder / answer.FILE)
    except RecordingError:  # not there yet
        return None
