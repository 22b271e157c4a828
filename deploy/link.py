"""The link to a real machine, or its twin, for whoever commands it directly: `mode=collect link=can`.

The bus process is the loop's own, guard included. Before the first command the operator has to
release the dead-man and press it; letting go of it stops the machine for as long, anything else
that the guard objects to ends the run.
"""

from __future__ import annotations

import logging
import time
from typing import Any, Self

import numpy as np

from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.spec import spec
from deploy.bus.can_bus import CanBus
from deploy.guard.guard import GuardState
from deploy.guard.limits import GuardLimits
from deploy.runtime.bus_process import BusProcessConfig
from deploy.runtime.operator_state import read_snapshot
from deploy.runtime.process import ChildProcess, ask_for_priority, give_up_priority
from deploy.runtime.process_group import BUS_PRIORITY, PATIENCE_S
from deploy.runtime.shm_layout import LoopMemory

log = logging.getLogger(__name__)

COMMANDER_PRIORITY = 40
"""Of the process that commands, below that of the bus."""
ANSWER_S = 0.2
"""Time for the bus process to act on a command."""


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
    patience_s: float
    realtime: bool

    @property
    def source(self) -> str:
        """The bus."""
        return f"machine: {self.wire.interface} {self.wire.channel}"

    def build(self, machine: Machine, num_runs: int, session: Session) -> CanLink:
        """Returns the link, not yet opened.

        Raises:
            ConfigError: more than one machine is asked for.
        """
        if num_runs != 1:
            raise ConfigError(f"link=can reaches one machine, not {num_runs}: collect.num_runs=1")
        return CanLink(self, machine)


class CanLink:
    """The link at work; see `brokk_rl.contracts.link.Link`."""

    def __init__(self, can: CanConnection, machine: Machine) -> None:
        self._can, self._machine = can, machine
        self._memory: LoopMemory | None = None
        self._child: ChildProcess | None = None
        self._reached = np.zeros(machine.num_joints)
        self._was_active = False

    def read(self) -> JointState:
        """Returns the newest positions and when they were measured."""
        state = self._state()
        return JointState(float(state["q_t_s"]), np.array(state["q"]))

    def send(self, command: Command) -> Command:
        """Asks the guard to send a command; returns its mean over the coming control period, zero where nothing was let pass.

        Raises:
            LinkError: the guard objects, and not only because the dead-man was released.
        """
        memory, u = self._opened(), np.asarray(command.u, dtype=float)
        if not np.isfinite(u).all():
            raise LinkError(f"link: a command that is no number cannot be sent: {u}")
        if not u.any():
            self._ask(u)
            self._reached = u
            return Command(u.copy())
        self._wait_for_operator()
        asked_s = self._ask(u)
        until_s = asked_s + ANSWER_S
        while float((state := self._state())["t_s"]) <= asked_s:
            if time.monotonic() > until_s:
                raise LinkError("link: the bus process does not answer")
            time.sleep(0.002)
        if int(state["guard"]) == GuardState.LATCHED.value:
            safety = read_snapshot(memory).safety
            raise LinkError(
                f"link: the guard has stopped the machine: {safety.cause if safety else 'unknown'}"
            )
        if int(state["guard"]) != GuardState.ACTIVE.value:
            self._reached = np.zeros_like(u)
            return Command(np.zeros_like(u))
        passed = np.where(
            np.array(state["sent"]) != 0,
            u.clip(-self._can.limits.max_command, self._can.limits.max_command),
            0.0,
        )
        return Command(self._mean(passed))

    def extra(self) -> dict[str, float]:
        """Returns the oil's temperature where the machine tells it."""
        oil_c = float(self._state()["oil_c"])
        return {"oil_c": oil_c} if np.isfinite(oil_c) else {}

    def __enter__(self) -> Self:
        can, machine = self._can, self._machine
        self._memory = LoopMemory.new(machine.num_joints, commands=True)
        setting = BusProcessConfig(can.wire, can.dbc, machine, can.limits)
        priority = BUS_PRIORITY if can.realtime else None
        self._child = ChildProcess(
            "bus",
            "deploy.runtime.bus_process:run",
            (setting, self._memory),
            self._memory.files,
            priority,
        )
        until_s = time.monotonic() + can.patience_s
        try:
            while (state := self._memory.state.read()) is None or float(state["q_t_s"]) == 0.0:
                if self._child.code is not None:
                    raise LinkError(
                        f"link: the bus process has died (exit code {self._child.code})"
                    )
                if time.monotonic() > until_s:
                    raise LinkError(
                        f"link: no joint positions on {can.source} within {can.patience_s:g} s; is the machine on?"
                    )
                time.sleep(0.02)
        except BaseException:
            self.__exit__()
            raise
        if can.realtime:
            ask_for_priority(COMMANDER_PRIORITY)
        self._arm()
        return self

    def __exit__(self, *exc: Any) -> None:
        if self._can.realtime:
            give_up_priority()
        if self._child is not None:
            self._child.end(PATIENCE_S)  # sends zero before it goes
        if self._memory is not None:
            self._memory.close()
        self._child = self._memory = None

    def _ask(self, u: np.ndarray) -> float:
        memory = self._opened()
        assert memory.request is not None
        request, now_s = memory.request.new(), time.monotonic()
        request["t_s"], request["u"] = now_s, u
        memory.request.write(request)
        return now_s

    def _wait_for_operator(self) -> None:
        """Waits, before the first motion, until the guard lets commands pass."""
        if self._was_active:
            return
        until_s = time.monotonic() + self._can.patience_s
        log.warning("release the dead-man, then press and hold it: the machine will move")
        while int(self._state()["guard"]) != GuardState.ACTIVE.value:
            if time.monotonic() > until_s:
                safety = read_snapshot(self._opened()).safety
                raise LinkError(
                    f"link: the machine was not released for motion: {safety.trip if safety else 'no state'}"
                )
            self._ask(np.zeros(self._machine.num_joints))
            time.sleep(0.02)
        self._was_active = True

    def _arm(self) -> None:
        controls = self._opened().controls.new()
        controls["t_s"], controls["armed"] = time.monotonic(), True
        self._opened().controls.write(controls)

    def _mean(self, wanted: np.ndarray) -> np.ndarray:
        """Returns the mean over a period of commands that grow towards `wanted`, `(J,)`, no faster than the guard allows."""
        rate, period_s = self._can.limits.max_rate_1_s, self._machine.period_s
        start = np.where(
            wanted * self._reached > 0, np.minimum(np.abs(self._reached), np.abs(wanted)), 0.0
        )
        grow_s = np.minimum((np.abs(wanted) - start) / rate, period_s)
        end = start + rate * grow_s
        self._reached = np.sign(wanted) * end
        return np.sign(wanted) * (end - rate * grow_s**2 / (2.0 * period_s))

    def _state(self) -> Any:
        state = self._opened().state.read()
        if state is None:
            raise LinkError("link: nothing has come from the bus yet")
        return state

    def _opened(self) -> LoopMemory:
        if self._memory is None:
            raise LinkError("link: it is not open; use it in a `with` block")
        return self._memory
