"""Where simulated operators do trials on the twin: the real time's own parts, one process, and a clock that runs as fast as it can.

Each trial has a twin (`deploy.twin`: plant, gateway, its messages), a remote, and of the loop the
receiver and the adviser with policy and lever display. Frames go through the bus description both
ways: coded, counted, checked. Not simulated are a bus with latencies, processes and their
scheduling, guard and page. A simulated person sees an advice in the control period in which it is
made, a real one some tens of milliseconds later.
Axes: `N` trials, `J` joints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from brokk_rl.contracts.link import Connection
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.progress import track_items
from brokk_rl.record import Recording
from brokk_rl.session import Session
from brokk_rl.spec import Index, spec
from deploy.bus.can_bus import CanBus, CanFrame
from deploy.bus.description import BusDescription
from deploy.guidance import LeverGuidance, LeverMap, find_full_angles_rad
from deploy.kernel.guard import GuardDecision, GuardState, GuardTrip
from deploy.kernel.limits import GuardLimits
from deploy.kernel.receiver import BusReceiver
from deploy.policy.bundle import PolicyBundle
from deploy.policy.policy_process import PolicyAdviser, PolicyProcessConfig
from deploy.twin.faults import FaultPort
from deploy.twin.remote import RadioRemote
from deploy.twin.twin import CYCLE_S, RunningTwin, Twin
from study.trial_contract import OperatorModel, OperatorView, TrialBatch
from study.twin_pool import Crew, count_cores

BEGIN_S = 1000.0
"""Start of the simulated clock, s; large, so that no small number passes for a time."""
BEFORE_S = 1.0
"""For which everything runs before a trial begins: the policy's history is full then."""
NO_BUS = CanBus(interface="virtual", channel="none", bitrate=None, port=None, hops=None)
TARGET = np.dtype([("t_s", float), ("center_in_base_m", float, (3,))])


@spec
class Twins:
    """The twin, with gateway, messages, receiver, policy and lever display of the loop, as fast as it computes.

    Attributes:
        plant: The machine beside its block.
        dbc: Description of the bus.
        limits: Plausibility limits of the loop.
        guidance: How advice is shown.
        policy: Policy bundle that advises.
        settle_s: Time for which a recording goes on after the insertion.
        num_processes: Processes that the twins are spread over; 0: one a core.
    """

    plant: Connection
    dbc: str
    limits: GuardLimits
    guidance: LeverGuidance
    policy: str
    settle_s: float
    num_processes: Index

    def run(
        self, machine: Machine, session: Session, trials: TrialBatch, operators: OperatorModel
    ) -> list[Recording]:
        """See `study.trial_contract.TrialGround`."""
        num, nothing = len(trials.q), np.full(machine.num_joints, np.nan)
        places = []
        for n in range(num):
            places.append(
                (
                    # A stream for each trial: results do not depend on how trials are spread over
                    # processes.
                    session.stream(f"twin {n}"),
                    trials.q[n],
                    trials.rim_in_base_m[n],
                    bool(trials.guided[n]),
                )
            )
        # Never more processes than twins.
        processes = min(self.num_processes or count_cores(), num)
        # Dealt out in turn: long and short trials mix, so that processes end at about the same
        # time.
        rows = [np.arange(first, num, processes) for first in range(processes)]
        parts = []
        for mine in rows:
            parts.append((self, machine, session, [places[n] for n in mine]))
        steps, left = (
            round(trials.limit_s / machine.period_s),
            np.full(num, round(self.settle_s / machine.period_s)),
        )
        # Trials end at different times; those that ended take no more steps.
        running = np.ones(num, bool)
        with Crew("study.twins:make_desks", parts, rows, num) as crew:
            now, found = crew.ask("seen", running), dict[int, Recording]()
            for _ in track_items(range(steps), "simulated operators at the twin"):
                # Operators are models over all trials at once, so their inputs are stacked.
                q = np.stack([now[n][0] for n in range(num)])
                advice = np.stack([now[n][1] if trials.guided[n] else nothing for n in range(num)])
                given = operators.step(
                    OperatorView(q=q, rim_in_base_m=trials.rim_in_base_m, advice=advice)
                )
                now |= crew.ask("period", running, given)
                # The recording goes on for a while after the insertion, as that of a real trial
                # does.
                left -= _detect_insertion(machine, q, trials) & running
                found |= crew.ask("end", running & (left <= 0))
                running &= left > 0
                if not running.any():
                    break
            found |= crew.ask("end", running)
        return [found[n] for n in range(num)]


