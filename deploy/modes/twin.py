"""`brokk mode=twin`: a simulated machine on the bus, to try the machine computer's programs on."""

from __future__ import annotations

from brokk_rl.contracts.link import Connection
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.twin.twin import Twin


@spec
class TwinMode:
    """A simulated machine on the bus: gateway, remote and plant in real time, faults on request."""

    session: Session
    machine: Machine
    link: Connection
    twin: Twin

    def run(self) -> None:
        """Run until the time is over or a person stops it.

        Raises:
            LinkError: the bus cannot be opened.
        """
        self.twin.run(lambda: False, self.machine, self.link, self.session)
