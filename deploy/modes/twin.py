"""`brokk mode=twin`: a simulated machine on the bus, to try the machine computer's programs on."""

from __future__ import annotations

import contextlib

from rich.console import Console

from brokk_rl.contracts.link import Connection
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.twin.twin import Twin, run


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
        twin, console = self.twin, Console(stderr=True)
        port = "none" if twin.fault_port is None else f"UDP port {twin.fault_port}"
        console.print(
            f"twin of {self.machine.name} on {twin.wire.interface} {twin.wire.channel}; "
            f"remote: {'its own' if twin.remote else 'on the bus'}; faults: {port}; "
            "beside it: brokk mode=deploy bus=udp; Ctrl-C ends it",
            soft_wrap=True,
            highlight=False,
        )
        with contextlib.suppress(KeyboardInterrupt):
            run(lambda: False, twin, self.machine, self.link, self.session)
