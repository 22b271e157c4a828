"""The control loop of a collection over any link, and a nominal machine on which a plan is tried out first."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from actuators.excite.plan.runner import Runner
from brokk_rl.contracts.link import Link
from brokk_rl.errors import LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.spec import spec

DUE = 0.9
"""Part of a control period after which a new state counts as due: states that come at the machine's
own rate jitter."""
SILENCE_S = 1.0
"""Time without a new state after which a link counts as lost."""


@dataclass(frozen=True)
class Sample:
    """One control period of all runs.

    Attributes:
        t_s: Time on the link's clock.
        q: Measured positions, `(N, J)`.
        u: Commands really sent, in force from `t_s` on, `(N, J)`.
        phase: What each run is doing, `(N,)`; see `runner`.
        segment: Number of its segment, `(N,)`.
        played: Control periods since the program of that segment began, `(N,)`.
        extra: What the link measures besides, each `(N,)`.
    """

    t_s: float
    q: np.ndarray
    u: np.ndarray
    phase: np.ndarray
    segment: np.ndarray
    played: np.ndarray
    extra: Mapping[str, np.ndarray]


def drive(
    link: Link, runner: Runner, machine: Machine, num_runs: int, run_s: float
) -> Iterator[Sample]:
    """Plays the runner's plan over an open link, one sample a control period, until it is done or `run_s` is over.

    What is not needed at once belongs between two samples: the loop sleeps only until the next
    control period is due.

    Raises:
        LinkError: the link fell silent, or said something that makes no sense.
    """
    extra, before = getattr(link, "extra", dict), -np.inf
    shape = (num_runs, machine.num_joints)
    for _ in range(round(run_s / machine.period_s)):
        if runner.done:
            return
        state = _next(link, before + DUE * machine.period_s)
        before, form = state.t_s, np.shape(state.q)
        q = np.asarray(state.q, dtype=np.float64)
        if q.size != np.prod(shape) or not np.isfinite(q).all():
            raise LinkError(
                f"link: expected {shape} finite positions at {state.t_s:.2f} s, got {q}"
            )
        q = q.reshape(shape)
        u = runner.command(q)
        phase, segment, played = runner.phase.copy(), runner.segment.copy(), runner.played
        sent = np.array(link.send(Command(u.reshape(form))).u, dtype=np.float64).reshape(shape)
        runner.took(sent)
        columns = {
            name: np.array(np.broadcast_to(value, (num_runs,)), dtype=np.float64)
            for name, value in extra().items()
        }
        yield Sample(
            t_s=state.t_s,
            q=q.copy(),
            u=sent,
            phase=phase,
            segment=segment,
            played=played,
            extra=columns,
        )


def _next(link: Link, due_s: float) -> JointState:
    """Returns the first state at or after `due_s`, sleeping until then; a simulated machine is always due."""
    given_up = time.monotonic() + SILENCE_S
    while (state := link.read()).t_s < due_s:
        if time.monotonic() > given_up:
            raise LinkError(
                f"link: no state after {state.t_s:.2f} s for {SILENCE_S:g} s; is the machine on, and the bus connected?"
            )
        time.sleep(min(max(due_s - state.t_s, 1e-3), SILENCE_S / 10.0))
    return state


@spec
class NominalMachine:
    """A machine as its file has it: dead time and full speed times command. Needs neither simulator nor torch."""

    @property
    def source(self) -> str:
        """That it is none."""
        return "nominal machine"

    def build(self, machine: Machine, num_runs: int, session: Session) -> Link:
        """Returns a link to `num_runs` of them."""
        return Nominal(machine, num_runs, alone=num_runs == 1)


class Nominal:
    """A machine as its file has it: dead time, full speed times command, stops; `N` of them, or one alone without that axis."""

    def __init__(self, machine: Machine, num_runs: int, alone: bool = False) -> None:
        self._machine, self._t_s, self._form = (
            machine,
            0.0,
            (machine.num_joints,) if alone else (num_runs, machine.num_joints),
        )
        self._q = np.tile(machine.home, (num_runs, 1))
        self._in_flight = np.zeros(
            (round(machine.dead_time_s / machine.period_s) + 1, *self._q.shape)
        )

    def read(self) -> JointState:
        """Returns the true positions."""
        return JointState(self._t_s, self._q.reshape(self._form))

    def send(self, command: Command) -> Command:
        """Moves on by one control period."""
        machine = self._machine
        u = np.nan_to_num(np.asarray(command.u, dtype=float), nan=0.0, posinf=0.0, neginf=0.0).clip(
            -1.0, 1.0
        )
        self._in_flight = np.concatenate([self._in_flight[1:], u.reshape(1, *self._q.shape)])
        self._q = (self._q + self._in_flight[0] * machine.max_speed * machine.period_s).clip(
            machine.lower, machine.upper
        )
        self._t_s += machine.period_s
        return Command(u)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass
