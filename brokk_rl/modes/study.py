"""`brokk mode=study`: does guidance help people? Plans the study, simulates it, reports it, forgets who wants to be forgotten."""

from __future__ import annotations

from typing import Any, Protocol

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec


class Steps(Protocol):
    """What a study is made of; the room of the machine's computer has it."""

    def run(self, machine: Machine, session: Session, ground: Any) -> float | None:
        """Does the step that was asked for; `ground` is where simulated operators work, `None` for nowhere."""
        ...


@spec
class Study:
    """Studies whether guidance helps people: `study.do=plan`, `simulate` (operators are simulated), `report` or `erase`.

    Attributes:
        session: Folder, seed, device.
        machine: The machine.
        study: Plan, measures, statistics.
        ground: Where simulated operators work; `null`: nowhere, as on the machine's own computer.
    """

    session: Session
    machine: Machine
    study: Steps
    ground: Any

    def run(self) -> float | None:
        """Leaves `plan.{json,html}` or `report.html` with its pictures and tables in the run folder."""
        return self.study.run(self.machine, self.session, self.ground)
