"""A desk instead of a machine: the twin, and an operator at its remote who follows the advice as the configured person does."""

from __future__ import annotations

from typing import Any

from brokk_rl.contracts.actuator import Follower
from brokk_rl.contracts.link import Connection
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.guidance import LeverGuidance, LeverMap
from deploy.runtime.supervisor import CompanionProcess
from deploy.twin.twin import TWIN_PRIORITY, Twin


@spec
class TwinBench:
    """What stands in for machine and operator.

    Attributes:
        twin: The twin.
        plant: The simulated machine behind it.
        operator: Who moves the levers as they are shown; `null`: nobody, the levers stay in
            neutral.
        guidance: How the levers are shown.
        assumed: What policies for such an operator assume of them (`advice=person`), for the
            record; `null` without one.
    """

    twin: Twin
    plant: Connection
    operator: Follower | None
    guidance: LeverGuidance
    assumed: dict[str, Any] | None

    def check(self) -> None:
        if self.twin.remote == (self.operator is not None):
            raise ConfigError(
                "bench: the remote is played by the twin (twin.remote=true) or by an operator, not by both or neither"
            )

    def companions(self, machine: Machine, session: Session) -> list[CompanionProcess]:
        """Return the processes to run beside the loop."""
        found = [
            CompanionProcess(
                "twin",
                "deploy.twin.twin:run",
                (self.twin, machine, self.plant, session),
                TWIN_PRIORITY,
            )
        ]
        if self.operator is not None:
            levers = LeverMap(self.guidance.levers or machine.levers, machine)
            wire, dbc, seed = self.twin.wire, self.twin.dbc, session.stream("operator")
            found.append(
                CompanionProcess(
                    "operator",
                    "deploy.twin.remote:run_operator",
                    (wire, dbc, machine, self.operator, levers, seed),
                    TWIN_PRIORITY,
                )
            )
        return found
