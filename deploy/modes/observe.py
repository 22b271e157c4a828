"""`brokk mode=observe`: makes the observer's file of a machine, and counts its alarms."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import spec
from deploy.observer_file import ObserverCalibration


@spec
class ObserveMode:
    """Make the observer's file from a fitted valve model and recordings, or count its alarms."""

    session: Session
    machine: Machine
    actuator: Any
    observe: ObserverCalibration

    def run(self) -> None:
        """Write `observer.json`, or `observed.json` where such a file is given.

        Raises:
            ConfigError: the model or the file is not one of this machine.
            RecordingError: nothing matches, or a recording cannot be read.
        """
        console = Console()
        for line in self.observe.run(self.machine, self.actuator, self.session):
            console.print(line, highlight=False)
