"""Cases and answers of a diagnosis are read and written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from brokk_rl.errors import RecordingError
from brokk_rl.machine import Machine
from diagnosis import answer, case, effect_library, effects_file
from diagnosis.answer import Answer, Estimate, Gap, Ranked, Selected
from diagnosis.gap import describe_joints


def test_a_case_without_its_half_is_refused(tmp_path: Path, machine: Machine) -> None:
    with pytest.raises(RecordingError, match="no such folder"):
        case.load_case(tmp_path / "nowhere", machine)
    (tmp_path / "field").mkdir()
    with pytest.raises(RecordingError, match=r"no reference/.*diagnosis.field"):
        case.load_case(tmp_path, machine)


def said() -> Answer:
    """An answer with everything in it."""
    selected = Selected(
        effect="backlash", joints=("q3",), probability=0.97,
        parameters={"gap_rad": {"q3": Estimate(0.031, (0.028, 0.034))}}, gap_closed=Estimate(0.91, (0.86, 0.95)),
        same_as=("lag",), decided_by="a dial gauge",
    )  # fmt: skip
    return Answer(
        verdict="effects", selected=(selected,), ranking=(Ranked("backlash", ("q3",), 0.97),),
        gap=Gap(0.03, 0.004, 0.002, Estimate(0.93, (0.88, 0.96))),
        reason="play", more={"sanity": [{"a": 1}]},
    )  # fmt: skip


def test_an_answer_is_written_in_the_fixed_format_and_read_again(tmp_path: Path) -> None:
    path = tmp_path / "diagnosis.json"
    said().write(path)
    found = json.loads(path.read_text())
    assert found["schema"] == 1 and found["sanity"] == [{"a": 1}]
    assert found["selected"][0]["parameters"]["gap_rad"]["q3"] == {
        "mean": 0.031,
        "ci95": [0.028, 0.034],
    }
    assert found["gap"]["before"] == {"rmse_rad": 0.03}
    assert answer.read_answer(path) == said()
    path.write_text(json.dumps(found | {"schema": 2}))
    with pytest.raises(RecordingError, match="schema 2"):
        answer.read_answer(path)


def test_training_takes_the_found_effects_as_they_are(
    tmp_path: Path, machine: Machine, brokk: Callable[..., Any]
) -> None:
    path = tmp_path / effects_file.EFFECTS_FILE
    effects_file.write_effects(said(), effect_library.load_effects(machine), path)
    done = brokk("mode=train", f"effect=@{path}", "--cfg", "job")
    text = done.out[done.out.index("backlash:") :]
    assert "q3: 0.031" in text and "other: 0.0" in text


def test_parts_of_the_gap_are_those_of_the_squares_beyond_the_floor(machine: Machine) -> None:
    percent = 0.01 * (machine.upper - machine.lower)
    before, floor = percent * [0.0, 5.0, 2.0, 3.0, 0.0], percent * [0.0, 3.0, 2.0, 4.0, 0.0]
    plain = describe_joints(machine, before, before, 0.0 * floor)
    parts = [one.part for one in plain.values()]
    assert parts == pytest.approx([0.0, 25 / 38, 4 / 38, 9 / 38, 0.0])
    found = describe_joints(machine, before, before, floor)
    assert [one.part for one in found.values()] == pytest.approx([0.0, 1.0, 0.0, 0.0, 0.0])
    below = describe_joints(machine, before, before, 9.0 * before)
    assert [one.part for one in below.values()] == pytest.approx(parts)
