"""`brokk mode=study`: plans, runs, simulates and reports a study of operators with and without advice."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from study import study_folder as folders
from study.analysis import analyse
from study.design import Design, format_plan, plan_trials
from study.measures import COMPARED
from study.report import judge_primary, write_plan_page, write_report
from study.sitting import Sitting, reserve_study
from study.twins import TwinGround

log = logging.getLogger(__name__)


@spec
class StudySteps:
    """A study of guidance against no guidance.

    Attributes:
        do: `plan`, `run`, `simulate`, `report` or `erase`.
        folder: The study's folder; `null`: the run folder, where `plan` and `simulate` begin one.
        participant: Whom to erase, or whose sitting to begin with.
        design: The design of the plan.
        sitting: How participants are led through it.
    """

    do: Literal["plan", "run", "simulate", "report", "erase"]
    folder: str | None
    participant: str | None
    design: Design
    sitting: Sitting

    def check(self) -> None:
        if self.design.primary not in COMPARED:
            raise ConfigError(
                f"design.primary: expected a measure, got '{self.design.primary}'; "
                + list_choices(self.design.primary, COMPARED)
            )
        for do, key in (("run", "folder"), ("erase", "folder"), ("erase", "participant")):
            if self.do == do and getattr(self, key) is None:
                raise ConfigError(f"{key}: study.do={do} needs study.{key}=<{key}>, got none")


@spec
class StudyMode:
    """Study of guidance: `study.do=plan`, `run`, `simulate` (simulated operators), `report`, `erase`.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        study: Plan, sittings, and which step to do.
        ground: Where simulated operators work; `null` where people do.
    """

    session: Session
    machine: Machine
    study: StudySteps
    ground: TwinGround | None

    def check(self) -> None:
        if self.study.do == "simulate" and self.ground is None:
            raise ConfigError("ground: study.do=simulate needs simulated operators; ground=twin")

    def run(self) -> None:
        """Leave `plan.{json,html}`, or `report.html` with pictures and tables, in the run folder.

        Sittings go into `study.folder`.
        """
        study, session, machine = self.study, self.session, self.machine
        folder = Path(study.folder) if study.folder else session.folder
        if study.do == "plan":
            self._plan(folder, "")
        elif study.do == "run":
            study.sitting.run(machine, session, folder, study.participant)
        elif study.do == "simulate":
            assert self.ground is not None
            self._plan(folder, f"The trials of this study are done by {folders.NOTICE}.")
            self.ground.conduct(folders.read_study(folder), machine, session)
            self._report(folder)
        elif study.do == "report":
            self._report(folder)
        else:
            self._erase(folder)

    def _plan(self, folder: Path, notice: str) -> None:
        design, machine, seed = self.study.design, self.machine, self.session.seed
        design.check_machine(machine)
        if (folder / folders.PLAN).exists():
            raise ConfigError(
                f"{folder} already holds a study; plan another one with study.folder=<folder>"
            )
        planned = plan_trials(design, self.session.generator("study plan"))
        write_json(folder / folders.PLAN, format_plan(design, machine, seed, planned))
        write_plan_page(folders.read_study(folder), notice)
        log.info("planned: %s", folder / "plan.html")

    def _report(self, folder: Path) -> None:
        data = folders.read_study(folder, self.machine)
        found = analyse(data, self.machine)
        path = write_report(self.session.folder, found)
        for remark in data.remarks:
            log.warning("%s: %s", remark.where, remark.text)
        log.info("report: %s; guidance, by the primary measure: %s", path, judge_primary(found))

    def _erase(self, folder: Path) -> None:
        assert self.study.participant is not None
        folders.read_study(folder)
        with reserve_study(folder):
            gone = folders.erase(folder, self.study.participant)
        log.info("%s erased: %d files deleted", self.study.participant, len(gone))
        log.warning(
            "delete the reports that were made before, and make them again: study.do=report"
        )
