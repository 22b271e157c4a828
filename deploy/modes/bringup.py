"""`brokk mode=bringup`: a checklist that runs on a machine before anybody trusts the loop on it."""

from __future__ import annotations

from functools import partial

from rich.console import Console

from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.bringup import REPORT, BringupChecklist
from deploy.runtime.supervisor import BenchSpec


@spec
class BringupMode:
    """Check bus, signs, limits, latency, dead-man and emergency stop; run the policy in the shadow."""

    session: Session
    machine: Machine
    bringup: BringupChecklist
    bench: BenchSpec | None

    def run(self) -> float:
        """Write `bringup.json` and the capture; return 0.

        Raises:
            LinkError: nothing is heard from the machine, or a check has failed.
        """
        say = partial(Console().print, highlight=False)
        companions = self.bench.companions(self.machine, self.session) if self.bench else ()
        results = self.bringup.run(self.machine, self.session, say, companions)
        failed = [one.check for one in results if not one.passed]
        if failed:
            raise LinkError(
                f"bring-up: {len(failed)} of {len(results)} checks failed: {', '.join(failed)}; "
                f"their reasons stand above and in {self.session.folder / REPORT}"
            )
        return 0.0
