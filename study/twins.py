"""A study by simulated operators at the twin: the real time's own parts, and a clock that runs as fast as it can.

Each trial has a twin (`deploy.twin`: plant, gateway, its messages), a remote, and of the loop the
receiver and the adviser with policy and lever display. Frames go through the bus description both
ways: coded, counted, checked. Not simulated are a bus with latencies, processes and their
scheduling, guard and page. A simulated person sees an advice in the control period in which it is
made, a real one some tens of milliseconds later. Trials are independent of each other, so that
several processes share them.
Axes: `J` joints.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from brokk_rl.contracts.link import Connection
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.progress import track_items
from brokk_rl.record import Recording, write_recording
from brokk_rl.session import Session
from brokk_rl.spec import Index, name_spec, spec
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
from study import study_folder as folders
from study import tlx
from study.design import Design, Trial
from study.measures import find_insertion, measure_trial
from study.operators.person import Operator, Person

BEGIN_S = 1000.0
"""Start of the simulated clock, s; large, so that no small number passes for a time."""
BEFORE_S = 1.0
"""For which everything runs before a trial begins: the policy's history is full then."""
NO_BUS = CanBus(interface="virtual", channel="none", bitrate=None, port=None, hops=None)
TARGET = np.dtype([("t_s", float), ("center_in_base_m", float, (3,))])


@spec
class TwinGround:
    """Simulated operators at the twin, with gateway, messages, receiver, policy and lever display of the loop.

    Attributes:
        plant: The machine beside its block.
        dbc: Description of the bus.
        limits: Plausibility limits of the loop.
        guidance: How advice is shown.
        policy: Policy bundle that advises.
        settle_s: Time for which a recording goes on after the insertion.
        num_processes: Processes that the trials are spread over; 0: one a core.
        guided: Operators with advice.
        unguided: The same persons without.
    """

    plant: Connection
    dbc: str
    limits: GuardLimits
    guidance: LeverGuidance
    policy: str
    settle_s: float
    num_processes: Index
    guided: Operator
    unguided: Operator

    def conduct(
        self, folder: Path, design: Design, planned: list[Trial], machine: Machine, session: Session
    ) -> None:
        """Do every trial that counts, and write recordings, trials and questionnaires into a study's folder.

        Args:
            folder: The study's folder, with its plan.
            design: The design of the plan.
            planned: Its trials; practice is left out, since these operators do not learn.
            machine: The machine.
            session: Gives the seed.
        """
        todo = [trial for trial in planned if trial.period]
        # The load of each period, from which the questionnaire is made up.
        loads: dict[tuple[str, int], list[float]] = {}
        recordings = self._run_trials(design, todo, machine, session)
        for trial, recording in zip(todo, recordings, strict=True):
            hole = design.holes[trial.hole]
            name = f"{folders.RECORDINGS}/{trial.name}.parquet"
            write_recording(recording, folder / name)
            found = measure_trial(recording, machine, hole, design.success, design.limit_s)
            facts: dict[str, Any] = {
                **asdict(trial),
                "hole": {"name": trial.hole, **asdict(hole)},
                "limit_s": design.limit_s,
                "outcome": "inserted" if found["success"] else "time limit",
                "recording": name,
                "simulated": True,
                "operator": name_spec(self._choose_operator(trial)),
            }
            folders.write_trial(folder, trial.name, facts)
            # Time and effort together: a made-up workload only has to vary with both. Chosen by
            # hand; not searched.
            load = found["time_s"] / design.limit_s + 0.1 * found["control_effort"]
            loads.setdefault((trial.participant, trial.period), []).append(load)
        generator = session.generator("study questionnaires")
        # Persons differ in how high they rate altogether: 10 points. Chosen by hand; not searched.
        habits = {trial.participant: generator.normal(0.0, 10.0) for trial in todo}
        for (participant, period), load in loads.items():
            answers = answer_questionnaire(float(np.mean(load)), habits[participant], generator)
            folders.write_questionnaire(folder, participant, period, answers)

    def _run_trials(
        self, design: Design, todo: list[Trial], machine: Machine, session: Session
    ) -> Iterator[Recording]:
        """Yield the recordings in order, each as soon as it is there."""
        from joblib import Parallel, delayed

        names = list(dict.fromkeys(trial.participant for trial in todo))
        calls = []
        for trial in todo:
            number = names.index(trial.participant)
            calls.append(delayed(self.run_trial)(design, trial, number, machine, session))
        num_processes = min(self.num_processes or len(os.sched_getaffinity(0)), len(todo))
        done = Parallel(num_processes, return_as="generator")(calls)
        yield from track_items(done, "simulated trials", len(todo))

    def run_trial(
        self, design: Design, trial: Trial, number: int, machine: Machine, session: Session
    ) -> Recording:
        """Return the recording of a trial by the person `number`, with advice where it was shown."""
        import torch

        # Processes side by side leave no core to the threads of each.
        torch.set_num_threads(1)
        q, hole = np.array(design.starts[trial.start]), design.holes[trial.hole]
        rim_m, is_guided = np.array(hole.center_in_base_m), trial.condition == "guided"
        own = replace(session, seed=session.stream(f"twin {trial.name}"))
        person = Person(number, session.stream("study operators"), own.generator("operator"))
        operator = self._choose_operator(trial).build(machine, person)
        desk = TwinDesk(self, machine, own, q, rim_m, is_guided)
        left = round(self.settle_s / machine.period_s)
        for _ in range(round(design.limit_s / machine.period_s)):
            q, shown = desk.seen()
            advice = shown if is_guided else np.full(machine.num_joints, np.nan)
            desk.run_period(operator.step(q, rim_m, advice))
            # The recording goes on for a while after the insertion, as that of a real trial does.
            tip_m = compute_tool_kinematics(machine, desk.seen()[0]).tip_in_base_m
            left -= find_insertion(tip_m[None], hole, design.success) is not None
            if left <= 0:
                break
        return desk.recording()

    def _choose_operator(self, trial: Trial) -> Operator:
        return self.guided if trial.condition == "guided" else self.unguided


