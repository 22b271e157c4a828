"""`brokk mode=twin`: a simulated machine on the bus, to try out everything that runs on the real one's computer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from brokk_rl.contracts.link import Connection
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec


class TwinSpec(Protocol):
    """What behaves as gateway and machine."""

    def run(
        self, stop: Callable[[], bool], machine: Machine, plant: Connection, session: Session
    ) -> None:
        """Runs until `stop` says so."""
        ...


@spec
class TwinMode:
    """A simulated machine behind the bus: gateway, remote and plant in real time, with faults on request."""

    session: Session
    machine: Machine
    link: Connection
    twin: TwinSpec

    def run(self) -> None:
        """Runs until its time is over or a person stops it.

        Raises:
            LinkError: the bus cannot be opened.
        """
        self.twin.run(lambda: False, self.machine, self.link, self.session)
