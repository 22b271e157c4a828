"""`brokk mode=study`: plans, runs, simulates and reports a study of operators with and without advice."""

from __future__ import annotations

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from study.study_steps import Steps
from study.trial_contract import Operator, TrialGround


@spec
class StudyMode:
    """Study of guidance: `study.do=plan`, `run`, `simulate` (simulated operators), `report`, `erase`.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        study: Plan, measures, statistics.
        ground: Where simulated operators work.
        guided: Simulated operators with advice.
        unguided: Simulated operators without; the same persons.
    """

    session: Session
    machine: Machine
    study: Steps
    ground: TrialGround
    guided: Operator
    unguided: Operator

    def run(self) -> None:
        """Leave `plan.{json,html}`, or `report.html` with pictures and tables, in the run folder.

        Sittings go into `study.folder`.
        """
        self.study.run(self.machine, self.session, self.ground, self.guided, self.unguided)
