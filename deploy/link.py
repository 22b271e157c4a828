"""The link to a real machine, or its twin, for direct commands: `mode=collect link=can`.

The bus process is the loop's own, guard included. Before the first command the operator has to
release the dead-man and press it. Releasing it stops the machine for as long; any other objection
of the guard ends the run.
"""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from typing import Any, Self

import numpy as np

from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.spec import Positive, spec
from deploy.bus.can_bus import CanBus
from deploy.bus.description import BusDescription
from deploy.guard_setup import check_command_rate
from deploy.kernel.bus_process import BusProcessConfig
from deploy.kernel.guard import GuardState
from deploy.kernel.limits import GuardLimits
from deploy.runtime.operator_state import OperatorControls, OperatorState, RequestedCommand
from deploy.runtime.process import ask_for_priority, give_up_priority
from deploy.runtime.process_group import BUS_PRIORITY, ProcessGroup
from deploy.runtime.shm_layout import LoopMemory

log = logging.getLogger(__name__)

COMMANDER_PRIORITY = 40
"""Of SCHED_FIFO for the process that commands, below that of the bus process. Chosen by hand."""
ANSWER_S = 0.2
"""Time for the bus process to act on a command: 20 of its cycles. Chosen by hand."""
POLL_S = 0.002
"""Between looks for the answer to a command, within a cycle of the bus process."""
WAIT_S = 0.02
"""Between looks while the machine or its operator is waited for."""


@spec
class CanConnection:
    """A machine on a bus, through the guard.

    Attributes:
        wire: The bus.
        dbc: Its description.
        limits: Of the guard.
        patience_s: How long to wait for the machine, and for the operator to press the dead-man.
        realtime: Whether to ask for real-time priority.
    """

    wire: CanBus
    dbc: str
    limits: GuardLimits
    patience_s: Positive
    realtime: bool

    @property
    def source(self) -> str:
        """The bus."""
        return f"machine: {self.wire.interface} {self.wire.channel}"

    def build(self, machine: Machine, num_runs: int, session: Session) -> CanLink:
        """Return the link, not yet opened.

        Raises:
            ConfigError: more than one machine is asked for, commands would be too old for the guard,
                or messages are not protected.
        """
        if num_runs != 1:
            raise ConfigError(f"link=can reaches one machine, not {num_runs}: collect.num_runs=1")
        check_command_rate(self.limits, machine)
        BusDescription(self.dbc, machine).check_protection()
        return CanLink(self, machine)


