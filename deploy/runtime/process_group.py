"""The processes of a run, and the settings of those that every run has: bus and policy."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.spec import spec
from deploy.bus.can_bus import CanBus
from deploy.bus.description import BusDescription
from deploy.guard_setup import check_command_rate
from deploy.guidance import LeverGuidance, LeverMap
from deploy.kernel.bus_process import BusProcessConfig
from deploy.kernel.limits import GuardLimits
from deploy.policy.bundle import PolicyBundle
from deploy.policy.policy_process import PolicyProcessConfig
from deploy.runtime.operator_state import OperatorState
from deploy.runtime.process import ChildProcess
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import TargetSpec

log = logging.getLogger(__name__)

PATIENCE_S = 3.0
"""Time that a process gets to end before it is killed. Chosen by hand."""
BUS_PRIORITY, POLICY_PRIORITY = 55, 50
"""Priorities under SCHED_FIFO, 1 to 99. Chosen by hand: the bus before the policy, and both before
twin (45) and commander (40)."""
OPTIONAL = {
    "page": "nothing is shown any more, and where commands are sent they end",
    "camera": "nothing new is seen any more",
    "video": "the page shows no video any more",
    "log": "nothing is recorded any more",
}
"""Processes without which a loop goes on, and the loss that the alarm names."""
END_ORDER = {"policy": 0, "bus": 1, "log": 3}
"""Order in which processes are asked to end; 2 for others. The bus ends after the policy, so that
it can send zero, and the log last, when all has been written."""
OTHERS_END = 2
POLL_S = 0.01
"""Between looks at the state: the cycle of the bus process."""


@dataclass
class ProcessGroup:
    """The processes of a run.

    Attributes:
        memory: Shared by all of them.
        realtime: Whether those that ask for real-time priority get it.
        optional: Processes without which the run goes on, and the loss that the alarm names.
    """

    memory: LoopMemory
    realtime: bool
    optional: Mapping[str, str]
    _running: list[ChildProcess] = field(default_factory=list)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        return {child.name: child.pid for child in self._running}

    def start(
        self, name: str, target: str, arguments: tuple[Any, ...], priority: int | None = None
    ) -> ChildProcess:
        """Start `target` (`module:function`), called as `function(stop, *arguments, memory)`."""
        realtime = priority if self.realtime else None
        arguments = (*arguments, self.memory)
        child = ChildProcess(name, target, arguments, self.memory.files, realtime)
        self._running.append(child)
        return child

    def check(self) -> None:
        """Report once each optional process that has ended unasked.

        Raises:
            LinkError: another process has died.
        """
        for child in list(self._running):
            if child.code is None:
                continue
            self._running.remove(child)
            if child.asked_to_stop:
                continue
            if child.name not in self.optional:
                raise LinkError(
                    f"the {child.name} process has died (exit code {child.code}); its own message stands above"
                )
            loss = self.optional[child.name]
            log.error("ALARM: the %s has ended (exit code %s); %s", child.name, child.code, loss)

    def wait_for_state(
        self, holds: Callable[[OperatorState], bool], patience_s: float
    ) -> OperatorState | None:
        """Return the first state of which `holds` is true; `None` where none comes in time.

        Raises:
            LinkError: a process has died.
        """
        end_s = time.monotonic() + patience_s
        while time.monotonic() < end_s:
            self.check()
            state = self.memory.state.read()
            if state is not None and holds(state):
                return state
            time.sleep(POLL_S)
        return None

    def end(self) -> None:
        """End them all, one after the other."""
        for child in sorted(self._running, key=lambda one: END_ORDER.get(one.name, OTHERS_END)):
            child.end(PATIENCE_S)


@spec
class BusAndPolicySettings:
    """Settings of a run that listens to a machine and runs a policy beside it.

    Attributes:
        wire: The bus.
        dbc: Its description.
        limits: Of the guard.
        guidance: How advice is shown.
        policy: Policy bundle.
        target: Source of the borehole's position.
        realtime: Whether to ask for real-time priority.
    """

    wire: CanBus
    dbc: str
    limits: GuardLimits
    guidance: LeverGuidance
    policy: str
    target: TargetSpec
    realtime: bool

    def check_machine(self, machine: Machine) -> None:
        """Check before any process runs that bus, levers and policy fit the machine.

        Raises:
            CheckpointError: the policy cannot be used on this machine.
            ConfigError: bus description, levers or the guard's limits do not fit the machine.
        """
        check_command_rate(self.limits, machine)
        BusDescription(self.dbc, machine)
        LeverMap(machine)
        PolicyBundle(self.policy, machine)

    def start_processes(
        self,
        group: ProcessGroup,
        machine: Machine,
        target_s: float,
        pitch_rad: float | None,
        needs_page: bool,
    ) -> None:
        """Start bus and policy.

        Args:
            group: The processes of the run.
            machine: The machine.
            target_s: Age of the borehole from which there is no advice.
            pitch_rad: Wanted pitch of the tool, for policies that ask for one.
            needs_page: Whether commands are sent only while the operator's page lives.

        Raises:
            ConfigError: The pitch contradicts the policy's task.
        """
        PolicyBundle(self.policy, machine).check_pitch(pitch_rad)
        bus = BusProcessConfig(self.wire, self.dbc, machine, self.limits, needs_page)
        policy = PolicyProcessConfig(
            machine, self.policy, self.guidance, self.limits.joints_s, target_s, pitch_rad
        )
        group.start("bus", "deploy.kernel.bus_process:run", (bus,), BUS_PRIORITY)
        group.start("policy", "deploy.policy.policy_process:run", (policy,), POLICY_PRIORITY)
