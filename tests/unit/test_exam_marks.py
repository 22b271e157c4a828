"""Marks of answers against labels, by tables worked by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from composed import option

from brokk_rl.errors import RecordingError
from diagnosis.answer import Answer, Estimate, Gap, Ranked, Selected
from exam import metrics, score
from exam.dataset import open_labels
from exam.metrics import build_table
from exam.run_cases import GivenAnswer, publish_answers, read_answers
from exam.score import CaseScore, Claim, score_answer


def label(
    kind: str, *effects: tuple[str, str, float], outside: str | None = None
) -> dict[str, Any]:
    told = []
    for name, joint, value in effects:
        numbers = {"parameters": {"number": {joint: value}}, "nothing": {"number": 0.0}}
        told.append({"effect": name, "joints": [joint], "size": 0.5, **numbers})
    strange = None if outside is None else {"ailment": outside, "joints": ["q1"], "size": 0.7}
    return {"case": "0000", "kind": kind, "effects": told, "outside": strange}


def chosen(
    effect: str,
    joint: str = "q3",
    probability: float = 0.9,
    said: float = 1.0,
    same_as: tuple[str, ...] = (),
) -> Selected:
    number = {"number": {joint: Estimate(said, (said - 0.196, said + 0.196))}}
    named: dict[str, Any] = {"effect": effect, "joints": (joint,), "probability": probability}
    return Selected(**named, parameters=number, gap_closed=None, same_as=same_as)


def answered(
    *selected: Selected, verdict: str | None = None, unknown: float | None = None
) -> Answer:
    ranking = [Ranked(one.effect, one.joints, one.probability) for one in selected]
    if unknown is not None:
        ranking.append(Ranked("unknown", (), unknown))
    return Answer(
        verdict=verdict or ("effects" if selected else "none"),  # pyright: ignore[reportArgumentType]
        selected=selected,
        ranking=tuple(ranking),
        gap=Gap(0.03, 0.01, 0.008, Estimate(0.9, (0.8, 0.95))),
    )


def marked(truth: dict[str, Any], said: Answer | None) -> CaseScore:
    return score_answer(truth, said, option("exam_mix", "main"))


def test_an_equivalent_is_right_beside_the_strict_figure_only() -> None:
    truth = label("one", ("dead_time", "q3", 1.0))
    for said in (chosen("clock_offset"), chosen("lag", same_as=("dead_time",))):
        found = marked(truth, answered(said))
        assert (found.first, found.exact) == (False, False)
        assert (found.first_equivalent, found.exact_equivalent) == (True, True)
        assert found.joints_right == (True,) and found.numbers == ()
    assert not marked(truth, answered(chosen("lag"))).first_equivalent


def test_the_most_probable_name_is_the_first_whatever_the_order() -> None:
    said = answered(chosen("lag", probability=0.6), chosen("backlash", probability=0.8))
    assert marked(label("one", ("backlash", "q3", 1.0)), said).first
    assert not marked(label("one", ("lag", "q3", 1.0)), said).first


def test_one_name_stands_for_one_effect_only() -> None:
    truth = label("several", ("dead_time", "q3", 1.0), ("lag", "q3", 1.0))
    found = marked(truth, answered(chosen("dead_time", same_as=("lag",))))
    assert found.stands_for == ("dead_time",) and not found.exact_equivalent


def test_intervals_and_errors_of_parameters_are_relative_to_the_size_of_the_effect() -> None:
    said = answered(chosen("lag", said=1.0))
    # the 95 % interval is 0.804 to 1.196, the 90 % interval begins at 1 - 0.196 * 0.839 = 0.8355
    for true, error, inside in ((0.82, 0.2195, False), (0.84, 0.1905, True)):
        (number,) = marked(label("one", ("lag", "q3", true)), said).numbers
        assert number.error == pytest.approx(error, abs=1e-4)
        assert number.in_90 is inside


def test_below_the_noise_none_and_the_true_name_are_right_and_another_is_an_alarm() -> None:
    truth, found = label("faint", ("lag", "q3", 1.0)), []
    for said, claim, alarm in (
        (answered(), Claim(1.0, True), False),
        (answered(chosen("lag")), Claim(0.9, True), False),
        (answered(chosen("creep")), Claim(0.9, False), True),
    ):
        found.append(marked(truth, said))
        assert found[-1].claims == (claim,) and found[-1].alarm == alarm
    table = metrics.compute_metrics([*found, marked(label("none"), answered())])
    assert table["false_alarms_faint"]["value"] == pytest.approx(1 / 3)
    assert table["false_alarms_none"]["value"] == 0.0


def test_a_missing_answer_is_wrong_everywhere() -> None:
    found = marked(label("one", ("lag", "q3", 1.0)), None)
    assert (found.verdict, found.first, found.claims) == ("failed", False, ())


def table() -> list[CaseScore]:
    """Eight cases: 2 of 3 single effects right, 1 of 2 sets, 1 of 2 quiet ones, the one outside."""
    two = label("several", ("lag", "q3", 1.0), ("creep", "q2", 1.0))
    given = [
        (label("one", ("lag", "q3", 1.0)), answered(chosen("lag"))),
        (label("one", ("lag", "q1", 1.0)), answered(chosen("lag", "q3", 0.7))),  # wrong joint
        (label("one", ("creep", "q3", 1.0)), answered(chosen("backlash", probability=0.6))),
        (two, answered(chosen("lag"), chosen("creep", "q2"))),
        (two, answered(chosen("lag"), chosen("backlash"))),
        (label("none"), answered()),
        (label("none"), answered(chosen("lag", probability=0.5))),
        (label("outside", outside="fading"), answered(verdict="unknown", unknown=0.8)),
    ]
    return [marked(truth, said) for truth, said in given]


def test_the_figures_of_a_table_are_those_worked_by_hand() -> None:
    found = metrics.compute_metrics(table())
    assert found["top1"]["value"] == pytest.approx(2 / 3) and found["top1"]["of"] == 3
    # effects rightly named: lag q3, lag q1 (wrong joint), lag q3 + creep q2, lag q3
    assert found["joints"]["value"] == pytest.approx(4 / 5)
    assert found["exact_set"]["value"] == 0.5
    assert found["false_alarms_none"]["value"] == 0.5 and found["false_alarms_none"]["of"] == 2
    assert found["unknown_recall"]["value"] == 1.0 and table()[-1].claims == (Claim(0.8, True),)
    assert found["said"] == {
        "lag": {"lag": 2}, "creep": {"backlash": 1}, "fading": {"unknown": 1},
        "lag+creep": {"lag+creep": 1, "lag+backlash": 1}, "none": {"none": 1, "lag": 1},
    }  # fmt: skip
    # said with 0.9 or more: lag, lag and creep, lag (backlash is not there), none
    assert (found["sure"]["value"], found["sure"]["of"]) == (pytest.approx(5 / 6), 6)


def test_intervals_hold_their_figure_and_shrink_with_the_number_of_cases() -> None:
    few, many = metrics.compute_metrics(table()), metrics.compute_metrics(table() * 10)
    low, high = few["exact_set"]["ci95"]
    assert low <= few["exact_set"]["value"] <= high
    assert many["exact_set"]["ci95"][1] - many["exact_set"]["ci95"][0] < high - low
    assert math.isclose(few["top1"]["ci95"][0], 0.2077, abs_tol=1e-3)  # Wilson, 2 of 3
    values = [0.1, 0.2, 0.3, 0.4, 0.9]
    median = metrics.compute_median(values)
    assert (median["value"], median["of"]) == (0.3, 5)
    assert 0.1 <= median["ci95"][0] < 0.3 < median["ci95"][1] <= 0.9
    assert metrics.compute_median(values[:1])["ci95"] == [0.1, 0.1]


def test_a_number_that_all_joints_share_counts_once() -> None:
    joints = ("q1", "q2", "q3")
    truth = {
        "parameters": {"probability": dict.fromkeys(joints, 0.1)},
        "nothing": {"probability": 0.0},
    }
    shared = dict.fromkeys(joints, Estimate(0.11, (0.09, 0.13)))
    own = {joint: Estimate(0.11 + 0.001 * n, (0.09, 0.13)) for n, joint in enumerate(joints)}
    for said, count in ((shared, 1), (own, 3)):
        one = replace(chosen("frame_loss"), joints=joints, parameters={"probability": said})
        assert len(score.score_parameters(truth, one)) == count


RESULTS = Path(__file__).parents[2] / "benchmarks/results"


@pytest.mark.parametrize(
    "name", [path.name for path in sorted(RESULTS.glob("exam_*")) if path.is_dir()]
)
def test_published_answers_have_the_published_score(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics, "NUM_DRAWS", 2)  # Wilson's intervals are compared, these are not
    labels, _ = open_labels(RESULTS / name)
    given = read_answers(RESULTS / name / "answers_diagnosis.jsonl")
    mix = option("exam_mix", {"exam_valves": "main"}.get(name, name.removeprefix("exam_")))
    found = build_table(labels["cases"], given, mix)
    result = json.loads((RESULTS / f"{name}.json").read_text())
    published = {row[""]: row for row in result["rows"]}
    rates = "top1 top1_equivalent exact_set joints false_alarms_none unknown_recall cover_90"
    for key in rates.split():
        row, (low, high) = published[metrics.METRICS[key].title], found[key]["ci95"]
        assert (round(found[key]["value"], 2), found[key]["of"]) == (row["reached"], row["of"])
        assert f"{low:.2f} to {high:.2f}" == row["95 %"]


def test_a_published_answer_says_what_it_leaves_out(tmp_path: Path) -> None:
    said = answered(chosen("lag")).to_json() | {"curves": [1.0]}
    path = tmp_path / "answers.jsonl"
    ended = GivenAnswer({"seconds": 1.0, "error": "in /home/me/run.py\nKeyError: 'x'"}, None)
    sealed = GivenAnswer({"seconds": 1.0, "error": None}, said, None, "f00d", {"closed": 0.5})
    answers = {"0001": sealed, "0002": ended}
    publish_answers(answers, path)
    row, second = map(json.loads, path.read_text().splitlines())
    assert second["note"]["error"] == "KeyError: 'x'"
    assert "curves" in row["left_out"] and "curves" not in row["answer"]
    assert {*row["left_out"], *row["answer"]} == {*said}
    assert (row["labels_sha256"], row["examined"]) == ("f00d", {"closed": 0.5})
    again = tmp_path / "again.jsonl"
    publish_answers(read_answers(path), again)
    assert again.read_text() == path.read_text()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{}\n", "a line a case of a published file"),
        ("not json\n", "a line a case of a published file"),
        ('{"case": "0000", "note": {}, "answer": {"schema": 9}}\n', "case 0000: schema 9"),
        ('{"case": "0000", "note": {}, "answer": {"schema": 1}}\n', "case 0000: no diagnosis"),
    ],
)
def test_a_file_that_holds_no_answers_is_refused(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "answers.jsonl"
    path.write_text(text)
    truth = [label("one", ("lag", "q3", 1.0))]
    with pytest.raises(RecordingError, match=told):
        build_table(truth, read_answers(path), option("exam_mix", "main"))