class CanLink:
    """Open link to the machine through the bus process and its guard; see `brokk_rl.contracts.link.Link`."""

    def __init__(self, can: CanConnection, machine: Machine) -> None:
        self._can, self._machine = can, machine
        self._group: ProcessGroup | None = None
        # The last command in force, from which the guard lets the next one grow.
        self._reached = np.zeros(machine.num_joints)
        self._was_active = False

    def read(self) -> JointState:
        """Return the newest positions and when they were measured."""
        state = self._read_state()
        return JointState(state.q_t_s, np.array(state.q))

    def send(self, command: Command) -> Command:
        """Ask the guard to send a command; return its mean over the coming control period.

        The mean is zero where the guard lets nothing pass.

        Raises:
            LinkError: the guard objects, and not only because the dead-man was released.
        """
        u = np.asarray(command.u, dtype=float)
        self._opened()
        # NaN passes comparisons with limits unnoticed, so it is stopped here.
        if not np.isfinite(u).all():
            raise LinkError(f"link: a command that is no number cannot be sent: {u}")
        # Zero needs no operator: it must always pass.
        if not u.any():
            self._ask(u)
            self._reached = u
            return Command(u.copy())
        self._wait_for_operator()
        asked_s = self._ask(u)
        until_s = asked_s + ANSWER_S
        # The guard's answer must be younger than the question.
        while (state := self._read_state()).t_s <= asked_s:
            if time.monotonic() > until_s:
                raise LinkError("link: the bus process does not answer")
            time.sleep(POLL_S)
        if state.guard is GuardState.LATCHED:
            raise LinkError(f"link: the guard has stopped the machine: {state.cause.value}")
        if state.guard is not GuardState.ACTIVE:
            self._reached = np.zeros_like(u)
            return Command(np.zeros_like(u))
        # The guard limits commands and withholds some joints; the recording needs the real mean.
        most = self._can.limits.max_command
        passed = np.where(state.sent != 0, u.clip(-most, most), 0.0)
        return Command(self._average_growth(passed))

    def extra(self) -> dict[str, float]:
        """Return the oil's temperature where the machine measures it."""
        oil_c = self._read_state().oil_c
        return {"oil_c": oil_c} if np.isfinite(oil_c) else {}

    def __enter__(self) -> Self:
        can, machine = self._can, self._machine
        memory = LoopMemory(machine.num_joints, commands=True)
        self._group = group = ProcessGroup(memory, can.realtime, optional={})
        # Recordings are made before there is a model of this machine: no observer yet.
        # Nobody watches a page, and the operator stands at the machine.
        limits = replace(can.limits, observer=None, vigilance_s=None)
        config = BusProcessConfig(can.wire, can.dbc, machine, limits, needs_page=False)
        try:
            group.start("bus", "deploy.kernel.bus_process:run", (config,), BUS_PRIORITY)
            if group.wait_for_state(lambda state: state.q_t_s > 0, can.patience_s) is None:
                raise LinkError(
                    f"link: no joint positions on {can.source} within {can.patience_s:g} s; is the machine on?"
                )
        # Also for an interruption: a started bus process must not be left behind.
        except BaseException:
            self.__exit__()
            raise
        # Only now: the bus process was started with its own priority.
        if can.realtime:
            ask_for_priority(COMMANDER_PRIORITY)
        self._arm()
        return self

    def __exit__(self, *exc: Any) -> None:
        if self._can.realtime:
            give_up_priority()
        if self._group is not None:
            self._group.end()  # the bus process sends zero before it goes
            self._group.memory.close()
        # Closing twice is harmless.
        self._group = None

    def _ask(self, u: np.ndarray) -> float:
        memory, now_s = self._opened(), time.monotonic()
        assert memory.request is not None
        memory.request.write(RequestedCommand(now_s, u))
        # The switches must not grow old while somebody asks for commands.
        self._arm()
        return now_s

    def _wait_for_operator(self) -> None:
        """Wait, before the first motion, until the guard lets commands pass."""
        if self._was_active:
            return
        until_s = time.monotonic() + self._can.patience_s
        log.warning("release the dead-man, then press and hold it: the machine will move")
        while (state := self._read_state()).guard is not GuardState.ACTIVE:
            if time.monotonic() > until_s:
                raise LinkError(
                    f"link: the machine was not released for motion: {state.trip.value}"
                )
            # Zero commands show the guard that somebody is there, and move nothing.
            self._ask(np.zeros(self._machine.num_joints))
            time.sleep(WAIT_S)
        self._was_active = True

    def _arm(self) -> None:
        now_s = time.monotonic()
        self._opened().controls.write(OperatorControls(now_s, armed=True, armed_t_s=now_s))

    def _average_growth(self, wanted: np.ndarray) -> np.ndarray:
        """Return the mean over a period of commands that grow towards `wanted`, `(J,)`.

        They grow no faster than the guard allows; towards zero they fall at once.
        """
        rate, period_s = self._can.limits.max_rate_1_s, self._machine.period_s
        # Growth begins at the smaller of old and new command of the same sign.
        kept = np.minimum(np.abs(self._reached), np.abs(wanted))
        start = np.where(wanted * self._reached > 0, kept, 0.0)
        grow_s = np.minimum((np.abs(wanted) - start) / rate, period_s)
        end = start + rate * grow_s
        self._reached = np.sign(wanted) * end
        # The mean of a ramp and a constant after it.
        return np.sign(wanted) * (end - rate * grow_s**2 / (2.0 * period_s))

    def _read_state(self) -> OperatorState:
        state = self._opened().state.read()
        if state is None:
            raise LinkError("link: nothing has come from the bus yet")
        return state

    def _opened(self) -> LoopMemory:
        if self._group is None:
            raise LinkError("link: it is not open; use it in a `with` block")
        return self._group.memory
