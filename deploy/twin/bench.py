"""A desk instead of a machine: the twin, and at its remote a simulated operator or a gamepad."""

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
from deploy.twin.remote import GamepadRemote
from deploy.twin.twin import TWIN_PRIORITY, Twin


@spec
class TwinBench:
    """Twin and operator in place of a machine.

    Attributes:
        twin: The twin.
        plant: The simulated machine behind it.
        operator: Simulated person who moves the levers as they are shown; `null`: none, the levers
            stay in neutral.
        guidance: How the levers are shown.
        assumed: Assumptions of policies for such an operator (`conf/advice.yaml`), for the record;
            `null` without one.
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
        arguments = (self.twin, machine, self.plant, session)
        twin = CompanionProcess("twin", "deploy.twin.twin:run", arguments, TWIN_PRIORITY)
        if self.operator is None:
            return [twin]
        levers = LeverMap(self.guidance.levers or machine.levers, machine)
        wire, dbc, seed = self.twin.wire, self.twin.dbc, session.stream("operator")
        arguments = (wire, dbc, machine, self.operator, levers, seed)
        target = "deploy.twin.remote:run_operator"
        return [twin, CompanionProcess("operator", target, arguments, TWIN_PRIORITY)]


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
        twin = self.twin
        arguments: tuple[Any, ...] = (twin, machine, self.plant, session)
        found = [CompanionProcess("twin", "deploy.twin.twin:run", arguments, TWIN_PRIORITY)]
        arguments = (twin.wire, twin.dbc, machine, self.gamepad)
        target = "deploy.twin.remote:run_gamepad"
        return [*found, CompanionProcess("gamepad", target, arguments, TWIN_PRIORITY)]
