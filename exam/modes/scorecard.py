"""`brokk mode=scorecard`: runs the diagnosis on recordings of real machines, and scores it."""

from __future__ import annotations

import json
import logging
import resource
import time
from pathlib import Path
from typing import Any

from brokk_rl import record
from brokk_rl.console_table import print_table, print_text
from brokk_rl.errors import BrokkError, ConfigError, RecordingError
from brokk_rl.session import Session, write_json
from brokk_rl.spec import Positive, spec
from diagnosis.answer import ANSWER_FILE
from exam import scorecard
from exam.real_cases import DIAGNOSIS_FOLDER, CaseRun, RealCase, RefusalError
from exam.report import format_cell

log = logging.getLogger(__name__)

RUN_FILE = "run.json"
"""Answer, logs and seconds of a finished case, in its folder."""
PRINTED = ("machine", "verdict", "first pick", "phantoms", "abstention", "closed", "seconds (CPU)")
"""Columns of the printed table."""


@spec
class ScorecardSettings:
    """Where the logs are, and how long a case may take.

    Attributes:
        data: Folder with a folder of logs for each case.
        limit_s: Time after which a stage of a case is ended.
    """

    data: str
    limit_s: Positive


@spec
class Scorecard:
    """Run the diagnosis on recordings of real machines, and score the answers.

    Attributes:
        session: Folder and seed.
        real_machine: Cases by name.
        scorecard: Where the logs are.
        resume: Run folder of an interrupted scorecard to go on with; the same as `session.out`.
    """

    session: Session
    real_machine: dict[str, RealCase]
    scorecard: ScorecardSettings
    resume: str | None

    def check(self) -> None:
        if not self.real_machine:
            raise ConfigError("real_machine: expected one or more cases, real_machine=[<name>, …]")
        if self.resume is not None and Path(self.resume).resolve() != self.session.folder.resolve():
            raise ConfigError(
                f"resume={self.resume}: a scorecard goes on in its folder; add session.out={self.resume}"
            )

    def run(self) -> None:
        """Write `scorecard.json`, `.md` and `.html`, anew after each case.

        Raises:
            RecordingError: no case has a folder of logs.
            StorageError: something could not be written.
        """
        folder, data = self.session.folder.resolve(), Path(self.scorecard.data).expanduser()
        todo, skipped = {}, {}
        for name, case in self.real_machine.items():
            if (data / case.folder).is_dir():
                todo[name] = case
                continue
            skipped[name] = f"there is no folder {data / case.folder}"
            log.warning("%s is skipped: %s", name, skipped[name])
        if not todo:
            raise RecordingError(
                f"scorecard.data={data}: expected a folder of logs, one of "
                f"{', '.join(case.folder for case in self.real_machine.values())}"
            )
        results: dict[str, dict[str, Any]] = {}
        begun, num_run = time.monotonic(), 0
        for number, (name, case) in enumerate(todo.items(), 1):
            if _is_answered(folder / name):
                log.info("%d of %d, %s: done already", number, len(todo), name)
                results[name] = _build_result(case, folder / name)
                continue
            elapsed_s, left = time.monotonic() - begun, len(todo) - number + 1
            about = f", about {elapsed_s / num_run * left / 60:.0f} min left" if num_run else ""
            log.info("%d of %d, %s: %s%s", number, len(todo), name, case.title, about)
            results[name] = self._run_case(name, case, data / case.folder, folder / name)
            num_run += 1
            scorecard.write_scorecard(folder, results, skipped)
        scorecard.write_scorecard(folder, results, skipped)
        _print_table(results, self.session.folder)

    def _run_case(self, name: str, case: RealCase, data: Path, folder: Path) -> dict[str, Any]:
        """Run one case; return its result. An answer is kept in the folder of the case."""
        work = CaseRun(case, data, folder, self.scorecard.limit_s)
        try:
            counts = work.convert_logs()
            log.info("%s: logs %s", name, counts)
            log.info("%s: simulator", name)
            work.fit_simulator()
            log.info("%s: diagnosis", name)
            begun, begun_cpu_s = time.monotonic(), _read_cpu_s()
            answer = _diagnose(work)
            seconds, cpu_s = time.monotonic() - begun, _read_cpu_s() - begun_cpu_s
        except BrokkError as error:
            log.warning("%s failed: %s", name, error)
            told = {"title": case.title, "known": case.known.source}
            return {"outcome": "failed", "reason": str(error), **told}
        run = {"logs": counts, "seconds": round(seconds, 1), "cpu_seconds": round(cpu_s, 1)}
        write_json(folder / RUN_FILE, run | {"answer": answer})
        return _build_result(case, folder)


def _is_answered(folder: Path) -> bool:
    return (folder / RUN_FILE).is_file()


def _build_result(case: RealCase, folder: Path) -> dict[str, Any]:
    """Return the result of an answered case, scored by the knowledge that is configured now."""
    run = json.loads((folder / RUN_FILE).read_text())
    answer = run.pop("answer")
    errors = scorecard.read_errors(answer, case.machine)
    if errors["unit"] is not None and "hold" not in errors["rivals"]:
        field = record.read_recordings(str(folder / "field" / "*.parquet"), case.machine)
        hold = scorecard.compute_hold_error(field, case.machine, errors["unit"])
        errors["rivals"]["hold"] = hold
    return {
        "outcome": "answered",
        "reason": "",
        "title": case.title,
        "known": case.known.source,
        **run,
        "scores": scorecard.score_answer(answer, case.known),
        "errors": errors,
    }


def _read_cpu_s() -> float:
    """Return the CPU time of all ended stages, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _diagnose(work: CaseRun) -> dict[str, Any]:
    """Return the public fields of the answer to a case; a refusal is an answer too."""
    try:
        work.diagnose_field()
    except RefusalError as error:
        return {"verdict": scorecard.REFUSED, "selected": [], "reason": str(error)}
    found = json.loads((work.folder / DIAGNOSIS_FOLDER / ANSWER_FILE).read_text())
    return {name: found[name] for name in scorecard.PUBLIC_FIELDS if name in found}


def _print_table(results: dict[str, dict[str, Any]], folder: Path) -> None:
    """Print the scores; the files have all columns."""
    places = [scorecard.COLUMNS.index(name) for name in PRINTED]
    rows = []
    for row in scorecard.build_rows(results):
        rows.append([format_cell(row[place]) for place in places])
    print_table(PRINTED, rows)
    print_text(f"report: {folder / scorecard.REPORT_FILE}")
