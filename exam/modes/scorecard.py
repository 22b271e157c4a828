"""`brokk mode=scorecard`: runs the diagnosis on recordings of real machines, and scores it."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from brokk_rl import record
from brokk_rl.errors import BrokkError, ConfigError, RecordingError
from brokk_rl.report import Cell
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from diagnosis.answer import ANSWER_FILE
from exam import scorecard
from exam.real_cases import DIAGNOSIS_FOLDER, CaseRun, RealCase, RefusalError

log = logging.getLogger(__name__)

RESULT_FILE = "result.json"
"""Result of a finished case, in its folder."""
PRINTED = {
    "machine": False, "verdict": True, "first pick": True, "known, named": False,
    "phantoms": False, "abstention": True, "closed": False, "apart: less by": False,
    "seconds": False,
}  # fmt: skip
"""Columns of the printed table, and whether with their notes."""


@spec
class ScorecardSettings:
    """Where the logs are, and how long a case may take.

    Attributes:
        data: Folder with a folder of logs for each case.
        limit_s: Time after which a stage of a case is ended.
    """

    data: str
    limit_s: float

    def check(self) -> None:
        if self.limit_s <= 0:
            raise ConfigError(f"scorecard.limit_s: expected more than 0, got {self.limit_s:g}")


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
            kept = _read_result(folder / name)
            if kept is not None:
                log.info("%d of %d, %s: done already", number, len(todo), name)
                results[name] = kept
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
        """Return the result of one case; that of an answered case is kept in its folder."""
        work = CaseRun(case, data, folder, self.scorecard.limit_s)
        told = {"title": case.title, "known": case.known.source}
        try:
            counts = work.convert_logs()
            log.info("%s: logs %s", name, counts)
            log.info("%s: simulator", name)
            work.fit_simulator()
            log.info("%s: diagnosis", name)
            begun = time.monotonic()
            answer = _diagnose(work)
            seconds = time.monotonic() - begun
        except BrokkError as error:
            log.warning("%s failed: %s", name, error)
            return {"outcome": "failed", "reason": str(error), **told}
        errors = scorecard.read_errors(answer, case.machine)
        if errors["unit"] is not None and "hold" not in errors["rivals"]:
            recordings = record.read_recordings(str(folder / "field" / "*.parquet"), case.machine)
            errors["rivals"]["hold"] = scorecard.compute_hold_error(
                recordings, case.machine, errors["unit"]
            )
        found = {
            "outcome": "answered", "reason": "", **told, "logs": counts,
            "scores": scorecard.score_answer(answer, case.known), "errors": errors,
            "seconds": round(seconds, 1),
        }  # fmt: skip
        write_json(folder / RESULT_FILE, found)
        return found


def _diagnose(work: CaseRun) -> dict[str, Any]:
    """Return the answer to a case; a refusal is one too."""
    try:
        work.diagnose_field()
    except RefusalError as error:
        return {"verdict": scorecard.REFUSED, "selected": [], "reason": str(error)}
    return json.loads((work.folder / DIAGNOSIS_FOLDER / ANSWER_FILE).read_text())


def _read_result(folder: Path) -> dict[str, Any] | None:
    path = folder / RESULT_FILE
    return json.loads(path.read_text()) if path.is_file() else None


def _print_table(results: dict[str, dict[str, Any]], folder: Path) -> None:
    """Print the columns of scores; the files have all columns and the notes."""
    shown = [k for k, name in enumerate(scorecard.COLUMNS) if name in PRINTED]
    table = Table(*(scorecard.COLUMNS[k] for k in shown), box=None)
    for row in scorecard.build_rows(results):
        cells = []
        for k in shown:
            cell = row[k]
            if isinstance(cell, Cell) and not PRINTED[scorecard.COLUMNS[k]]:
                cell = Cell(cell.value)
            cells.append(scorecard.format_cell(cell))
        table.add_row(*cells)
    console = Console()
    console.print(table)
    console.print(f"report: {folder / scorecard.REPORT_FILE}", highlight=False)
