"""A sitting: what comes next stands in the folder alone; nothing is lost, and what goes wrong is kept and said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from browser import SHOWN, Scripted
from sitting import (
    MACHINE,
    Arm,
    agreed,
    begun,
    conductor,
    done,
    inserted_after,
    plan,
    recorded,
    saved,
)

from brokk_rl import record
from brokk_rl.errors import ConfigError, StorageError
from brokk_rl.record import Recording
from deploy.page.protocol import OperatorRequest
from deploy.recorder.conversion import CaptureLogReader
from study import analysis, study_folder, tlx
from study.conductor import Conductor, find_next_step
from study.sitting import StudyFeed, reserve_study


@pytest.fixture
def arm(tmp_path: Path) -> Arm:
    plan(tmp_path)
    return Arm()


@pytest.fixture
def lead(tmp_path: Path, arm: Arm) -> Conductor:
    """Who leads the first participant, who has agreed."""
    made = conductor(tmp_path, arm)
    agreed(made)
    return made


@pytest.fixture(autouse=True)
def captures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every capture shows an insertion at the end of the trial, and advice."""

    def between(*given: Any) -> Recording:
        begin_s, end_s = given[-2:]
        q = inserted_after(int((end_s - begin_s) * 20) - 9)
        return recorded(q, **{f"advice_{name}": q[:, 0] for name in MACHINE.joint_names})

    monkeypatch.setattr(CaptureLogReader, "between", between)


def answer(lead: Conductor, value: int = 40) -> None:
    for scale in tlx.SCALES:
        assert lead.take({"do": "rate", "scale": scale, "value": value}) == ""
    assert lead.take({"do": "to", "to": len(tlx.SCALES)}) == ""
    assert lead.take({"do": "finish"}) == ""


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def remarks(place: Path) -> str:
    found = analysis.analyse(study_folder.read_study(place), MACHINE)
    return "\n".join(f"{remark.where}: {remark.text}" for remark in found.data.remarks)


def test_a_sitting_from_consent_to_the_end_gives_what_a_report_reads(
    tmp_path: Path, arm: Arm, lead: Conductor
) -> None:
    seen = []
    while (kind := lead.view()["kind"]) != "done":
        seen.append((kind, lead.view()["period"], lead.view()["condition"]))
        if kind == "trial":
            done(lead, arm)
        else:
            answer(lead)
    data = study_folder.read_study(tmp_path)
    expected = []
    for period, condition in enumerate(data.plan["participants"]["P01"], 1):
        for kind in ("trial", "trial", "questionnaire"):
            expected.append((kind, period, condition))
    assert seen == expected
    found = analysis.analyse(data, MACHINE)
    assert found.trials.success.tolist() == [1.0] * 4
    assert found.trials.outcome.tolist() == ["inserted"] * 4
    assert found.means.tlx_raw[:2].tolist() == [40.0] * 2
    assert "P01" not in remarks(tmp_path), "there is nothing to say against it"
    consent = read(tmp_path / "participants" / "P01.json")["consent"]
    assert consent["agreed"] and consent["language"] == "de" and consent["version"] == "v1"
    for trial in data.planned[:4]:
        path = tmp_path / f"recordings/{trial.name}.parquet"
        columns = record.read_recording(path, MACHINE).extra
        assert ("advice_q1" in columns) == (trial.condition == "guided")
        assert data.trials[trial.key]["twin"] is True


def test_who_does_not_agree_takes_no_part(tmp_path: Path, arm: Arm) -> None:
    lead = conductor(tmp_path, arm)
    lead.choose("P02")
    assert lead.take({"do": "begin"}) != ""
    lead.take({"do": "consent", "agreed": False})
    assert lead.view()["kind"] == "stopped" and not (tmp_path / "trials").exists()
    assert "no consent" in remarks(tmp_path)


def test_a_trial_that_the_program_did_not_survive_is_kept_and_done_again(
    tmp_path: Path, arm: Arm, lead: Conductor
) -> None:
    done(lead, arm)
    begun(lead, arm)
    # Killed: nobody says goodbye.
    arm = Arm()
    again = conductor(tmp_path, arm)
    again.choose("P01")
    view = again.view()
    assert (view["kind"], view["number"], view["phase"], view["done"]) == ("trial", 2, "ready", 1)
    lost = read(tmp_path / "trials" / "P01_1_02.json")
    assert lost["outcome"] == "aborted" and "interrupted" in lost["reason"]
    done(again, arm)
    data = study_folder.read_study(tmp_path)
    assert data.trials["P01", 1, 2]["outcome"] == "inserted"
    assert find_next_step(data, "P01").kind == "questionnaire"
    assert "aborted (interrupted" in remarks(tmp_path)


def test_half_a_questionnaire_is_kept_said_and_gone_on_with(
    tmp_path: Path, arm: Arm, lead: Conductor
) -> None:
    for _ in range(2):
        done(lead, arm)
    lead.take({"do": "rate", "scale": "mental", "value": 35})
    again = conductor(tmp_path, arm)
    again.choose("P01")
    view = again.view()
    assert view["ratings"] == {"mental": 35}
    assert view["at"] == 1, "the first screen without an answer"
    for wrong in ({"value": 101}, {"value": 33}, {"value": True}, {"scale": "joy", "value": 5}, {}):
        assert again.take({"do": "rate", "scale": "effort", **wrong}) == "malformed"
    again.take({"do": "to", "to": 6})
    assert again.take({"do": "finish"}) == "" and again.view()["kind"] == "trial"
    assert "frustration not answered: no mean" in remarks(tmp_path)


