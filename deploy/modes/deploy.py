"""`brokk mode=deploy`: runs the loop on the machine's computer."""

from __future__ import annotations

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.runtime.supervisor import BenchSpec, DeploymentLoop


@spec
class DeployMode:
    """Listen to a machine and show the operator lever positions; `deploy=auto` commands the valves."""

    session: Session
    machine: Machine
    deploy: DeploymentLoop
    bench: BenchSpec | None

    def run(self) -> None:
        """Write `capture.mcap` (recorded), `timing.json` and `processes.json`.

        Raises:
            CheckpointError: the policy was made for another machine, or is damaged.
            LinkError: the bus or the policy process died.
        """
        companions = self.bench.companions(self.machine, self.session) if self.bench else ()
        self.deploy.run(self.machine, self.session, companions)
