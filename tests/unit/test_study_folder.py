"""A study that does not go as planned: everything is kept and said; the page, the tables, and who wants to be forgotten."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brokk_rl import record
from brokk_rl.errors import ConfigError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.record import Recording
from brokk_rl.session import write_json
from study import analysis, design, report, study_folder, tlx

RATE_HZ = 20.0


def made(machine: Machine, order: str = "counterbalanced", count: int = 4) -> design.Design:
    tip = compute_tool_kinematics(machine, machine.home).tip_in_base_m
    hole = design.Hole(center_in_base_m=(tip[0], tip[1], tip[2] + 0.12), radius_m=0.05)
    return design.Design(
        num_participants=count, order=order, holes=dict.fromkeys("ABC", hole),  # type: ignore[arg-type]
        starts=dict.fromkeys("123", tuple(machine.home)), practice_trials=2, practice_minutes=10.0, limit_s=20.0,
        success=design.Success(depth_m=0.1, clearance_m=0.013), primary="time_s", alpha=0.05,
    )  # fmt: skip


def study(
    folder_: Path, machine: Machine, count: int = 4, order: str = "counterbalanced"
) -> list[design.Trial]:
    """Writes a whole study in which guided trials last 4 s and others 8 s, the second period 1 s less, and persons differ."""
    what = made(machine, order, count)
    planned = design.plan_trials(what, np.random.default_rng(0))
    write_json(folder_ / study_folder.PLAN, design.format_plan(what, machine, 0, planned))
    hole = what.holes["A"]
    for trial in planned:
        person = int(trial.participant[1:])
        time_s = (4.0 if trial.condition == "guided" else 8.0) - (trial.period == 2) + 0.1 * person
        name = f"{study_folder.RECORDINGS}/{trial.name}.parquet"
        record.write_recording(trial_of(machine, time_s), folder_ / name)
        facts = {
            "participant": trial.participant,
            "period": trial.period,
            "condition": trial.condition,
            "number": trial.number,
        }
        place = {
            "name": trial.hole,
            "center_in_base_m": list(hole.center_in_base_m),
            "radius_m": 0.05,
        }
        study_folder.write_trial(
            folder_,
            trial.name,
            facts
            | {
                "hole": place,
                "limit_s": 20.0,
                "outcome": "inserted",
                "recording": name,
                "start": "1",
            },
        )
    for who, conditions in study_folder.read_plan(folder_)["participants"].items():
        for period, condition in zip((1, 2), conditions, strict=True):
            ratings = dict.fromkeys(tlx.SCALES, 30 if condition == "guided" else 50)
            answers = [{"pair": list(pair), "chosen": pair[0]} for pair in tlx.PAIRS]
            study_folder.write_questionnaire(
                folder_, who, period, {"ratings": ratings, "pairs": answers}
            )
    return planned


def trial_of(machine: Machine, time_s: float) -> Recording:
    num = round(time_s * RATE_HZ)
    q = np.repeat(machine.home[None], num + 10, 0)
    q[:num, 0] += 0.3 * np.linspace(1.0, 0.1, num)
    return Recording(
        machine=machine.name, joints=machine.joint_names, units=("rad",) * 5, rate_hz=RATE_HZ,
        t_s=np.arange(len(q)) / RATE_HZ, u=np.zeros_like(q), q=q,
    )  # fmt: skip


def said(data: Any) -> str:
    return "\n".join(f"{remark.where}: {remark.text}" for remark in data.remarks)


def test_a_whole_study_says_what_was_put_in(machine: Machine, tmp_path: Path) -> None:
    study(tmp_path, machine, count=12)
    data = study_folder.read_study(tmp_path)
    found = analysis.analyse(data, machine)
    effect = found.effects["time_s"]
    assert not found.remarks and len(found.trials) == 12 * 8  # practice is there, too …
    assert sum(trial.counts for trial in found.trials) == 12 * 6  # … and does not count
    assert effect.difference == pytest.approx(-4.0, abs=0.06) and effect.period == pytest.approx(
        -1.0, abs=0.06
    )
    assert effect.p == pytest.approx(2 / 64)
    assert found.effects["tlx_raw"].difference == pytest.approx(-20.0)
    assert found.loads["weighted"]["guided"].tolist() == [30.0] * 12
    assert found.holm["tlx_mental"] == pytest.approx(6 * 2 / 64)
    assert "time_s" not in found.holm  # the primary measure stands alone
    path = report.write_report(tmp_path / "out", data, found)
    page = path.read_text()
    assert "Guidance helps" in page and "imulated" not in page
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {
        "report.html", "report.json", "trials.csv", "means.csv", "paths.png", "tlx.png", "pairs.png",
    }  # fmt: skip
    assert (tmp_path / "out" / "means.csv").read_text().count("\n") == 1 + 24
    json.loads((tmp_path / "out" / "report.json").read_text())


def test_with_the_papers_order_the_report_says_that_nothing_can_be_said(
    machine: Machine, tmp_path: Path
) -> None:
    study(tmp_path, machine, count=5, order="fixed")
    found = analysis.analyse(study_folder.read_study(tmp_path), machine)
    text, tone = report.state_verdict(found)
    assert tone == "bad" and "order cannot be told apart" in text
    assert found.effects["time_s"].p is None


def test_what_went_wrong_is_kept_and_said(machine: Machine, tmp_path: Path) -> None:
    planned = study(tmp_path, machine, count=6)
    trials = tmp_path / study_folder.TRIALS
    (trials / "P01_1_02.json").unlink()  # missing
    for path in [*trials.glob("P02_1_*"), *trials.glob("P02_2_*")]:  # stopped after practice
        path.unlink()
    study_folder.write_participant(tmp_path, "P02", {"stopped": True, "reason": "felt unwell"})
    first = json.loads((trials / "P03_1_01.json").read_text())
    # Done twice
    study_folder.write_trial(
        tmp_path, "P03_1_01", {**first, "created": "2999-01-01", "limit_s": 20.0}
    )
    study_folder.write_trial(tmp_path, "P99_1_01", {**first, "participant": "P99"})  # unknown
    swapped = "unguided" if first["condition"] == "guided" else "guided"
    study_folder.write_trial(tmp_path, "P03_1_07", {**first, "number": 7, "condition": swapped})
    (trials / "P04_1_01.json").write_text("{broken")
    (tmp_path / study_folder.RECORDINGS / "P05_2_01.parquet").write_bytes(b"cut off")
    aborted = json.loads((trials / "P05_1_01.json").read_text())
    (trials / "P05_1_01.json").write_text(
        json.dumps({**aborted, "outcome": "aborted", "reason": "hose burst"})
    )
    (tmp_path / study_folder.QUESTIONNAIRES / "P04_2.json").unlink()
    half = {"ratings": {"mental": 40}, "pairs": []}
    study_folder.write_questionnaire(tmp_path, "P05", 1, half)
    data = study_folder.read_study(tmp_path)
    found = analysis.analyse(data, machine)
    text = said(found)
    for claim in (
        "1 of 6 trials are missing (period.trial 1.2)", "stopped after 0 trials (felt unwell)", "done twice: the first counts",
        "'P99' is no participant", f"done {swapped}, but planned", "P04_1_01.json: cannot be read", "aborted (hose burst)",
        "P05 2.1: its recording cannot be used", "P04: no questionnaire for period 2", "physical, temporal",
        "was filled in twice", "P02: 0 trials guided: is in no comparison",
    ):  # fmt: skip
        assert claim in text, claim
    # Spare ones are still there; the unreadable and missing are not.
    assert len(found.trials) == len(planned) + 3 - 6 - 1 - 1
    assert sum(not t.counts and bool(t.facts["period"]) for t in found.trials) == 4
    assert found.effects["time_s"].num_persons == 5 and found.effects["tlx_raw"].num_persons == 4
    assert math.isnan(found.means["time_s"]["guided"][1])
    assert (tmp_path / study_folder.TRIALS / "P03_1_01_again2.json").exists()
    page = report.write_report(tmp_path / "out", data, found).read_text()
    assert "hose burst" in page and "felt unwell" in page


def test_a_participant_is_forgotten_on_request(machine: Machine, tmp_path: Path) -> None:
    study(tmp_path, machine, count=4)
    study_folder.write_participant(tmp_path, "P02", {"hand": "left"})
    study_folder.note_report(tmp_path, tmp_path / "out")
    (tmp_path / "out").mkdir()
    gone, reports = study_folder.erase(tmp_path, "P02")
    assert len(gone) == 8 + 8 + 2 + 1 and reports == [tmp_path / "out"]
    assert not list(tmp_path.rglob("P02*"))
    found = analysis.analyse(study_folder.read_study(tmp_path), machine)
    assert found.participants == ["P01", "P03", "P04"] and "P02: erased on request" in said(found)
    with pytest.raises(ConfigError, match="no such participant"):
        study_folder.erase(tmp_path, "Jane")


def test_an_outcome_that_the_recording_contradicts_is_said(
    machine: Machine, tmp_path: Path
) -> None:
    study(tmp_path, machine)
    path = tmp_path / study_folder.TRIALS / "P01_1_01.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"outcome": "time limit"}))
    assert "written down as 'time limit', but the recording shows an insertion" in said(
        analysis.analyse(study_folder.read_study(tmp_path), machine)
    )


def test_every_hole_and_start_stands_everywhere_equally_often(machine: Machine) -> None:
    what = made(machine, count=12)
    planned = [
        trial for trial in design.plan_trials(what, np.random.default_rng(1)) if trial.period
    ]
    for attribute, names in (("hole", "ABC"), ("start", "123")):
        for name in names:
            places = [(t.period, t.number) for t in planned if getattr(t, attribute) == name]
            assert {place: places.count(place) for place in places} == {
                (p, n): 4 for p in (1, 2) for n in (1, 2, 3)
            }
    pairs = {(t.hole, t.start) for t in planned}
    assert len(pairs) == 9  # orthogonal squares
    for who in {t.participant for t in planned}:
        mine = [t for t in planned if t.participant == who]
        assert sorted(t.hole for t in mine) == sorted("ABC" * 2) and {
            t.condition for t in mine
        } == {"guided", "unguided"}


@pytest.mark.parametrize("size", [2, 3, 4, 5, 6, 7])
def test_squares_are_latin(size: int) -> None:
    for square in design.make_latin_squares(size):
        for line in (*square, *square.T):
            assert sorted(line) == list(range(size))
    if size in (3, 5, 7):
        assert (
            len(
                set(
                    zip(
                        *(square.ravel() for square in design.make_latin_squares(size)), strict=True
                    )
                )
            )
            == size**2
        )


def test_orders_are_drawn_in_pairs_and_differ_from_seed_to_seed(machine: Machine) -> None:
    what = made(machine, count=20)
    drawn = [
        [
            c[0] == "guided"
            for c in design.draw_sequences(what, np.random.default_rng(seed)).values()
        ]
        for seed in range(3)
    ]
    for firsts in drawn:
        assert all(a != b for a, b in zip(firsts[::2], firsts[1::2], strict=True))
    assert drawn[0] != drawn[1] or drawn[1] != drawn[2]


def test_a_start_beyond_a_joints_end_is_refused(machine: Machine) -> None:
    what = replace(
        made(machine),
        starts={"1": (0.0, 0.0, 0.0, 0.0, 0.0), "2": (9.0, 0.0, 0.0, 0.0, 0.0), "3": (0.0,) * 5},
    )
    with pytest.raises(ConfigError, match=r"starts\.2: q1 = 9\.0"):
        what.check_machine(machine)
