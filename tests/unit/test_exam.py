"""The exam as a person runs it: cases that tell nothing, sealed labels, sittings that can be resumed, a table and a ledger."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from composed import MACHINE, option
from conftest import Brokk
from small_exam import SMALL

from brokk_rl import record
from brokk_rl.errors import RecordingError, StorageError
from brokk_rl.extensions import load_mode
from brokk_rl.machine import Machine
from diagnosis.answer import ANSWER_FILE
from exam import dataset, generate, run_cases
from exam.case_distribution import CaseDesign, CaseDistribution
from exam.dataset import BEGUN, read_ledger
from exam.generate import CASES_FOLDER, UNCHANGED_FOLDER, WITHHELD_FOLDER, CaseRecorder
from exam.plants.valve_faults import CAUSES
from exam.run_cases import ConstantAnswer

SEALED = ("exam_protocol=sealed", "exam.mix.num_cases=2", "session.seed=1234")


def questions(mix: CaseDistribution, machine: Machine, seed: int) -> list[CaseDesign]:
    return mix.questions(machine, option("exam_plants", "valves"), np.random.default_rng(seed))


def test_cases_have_the_shares_effects_and_sizes_of_their_kinds() -> None:
    mix = option("exam_mix", "main")
    found = questions(mix, MACHINE, 3)
    counts = {"none": 15, "faint": 10, "one": 35, "several": 20, "outside": 20}
    assert Counter(one.kind for one in found) == counts
    single = Counter(one.faults[0].effect for one in found if one.kind == "one")
    assert set(single.values()) <= {1, 2, 3} and len(single) >= 20
    strange = Counter(one.faults[0].effect for one in found if one.kind == "outside")
    assert strange == dict.fromkeys(CAUSES, 2)
    for one in found:
        names = {fault.effect for fault in one.faults}
        allowed = {"none": {0}, "several": {2, 3}}.get(one.kind, {1})
        assert len(one.faults) == len(names) and len(names) in allowed
        assert not any(len(names & set(group)) > 1 for group in mix.classes)
        low, high = mix.faint_sizes if one.kind == "faint" else mix.sizes
        for fault in one.faults:
            assert low <= fault.size <= high
            has = np.isin(MACHINE.joint_names, fault.joints)
            if one.kind == "outside":
                assert fault.parameters["severity"].tolist() == (fault.size * has).tolist()
                continue
            assert one.tracked or not mix.troubles[fault.effect].needs_tool
            for name, nothing in fault.drawn.items():
                away = abs(mix.troubles[fault.effect].numbers[name][1] - nothing)
                values = np.abs(fault.parameters[name][has] - nothing)
                np.testing.assert_allclose(values, fault.size * away)
    again, other = questions(mix, MACHINE, 3), questions(mix, MACHINE, 4)
    assert repr(again) == repr(found) != repr(other)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sealed exam of two cases."""
    out = tmp_path_factory.mktemp("made") / "exam"
    mode = load_mode(*SMALL, *SEALED, f"session.out={out}")
    out.mkdir()
    mode.run()
    return out


@pytest.fixture
def exam(made: Path, tmp_path: Path) -> Path:
    """The exam in a folder of its own, whose ledger nobody has written into."""
    return Path(shutil.copytree(made, tmp_path / "exam"))


def test_a_made_exam_is_sealed_and_its_cases_tell_nothing(exam: Path) -> None:
    labels = exam / dataset.LABELS_FILE
    assert labels.stat().st_mode & 0o777 == 0o600
    sealed = hashlib.sha256(labels.read_bytes()).hexdigest()
    assert (exam / dataset.HASH_FILE).read_text().split()[0] == sealed
    files = sorted((exam / CASES_FOLDER).rglob("*.parquet"))
    times = {file.stat().st_mtime for file in files}
    assert (len(files), len(times)) == (2 * 3, 1)
    for file in files:
        assert set(pq.read_schema(file).metadata) == {
            b"brokk.schema", b"brokk.machine", b"brokk.rate_hz", b"brokk.created", b"brokk.fingerprint"
        }  # fmt: skip
        found = record.read_recording(file, MACHINE)
        moving = np.abs(found.u) > 0
        exclusive = MACHINE.is_exclusive
        assert not (moving[:, exclusive].any(1) & moving[:, ~exclusive].any(1)).any()
        assert (found.q >= MACHINE.lower - 0.05).all() and (found.q <= MACHINE.upper + 0.05).all()
    told = json.loads(labels.read_text())["cases"]
    (name,) = [case["effects"][0]["effect"] for case in told if case["effects"]]
    assert not any(name.encode() in file.read_bytes() for file in files)


def test_labels_that_were_changed_are_not_scored(tmp_path: Path) -> None:
    dataset.seal_labels(tmp_path, {"cases": [{"kind": "one"}]}, "salt")
    assert dataset.open_labels(tmp_path)[0]["cases"] == [{"kind": "one"}]
    path = tmp_path / dataset.LABELS_FILE
    path.write_text(path.read_text().replace('"one"', '"none"'))
    with pytest.raises(RecordingError, match="was changed after it was sealed"):
        dataset.open_labels(tmp_path)
    with pytest.raises(StorageError, match="is sealed"):
        dataset.seal_labels(tmp_path, {"cases": []}, "salt")


