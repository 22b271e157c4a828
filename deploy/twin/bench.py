"""A desk instead of a machine: the twin, and who is at its remote: a simulated operator, a gamepad."""

from __future__ import annotations

from brokk_rl.contracts.actuator import Follower
from brokk_rl.contracts.link import Connection
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.runtime.supervisor import CompanionProcess
from deploy.twin.remote import GamepadRemote, RemoteHolder, SimulatedOperator
from deploy.twin.twin import TWIN_PRIORITY, Twin


@spec
class Bench:
    """Twin in place of a machine, and a person at its remote.

    Attributes:
        twin: The twin.
        plant: The simulated machine behind it.
    """

    twin: Twin
    plant: Connection

    def find_person(self, machine: Machine, session: Session) -> RemoteHolder | None:
        """Return who holds the remote; `None` where the twin plays it, levers in neutral."""
        raise NotImplementedError

    def companions(self, machine: Machine, session: Session) -> list[CompanionProcess]:
        """Return the processes to run beside the loop.

        Raises:
            ConfigError: the gamepad cannot be opened.
        """
        twin, person = self.twin, self.find_person(machine, session)
        own = (twin, machine, self.plant, session)
        found = [CompanionProcess("twin", "deploy.twin.twin:run", own, TWIN_PRIORITY)]
        if person is not None:
            others = (twin.wire, twin.dbc, machine, person)
            target = "deploy.twin.remote:run_remote"
            found.append(CompanionProcess("operator", target, others, TWIN_PRIORITY))
        return found


@spec
class TwinBench(Bench):
    """Twin and operator in place of a machine.

    Attributes (and those of `Bench`):
        operator: Simulated person who moves the levers as they are shown; `null`: none, the levers
            stay in neutral.
    """

    operator: Follower | None

    def check(self) -> None:
        if self.twin.remote == (self.operator is not None):
            raise ConfigError(
                "bench: the remote is played by the twin (twin.remote=true) or by an operator, not by both or neither"
            )

    def find_person(self, machine: Machine, session: Session) -> RemoteHolder | None:
        """See `Bench`."""
        if self.operator is None:
            return None
        return SimulatedOperator(self.operator, session.stream("operator"))


@spec
class GamepadBench(Bench):
    """Twin in place of a machine, and a gamepad in the hands of a person.

    Attributes (and those of `Bench`):
        gamepad: The gamepad.
    """

    gamepad: GamepadRemote

    def check(self) -> None:
        if self.twin.remote:
            raise ConfigError(
                "bench=gamepad: expected twin.remote=false, since the gamepad is the remote"
            )

    def find_person(self, machine: Machine, session: Session) -> RemoteHolder:
        """See `Bench`."""
        # Before anything starts: a person who has forgotten to plug it in is told so at once.
        self.gamepad.open_device().close()
        return self.gamepad
