"""A study that does not go as planned: everything is kept and said; the page, the tables, and who wants to be forgotten."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from composed import MACHINE
from sitting import inserted_after, make_design, plan, recorded

from brokk_rl import record
from brokk_rl.errors import ConfigError
from study import analysis, design, report, study_folder, tlx


def study(place: Path, count: int) -> list[design.Trial]:
    """Writes a whole study in which guided trials last 4 s and others 8 s, the second period 1 s less, and persons differ."""
    planned = plan(place, count, practice=2, trials=3)
    data = study_folder.read_study(place)
    for trial in planned:
        time_s = {"guided": 4.0, "unguided": 8.0}[trial.condition] - (trial.period == 2)
        time_s += 0.1 * int(trial.participant[1:])
        name = f"{study_folder.RECORDINGS}/{trial.name}.parquet"
        record.write_recording(recorded(inserted_after(round(20 * time_s))), place / name)
        facts = {"outcome": "inserted", "recording": name}
        study_folder.write_trial(place, trial.name, asdict(trial) | facts)
    for who, conditions in data.plan["participants"].items():
        for period, condition in enumerate(conditions, 1):
            ratings = dict.fromkeys(tlx.SCALES, 30 if condition == "guided" else 50)
            write_answers(place, who, period, ratings)
    return planned


def write_answers(place: Path, who: str, period: int, ratings: dict[str, int]) -> None:
    path = place / study_folder.QUESTIONNAIRES / f"{who}_{period}.json"
    entry = {"participant": who, "period": period, "ratings": ratings}
    study_folder.update_record(path, entry)


def analysed(place: Path) -> analysis.Analysis:
    return analysis.analyse(study_folder.read_study(place), MACHINE)


def said(found: analysis.Analysis) -> str:
    return "\n".join(f"{remark.where}: {remark.text}" for remark in found.data.remarks)


def change(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_a_whole_study_says_what_was_put_in(tmp_path: Path) -> None:
    study(tmp_path, count=12)
    found = analysed(tmp_path)
    effect = found.effects["time_s"]
    assert not said(found) and len(found.trials) == 12 * 8  # practice is there, too …
    assert found.trials.counts.sum() == 12 * 6  # … and does not count
    assert effect.difference == pytest.approx(-4.0, abs=0.06)
    assert effect.period == pytest.approx(-1.0, abs=0.06)
    assert effect.p == pytest.approx(2 / 64)
    assert found.effects["tlx_raw"].difference == pytest.approx(-20.0)
    assert found.holm["tlx_mental"] == pytest.approx(6 * 2 / 64)
    assert "time_s" not in found.holm  # the primary measure stands alone
    page = report.write_report(tmp_path / "out", found).read_text()
    assert "Guidance helps" in page and "imulated" not in page
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "report.html", "effects.csv", "trials.csv", "means.csv", "paths.png", "pairs.png",
    }  # fmt: skip
    means = pd.read_csv(tmp_path / "out" / "means.csv")
    assert means[means.condition == "guided"].tlx_raw.tolist() == [30.0] * 12
    effects = pd.read_csv(tmp_path / "out" / "effects.csv", index_col="measure")
    assert effects.p["time_s"] == effect.p and effects.p_holm["tlx_mental"] == pytest.approx(6 / 32)
    assert not effects.simulated.any()


def test_what_went_wrong_is_kept_and_said(tmp_path: Path) -> None:
    planned = study(tmp_path, count=6)
    trials = tmp_path / study_folder.TRIALS
    (trials / "P01_1_02.json").unlink()
    for path in [*trials.glob("P02_1_*"), *trials.glob("P02_2_*")]:  # stopped after practice
        path.unlink()
    told = {"participant": "P02", "stopped": True, "reason": "felt unwell"}
    study_folder.update_record(tmp_path / "participants/P02.json", told)
    first = json.loads((trials / "P03_1_01.json").read_text())
    study_folder.write_trial(tmp_path, "P03_1_01", {**first, "created": "2999-01-01"})
    study_folder.write_trial(tmp_path, "P99_1_01", {**first, "participant": "P99"})
    swapped = "unguided" if first["condition"] == "guided" else "guided"
    study_folder.write_trial(tmp_path, "P03_1_01", {**first, "condition": swapped})
    (trials / "P04_1_01.json").write_text("{broken")
    (tmp_path / study_folder.RECORDINGS / "P05_2_01.parquet").write_bytes(b"cut off")
    change(trials / "P05_1_01.json", outcome="aborted", reason="hose burst")
    change(trials / "P06_1_01.json", outcome="time limit")
    (tmp_path / study_folder.QUESTIONNAIRES / "P04_2.json").unlink()
    write_answers(tmp_path, "P05", 1, {"mental": 40})
    found = analysed(tmp_path)
    for claim in (
        "1 of 6 trials are missing (period.trial 1.2)", "stopped after 0 trials (felt unwell)", "done twice: the first counts",
        "P99, period 1, trial 1 is not in the plan", f"done {swapped}, but planned", "aborted (hose burst)",
        "P04_1_01.json cannot be read",
        "P05 2.1: its recording cannot be used", "P04: no questionnaire for period 2", "P05 period 1: questionnaire: physical not",
        "P02: has no trials", "written down as 'time limit', but the recording shows an insertion",
    ):  # fmt: skip
        assert claim in said(found), claim
    # Spare ones are still there; the unreadable and missing are not.
    assert len(found.trials) == len(planned) + 3 - 6 - 1 - 1
    assert ((found.trials.period > 0) & ~found.trials.counts).sum() == 4
    assert found.effects["time_s"].num_persons == 5 and found.effects["tlx_raw"].num_persons == 4
    assert found.means[found.means.participant == "P02"].time_s.isna().all()
    assert (trials / "P03_1_01_again3.json").exists()
    page = report.write_report(tmp_path / "out", found).read_text()
    assert "hose burst" in page and "felt unwell" in page


def test_a_study_without_trials_is_reported_as_that(tmp_path: Path) -> None:
    plan(tmp_path)
    found = analysed(tmp_path)
    assert "Nothing can be said" in report.write_report(tmp_path / "out", found).read_text()
    assert math.isnan(found.means.time_s.iloc[0])


def test_a_participant_is_forgotten_on_request(tmp_path: Path) -> None:
    study(tmp_path, count=4)
    told = {"participant": "P02", "hand": "left"}
    study_folder.update_record(tmp_path / "participants/P02.json", told)
    (tmp_path / study_folder.TRIALS / "P02_1_01.json").rename(tmp_path / "trials" / "copy.json")
    assert len(study_folder.erase(tmp_path, "P02")) == 8 + 8 + 2 + 1
    assert not list(tmp_path.rglob("P02*"))
    found = analysed(tmp_path)
    assert set(found.means.participant) == {"P01", "P03", "P04"}
    assert "P02: erased on request" in said(found)
    for name in ("Jane", "P02"):
        with pytest.raises(ConfigError, match="no participant of the plan"):
            study_folder.erase(tmp_path, name)


def test_every_hole_and_start_stands_everywhere_equally_often() -> None:
    made = make_design(count=12, practice=2, trials=3)
    planned = pd.DataFrame(map(asdict, design.plan_trials(made, np.random.default_rng(1))))
    counted = planned[planned.period > 0]
    for name in ("hole", "start"):
        assert set(counted.groupby([name, "period", "number"]).size()) == {4}
    assert len(counted.groupby(["hole", "start"])) == 9  # orthogonal squares
    for _, mine in counted.groupby("participant"):
        assert sorted(mine.hole) == sorted("ABC" * 2)
        assert set(mine.condition) == {"guided", "unguided"}


def test_orders_are_drawn_in_pairs_and_differ_from_seed_to_seed() -> None:
    drawn = set()
    for seed in range(3):
        sequences = design.draw_sequences(20, np.random.default_rng(seed)).values()
        first = [conditions[0] for conditions in sequences]
        assert all(a != b for a, b in zip(first[::2], first[1::2], strict=True))
        drawn.add(tuple(first))
    assert len(drawn) > 1


def test_a_start_beyond_a_joints_end_is_refused() -> None:
    made = replace(make_design(), starts={"1": (0.0,) * 5, "2": (9.0, 0.0, 0.0, 0.0, 0.0)})
    with pytest.raises(ConfigError, match=r"starts\.2: expected 5 positions .* got \(9\.0"):
        made.check_machine(MACHINE)
