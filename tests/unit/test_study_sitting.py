"""A sitting: what comes next stands in the folder alone; nothing is lost, and what goes wrong is kept and said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import SHOWN, Scripted
from sitting import FACTS, Arm, conductor, in_trial, machine, plan, saved

from brokk_rl import record
from brokk_rl.errors import ConfigError, StorageError
from deploy.page.protocol import OperatorRequest
from study import analysis, study_folder, tlx
from study.conductor import Conductor
from study.sitting import reserve_study
from study.steps import find_next_step
from study.study_server import StudyFeed

MACHINE = machine()


@pytest.fixture
def arm(tmp_path: Path) -> Arm:
    plan(tmp_path, MACHINE)
    return Arm(MACHINE)


def agreed(lead: Conductor, who: str = "P01") -> None:
    lead.choose(who)
    assert lead.take({"do": "consent", "agreed": True, "language": "de"}) == ""


def answer(lead: Conductor, value: int = 40) -> None:
    for scale in tlx.SCALES:
        assert lead.take({"do": "rate", "scale": scale, "value": value}) == ""
    for index, pair in enumerate(lead.view()["pairs"]):
        assert lead.take({"do": "pair", "pair": index, "chosen": pair[0]}) == ""
    assert lead.take({"do": "finish"}) == ""


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def test_a_sitting_from_consent_to_the_end_gives_what_a_report_reads(
    tmp_path: Path, arm: Arm
) -> None:
    lead, seen = conductor(tmp_path, arm), []
    agreed(lead)
    while (kind := lead.view()["kind"]) != "done":
        seen.append((kind, lead.view()["period"], lead.view()["condition"]))
        if kind == "trial":
            in_trial(lead, arm)
            assert lead.take({"do": "next"}) == ""
        else:
            answer(lead)
    conditions = study_folder.read_plan(tmp_path)["participants"]["P01"]
    assert seen == [
        (kind, period, conditions[period - 1]) for period in (1, 2) for kind in ("trial", "trial", "questionnaire")
    ]  # fmt: skip
    found = analysis.analyse(study_folder.read_study(tmp_path), MACHINE)
    mine = [trial for trial in found.trials if trial.facts["participant"] == "P01"]
    assert len(mine) == 4 and all(trial.values["success"] == 1 for trial in mine)
    assert all(
        trial.facts["outcome"] == "inserted" and trial.facts["twin"] is True for trial in mine
    )
    assert found.loads["weighted"]["guided"][0] == found.loads["raw"]["unguided"][0] == 40.0
    # Nothing to say against it.
    assert "P01" not in "".join(f"{remark.where}{remark.text}" for remark in found.remarks)
    consent = read(tmp_path / "participants" / "P01.json")["consent"]
    assert consent["agreed"] and consent["language"] == "de" and consent["version"] == "v1"
    for trial in mine:
        columns = record.read_recording(tmp_path / trial.facts["recording"], MACHINE).extra
        assert ("advice_q1" in columns) == (trial.facts["condition"] == "guided")
        assert trial.facts["start_error"] == [0.0] * 5


def test_who_does_not_agree_takes_no_part(tmp_path: Path, arm: Arm) -> None:
    lead = conductor(tmp_path, arm)
    lead.choose("P02")
    assert lead.take({"do": "begin"}) != ""
    lead.take({"do": "consent", "agreed": False})
    assert lead.view()["kind"] == "stopped" and not (tmp_path / "trials").exists()
    assert "no consent" in "".join(
        remark.text for remark in study_folder.read_study(tmp_path).remarks
    )


def test_a_trial_that_the_program_did_not_survive_is_kept_and_done_again(
    tmp_path: Path, arm: Arm
) -> None:
    lead = conductor(tmp_path, arm)
    agreed(lead)
    in_trial(lead, arm)
    lead.take({"do": "next"})
    lead.take({"do": "begin"})
    arm.later(lead, 3.0)
    assert lead.running
    del lead  # killed: nobody says goodbye
    again = conductor(tmp_path, Arm(MACHINE))
    again.choose("P01")
    view = again.view()
    assert (view["kind"], view["number"], view["phase"], view["done"]) == ("trial", 2, "ready", 1)
    lost = read(tmp_path / "trials" / "P01_1_02.json")
    assert lost["outcome"] == "aborted" and "interrupted" in lost["reason"]
    in_trial(again, again._stage)  # type: ignore[arg-type]
    again.take({"do": "next"})
    data = study_folder.read_study(tmp_path)
    assert (
        data.trials["P01", 1, 2]["outcome"] == "inserted"
        and find_next_step(data, "P01").kind == "questionnaire"
    )
    assert any("aborted (interrupted" in remark.text for remark in data.remarks)


def test_half_a_questionnaire_is_kept_said_and_gone_on_with(tmp_path: Path, arm: Arm) -> None:
    lead = conductor(tmp_path, arm)
    agreed(lead)
    for _ in range(2):
        in_trial(lead, arm)
        lead.take({"do": "next"})
    lead.take({"do": "rate", "scale": "mental", "value": 35})
    lead.take({"do": "to", "to": 6})
    first = lead.view()["pairs"]
    lead.take({"do": "pair", "pair": 0, "chosen": first[0][1]})
    again = conductor(tmp_path, arm)
    again.choose("P01")
    view = again.view()
    assert (
        view["ratings"] == {"mental": 35}
        and view["pairs"] == first
        and view["chosen"][0] == first[0][1]
    )
    assert view["at"] == 1, "the first screen without an answer"
    for wrong in ({"value": 101}, {"value": 33}, {"value": True}, {"scale": "joy", "value": 5}, {}):
        assert again.take({"do": "rate", "scale": "effort", **wrong}) == "malformed"
    again.take({"do": "to", "to": 21})
    assert again.take({"do": "finish"}) == "" and again.view()["kind"] == "trial"
    said = [
        remark.text
        for remark in analysis.analyse(study_folder.read_study(tmp_path), MACHINE).remarks
    ]
    assert any(
        "physical, temporal, performance, effort, frustration not answered" in text for text in said
    )
    assert any("1 of 15 pairs" in text for text in said)


def test_who_stops_in_a_trial_is_believed_and_may_come_back(tmp_path: Path, arm: Arm) -> None:
    lead = conductor(tmp_path, arm)
    agreed(lead)
    lead.take({"do": "begin"})
    arm.later(lead, 3.0)
    assert lead.take({"do": "stop_sitting", "reason": "felt unwell"}) == ""
    assert lead.view()["kind"] == "stopped" and arm.recorded is None
    assert read(tmp_path / "trials" / "P01_1_01.json")["outcome"] == "stopped"
    assert any(
        "stopped after 1 trials (felt unwell)" in remark.text
        for remark in study_folder.read_study(tmp_path).remarks
    )
    lead.take({"do": "go_on"})
    assert (lead.view()["kind"], lead.view()["number"]) == ("trial", 2)


@pytest.mark.parametrize(
    ("happens", "outcome", "reason"),
    [
        ("late", "time limit", ""),
        ("button", "stopped", ""),
        ("fault", "aborted", "experimenter"),
        ("silence", "aborted", "positions"),
    ],
)
def test_how_a_trial_can_end(
    tmp_path: Path, arm: Arm, happens: str, outcome: str, reason: str
) -> None:
    lead = conductor(tmp_path, arm)
    agreed(lead)
    lead.take({"do": "begin"})
    arm.later(lead, 2.0)
    if happens == "late":
        arm.later(lead, 20.0)
    elif happens == "silence":
        arm.q = None
        arm.later(lead, 1.5)
    else:
        assert lead.take({"do": {"button": "stop_trial", "fault": "abort"}[happens]}) == ""
    arm.later(lead, 1.0)
    saved(lead, arm)
    told = read(tmp_path / "trials" / "P01_1_01.json")
    assert told["outcome"] == outcome and reason in told["reason"]
    lead.take({"do": "next"})
    assert lead.view()["number"] == (1 if outcome == "aborted" else 2)


def test_a_recording_that_cannot_be_used_is_said_and_the_outcome_kept(
    tmp_path: Path, arm: Arm
) -> None:
    lead, arm.fails = conductor(tmp_path, arm), "a gap of 3 s"
    agreed(lead)
    in_trial(lead, arm)
    told = read(tmp_path / "trials" / "P01_1_01.json")
    assert (
        told["outcome"] == "inserted"
        and told["recording_problem"] == "a gap of 3 s"
        and "recording" not in told
    )


def test_practice_ends_with_two_successes_in_a_row_or_when_it_is_said(tmp_path: Path) -> None:
    plan(tmp_path, MACHINE, practice=4)
    arm = Arm(MACHINE)
    lead = conductor(tmp_path, arm)
    agreed(lead)
    for _ in range(2):
        assert lead.view()["period"] == 0
        in_trial(lead, arm)
        lead.take({"do": "next"})
    assert lead.view()["period"] == 1
    agreed(lead, "P02")
    assert lead.view()["period"] == 0
    lead.take({"do": "end_practice"})
    assert (
        lead.view()["period"] == 1
        and read(tmp_path / "participants" / "P02.json")["consent"]["agreed"]
    )


def test_advice_leaves_the_loop_in_guided_trials_alone(tmp_path: Path, arm: Arm) -> None:
    lead, inner = conductor(tmp_path, arm), Scripted(replace(SHOWN, guiding=False))
    feed = StudyFeed(inner, lead)
    agreed(lead)
    while lead.view()["kind"] == "trial":
        condition = lead.view()["condition"]
        assert feed.read_state().advice is None and feed.read_state().path_in_base_m == ()
        lead.take({"do": "begin"})
        arm.later(lead, 2.0)
        assert (
            (feed.read_state().advice is not None)
            == feed.read_state().guiding
            == (condition == "guided")
        )
        assert (
            not feed.submit(OperatorRequest("record", "off"))
            and not feed.submit(OperatorRequest("start", ""))
            and inner.requests == []
        )
        assert feed.submit(OperatorRequest("stop", "")) and not lead.running
        arm.later(lead, 1.0)
        saved(lead, arm)
        lead.take({"do": "next"})


def test_a_disk_that_takes_no_more_ends_the_trial_and_is_said(
    tmp_path: Path, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    lead = conductor(tmp_path, arm)
    agreed(lead)
    lead.take({"do": "begin"})
    arm.later(lead, 2.0)

    def full(*_: Any) -> None:
        raise StorageError("cannot write: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(study_folder, "write_json", full)
        arm.q = MACHINE.home
        arm.later(lead, 0.2)
        assert (
            lead.view()["kind"] == "choose"
            and "No space left" in lead.view()["problem"]
            and arm.recorded is None
        )
    lead.take({"do": "choose", "who": "P01"})
    assert (lead.view()["kind"], lead.view()["number"], lead.view()["problem"]) == (
        "trial",
        1,
        "",
    ), "it is done again"


def test_nobody_is_led_who_is_not_in_the_plan(tmp_path: Path, arm: Arm) -> None:
    lead = conductor(tmp_path, arm)
    with pytest.raises(ConfigError, match="no participant of the plan"):
        lead.choose("Jane")
    assert (
        lead.take({"do": "choose", "who": "Jane"}) == "failed" and "Jane" in lead.view()["problem"]
    )
    assert lead.take({"do": "begin"}) == "nobody" and lead.take({}) == "nobody"
    agreed(lead)
    (tmp_path / "captures" / "P01_1_01").mkdir(parents=True)
    (tmp_path / "captures" / "P01_1_01" / "capture.mcap").write_bytes(b"all that was on the bus")
    study_folder.erase(tmp_path, "P01")
    assert not list(tmp_path.rglob("P01*"))
    assert conductor(tmp_path, arm).view()["participants"][0]["state"] == "erased"
    assert np.all([FACTS["twin"], not FACTS["simulated"]])


def test_a_recording_that_an_interruption_left_unsaved_is_made_the_next_time(
    tmp_path: Path, arm: Arm
) -> None:
    lead = conductor(tmp_path, arm)
    agreed(lead)
    in_trial(lead, arm)
    path = tmp_path / "trials" / "P01_1_01.json"
    told = read(path)
    path.write_text(json.dumps({key: value for key, value in told.items() if key != "recording"}))
    (tmp_path / told["recording"]).unlink()
    conductor(tmp_path, Arm(MACHINE))
    assert read(path) == told and (tmp_path / told["recording"]).exists()
    (path.parent / "P02_1_01.json").write_text("{half")
    assert conductor(tmp_path, Arm(MACHINE)).view()["kind"] == "choose"


def test_one_program_at_a_time_leads_sittings_of_a_study(tmp_path: Path) -> None:
    with (
        reserve_study(tmp_path),
        pytest.raises(ConfigError, match="go on already"),
        reserve_study(tmp_path),
    ):
        pass
    with reserve_study(tmp_path):
        pass
