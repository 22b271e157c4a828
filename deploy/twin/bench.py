"""A desk instead of a machine: the twin, and at its remote a simulated operator or a gamepad."""

from __future__ import annotations

from typing import Any

from brokk_rl.contracts.actuator import Follower
from brokk_rl.contracts.link import Connection
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.runtime.supervisor import CompanionProcess
from deploy.twin.remote import GamepadRemote
from deploy.twin.twin import TWIN_PRIORITY, Twin


def list_companions(
    twin: Twin,
    plant: Connection,
    machine: Machine,
    session: Session,
    target: str = "",
    *arguments: Any,
) -> list[CompanionProcess]:
    """Return the process of a twin, and of who plays its remote, where `target` names that."""
    own = (twin, machine, plant, session)
    found = [CompanionProcess("twin", "deploy.twin.twin:run", own, TWIN_PRIORITY)]
    if target:
        others = (twin.wire, twin.dbc, machine, *arguments)
        found.append(CompanionProcess("operator", target, others, TWIN_PRIORITY))
    return found


@spec
class TwinBench:
    """Twin and operator in place of a machine.

    Attributes:
        twin: The twin.
        plant: The simulated machine behind it.
        operator: Simulated person who moves the levers as they are shown; `null`: none, the levers
            stay in neutral.
    """

    twin: Twin
    plant: Connection
    operator: Follower | None

    def check(self) -> None:
        if self.twin.remote == (self.operator is not None):
            raise ConfigError(
                "bench: the remote is played by the twin (twin.remote=true) or by an operator, not by both or neither"
            )

    def companions(self, machine: Machine, session: Session) -> list[CompanionProcess]:
        """Return the processes to run beside the loop."""
        if self.operator is None:
            return list_companions(self.twin, self.plant, machine, session)
        arguments = (self.operator, session.stream("operator"))
        target = "deploy.twin.remote:run_operator"
        return list_companions(self.twin, self.plant, machine, session, target, *arguments)


@spec
class GamepadBench:
    """Twin in place of a machine, and a gamepad in the hands of a person.

    Attributes:
        twin: The twin.
        plant: The simulated machine behind it.
        gamepad: The gamepad.
    """

    twin: Twin
    plant: Connection
    gamepad: GamepadRemote

    def check(self) -> None:
        if self.twin.remote:
            raise ConfigError(
                "bench=gamepad: expected twin.remote=false, since the gamepad is the remote"
            )

    def companions(self, machine: Machine, session: Session) -> list[CompanionProcess]:
        """Return the processes to run beside the loop.

        Raises:
            ConfigError: the gamepad cannot be opened.
        """
        # Before anything starts: a person who has forgotten to plug it in is told so at once.
        self.gamepad.open_device().close()
        target = "deploy.twin.remote:run_gamepad"
        return list_companions(self.twin, self.plant, machine, session, target, self.gamepad)