def answer_questionnaire(
    load: float, habit: float, generator: np.random.Generator
) -> dict[str, Any]:
    """Return a questionnaire as made up from how long and busy the trials were; it has the form of answers, no more."""
    # A middle of 25 to 85 points leaves room for the habit at both ends. Chosen by hand; not
    # searched.
    middle = 25.0 + 60.0 * load + habit
    ratings, chosen = {}, []
    for scale in tlx.SCALES:
        value = tlx.STEP * round((middle + generator.normal(0.0, 8.0)) / tlx.STEP)
        ratings[scale] = min(max(value, 0), 100)
    for pair in tlx.shuffle_pairs(generator):
        chosen.append({"pair": pair, "chosen": pair[int(generator.integers(2))]})
    return {"ratings": ratings, "pairs": chosen, "simulated": True, "note": folders.NOTICE}


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


class _Air:
    """Frames on their way from the twin."""

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []

    def recv(self, timeout_s: float) -> CanFrame | None:
        return None

    def send(self, frame: CanFrame) -> None:
        self.frames.append(frame)


class TwinDesk:
    """One trial: twin, remote and loop on a clock of their own; `BEFORE_S` have gone by when it begins.

    Args:
        ground: Settings of the twin.
        machine: The machine.
        session: Gives the seed of the trial.
        q: Joint positions at the start, `(J,)`.
        rim_m: Centre of the hole's rim in the base frame, `(3,)`.
        is_guided: Whether the advice is shown, and so recorded.
    """

    def __init__(
        self,
        ground: TwinGround,
        machine: Machine,
        session: Session,
        q: np.ndarray,
        rim_m: np.ndarray,
        is_guided: bool,
    ) -> None:
        self._seed, self._is_guided = session.seed, is_guided
        self._machine, self._rim_m, self._now_s = machine, rim_m, BEGIN_S
        start, hole = tuple(q.tolist()), tuple(rim_m.tolist())
        # A plant that cannot be placed has no such fields; `link=site` has.
        placed = replace(ground.plant, start=start, hole_in_base_m=hole)  # type: ignore[type-var]
        self._link, self._air = placed.build(machine, 1, session), _Air()
        alone = {"again_s": None, "fault_port": None, "seconds": None}
        twin = Twin(
            wire=NO_BUS, dbc=ground.dbc, remote=False, deadman=False, realtime=False, **alone
        )
        self._twin = RunningTwin(twin, machine, self._link, self._air, FaultPort(None))
        description = BusDescription(ground.dbc, machine)
        self._remote = RadioRemote(description)
        # The operator holds the dead-man throughout: the twin is driven by hand.
        self._remote.deadman = True
        self._receiver = BusReceiver(description, machine, ground.limits)
        # Nothing is ever commanded in a study: the guard stays silent.
        self._silent = GuardDecision(
            GuardState.SILENT, (0.0,) * machine.num_joints, GuardTrip.NONE, GuardTrip.NONE
        )
        target = np.zeros((), TARGET)
        target["t_s"], target["center_in_base_m"] = BEGIN_S, rim_m
        self._shared: Any = SimpleNamespace(
            state=_Newest(),
            advice=_Newest(),
            target=_Newest(target),
            request=None,
            policy_log=_NoLog(),
        )
        # 1e9 s: the borehole never grows old, as the study says where it is.
        counsel = PolicyProcessConfig(
            machine, ground.policy, ground.guidance, ground.limits.joints_s, 1e9, None
        )
        self._adviser = PolicyAdviser(counsel, PolicyBundle(ground.policy, machine), self._shared)
        self._own = LeverMap(machine.levers, machine)
        self._display = LeverMap(ground.guidance.levers or machine.levers, machine)
        self._full_rad, self._cycles = find_full_angles_rad(machine.levers), 0
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = []
        self._shown = np.zeros(machine.num_joints)
        for _ in range(round(BEFORE_S / machine.period_s)):
            self.run_period(np.zeros(machine.num_joints))
        # Time before the trial is no part of its recording.
        self._rows.clear()

    def seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the arm as a person beside it sees it, and the commands that the levers shown now stand for, `(J,)` each."""
        return np.asarray(self._link.read().q, float), self._shown

    def run_period(self, given: np.ndarray) -> None:
        """Let one control period go by with the levers at `given`, `(J,)`."""
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
        state = self._receiver.build_state(
            self._now_s, True, self._silent, GuardTrip.NONE, missed=0
        )
        self._shared.state.write(state)
        self._adviser.run_cycle(0, self._now_s)
        advice = self._shared.advice.read()
        self._shown = self._display.command(advice.lever_rad, advice.button_right)

    def recording(self) -> Recording:
        """Return the trial at the control rate, commands as the valves got them."""
        machine = self._machine
        q, u, advice, force_n = map(np.array, zip(*self._rows, strict=True))
        extra = {"force_n": force_n.astype(np.float32)}
        for index, axis in enumerate("xyz"):
            extra[f"target_{axis}_m"] = np.full(len(q), self._rim_m[index], np.float32)
        if self._is_guided:
            for j, name in enumerate(machine.joint_names):
                extra[f"advice_{name}"] = advice[:, j].astype(np.float32)
        return Recording(
            machine=machine.name,
            joints=machine.joint_names,
            units=tuple(joint.unit for joint in machine.joints),
            rate_hz=1.0 / machine.period_s,
            t_s=np.arange(len(q)) * machine.period_s,
            # Flow may exceed full by rounding.
            u=u.astype(np.float32).clip(-1.0, 1.0),
            q=q.astype(np.float32),
            extra=extra,
            metadata={"source": "simulated operator, twin", "seed": str(self._seed)},
        )
