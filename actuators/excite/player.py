"""Playing a plan on `N` machines at once: guards, state machine, control loop.

    approach --arrived or given up--> rest --over--> play --program over--> approach of the next
                                                    |  ^
                    stop near, segment with `home`  v  |  program passes zero
                                                   return --arrived--> wait

Approaches run in closed loop, programs in open loop, both within the guards. The clock of a
program keeps running while its joint is brought home, so a segment lasts as long as its program.
"""

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
from annotated_types import Interval

from actuators.excite.schedule import (
    APPROACH_LEAST,
    APPROACH_LEVEL,
    APPROACH_SETTLE_S,
    ARRIVED,
    REST_S,
    ExcitationPlan,
    estimate_approach_s,
)
from brokk_rl.commands import SpeedProgram, find_rest, read_targets
from brokk_rl.contracts.link import Link
from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine, mask_exclusive_joints
from brokk_rl.session import Session
from brokk_rl.signals import Command, JointState
from brokk_rl.spec import Positive, spec


@spec
class CommandGuards:
    """Bounds on the commands of a collection; they do not replace the machine's own guard.

    Attributes:
        max_command: Largest command.
        max_tool_speed_m_s: Largest speed of the tool point, predicted from the machine's nominal
            speeds; commands that would exceed it are scaled down together. `null`: no bound. Needs
            a machine whose geometry is known.
    """

    max_command: Annotated[float, Interval(gt=0, le=1)]
    max_tool_speed_m_s: Positive | None


