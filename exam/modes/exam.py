"""`brokk mode=exam`: make sealed cases, have them diagnosed blindly, and score the answers."""

from __future__ import annotations

import json
import logging
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from actuators.contracts import ActuatorFit
from brokk_rl.console_table import print_table, print_text
from brokk_rl.contracts.actuator import Excitation
from brokk_rl.errors import ConfigError, RecordingError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.parallel import map_parallel, use_workers
from brokk_rl.progress import ItemProgress
from brokk_rl.session import Session, describe_commit, write_json, write_text
from brokk_rl.spec import Count, spec
from exam import dataset, metrics, run_cases
from exam.case_distribution import CaseDesign, CaseDistribution
from exam.examiner import examine_case
from exam.generate import CASES_FOLDER, STREAMS, WITHHELD_FOLDER, CaseRecorder, Half, HalfPlan
from exam.plants.family import DrawnPlants
from exam.run_cases import Candidate

log = logging.getLogger(__name__)

FACTS_FILE = "exam.json"
"""Facts of an exam that do not tell its labels."""
MAKE_AGAIN = (
    "add what is missing by exam.do=make resume=<exam> session.out=<exam> and its own options"
)


@spec
class ExamSettings:
    """The step to do, and the cases.

    Attributes:
        do: `make` cases into the run folder, `run` a candidate on them, or `score` the
            answers of one or several.
        folder: The exam that all but `make` are about: the folder that `make` left.
        candidate: Who answers.
        workers: Cases answered or recorded at once.
        answers: Of `score`: a name for each candidate, and the run folder with its answers.
        fit: Of `score`: fit of the examiner's simulator, the same as the candidate's.
        mix: Which cases there are.
        plants: Machines, written apart from the library.
        roughness: How much of a machine no tidy model has: a name of the family's, `mild` or
            `strong`.
        reference: How the machine as it is believed to be is recorded.
        field: How the machine as it is is recorded.
        withheld: How it is recorded for the examiner, who simulates the repair there.
        sealed: The cases depend on a secret salt among the labels, too: nobody can make them again
            from `session.seed`.
        salt: That salt, to make the cases of an opened exam again; `null` draws one.
    """

    do: Literal["make", "run", "score"]
    folder: str | None
    candidate: Candidate
    workers: Count
    answers: dict[str, str]
    fit: ActuatorFit
    mix: CaseDistribution
    plants: DrawnPlants
    roughness: str
    reference: HalfPlan
    field: HalfPlan
    withheld: HalfPlan
    sealed: bool
    salt: str | None

    def check(self) -> None:
        if self.do != "make" and self.folder is None:
            raise ConfigError(
                f"exam.do={self.do}: expected exam.folder=<folder>, the one that exam.do=make wrote"
            )
        if self.do == "score" and not self.answers:
            raise ConfigError(
                f"exam.do={self.do}: expected +exam.answers.<name>=<folder>, a folder that exam.do=run wrote; one or several"
            )
        for name in self.mix.troubles:
            if name not in self.plants.table:
                raise ConfigError(
                    f"exam.mix.troubles: no plant has '{name}'; {list_choices(name, self.plants.table)}"
                )


