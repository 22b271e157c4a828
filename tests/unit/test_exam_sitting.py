"""Interruption and scoring of an exam, and the examiner's simulation."""

from __future__ import annotations

import json
import os
import stat
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from composed import option
from small_exam import SMALL

from brokk_rl.build import describe_spec
from brokk_rl.errors import RecordingError
from brokk_rl.extensions import load_mode
from brokk_rl.machine import Machine
from brokk_rl.progress import ItemProgress
from diagnosis.answer import Answer, Estimate, Gap, Where
from exam import dataset, examiner, run_cases
from exam.examiner import ExaminerSimulator, compute_closed, read_effects
from exam.generate import UNCHANGED_FOLDER, restrict_machine
from exam.ledger import BEGUN, read_ledger


def test_a_sealed_exam_knows_its_engine_before_its_labels_are_opened(
    brokk: Callable[..., Any], tmp_path: Path
) -> None:
    exam, answers = tmp_path / "exam", tmp_path / "answers"
    sealed = ("exam_protocol=sealed", "exam.mix.num_cases=2", "session.seed=1234")
    made = brokk(*SMALL, *sealed, f"session.out={exam}")
    assert made.code == 0, made.err
    facts = json.loads((exam / "exam.json").read_text())
    assert facts["sealed"] and facts["num_cases"] == 2
    withheld = sorted((exam / dataset.WITHHELD_FOLDER).rglob("*.parquet"))
    assert {path.parent.name for path in withheld} == {"0000", "0001", UNCHANGED_FOLDER}
    about = ("mode=exam", f"exam.folder={exam}", "exam_candidate=always_none")
    done = brokk(*about, "exam.do=run", f"session.out={answers}")
    assert done.code == 0, done.err
    (begun,) = read_ledger(exam)
    assert begun["event"] == BEGUN and begun["run"]["labels_sha256"] == facts["labels_sha256"]
    score = (*about, "exam.do=score", f"+exam.answers.none={answers}")
    for count in range(2):
        out = tmp_path / f"marks_{count}"
        assert brokk(*score, f"session.out={out}").code == 0
        (said,) = json.loads((out / "marks.json").read_text())["exam"]["ledger"]
        assert "registered before" in said and f"opened {count} times" in said
    run = json.loads((answers / "run.json").read_text())
    (answers / "run.json").write_text(json.dumps(run | {"labels_sha256": "other"}))
    refused = brokk(*score, f"session.out={tmp_path / 'refused'}")
    assert refused.code == 2 and "got answers to others" in refused.err


