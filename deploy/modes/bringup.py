"""`brokk mode=bringup`: a checklist that runs on a machine before anybody trusts the loop on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from rich.console import Console

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec


class Found(Protocol):
    """What a check has found."""

    check: str
    passed: bool


class Checklist(Protocol):
    """What knows the checks."""

    def run(
        self, machine: Machine, session: Session, say: Callable[[str], None]
    ) -> Sequence[Found]:
        """Runs them; `say` tells the operator what to do."""
        ...


@spec
class BringupMode:
    """Checks bus, signs, limits, latency, dead-man and emergency stop with the operator, and lets the policy run in the shadow."""

    session: Session
    machine: Machine
    bringup: Checklist

    def run(self) -> float:
        """Writes `bringup.json` and the capture; returns the number of checks that failed.

        Raises:
            LinkError: nothing is heard from the machine.
        """
        console = Console()
        found = self.bringup.run(
            self.machine, self.session, lambda text: console.print(text, highlight=False)
        )
        return float(sum(not one.passed for one in found))
