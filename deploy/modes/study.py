"""`brokk mode=study`: does guidance help people? Plans the study, leads people through it, simulates and reports it, forgets."""

from __future__ import annotations

from typing import Protocol

from brokk_rl.contracts.operator import Operator, TrialGround
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec


class Steps(Protocol):
    """What a study is made of; the room of the machine's computer has it."""

    def run(
        self,
        machine: Machine,
        session: Session,
        ground: TrialGround,
        guided: Operator,
        unguided: Operator,
    ) -> float | None:
        """Does the step that was asked for; simulated operators work on `ground`, with advice shown and without."""
        ...


@spec
class StudyMode:
    """Studies whether guidance helps people: `study.do=plan`, `run`, `simulate` (operators are simulated), `report` or `erase`.

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

    def run(self) -> float | None:
        """Leaves `plan.{json,html}`, or `report.html` with pictures and tables, in the run folder; sittings into `study.folder`."""
        return self.study.run(self.machine, self.session, self.ground, self.guided, self.unguided)
