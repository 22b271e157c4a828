"""The steps of a study, each one command: plan, run, simulate, report, erase."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.progress import track_items
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from study import design as designs
from study import plan_page, report
from study import study_folder as folders
from study.analysis import analyse
from study.design import Design
from study.simulation import NOTICE, Nowhere, simulate
from study.sitting import Sitting, reserve_study
from study.trial_contract import Operator, TrialGround

log = logging.getLogger(__name__)


@spec
class Steps:
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

    def run(
        self,
        machine: Machine,
        session: Session,
        ground: TrialGround,
        guided: Operator,
        unguided: Operator,
    ) -> None:
        """Do the step `do`; see `study.modes.study.Steps`."""
        if self.do == "plan":
            self._plan(machine, session)
        elif self.do == "erase":
            self._erase(session)
        elif self.do == "run":
            if self.folder is None:
                raise ConfigError(
                    "study.do=run needs study.folder=<folder>: the study that study.do=plan has planned"
                )
            self.sitting.run(machine, session, Path(self.folder), self.participant)
        elif self.do == "simulate":
            if isinstance(ground, Nowhere):
                raise ConfigError("study.do=simulate needs a simulator: ground=twin")
            planned = self._plan(machine, session, is_simulated=True)
            simulate(
                self._home(session),
                self.design,
                planned,
                machine,
                session,
                ground,
                guided,
                unguided,
            )
            self._report(machine, session)
        else:
            self._report(machine, session)

    def _plan(
        self, machine: Machine, session: Session, is_simulated: bool = False
    ) -> list[designs.Trial]:
        plan = plan_study(self.design, machine, session)
        folder = self._home(session)
        if (folder / folders.PLAN).exists():
            raise ConfigError(
                f"{folder} already holds a study; plan another one with study.folder=<folder>"
            )
        folder.mkdir(parents=True, exist_ok=True)
        write_json(
            folder / folders.PLAN,
            designs.format_plan(self.design, machine, session.seed, plan)
            | {"simulated": is_simulated},
        )
        notice = f"The trials of this study are done by {NOTICE}." if is_simulated else ""
        page = plan_page.build_plan_page(self.design, machine.name, session.seed, plan, notice)
        page.write(folder / "plan.html")
        log.info("planned: %s", folder / "plan.html")
        return plan

    def _report(self, machine: Machine, session: Session) -> None:
        data = folders.read_study(self._home(session))
        machine.check_fingerprint(data.plan["fingerprint"], f"the study in {data.folder}")
        found = analyse(data, machine, lambda trials: track_items(trials, "measuring trials"))
        path = report.write_report(session.folder, data, found)
        folders.note_report(data.folder, session.folder)
        for remark in found.remarks:
            log.warning("%s: %s", remark.where, remark.text)
        log.info("%s", report.state_verdict(found, data.is_simulated)[0])
        log.info("report: %s", path)

    def _erase(self, session: Session) -> None:
        if not self.participant:
            raise ConfigError(
                "study.do=erase needs study.participant=<pseudonym> and study.folder=<folder>"
            )
        folders.read_plan(self._home(session))
        with reserve_study(self._home(session)):
            gone, reports = folders.erase(self._home(session), self.participant)
        log.info("%s erased: %d files deleted", self.participant, len(gone))
        for place in reports:
            log.warning(
                "%s was made with this participant's data: delete it, and make it again with study.do=report",
                place,
            )

    def _home(self, session: Session) -> Path:
        return Path(self.folder) if self.folder else session.folder


def plan_study(design: Design, machine: Machine, session: Session) -> list[designs.Trial]:
    """Return all trials of a new study."""
    design.check_machine(machine)
    return designs.plan_trials(design, session.generator("study plan"))