@spec
class Exam:
    """Examine the diagnosis on cases with a withheld cause.

    Attributes:
        session: Folder and seed.
        machine: The machine of all cases.
        excitation: Excitations by name; `exam.reference` and `exam.field` give the file.
        exam: The step and the cases.
        resume: Run folder of an interrupted step to go on with; the same as `session.out`.
    """

    session: Session
    machine: Machine
    excitation: dict[str, Excitation]
    exam: ExamSettings
    resume: str | None

    def check(self) -> None:
        if self.resume is None:
            return
        if Path(self.resume).resolve() != self.session.folder.resolve():
            raise ConfigError(
                f"resume={self.resume}: a step goes on in its own folder; add "
                f"session.out={self.resume} and give exam.do as before"
            )

    def run(self) -> None:
        """Do the step of `exam.do` in the run folder."""
        getattr(self, f"_{self.exam.do}")()

    def _make(self) -> None:
        """Write `cases/`, `labels.sealed.json` (mode 0600), `labels.sha256` and `exam.json`."""
        settings, folder = self.exam, self.session.folder
        salt = settings.salt or dataset.read_salt(folder) or secrets.token_hex(16)
        questions, labels = self.questions(salt), []
        for number, one in enumerate(questions):
            other_hand = settings.field.has_other_hand(one)
            labels.append(dataset.make_label(f"{number:04d}", one, self.machine, other_hand))
        facts = {
            "schema": 2,
            "seed": self.session.seed,
            "sealed": settings.sealed,
            "machine": self.machine.name,
            "makes": list(settings.plants.makes),
            "roughness": settings.roughness,
            "num_cases": len(labels),
        }
        found = dataset.seal_labels(folder, {**facts, "cases": labels}, salt)
        halves: dict[Half, HalfPlan] = {half: getattr(settings, half) for half in STREAMS}
        drawn = (settings.plants, settings.roughness, self.excitation)
        recorder = CaseRecorder(self.machine, *drawn, halves, folder)
        recorder.write_all(questions, settings.workers)
        write_json(folder / FACTS_FILE, {**facts, "labels_sha256": found})
        log.info("%d cases in %s, labels sealed: sha256 %s", len(labels), folder, found)

    def questions(self, salt: str) -> list[CaseDesign]:
        """Return the cases; those of a sealed exam depend on the secret salt too."""
        settings = self.exam
        secret = salt.encode() if settings.sealed else b""
        generator = np.random.default_rng([self.session.seed, *secret])
        return settings.mix.questions(self.machine, settings.plants, generator)

    def _run(self) -> None:
        """Write `<case>/diagnosis.json` and `<case>/sitting.json` for each case, and `run.json`."""
        settings, facts, out = self.exam, self._read_facts(), self.session.folder
        cases = [self._folder / CASES_FOLDER / f"{n:04d}" for n in range(facts["num_cases"])]
        files = {}
        for case in cases:
            files[case.name] = {str(path.relative_to(case)) for path in case.rglob("*.parquet")}
        whole = set[str]().union(*files.values())
        damaged = [name for name, there in files.items() if there != whole]
        if damaged or not whole:
            raise RecordingError(
                f"exam.folder={self._folder}: expected the same files in all {len(cases)} folders of {CASES_FOLDER}/, but "
                f"{', '.join(damaged)} lack some; {MAKE_AGAIN}"
            )
        run = {
            "commit": describe_commit(),
            "labels_sha256": facts["labels_sha256"],
            "candidate": repr(settings.candidate),
        }
        before = {**run, **run_cases.read_run(out)}
        for name in ("candidate", "labels_sha256"):
            if before[name] != run[name]:
                raise ConfigError(
                    f"resume={out}: expected {name}={before[name]}, as in its {run_cases.RUN_FILE}, got {run[name]}: answers "
                    "of two candidates or to two exams are not mixed; choose another session.out=<folder>"
                )
        if before["commit"] != run["commit"]:
            log.warning("answers of two commits: %s, then %s", before["commit"], run["commit"])
        if not any(one.get("run") == run for one in dataset.read_ledger(self._folder)):
            entry = {"labels_sha256": facts["labels_sha256"], "run": run}
            dataset.append_entry(self._folder, dataset.BEGUN, entry)
        write_json(out / run_cases.RUN_FILE, run)
        candidate, workers = settings.candidate, settings.workers
        failed = run_cases.answer_cases(candidate, cases, out, self.machine, workers)
        if failed:
            text = "%d of %d cases have no answer; why stands in their %s"
            log.warning(text, failed, len(cases), run_cases.NOTE_FILE)
        log.info("answers in %s; exam.do=score opens the labels", out)

    @property
    def _folder(self) -> Path:
        return Path(self.exam.folder or "")

    def _read_facts(self) -> dict[str, Any]:
        """Return number of cases and hash of the labels of the exam in `exam.folder`.

        Raises:
            RecordingError: there is no exam, or it is not finished.
        """
        path = self._folder / FACTS_FILE
        try:
            facts = json.loads(path.read_text())
            return {key: facts[key] for key in ("num_cases", "labels_sha256")}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RecordingError(
                f"exam.folder={self._folder}: expected {FACTS_FILE}, which exam.do=make writes last ({error!r}); {MAKE_AGAIN}"
            ) from error

    def _examine(
        self, labels: Sequence[Mapping[str, Any]], folders: Mapping[str, Path]
    ) -> dict[str, dict[str, Any]]:
        """Return the examiner's figures by case and candidate; none without withheld recordings."""
        cases = []
        for label in labels:
            is_withheld = (self._folder / WITHHELD_FOLDER / label["case"]).is_dir()
            if label["kind"] in ("one", "several") and is_withheld:
                cases.append(label["case"])

        def examine_begun(case: str) -> dict[str, Any]:
            begun = [name for name in folders if run_cases.is_begun(folders[name] / case)]
            answers = {name: folders[name] / case for name in begun}
            about = (self._folder, self.exam.fit, self.machine, case)
            return examine_case(*about, answers) if begun else {}

        bar = ItemProgress("repairs examined", len(cases))
        with bar as progress, use_workers(self.exam.workers):
            tell = lambda _, share: progress.reach(share * len(cases))  # noqa: E731
            return dict(zip(cases, map_parallel(examine_begun, cases, tell), strict=True))

    def _score(self) -> None:
        """Open the labels; write marks, answers, labels and report; print the table."""
        is_published = not (self._folder / dataset.LABELS_FILE).is_file()
        if not is_published:
            self._read_facts()  # labels of cases that are still being made stay closed
        facts, text = dataset.open_labels(self._folder)
        labels = facts.pop("cases")
        answers = {name: Path(path) for name, path in self.exam.answers.items()}
        given = {name: run_cases.read_answers(path) for name, path in answers.items()}
        for name, path in answers.items():
            hashes = {one.labels_sha256 for one in given[name].values()}
            if hashes - {None, facts["labels_sha256"]}:
                raise RecordingError(
                    f"{path}: expected answers to the labels of {self._folder}, got answers to others; choose another exam.folder"
                )
        facts["ledger"] = []
        for path in answers.values():
            run = run_cases.read_run(path)
            facts["ledger"].append(dataset.describe_registration(self._folder, path, run))
        if not is_published:
            hashes = {"labels_sha256": facts["labels_sha256"]}
            dataset.append_entry(self._folder, dataset.OPENED, hashes)
        out = self.session.folder
        tables, examined = {}, self._examine(labels, answers)
        for name, one in given.items():
            for case, figures in examined.items():
                if name in figures:
                    one[case] = replace(one[case], examined=figures[name])
            tables[name] = metrics.build_table(labels, one, self.exam.mix)
            tables[name]["commit"] = run_cases.read_run(answers[name]).get("commit")
            # Answers and labels stand beside the score, so that anybody can score them again.
            run_cases.publish_answers(one, out / f"answers_{name}.jsonl")
        write_text(out / dataset.OPENED_FILE, text)
        write_json(out / "marks.json", {"exam": facts, "candidates": tables})
        metrics.write_report(out, facts, tables)
        print_table(["", *tables], metrics.build_rows(tables))
        for sentence in facts["ledger"]:
            print_text(sentence)
        log.info("report: %s", out / metrics.REPORT_FILE)