def test_an_exam_is_sat_and_scored_and_its_ledger_knows_the_engine_before_the_labels(
    exam: Path, brokk: Brokk, tmp_path: Path
) -> None:
    answers = tmp_path / "answers"
    about = ("mode=exam", f"exam.folder={exam}", "exam_candidate=always_none")
    run = (*about, "exam.do=run", f"session.out={answers}")
    brokk(*run)
    brokk(*run, f"resume={answers}")
    brokk(*run, code=2)
    other = brokk(*run, f"resume={answers}", "exam_candidate=most_frequent", code=2)
    assert "answers of two candidates" in other.err
    (begun,) = read_ledger(exam)
    facts = json.loads((exam / "exam.json").read_text())
    assert begun["event"] == BEGUN and begun["run"]["labels_sha256"] == facts["labels_sha256"]
    score = (*about, "exam.do=score", f"+exam.answers.none={answers}")
    for count in range(2):
        marks = tmp_path / f"marks_{count}"
        brokk(*score, f"session.out={marks}")
        found = json.loads((marks / "marks.json").read_text())
        (said,) = found["exam"]["ledger"]
        assert "registered before" in said and f"opened {count} times" in said
    table = found["candidates"]["none"]
    assert table["false_alarms_none"]["value"] == table["top1"]["value"] == table["failed"] == 0
    assert "machine brokk170 (sensing)" in (marks / "exam.html").read_text()
    # labels and answers are published beside the score
    assert (marks / "labels.json").read_bytes() == (exam / dataset.LABELS_FILE).read_bytes()
    said = [json.loads(text) for text in (marks / "answers_none.jsonl").read_text().splitlines()]
    assert [one["answer"]["verdict"] for one in said] == ["none", "none"]
    # whoever says "none" repairs nothing, by the examiner's own simulation
    (examined,) = [one["examined"] for one in said if "examined" in one]
    assert examined["before"] == examined["after"]
    assert {one["labels_sha256"] for one in said} == {facts["labels_sha256"]}
    noted = json.loads((answers / "run.json").read_text())
    (answers / "run.json").write_text(json.dumps(noted | {"labels_sha256": "other"}))
    refused = brokk(*score, f"session.out={tmp_path / 'refused'}", code=2)
    assert "got answers to others" in refused.err


