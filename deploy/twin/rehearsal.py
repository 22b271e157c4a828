"""Rehearsal of the bring-up: a twin, and a scripted person who does what the checklist asks.

The person leaves the machine at rest while the checklist listens. Then they go round: dead-man,
emergency stop, one joint after the other, each both ways. They can fail one chosen check, to see that it is noticed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.spec import Positive, spec
from deploy.runtime.shm_layout import LoopMemory
from deploy.twin.bench import Bench
from deploy.twin.faults import request_fault
from deploy.twin.remote import RadioRemote

CHECKS = ("bus", "positions", "dead-man", "e-stop", "joints", "shadow")
"""Checks that can be failed."""
SENSORS = {"swapped": "swapped", "turned": "mirrored", "doubled": "doubled", "offset": "offset"}
"""Faults of sensors that the bring-up names, and what each is called by the twin."""
PART_S = 4.8
"""Part of a round for each joint. Chosen by hand: a joint rests for a second before each motion,
longer than the dead time."""
PUSH = 0.6
"""Deflection of the levers, of full. Chosen by hand: above any dead band."""
PRESSES_S = {"dead-man": (0.2, 0.8), "e-stop": (1.2, 1.6)}
"""When in a round a switch is pressed and released. No joint moves meanwhile."""
JOINTS_S = 2.2
"""When in a round the first joints are moved."""
PUSHES_S = ((1.0, 1.6, -PUSH), (3.4, 4.0, PUSH))
"""Beginning, end and deflection of the motions in a part. Upwards first: downwards, the tool of the
simulated machine touches the ground, and a joint that is pushed back has no dead time."""
SOUND_ROUNDS = 2
"""Rounds after which a person who fails the shadow run spoils it: the joints have been seen by then."""
SPOILED_S = 1.0
"""Time for which messages or positions are spoiled to fail a check that needs it. Chosen by hand."""


@spec
class RehearsalBench(Bench):
    """Twin and scripted person in place of a machine and its operator.

    The twin needs a fault port, for the emergency stop.

    Attributes (and those of `Bench`):
        rest_s: Time after the first positions for which the person leaves the machine at rest.
        fails: Check that the person fails, or fault of a sensor (`SENSORS`); `null`: none.
    """

    rest_s: Positive
    fails: str | None

    def check(self) -> None:
        if self.twin.remote or self.twin.fault_port is None:
            raise ConfigError(
                "bench=operator: expected twin.remote=false and a twin.fault_port, since the person holds the remote "
                "and presses the emergency stop"
            )
        known = (*CHECKS, *SENSORS)
        if self.fails is not None and self.fails not in known:
            raise ConfigError(
                f"bench.fails: there is no check '{self.fails}'; {list_choices(self.fails, known)}"
            )

    def find_person(self, machine: Machine, session: Session) -> ScriptedPerson:
        """See `Bench`."""
        assert self.twin.fault_port is not None
        return ScriptedPerson(machine, self.fails, self.rest_s, self.twin.fault_port)


class ScriptedPerson:
    """Hands of the person, as a function of the time since they began.

    Args:
        machine: Its levers and joints.
        fails: Check that the person fails; `None`: none.
        rest_s: Time after the first positions for which the machine is left at rest.
        port: Of the twin's faults.

    Attributes:
        round_s: Length of a round.
    """

    def __init__(self, machine: Machine, fails: str | None, rest_s: float, port: int) -> None:
        self._machine, self._fails, self._rest_s, self._port = machine, fails, rest_s, port
        self.round_s = JOINTS_S + machine.num_joints * PART_S

    def holds(self, switch: str, t_s: float) -> bool:
        """Return whether a switch of `PRESSES_S` is pressed at `t_s`; before 0 none is."""
        begin_s, end_s = PRESSES_S[switch]
        return t_s >= 0 and switch != self._fails and begin_s <= t_s % self.round_s < end_s

    def command(self, t_s: float) -> np.ndarray:
        """Return the commands that the levers stand for, `(J,)`."""
        u = np.zeros(self._machine.num_joints)
        since_s = t_s % self.round_s - JOINTS_S
        if t_s < 0 or since_s < 0:
            return u
        for begin_s, end_s, push in PUSHES_S:
            if begin_s <= since_s % PART_S < end_s:
                u[int(since_s / PART_S)] = push
        if self._fails == "joints":
            u[-1] = 0.0
        return u

    def move(self, remote: RadioRemote, t_s: float) -> None:
        """Move the remote's levers and hold its dead-man as at `t_s`."""
        remote.move_levers(self.command(t_s))
        remote.deadman = self.holds("dead-man", t_s)

    def spoil(self, t_s: float) -> dict[str, object] | None:
        """Return the fault that the person asks the twin for at `t_s`, if any."""
        if self._fails == "bus":
            return {"fault": "corrupt", "message": "MachineStatus", "seconds": SPOILED_S}
        if self._fails == "positions":
            return {"fault": "drift", "seconds": self._rest_s}
        if self._fails in SENSORS:
            return {"fault": SENSORS[self._fails]}
        if self._fails == "shadow" and t_s > SOUND_ROUNDS * self.round_s:
            return {"fault": "invalid"}
        return None

    def hold_remote(self, remote: RadioRemote, cycles: Iterator[float], memory: LoopMemory) -> None:
        """See `RemoteHolder`; at rest until the loop has listened, then round by round."""
        begun_s, pressed, spoiled = np.inf, False, False
        for now_s in cycles:
            state = memory.state.read()
            if state is not None and state.q_t_s > 0 and begun_s == np.inf:
                begun_s = now_s + self._rest_s
            t_s = now_s - begun_s
            self.move(remote, t_s)
            # A busy twin may not answer in time: then the person tries again.
            with contextlib.suppress(TimeoutError):
                if self.holds("e-stop", t_s) and not pressed:
                    begin_s, end_s = PRESSES_S["e-stop"]
                    request_fault(self._port, {"fault": "estop", "seconds": end_s - begin_s})
                pressed = self.holds("e-stop", t_s)
                if begun_s < np.inf and not spoiled and (fault := self.spoil(t_s)):
                    request_fault(self._port, fault)
                    spoiled = True