def test_who_stops_in_a_trial_is_believed_and_may_come_back(
    tmp_path: Path, arm: Arm, lead: Conductor
) -> None:
    begun(lead, arm)
    assert lead.take({"do": "stop_sitting", "reason": "felt unwell"}) == ""
    assert lead.view()["kind"] == "stopped" and arm.recorded is None
    assert read(tmp_path / "trials" / "P01_1_01.json")["outcome"] == "stopped"
    assert "stopped after 1 trials (felt unwell)" in remarks(tmp_path)
    lead.take({"do": "go_on"})
    assert (lead.view()["kind"], lead.view()["number"]) == ("trial", 2)


@pytest.mark.parametrize(
    ("happens", "outcome", "reason"),
    [
        ("late", "time limit", ""), ("stop_trial", "stopped", ""), ("abort", "aborted", "experimenter"),
        ("silence", "aborted", "positions"),
    ],
)  # fmt: skip
def test_how_a_trial_can_end(
    tmp_path: Path, arm: Arm, lead: Conductor, happens: str, outcome: str, reason: str
) -> None:
    begun(lead, arm)
    if happens == "late":
        arm.later(lead, 20.0)
    elif happens == "silence":
        arm.q = None
        arm.later(lead, 1.5)
    else:
        assert lead.take({"do": happens}) == ""
    saved(lead, arm)
    told = read(tmp_path / "trials" / "P01_1_01.json")
    assert told["outcome"] == outcome and reason in told["reason"]
    lead.take({"do": "next"})
    assert lead.view()["number"] == (1 if outcome == "aborted" else 2)


def test_a_capture_that_cannot_be_used_is_said_and_outcome_and_time_kept(
    tmp_path: Path, arm: Arm, lead: Conductor, monkeypatch: pytest.MonkeyPatch
) -> None:
    done(lead, arm)
    monkeypatch.undo()
    found = analysis.analyse(study_folder.read_study(tmp_path), MACHINE)
    assert "P01 1.1: its recording cannot be used" in remarks(tmp_path)
    assert found.trials.success.tolist() == [1.0]
    assert found.trials.time_s.tolist() == pytest.approx([3.2], abs=0.3)


def test_practice_ends_with_two_successes_in_a_row_or_when_it_is_said(tmp_path: Path) -> None:
    plan(tmp_path, practice=4)
    arm = Arm()
    lead = conductor(tmp_path, arm)
    agreed(lead)
    for _ in range(2):
        assert lead.view()["period"] == 0
        done(lead, arm)
    assert lead.view()["period"] == 1
    agreed(lead, "P02")
    assert lead.view()["period"] == 0
    lead.take({"do": "end_practice"})
    assert lead.view()["period"] == 1
    assert read(tmp_path / "participants" / "P02.json")["consent"]["agreed"]


def test_advice_leaves_the_loop_in_guided_trials_alone(arm: Arm, lead: Conductor) -> None:
    inner = Scripted(replace(SHOWN, guiding=False))
    feed, conditions = StudyFeed(inner, lead), set()
    while lead.view()["kind"] != "done":
        if lead.view()["kind"] == "questionnaire":
            answer(lead)
            continue
        is_guided = lead.view()["condition"] == "guided"
        conditions.add(is_guided)
        assert feed.read_state().advice is None and feed.read_state().path_in_base_m == ()
        begun(lead, arm)
        assert (feed.read_state().advice is not None) == feed.read_state().guiding == is_guided
        assert not feed.submit(OperatorRequest("record", "off"))
        assert not feed.submit(OperatorRequest("start", "")) and inner.requests == []
        assert feed.submit(OperatorRequest("stop", "")) and not lead.running
        saved(lead, arm)
        lead.take({"do": "next"})
    assert conditions == {True, False}


def test_a_disk_that_takes_no_more_ends_the_trial_and_is_said(
    arm: Arm, lead: Conductor, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(lead, arm)

    def full(*_: Any) -> None:
        raise StorageError("cannot write: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(study_folder, "write_json", full)
        arm.q = MACHINE.home
        arm.later(lead, 0.2)
        assert lead.view()["kind"] == "choose" and arm.recorded is None
        assert "No space left" in lead.view()["problem"]
    lead.take({"do": "choose", "who": "P01"})
    assert (lead.view()["kind"], lead.view()["number"], lead.view()["problem"]) == ("trial", 1, "")


def test_nobody_is_led_who_is_not_in_the_plan(tmp_path: Path, arm: Arm) -> None:
    lead = conductor(tmp_path, arm)
    with pytest.raises(ConfigError, match="no participant of the plan"):
        lead.choose("Jane")
    assert lead.take({"do": "choose", "who": "Jane"}) == "failed"
    assert "Jane" in lead.view()["problem"]
    assert lead.take({"do": "begin"}) == "nobody" and lead.take({}) == "nobody"
    agreed(lead)
    (tmp_path / "captures" / "P01_1_01").mkdir(parents=True)
    (tmp_path / "captures" / "P01_1_01" / "capture.mcap").write_bytes(b"all that was on the bus")
    study_folder.erase(tmp_path, "P01")
    assert not list(tmp_path.rglob("P01*"))
    assert conductor(tmp_path, arm).view()["participants"][0]["state"] == "erased"


def test_one_program_at_a_time_leads_sittings_of_a_study(tmp_path: Path) -> None:
    refused = pytest.raises(ConfigError, match="go on already")
    with reserve_study(tmp_path), refused, reserve_study(tmp_path):
        pass
    with reserve_study(tmp_path):
        pass