def test_a_make_that_was_interrupted_goes_on_and_gives_the_cases_of_its_salt(
    made: Path, brokk: Brokk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    part, (labels, text) = tmp_path / "part", dataset.open_labels(made)
    again = (*SMALL, *SEALED, f"session.out={part}")
    monkeypatch.setattr(generate, "BLOCK_CASES", 1)
    write = CaseRecorder.write

    def fail_on_second(self: Any, questions: dict[int, CaseDesign]) -> None:
        if 1 in questions:
            raise RecordingError("interrupted")
        write(self, questions)

    with monkeypatch.context() as patch:
        patch.setattr(CaseRecorder, "write", fail_on_second)
        brokk(*again, f"exam.salt={labels['salt']}", code=2)
    assert [path.name for path in (part / CASES_FOLDER).iterdir()] == ["0000"]
    sealed = part / dataset.LABELS_FILE
    assert sealed.read_text() == text and sealed.stat().st_mode & 0o777 == 0o600
    # nobody answers half of an exam, and its labels stay closed
    answers = (f"exam.folder={part}", "exam_candidate=always_none", f"session.out={tmp_path / 'x'}")
    for step in (("exam.do=run",), ("exam.do=score", f"+exam.answers.a={part}")):
        refused = brokk("mode=exam", *step, *answers, code=2)
        assert "exam.do=make resume=" in refused.err
    first = part / CASES_FOLDER / "0000/field/01.parquet"
    first.unlink()  # a file that is lost is made again, a label that was never sealed is not
    brokk(*again, f"resume={part}", "session.seed=1235", code=2)
    brokk(*again, f"resume={part}")
    assert dataset.open_labels(part)[1] == text
    withheld = {path.parent.name for path in (made / WITHHELD_FOLDER).rglob("*.parquet")}
    assert withheld == {"0000", "0001", UNCHANGED_FOLDER}
    for path in sorted(made.rglob("*.parquet")):
        assert path.read_bytes() == (part / path.relative_to(made)).read_bytes()


def sit(candidate: run_cases.Candidate, cases: list[Path], answers: Path) -> int:
    """Returns how many cases have no answer."""
    return run_cases.answer_cases(candidate, cases, answers, MACHINE, 1)


def test_cases_that_nobody_began_are_left_out_and_those_that_broke_are_not(
    exam: Path, brokk: Brokk, tmp_path: Path, caplog: Any
) -> None:
    first, second = sorted((exam / CASES_FOLDER).iterdir())
    answers = tmp_path / "answers"
    answers.mkdir()
    assert sit(Recorder(ValueError("ran away")), [first], answers) == 1
    assert sit(ConstantAnswer(effect=None, probability=0.5), [second], answers) == 0
    score = ("mode=exam", "exam.do=score", f"exam.folder={exam}", f"+exam.answers.it={answers}")
    for sat, missed in ((2, 1), (1, 0)):
        marks = tmp_path / f"marks_{missed}"
        brokk(*score, f"session.out={marks}")
        found = json.loads((marks / "marks.json").read_text())["candidates"]["it"]
        assert found["sat"] == {"value": sat, "of": 2} and found["failed"] == missed
        assert ("1 of 2 cases were not begun" in caplog.text) is (missed == 0)
        shutil.rmtree(answers / first.name, ignore_errors=True)  # from then on nobody has begun it


def test_cases_of_an_exam_hang_on_the_salt_and_those_of_development_on_the_seed_alone(
    tmp_path: Path,
) -> None:
    def drawn(protocol: str, salt: str) -> str:
        mode = load_mode(*SMALL, f"session.out={tmp_path}", f"exam_protocol={protocol}")
        return repr(mode.questions(salt))

    assert drawn("sealed", "a") == drawn("sealed", "a") != drawn("sealed", "b")
    assert drawn("development", "a") == drawn("development", "b")


class Recorder:
    """A candidate that notes what it is given, and says that there is no gap, or fails."""

    def __init__(self, failure: Exception | None) -> None:
        self.given: list[tuple[Path, list[str]]] = []
        self._failure = failure

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        self.given.append((case, sorted(str(path.relative_to(case)) for path in case.rglob("*"))))
        if self._failure:
            raise self._failure
        ConstantAnswer(effect=None, probability=0.5).answer(case, out, machine)


def test_a_candidate_gets_a_copy_of_the_case_alone_and_what_failed_is_tried_again(
    tmp_path: Path,
) -> None:
    case, answers = tmp_path / "exam" / CASES_FOLDER / "0000", tmp_path / "answers"
    (case / "field").mkdir(parents=True)
    (case / "field" / "00.parquet").touch()
    dataset.seal_labels(tmp_path / "exam", {"cases": []}, "salt")
    first, second, third = Recorder(RecordingError("no")), Recorder(None), Recorder(None)
    assert sit(first, [case], answers) == 1
    assert run_cases.read_facts(answers / "0000" / run_cases.NOTE_FILE)["error"]
    assert sit(second, [case], answers) == sit(third, [case], answers) == 0
    ((given, content),) = second.given
    assert content == ["field", "field/00.parquet"] and third.given == []
    assert tmp_path not in given.parents and "0000" not in str(given)
    assert (answers / "0000" / ANSWER_FILE).is_file()
    assert run_cases.read_facts(answers / "0000" / run_cases.NOTE_FILE)["error"] is None


def test_a_program_that_fails_or_takes_too_long_says_so(tmp_path: Path) -> None:
    for words, limit_s, message in (("exit 1", 10.0, "exit status 1"), ("sleep 9", 0.2, "within")):
        command = run_cases.CommandCandidate(
            command=("sh", "-c", f"{words} #{{case}}{{out}}"), limit_s=limit_s, threads=1
        )
        with pytest.raises(RecordingError, match=message):
            command.answer(tmp_path, tmp_path / "out", MACHINE)


def test_an_interrupted_program_leaves_no_note_and_sits_again(tmp_path: Path) -> None:
    case, answers = tmp_path / "case", tmp_path / "answers"
    case.mkdir()
    (case / "a").touch()
    # A job in the background of a shell inherits an ignored SIGINT, so the program restores it first.
    program = "from signal import *; signal(SIGINT, SIG_DFL); raise_signal(SIGINT)"
    command = run_cases.CommandCandidate(
        command=(sys.executable, "-c", program, "{case}", "{out}"), limit_s=10.0, threads=1
    )
    with pytest.raises(KeyboardInterrupt):
        sit(command, [case], answers)
    assert not run_cases.is_begun(answers / "case")
    failing = replace(command, command=("sh", "-c", "exit 3 #{case}{out}"))
    sit(failing, [case], answers)
    assert run_cases.is_begun(answers / "case")


def test_another_hand_drives_the_field_of_half_of_the_cases_and_never_the_reference(
    tmp_path: Path,
) -> None:
    words = ("exam_recording=hands", "exam.field.other_hand=[[work],[work]]")
    mode = load_mode(*SMALL, *words, "exam.mix.num_cases=20", f"session.out={tmp_path}")
    exam, questions = mode.exam, mode.questions("")
    halves: dict[generate.Half, Any] = {"reference": exam.reference, "field": exam.field}
    about = (mode.machine, exam.plants, "mild", mode.excitation)
    recorder = CaseRecorder(*about, halves, tmp_path)

    def name_first(number: int, half: generate.Half) -> str:
        job = recorder.list_jobs(number, questions[number], half)[0]
        return recorder.plan_run(job).runs[0][0].name

    by_person = {n for n in range(20) if name_first(n, "field").startswith("work")}
    expected = {n for n, one in enumerate(questions) if exam.field.has_other_hand(one)}
    assert by_person == expected and 3 < len(expected) < 17
    assert all(name_first(n, "reference").startswith("levels") for n in range(4))
