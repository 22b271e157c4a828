"""What listens to a machine and lets a policy run along: a bus and a policy process, and the processes beside them."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from deploy.bus.can_bus import BusReplay, CanBus
from deploy.bus.description import BusDescription
from deploy.guard.limits import GuardLimits
from deploy.guidance import LeverGuidance, LeverMap
from deploy.policy.bundle import PolicyBundle
from deploy.policy.policy_process import PolicyProcessConfig
from deploy.runtime.bus_process import BusProcessConfig
from deploy.runtime.process import ChildProcess
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import TargetSpec

log = logging.getLogger(__name__)

PATIENCE_S = 3.0
BUS_PRIORITY, POLICY_PRIORITY = 55, 50
OPTIONAL = {"page": "nothing is shown any more", "camera": "nothing new is seen any more"}
"""Processes without which the loop goes on, and what is lost with them."""
ENDED = {"policy": 0, "bus": 1, "log": 3}
"""In which order they are asked to: the policy before the bus, so that it can say goodbye, and the
log when all has been said."""


@dataclass
class ProcessGroup:
    """The processes of a run.

    Attributes:
        memory: What they share.
        realtime: Whether those that ask for real-time priority get it.
    """

    memory: LoopMemory
    realtime: bool
    _running: list[ChildProcess] = field(default_factory=list)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        return {child.name: child.pid for child in self._running}

    def start(
        self, name: str, target: str, arguments: tuple[Any, ...], priority: int | None = None
    ) -> None:
        """Starts `target` (`module:function`), called as `function(stop, *arguments, memory)`."""
        realtime = priority if self.realtime else None
        self._running.append(
            ChildProcess(name, target, (*arguments, self.memory), self.memory.files, realtime)
        )

    def check(self) -> None:
        """Says once which of the optional ones have ended.

        Raises:
            LinkError: another one has died.
        """
        for child in list(self._running):
            if child.code is None:
                continue
            self._running.remove(child)
            if child.name in OPTIONAL:
                log.error(
                    "ALARM: the %s has ended (exit code %s); %s",
                    child.name,
                    child.code,
                    OPTIONAL[child.name],
                )
            else:
                raise LinkError(
                    f"the {child.name} process has died (exit code {child.code}); what it said stands above"
                )

    def end(self) -> None:
        """Ends them all, one after the other."""
        for child in sorted(self._running, key=lambda child: ENDED.get(child.name, 2)):
            child.end(PATIENCE_S)


@spec
class BusAndPolicySettings:
    """Whatever listens to a machine and lets a policy run along.

    Attributes:
        wire: The bus.
        dbc: Its description.
        limits: Of the guard.
        guidance: How advice is shown.
        policy: Policy bundle.
        target: Where the borehole is.
        realtime: Whether to ask for real-time priority.
    """

    wire: CanBus | BusReplay
    dbc: str
    limits: GuardLimits
    guidance: LeverGuidance
    policy: str
    target: TargetSpec
    realtime: bool

    def refuse(self, machine: Machine) -> None:
        """Looks through what the processes will need, before any of them runs.

        Raises:
            CheckpointError: the policy cannot be used on this machine.
            ConfigError: bus description or levers do not fit the machine.
        """
        BusDescription(self.dbc, machine)
        LeverMap(self.guidance.levers or machine.levers, machine)
        PolicyBundle(self.policy, machine)

    def listen(
        self, children: ProcessGroup, machine: Machine, target_s: float, pitch_rad: float | None
    ) -> None:
        """Starts bus and policy.

        Args:
            children: Where to.
            machine: The machine.
            target_s: Age of the borehole from which there is no advice.
            pitch_rad: Wanted pitch of the tool, for policies that ask for one.
        """
        setting = BusProcessConfig(self.wire, self.dbc, machine, self.limits)
        counsel = PolicyProcessConfig(
            machine, self.policy, self.guidance, self.limits.joints_s, target_s, pitch_rad
        )
        children.start("bus", "deploy.runtime.bus_process:run", (setting,), BUS_PRIORITY)
        children.start("policy", "deploy.policy.policy_process:run", (counsel,), POLICY_PRIORITY)
