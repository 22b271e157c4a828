"""`brokk mode=deploy`: listens to a machine, advises its operator, records; commands valves only where that was asked for."""

from __future__ import annotations

from typing import Any, Protocol

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec


class Deployment(Protocol):
    """A spec in `conf/deploy`: the loop on the machine's computer."""

    def run(self, machine: Machine, session: Session, companions: Any) -> None:
        """Runs until its time is over or a person stops it."""
        ...


class Bench(Protocol):
    """A spec in `conf/bench`: what stands in for machine and operator on a desk."""

    def companions(self, machine: Machine, session: Session) -> Any:
        """Returns the processes to run beside the loop."""
        ...


@spec
class DeployMode:
    """Listens to a machine and shows the operator where to move the levers; `deploy=auto` sends the policy's commands itself."""

    session: Session
    machine: Machine
    deploy: Deployment
    bench: Bench | None

    def run(self) -> None:
        """Leaves `capture.mcap` and `frames.blf` (recorded), `timing.json` and `processes.json` in the run folder.

        Raises:
            CheckpointError: the policy was made for another machine, or is damaged.
            LinkError: the bus or the policy process died.
        """
        beside = self.bench.companions(self.machine, self.session) if self.bench else ()
        self.deploy.run(self.machine, self.session, beside)
