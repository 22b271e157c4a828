"""Candidates, and their answers to all cases: one process a case, which sees a copy of that case only.

Answers are read from the folder of a run, or from a published file.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import yaml

from brokk_rl.build import describe_spec
from brokk_rl.errors import ConfigError, RecordingError
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel, use_workers
from brokk_rl.progress import ItemProgress
from brokk_rl.session import write_bytes, write_json, write_text
from brokk_rl.spec import Share, spec
from diagnosis.answer import ANSWER_FILE, Answer, Ranked, Selected, Verdict

log = logging.getLogger(__name__)

NOTE_FILE = "sitting.json"
MACHINE_FILE = "machine.yaml"
INTERRUPTED = (-signal.SIGINT, 128 + signal.SIGINT)
"""Exit codes of a program that an interruption of the command ended too."""
LAST_CHARACTERS = 2000
"""Last characters of a program's output that an error quotes. Chosen by hand; not searched."""


PUBLISHED = ("schema", "verdict", "reason", "selected", "ranking", "gap")
"""Parts of an answer that are published: those that a score reads. The others are nine in ten of its bytes; a
published file names them as `left_out`."""
RUN_FILE = "run.json"
"""File beside answers: who gave them, at which commit, to which labels."""


class Candidate(Protocol):
    """A spec in `conf/exam_candidate`: whatever answers a case."""

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Write `diagnosis.json` for the folder `case` into the empty folder `out`.

        Raises:
            RecordingError: it could not.
        """
        ...


@spec
class CommandCandidate:
    """A program that diagnoses one case, started anew for each, without a way to the labels.

    Attributes:
        command: Program and arguments; `{case}` and `{out}` stand for the two folders, `{machine}`
            for a file with the machine as far as it is known. `brokk` is the one that runs now.
        limit_s: Time after which it is ended.
        threads: CPU threads for its numerical libraries.
    """

    command: tuple[str, ...]
    limit_s: float
    threads: int

    def check(self) -> None:
        text = " ".join(self.command)
        if "{case}" not in text or "{out}" not in text:
            raise ConfigError(
                f"candidate.command: expected {{case}} and {{out}} among its arguments, got {list(self.command)}"
            )

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Start the program in an empty folder and waits for it."""
        file = case.parent / MACHINE_FILE
        write_text(file, yaml.safe_dump(describe_spec(machine), sort_keys=False))
        words = [word.format(case=case, out=out, machine=file) for word in self.command]
        if words[0] == "brokk":
            words[:1] = [sys.executable, "-P", "-m", "brokk_rl"]
        threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        environment = os.environ | dict.fromkeys(threads, str(self.threads))
        # the folders of the exam must not be told: they lead to the labels
        for name in ("OLDPWD", "PWD"):
            environment.pop(name, None)
        with tempfile.TemporaryDirectory(prefix="brokk") as empty:
            try:
                done = subprocess.run(
                    words,
                    cwd=empty,
                    env=environment,
                    capture_output=True,
                    text=True,
                    timeout=self.limit_s,
                )
            except subprocess.TimeoutExpired as error:
                raise RecordingError(f"no answer within {self.limit_s:g} s") from error
            except OSError as error:
                raise RecordingError(f"{words[0]} cannot be started: {error.strerror}") from error
        if done.returncode in INTERRUPTED:
            raise InterruptedError("the person interrupted the exam")
        if done.returncode:
            raise RecordingError(
                (done.stderr or done.stdout)[-LAST_CHARACTERS:].strip()
                or f"exit status {done.returncode}"
            )


def answer_cases(
    candidate: Candidate, cases: Sequence[Path], folder: Path, machine: Machine, workers: int
) -> int:
    """Have every case answered that is not yet; returns how many have no answer in the end.

    `folder/<case>/diagnosis.json` is the answer, `sitting.json` beside it says how long it took, or
    why there is none. A case without an answer is tried again by the next run, an answer that
    stands is kept.

    Args:
        candidate: Who answers.
        cases: Folders of the cases.
        folder: Where the answers go.
        machine: The machine.
        workers: Cases answered at once.
    """
    todo = [case for case in cases if not (folder / case.name / ANSWER_FILE).is_file()]
    num_kept = len(cases) - len(todo)
    with ItemProgress("cases answered", len(cases)) as progress, use_workers(workers):
        progress.skip(num_kept)
        errors = map_parallel(
            lambda case: _answer_case(candidate, case, folder / case.name, machine),
            todo,
            lambda _, share: progress.reach(num_kept + share * len(todo)),
        )
    for case, error in zip(todo, errors, strict=True):
        if error is not None:
            log.warning("case %s: no answer: %s", case.name, error.splitlines()[-1])
    return len(errors) - errors.count(None)