def test_a_make_that_was_interrupted_goes_on_and_gives_the_same_cases(
    brokk: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    whole, part = tmp_path / "whole", tmp_path / "part"
    assert brokk(*SMALL, f"session.out={whole}").code == 0
    monkeypatch.setattr(dataset, "BLOCK_CASES", 1)
    write = dataset.CaseSet.write

    def fail_on_second(self: Any, numbers: list[int]) -> Any:
        if numbers == [1]:
            raise RecordingError("interrupted")
        return write(self, numbers)

    fail_on_second.__name__ = "write"  # another process finds a method by its name
    with monkeypatch.context() as patch:
        patch.setattr(dataset.CaseSet, "write", fail_on_second)
        assert brokk(*SMALL, f"session.out={part}").code != 0
    partial = part / dataset.PARTIAL_FILE
    assert stat.S_IMODE(os.stat(partial).st_mode) == 0o600
    assert [json.loads(line).get("case") for line in partial.read_text().splitlines()][1:] == [
        "0000"
    ]
    assert not (part / dataset.LABELS_FILE).exists()
    again = brokk(*SMALL, f"session.out={part}", f"resume={part}")
    assert again.code == 0, again.err
    labels = [
        json.loads((folder / dataset.LABELS_FILE).read_text())["cases"] for folder in (whole, part)
    ]
    assert labels[0] == labels[1] and not partial.exists()
    for path in sorted((whole / "cases").rglob("*.parquet")):
        assert path.read_bytes() == (part / path.relative_to(whole)).read_bytes()


@pytest.mark.slow
def test_an_exam_of_arms_known_by_their_joints_asks_nothing_that_needs_masses(
    brokk: Callable[..., Any], machine: Machine, tmp_path: Path
) -> None:
    exam = tmp_path / "exam"
    many = (
        "exam.mix.num_cases=4",
        "exam.mix.shares={none: 0, faint: 0, one: 1, several: 0, outside: 0}",
    )
    done = brokk(*SMALL, *many, "exam.known=joints", f"session.out={exam}")
    assert done.code == 0, done.err
    known = restrict_machine(machine, "joints")
    assert not known.has_bodies and known.name == "brokk170_joints"
    labels, _ = dataset.open_labels(exam)
    named = {one["effect"] for label in labels["cases"] for one in label["effects"]}
    assert labels["known"] == "joints" and not any(label["tracked"] for label in labels["cases"])
    assert named and not named & {"encoder_bias", "encoder_scale", "link_length", "base_tilt"}
    # the files are those of the machine that a candidate knows
    ExaminerSimulator(exam, "0000", option("fit", "valve"), known)
    with pytest.raises(RecordingError):
        ExaminerSimulator(exam, "0000", option("fit", "valve"), machine)
    # a program gets the machine as an option file
    text = json.dumps(describe_spec(known))
    assert '"_target_": "brokk_rl.machine.Machine"' in text and '"body": null' in text


@pytest.fixture(scope="module")
def slow_case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exam of one case: all joints at 0.6 of their speed, withheld recordings of 30 s."""
    out = tmp_path_factory.mktemp("examined") / "exam"
    gain = (
        "{flow_gain: {_target_: exam.case_distribution.EffectDistribution, numbers: {gain: [1.0, 0.6]}, "
        "joints: all, needs_tool: false, only_one: false, mirrored: false, not_on: [], shape: {}}}"
    )
    words = [
        "mode=exam", "exam.mix.num_cases=1", "exam.mix.shares={none: 0, faint: 0, one: 1, several: 0, outside: 0}",
        "exam.mix.sizes=[1.0,1.0]", "~exam.mix.troubles", f"+exam.mix.troubles={gain}",
        "exam.reference.programs=[[levels],[levels]]",
        "exam.reference.file_s=40", "exam.field.programs=[[levels]]", "exam.field.file_s=8", "exam.withheld.programs=[[levels]]",
        "exam.withheld.file_s=30", f"session.out={out}",
    ]  # fmt: skip
    mode = load_mode(*words)
    out.mkdir()
    mode.run()
    return out


def say(closed: float | None) -> Answer:
    """An answer that states how far it closes the gap."""
    estimate = None if closed is None else Estimate(closed, (closed - 0.02, closed + 0.02))
    return Answer(
        verdict="effects",
        selected=(),
        ranking=(),
        where=Where({}, (), None),
        gap=Gap(0.03, 0.01, 0.008, estimate),
        next_experiment=None,
    )


def test_the_examiner_believes_its_own_simulation(
    slow_case: Path, machine: Machine, tmp_path: Path
) -> None:
    simulator = ExaminerSimulator(slow_case, "0000", option("fit", "valve"), machine)
    path = tmp_path / "effects.yaml"

    def write(gain: float) -> dict[str, Any]:
        path.write_text(
            "# @package effect\nflow_gain:\n  _target_: actuators.effects.speed.FlowGain\n"
            f"  joints: all\n  gain: {gain}\n"
        )
        return read_effects(path, machine)

    nothing = simulator.examine({}, None)
    right, half, wrong = (simulator.examine(write(gain), say(0.95)) for gain in (0.6, 0.8, 1.4))
    assert nothing.after == nothing.before and nothing.closed == 0.0
    # an effect that changes nothing runs as none does, warm-up included
    assert simulator.examine(write(1.0), None).after == pytest.approx(nothing.before, rel=1e-4)
    assert nothing.before > 1.5 * nothing.floor, "a joint at 0.6 of its speed is seen"
    assert right.closed is not None and right.closed > 0.8 and not right.differs
    assert half.closed is not None and 0.2 < half.closed < 0.8 and half.differs
    assert wrong.closed is not None and wrong.closed < 0.0 and wrong.differs
    assert not simulator.examine(write(0.8), say(None)).differs


def test_an_effects_file_brings_no_targets_of_its_own(machine: Machine, tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    for text in (
        "lag: {_target_: os.system, command: ls}\n",
        "made_up: {_target_: actuators.effects.speed.Lag, joints: all, time_constant_s: 0.1}\n",
        "lag: {_target_: actuators.effects.speed.Lag, joints: all}\n",
        "[1, 2]\n",
    ):
        path.write_text(text)
        with pytest.raises(RecordingError, match="no effects of the library"):
            read_effects(path, machine)
    path.write_text("# @package effect\n# none: no gap\n")
    assert read_effects(path, machine) == {}


def test_the_closed_share_is_that_worked_by_hand() -> None:
    before, after, floor = np.array([3.0, 3.0, 5.0]), np.array([2.0, 1.0, 2.0]), np.ones(3)
    share, interval = compute_closed(before, after, floor)
    assert share == pytest.approx(0.5)  # (3 - 2) / (3 - 1)
    assert interval == pytest.approx((0.75 + 0.025 * 0.25, 1.0 - 0.025 * 0.25))  # of 1 and 0.75
    assert compute_closed(1.04 * floor, floor, floor) == (None, None)
    assert examiner.MAX_DIFFERENCE == 0.2


def test_an_interrupted_program_leaves_no_note_and_sits_again(
    machine: Machine, tmp_path: Path
) -> None:
    case, answers = tmp_path / "case", tmp_path / "answers"
    case.mkdir()
    (case / "a").touch()
    # A job in the background of a shell inherits an ignored SIGINT, so the program restores it first.
    program = "from signal import *; signal(SIGINT, SIG_DFL); raise_signal(SIGINT)"
    command = run_cases.CommandCandidate(
        command=(sys.executable, "-c", program, "{case}", "{out}"), limit_s=10.0, threads=1
    )
    with pytest.raises(KeyboardInterrupt):
        run_cases.answer_cases(command, [case], answers, machine, 1, ItemProgress("", 1))
    assert not run_cases.is_begun(answers / "case")
    failing = replace(command, command=("sh", "-c", "exit 3 #{case}{out}"))
    run_cases.answer_cases(failing, [case], answers, machine, 1, ItemProgress("", 1))
    assert run_cases.is_begun(answers / "case")