def make_desks(
    ground: Twins,
    machine: Machine,
    session: Session,
    places: list[tuple[int, np.ndarray, np.ndarray, bool]],
) -> list[_Desk]:
    """Return a desk for each of `places`: seed, start, rim, and whether advice is shown there."""
    bundle, description = PolicyBundle(ground.policy, machine), BusDescription(ground.dbc, machine)
    made = []
    for seed, q, rim, guided in places:
        made.append(
            _Desk(ground, machine, description, bundle, replace(session, seed=seed), q, rim, guided)
        )
    for desk in made:
        desk.wait(BEFORE_S)
    return made


def _detect_insertion(machine: Machine, q: np.ndarray, trials: TrialBatch) -> np.ndarray:
    away = compute_tool_kinematics(machine, q).tip_in_base_m - trials.rim_in_base_m
    # The clearance tells a chisel inside the hole from one beside it at the same depth.
    return (np.hypot(away[:, 0], away[:, 1]) <= trials.clearance_m) & (
        away[:, 2] <= -trials.depth_m
    )


class _Newest:
    """The newest record, for one process; see `deploy.runtime.shared_memory.RecordSlot`."""

    def __init__(self, record: Any = None) -> None:
        self._record = record

    def write(self, record: Any) -> None:
        self._record = record

    def read(self) -> Any:
        return self._record


class _NoLog:
    def put(self, data: bytes) -> bool:
        return True


@dataclass
class _Shared:
    """Shared memory that an adviser reads and writes."""

    state: _Newest
    advice: _Newest
    target: _Newest
    request: None
    policy_log: _NoLog


class _Air:
    """Frames on their way from the twin."""

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []

    def recv(self, timeout_s: float) -> CanFrame | None:
        return None

    def send(self, frame: CanFrame) -> None:
        self.frames.append(frame)