def _answer_case(candidate: Candidate, case: Path, out: Path, machine: Machine) -> str | None:
    """Answer one case from a copy under a neutral name, and return why there is no answer.

    No path leads from the copy to the labels.

    Raises:
        KeyboardInterrupt: the person interrupted the program that answers; nothing is noted then.
    """
    if (out / ANSWER_FILE).is_file():
        return None  # by a helper process before another one was killed
    begun, error = time.monotonic(), None
    with tempfile.TemporaryDirectory(prefix="brokk") as scratch:
        copy, place = Path(scratch) / "case", Path(scratch) / "answer"
        shutil.copytree(case, copy)
        try:
            candidate.answer(copy, place, machine)
            if not (place / ANSWER_FILE).is_file():
                error = f"it left no {ANSWER_FILE}"
        except InterruptedError as failure:
            raise KeyboardInterrupt from failure
        except Exception as failure:  # whoever answers may break in any way: that is an answer missed, and no end of the exam
            error = str(failure) or repr(failure)
        note = {"seconds": round(time.monotonic() - begun, 2), "error": error}
        write_json(out / NOTE_FILE, note)
        if error is None:
            # The answer itself comes last: a case with it is finished.
            others = shutil.ignore_patterns(ANSWER_FILE)
            shutil.copytree(place, out, ignore=others, dirs_exist_ok=True)
            write_bytes(out / ANSWER_FILE, (place / ANSWER_FILE).read_bytes())
    return error


def is_begun(answer: Path) -> bool:
    """Return whether anybody answered the case, or tried to, whose answer belongs into a folder."""
    return (answer / NOTE_FILE).is_file() or (answer / ANSWER_FILE).is_file()


def read_facts(path: Path) -> dict[str, Any]:
    """Return what was noted in a JSON file beside answers, empty where there is none."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return {}


@dataclass(frozen=True)
class GivenAnswer:
    """Answer of a candidate to a case; the fields of a line of a published file.

    Attributes:
        note: Seconds that it took, or the reason why there is no answer; empty where nothing was noted.
        answer: Content of its `diagnosis.json`, `None` without one.
        left_out: Parts of it that are not published; `None` where nothing was left out.
        labels_sha256: Hash of the labels of the exam that was answered; `None` where nobody noted it.
        examined: The examiner's figures; see `exam.examiner.examine_case`.
    """

    note: Mapping[str, Any]
    answer: Mapping[str, Any] | None
    left_out: Sequence[str] | None = None
    labels_sha256: str | None = None
    examined: Mapping[str, Any] | None = None


def read_answers(path: Path) -> dict[str, GivenAnswer]:
    """Return the answers in the folder of `exam.do=run`, or in a published file, by case.

    Raises:
        RecordingError: there is no answer.
    """
    found: dict[str, GivenAnswer] = {}
    where = path
    try:
        if path.is_file():
            for row in map(json.loads, path.read_text().splitlines()):
                case = row.pop("case")
                found[case] = GivenAnswer(**row)
        elif path.is_dir():
            answered = read_run(path).get("labels_sha256")
            for place in filter(is_begun, path.iterdir()):
                where = place / ANSWER_FILE
                content = json.loads(where.read_text()) if where.is_file() else None
                note = read_facts(place / NOTE_FILE)
                found[place.name] = GivenAnswer(note, content, labels_sha256=answered)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"exam.answers: {where}: expected {ANSWER_FILE} in a folder a case, or a line a case of a published file "
            f"({error!r}); delete what is damaged, and exam.do=run resume=<answers> answers it again"
        ) from error
    if all(one.answer is None for one in found.values()):
        raise RecordingError(f"exam.answers: {path} holds no answer to any case")
    return found


def read_run(answers: Path) -> dict[str, Any]:
    """Return what `exam.do=run` noted beside answers; empty where nothing is noted, as of a published file."""
    return read_facts(answers / RUN_FILE)


def publish_answers(given: Mapping[str, GivenAnswer], path: Path) -> None:
    """Write all answers into one file, a line a case, with their notes and what is left out."""
    lines = []
    for case, one in sorted(given.items()):
        note = dict(one.note)
        if note.get("error"):
            # The lines before name folders of the computer that answered.
            note["error"] = note["error"].strip().splitlines()[-1]
        kept = replace(one, note=note)
        if one.answer is not None:
            answer = {key: one.answer[key] for key in PUBLISHED if key in one.answer}
            left_out = sorted({*(one.left_out or ()), *one.answer} - {*PUBLISHED})
            kept = replace(kept, answer=answer, left_out=left_out)
        # A missing answer is told as `null`; whatever else is missing is left away.
        told = {key: value for key, value in vars(kept).items() if value is not None}
        lines.append(json.dumps({"case": case, "note": note, "answer": None} | told) + "\n")
    write_text(path, "".join(lines))


@spec
class ConstantAnswer:
    """Give the same answer to every case: an effect on all joints, or no gap.

    Attributes:
        effect: The effect; `null` for none.
        probability: With which it is stated.
    """

    effect: str | None
    probability: Share

    def answer(self, case: Path, out: Path, machine: Machine) -> None:
        """Write it."""
        out.mkdir(parents=True, exist_ok=True)
        verdict: Verdict = "none"
        joints: tuple[str, ...] = ()
        selected: tuple[Selected, ...] = ()
        if self.effect is not None:
            verdict, joints = "effects", machine.joint_names
            named = {"effect": self.effect, "joints": joints, "probability": self.probability}
            selected = (Selected(**named, parameters={}, gap_closed=None),)
        said = Answer(
            verdict=verdict,
            selected=selected,
            ranking=(Ranked(self.effect or "none", joints, self.probability),),
            gap=None,
        )
        said.write(out / ANSWER_FILE)