def measure_tool_speed(machine: Machine, q: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the speed of the tool point, `(N,)` m/s, at `q` and joint speeds `speed`, each `(N, J)`."""
    jacobian = compute_tool_kinematics(machine, q).jacobian
    return np.linalg.norm((jacobian @ speed[..., None])[..., 0], axis=-1)


log = logging.getLogger(__name__)

SPEED_WINDOW = 4
"""Control periods over which the measured speed is taken; one period alone would be mostly
noise."""


PATIENCE = 3.0
"""An approach is given up after this many times its nominal duration; chosen by hand."""
APPROACH, REST, PLAY, RETURN, WAIT, DONE = range(6)
"""What a run is doing."""
MOVES = np.array([True, False, False, True, False, False])
"""By phase: on its way to the start of a segment."""
INSIDE = np.array([False, False, True, True, True, False])
"""By phase: the clock of the program runs."""


class PlanPlayer:
    """The state machine, over all runs at once.

    Args:
        plan: Segments of each run.
        machine: The machine.
        guards: Limits of all commands.

    Attributes:
        phase: `APPROACH`, `REST`, … of each run, `(N,)`.
        segment: Number of the segment of each run, `(N,)`.
    """

    level = logging.WARNING
    """Level of the message that the way to a start pose was given up."""

    def __init__(self, plan: ExcitationPlan, machine: Machine, guards: CommandGuards) -> None:
        self._plan, self._machine, self._guards = plan, machine, guards
        if guards.max_tool_speed_m_s is not None and not machine.has_bodies:
            raise ConfigError(
                f"collect.guards.max_tool_speed_m_s: the geometry of machine '{machine.name}' is not known; give null, or bodies "
                "and tool_m in its file"
            )
        count = len(plan.runs)
        self._rows = np.arange(count)
        self._travel, self._speed = machine.upper - machine.lower, machine.max_speed
        self._last = np.array([len(run) - 1 for run in plan.runs])
        self._pack()
        delay = max(1, round(machine.dead_time_s / machine.period_s))
        self._in_flight = np.zeros((count, delay, machine.num_joints))
        self._seen: np.ndarray | None = None
        self._turned = np.ones((count, machine.num_joints))
        self.phase, self.segment = np.full(count, APPROACH), np.zeros(count, dtype=int)
        self._index, self._left = np.zeros(count, dtype=int), np.zeros(count, dtype=int)

    def command(self, q: np.ndarray) -> np.ndarray:
        """Return the commands of the coming period, `(N, J)`, at measured positions `q`, `(N, J)`."""
        if self._seen is None:
            self._seen = np.repeat(q[None], SPEED_WINDOW + 1, 0)
            self._left = self._patience(q)
        self._seen = np.concatenate([self._seen[1:], q[None]])
        slow, fast = self._rest_positions(q)
        target = self._start[self._rows, self.segment]
        error = target - slow
        far = np.abs(error) > ARRIVED * self._travel
        program = self._program[self._rows, self._index]
        before = self._program[self._rows, np.maximum(self._index - 1, 0)]
        self._advance(q, far, ((program * before <= 0) & (before != 0)).any(1))
        program = program * (self.phase == PLAY)[:, None]
        low, high = self._low[self._rows, self.segment], self._high[self._rows, self.segment]
        # Kept until the program passes zero.
        self._turned = np.where(program * before > 0, self._turned, 1.0)
        demand = program * self._turned
        leaving = (demand < 0) & (np.minimum(slow, fast) < low)
        leaving |= (demand > 0) & (np.maximum(slow, fast) > high)
        home = self._goes_home[self._rows, self.segment]
        self._turned = np.where(leaving & ~home[:, None], -self._turned, self._turned)
        sent_home = leaving.any(1) & home
        if sent_home.any():
            self.phase[sent_home] = RETURN
            self._left[sent_home] = self._patience(q)[sent_home]
        moving = MOVES[self.phase][:, None]
        u = np.where(moving, self._toward(error, far), program * self._turned)
        return self._guarded(u, slow)

    def took(self, u: np.ndarray) -> None:
        """Take the commands that were really sent, `(N, J)`, and advance by one control period."""
        self._in_flight = np.concatenate([self._in_flight[:, 1:], u[:, None]], 1)
        inside = INSIDE[self.phase]
        self._index += inside
        self._left -= 1
        over = inside & (self._index >= self._end[self._rows, self.segment])
        self.phase[over] = np.where(self.segment[over] < self._last[over], APPROACH, DONE)
        following = over & (self.phase == APPROACH)
        self.segment[following] += 1
        self._index[over] = np.minimum(self._index[over], self._program.shape[1] - 1)
        if following.any():
            assert self._seen is not None
            self._left[following] = self._patience(self._seen[-1])[following]

    @property
    def done(self) -> bool:
        """True when every run has played all its segments."""
        return bool((self.phase == DONE).all())

    def _advance(self, q: np.ndarray, far: np.ndarray, at_zero: np.ndarray) -> None:
        """Go on from approach to rest to play, and from return to wait to play, where a program passes zero."""
        phase, late = self.phase, self._left <= 0
        moving = MOVES[phase]
        arrived = moving & (~far.any(1) | late)
        for n in np.flatnonzero(arrived & far.any(1)):
            names = self._machine.joint_names
            joints = ", ".join(f"{names[j]} ({q[n, j]:.3f})" for j in np.flatnonzero(far[n]))
            name = self._plan.runs[n][self.segment[n]].name
            text = "run %d: way to the start of %s given up, out of place: %s; going on from there"
            log.log(self.level, text, n, name, joints)
        phase[arrived] += 1  # rest, or wait
        rest = round(REST_S / self._machine.period_s)
        self._left[arrived] = rest
        rested = ~arrived & late
        phase[rested & (phase == REST)] = PLAY
        phase[rested & (phase == WAIT) & at_zero] = PLAY

    def _rest_positions(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the joints would come to rest if the commands ended now, each `(N, J)`.

        First from the commands on their way at the machine's nominal speeds, then from the measured
        speed: whichever reaches further counts at the stops, so that a machine faster than its file
        is caught too.
        """
        assert self._seen is not None
        period_s = self._machine.period_s
        measured = (q - self._seen[0]) / (SPEED_WINDOW * period_s)
        nominal = self._in_flight.sum(1) * self._speed * period_s
        return q + nominal, q + measured * self._machine.dead_time_s

    def _toward(self, error: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Return commands toward the targets: ordinary joints first, then exclusive ones."""
        exclusive = self._machine.is_exclusive
        size = np.abs(error) / (self._speed * APPROACH_SETTLE_S)
        size = size.clip(APPROACH_LEAST, APPROACH_LEVEL)
        first = far[:, ~exclusive].any(1)
        return np.sign(error) * size * far * mask_exclusive_joints(exclusive, ~first)

    def _guarded(self, u: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the commands within the guards; exclusive joints wait for the others."""
        exclusive = self._machine.is_exclusive
        together = (u[:, ~exclusive] != 0).any(1)
        most = self._guards.max_command
        u = np.where(exclusive & together[:, None], 0.0, u).clip(-most, most)
        limit_m_s = self._guards.max_tool_speed_m_s
        if limit_m_s is None:
            return u
        speed_m_s = measure_tool_speed(self._machine, q, u * self._speed)
        scale = limit_m_s / np.maximum(speed_m_s, 1e-9)
        return u * np.minimum(1.0, scale)[:, None]

    def _patience(self, q: np.ndarray) -> np.ndarray:
        """Return the periods after which the approach from `q` is given up, `(N,)`."""
        start = self._start[self._rows, self.segment]
        needed_s = estimate_approach_s(self._machine, q, start)
        return np.ceil(PATIENCE * needed_s / self._machine.period_s).astype(int)

    def _pack(self) -> None:
        """Pack segments into arrays: programs end to end, `(N, L, J)`, the rest `(N, S, …)`."""
        runs, machine = self._plan.runs, self._machine
        shape = len(runs), max(len(run) for run in runs)
        programs = [np.concatenate([segment.u for segment in run]) for run in runs]
        self._program = np.zeros((len(runs), max(map(len, programs)), machine.num_joints))
        self._start, self._end = np.tile(machine.home, (*shape, 1)), np.zeros(shape, dtype=int)
        self._goes_home, margin = np.zeros(shape, dtype=bool), np.zeros((*shape, 1))
        for n, run in enumerate(runs):
            self._program[n, : len(programs[n])] = programs[n]
            for i, segment in enumerate(run):
                self._start[n, i], margin[n, i] = segment.start, segment.stop_margin
                self._goes_home[n, i] = segment.stops == "home"
            self._end[n, : len(run)] = np.cumsum([len(segment.u) for segment in run])
        self._low = machine.lower + margin * self._travel
        self._high = machine.upper - margin * self._travel


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
        phase: Phase of each run, `(N,)`: `APPROACH`, `REST`, …
        segment: Number of its segment, `(N,)`.
        extra: Further measurements of the link, each `(N,)`.
    """

    t_s: float
    q: np.ndarray
    u: np.ndarray
    phase: np.ndarray
    segment: np.ndarray
    extra: Mapping[str, np.ndarray]


def drive(
    link: Link, runner: PlanPlayer, machine: Machine, num_runs: int, run_s: float
) -> Iterator[Sample]:
    """Play the plan over an open link, one sample a control period, until it or `run_s` ends.

    Slow work belongs between two samples: the loop sleeps only until the next
    control period is due.

    Raises:
        LinkError: the link fell silent, or said something that makes no sense.
    """
    if machine.interface == "torque":
        raise ConfigError(
            f"machine '{machine.name}' is commanded by torque: programs of speeds do not drive it; record it with its own "
            "controller, and read its logs with mode=import"
        )
    extra, before = getattr(link, "extra", dict), -np.inf
    program = SpeedProgram(machine)
    shape = (num_runs, machine.num_joints)
    for _ in range(round(run_s / machine.period_s)):
        if runner.done:
            return
        state = _wait_for_state(link, before + DUE * machine.period_s)
        before, form = state.t_s, np.shape(state.q)
        q = np.asarray(state.q, dtype=np.float64)
        if q.size != np.prod(shape) or not np.isfinite(q).all():
            raise LinkError(
                f"link: expected {shape} finite positions at {state.t_s:.2f} s, got {q}"
            )
        q = q.reshape(shape)
        u, speeds = program.command(runner.command(q), q)
        phase, segment = runner.phase.copy(), runner.segment.copy()
        sent = np.array(link.send(Command(u.reshape(form))).u, dtype=np.float64).reshape(shape)
        runner.took(speeds if machine.interface == "position" else sent)
        columns = {}
        for name, value in extra().items():
            columns[name] = np.array(np.broadcast_to(value, (num_runs,)), dtype=np.float64)
        yield Sample(state.t_s, q.copy(), sent, phase, segment, columns)


def _wait_for_state(link: Link, due_s: float) -> JointState:
    """Return the first state at or after `due_s`, sleeping until then.

    A simulated machine is always due.
    """
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
    """A machine as its file describes it: dead time and full speed times command."""

    @property
    def source(self) -> str:
        """That it is none."""
        return "nominal machine"

    def build(self, machine: Machine, num_runs: int, session: Session) -> Link:
        """Return a link to `num_runs` of them."""
        return NominalLink(machine, num_runs, alone=num_runs == 1)


class NominalLink:
    """Link to `N` nominal machines: dead time, full speed times command (or its target), stops.

    One machine alone has no axis `N`.
    """

    def __init__(self, machine: Machine, num_runs: int, alone: bool = False) -> None:
        self._machine, self._t_s = machine, 0.0
        self._form = (machine.num_joints,) if alone else (num_runs, machine.num_joints)
        self._q = np.tile(machine.home, (num_runs, 1))
        on_their_way = round(machine.dead_time_s / machine.period_s) + 1
        self._in_flight = np.tile(find_rest(self._q, machine), (on_their_way, 1, 1))

    def read(self) -> JointState:
        """Return the true positions."""
        return JointState(self._t_s, self._q.reshape(self._form))

    def send(self, command: Command) -> Command:
        """Move on by one control period."""
        machine = self._machine
        u = np.nan_to_num(np.asarray(command.u, dtype=float), posinf=0.0, neginf=0.0)
        u = u.clip(-1.0, 1.0)
        self._in_flight = np.concatenate([self._in_flight[1:], u.reshape(1, *self._q.shape)])
        step = self._in_flight[0] * machine.max_speed * machine.period_s
        if machine.interface == "position":
            step = read_targets(self._in_flight[0], machine) - self._q
        self._q = (self._q + step).clip(machine.lower, machine.upper)
        self._t_s += machine.period_s
        return Command(u)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: Any) -> None:
        pass