class _Desk:
    """One trial: twin, remote and loop on a clock of their own."""

    def __init__(
        self, ground: Twins, machine: Machine, description: BusDescription, bundle: PolicyBundle, session: Session, q: np.ndarray,
        rim_m: np.ndarray, guided: bool,
    ) -> None:  # fmt: skip
        self._seed, self._guided = session.seed, guided
        self._machine, self._rim_m, self._now_s = machine, rim_m, BEGIN_S
        start, hole = tuple(q.tolist()), tuple(rim_m.tolist())
        # A plant that cannot be placed has no such fields; `link=site` has.
        placed = replace(ground.plant, start=start, hole_in_base_m=hole)  # type: ignore[type-var]
        self._link, self._air = placed.build(machine, 1, session), _Air()
        twin = Twin(
            wire=NO_BUS,
            dbc=ground.dbc,
            remote=False,
            deadman=False,
            again_s=None,
            fault_port=None,
            seconds=None,
            realtime=False,
        )
        self._twin = RunningTwin(twin, machine, self._link, self._air, FaultPort(None))
        self._remote, self._receiver = (
            RadioRemote(description),
            BusReceiver(description, machine, ground.limits),
        )
        # The operator holds the dead-man throughout: the twin is driven by hand.
        self._remote.deadman = True
        target = np.zeros((), TARGET)
        target["t_s"], target["center_in_base_m"] = BEGIN_S, rim_m
        self._shared = _Shared(_Newest(), _Newest(), _Newest(target), None, _NoLog())
        # Nothing is ever commanded in a study: the guard stays silent.
        self._silent = GuardDecision(
            GuardState.SILENT, (0.0,) * machine.num_joints, GuardTrip.NONE, GuardTrip.NONE
        )
        # 1e9 s: the borehole never grows old, as the study says where it is.
        counsel = PolicyProcessConfig(
            machine, ground.policy, ground.guidance, ground.limits.joints_s, 1e9, None
        )
        self._adviser = PolicyAdviser(counsel, bundle, self._shared)  # type: ignore[arg-type]
        self._own, self._display = (
            LeverMap(machine.levers, machine),
            LeverMap(ground.guidance.levers or machine.levers, machine),
        )
        self._full_rad, self._cycles = find_full_angles_rad(machine.levers), 0
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = []
        self._shown = np.zeros(machine.num_joints)

    def seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the arm as a person beside it sees it, and the commands that the levers shown now stand for, `(J,)` each."""
        return np.asarray(self._link.read().q, float), self._shown

    def wait(self, seconds: float) -> None:
        """Let time go by before the trial, levers in neutral."""
        for _ in range(round(seconds / self._machine.period_s)):
            self.period(np.zeros(self._machine.num_joints))
        # Time before the trial is no part of its recording.
        self._rows.clear()

    def period(self, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Step one control period with the levers at `given`, `(J,)`; return `seen` at its end."""
        receiver, before = self._receiver, (self._receiver.flow_sum, self._receiver.flow_number)
        # Before the first message the position is that of the plant.
        q = receiver.q.copy() if receiver.frames else self.seen()[0]
        force = getattr(self._link, "extra", dict)().get("force_n", np.zeros(1))
        angles_rad, self._remote.button_right = self._own.levers(given)
        self._remote.levers = (angles_rad / self._full_rad).clip(-1.0, 1.0).tolist()
        advised = self._shared.advice.read()
        advice = np.full(len(given), np.nan)
        if advised is not None and advised.valid:
            advice = np.array(advised.u)
        for _ in range(round(self._machine.period_s / CYCLE_S)):
            self._cycle()
        # The mean flow of the period, as the recorder computes it from the counters.
        u = (receiver.flow_sum - before[0]) / max(1, receiver.flow_number - before[1])
        self._rows.append((q, u, advice, float(force[0])))
        self._advise()
        return self.seen()

    def _cycle(self) -> None:
        self._now_s += CYCLE_S
        # The remote sends more slowly than the gateway.
        if self._cycles % round(self._remote.period_s / CYCLE_S) == 0:
            frame = self._remote.build_frame()
            self._twin.hear(frame, self._now_s)
            self._receiver.take(frame, self._now_s)
        self._cycles += 1
        self._twin.cycle(self._now_s)
        for frame in self._air.frames:
            self._receiver.take(frame, self._now_s)
            self._remote.hear(frame)
        self._air.frames.clear()

    def _advise(self) -> None:
        """Publish the state as the bus process does, and let the policy propose a command."""
        now_s = self._now_s
        target = GuardTrip.NONE
        state = self._receiver.build_state(now_s, True, self._silent, target, missed=0)
        self._shared.state.write(state)
        self._adviser.run_cycle(0, now_s)
        advice = self._shared.advice.read()
        self._shown = self._display.command(advice.lever_rad, advice.button_right)

    def end(self) -> Recording:
        """Return the recording and release the twin's memory."""
        found = self.recording()
        # Hundreds of twins would fill the memory until the last trial ends.
        del self._twin, self._link
        return found

    def recording(self) -> Recording:
        """Return the trial at the control rate, commands as the valves got them."""
        machine = self._machine
        columns = []
        for column in range(3):
            stacked = np.stack([row[column] for row in self._rows])
            columns.append(stacked.astype(np.float32))
        q, u, advice = columns
        extra = {"force_n": np.array([row[3] for row in self._rows], np.float32)}
        for index, axis in enumerate("xyz"):
            extra[f"target_{axis}_m"] = np.full(len(q), self._rim_m[index], np.float32)
        if self._guided:
            extra |= {f"advice_{name}": advice[:, j] for j, name in enumerate(machine.joint_names)}
        return Recording(
            machine=machine.name,
            # Flow may exceed full by rounding.
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=np.arange(len(q)) * machine.period_s,
            u=u.clip(-1.0, 1.0),
            q=q,
            extra=extra,
            metadata={"source": "simulated operator, twin", "seed": str(self._seed)},
        )
