"""A study by simulated operators at the twin's plant, on a clock that runs as fast as it can.

The plant, the policy with its history, and the lever display are those of the loop with its twin.
Not simulated are the bus, processes and their scheduling, guard and page. A simulated person sees an
advice in the control period in which it is made, a real one some tens of milliseconds later. Trials
are independent of each other, so that several processes share them.
Axes: `J` joints.
"""

# pyright: reportArgumentType=false
# The stubs of joblib do not know what its generator yields.

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from brokk_rl.contracts.link import Connection
from brokk_rl.kinematics import compute_tool_kinematics
from brokk_rl.machine import Machine
from brokk_rl.progress import track_items
from brokk_rl.record import Recording, make_motion, write_recording
from brokk_rl.session import Session
from brokk_rl.signals import Command
from brokk_rl.spec import Index, NonNegative, name_spec, spec
from deploy.guidance import LeverGuidance, LeverMap
from deploy.policy.bundle import PolicyBundle
from deploy.policy.policy_process import PolicyAdviser, PolicyProcessConfig
from deploy.runtime.operator_state import OperatorState
from deploy.runtime.shared_memory import RecordLayout
from deploy.runtime.shm_layout import LoopMemory
from study import study_folder as folders
from study.design import Design, Trial
from study.measures import find_insertion, measure_trial
from study.operators.person import Operator, Person
from study.study_folder import StudyData

BEGIN_S = 1000.0
"""Start of the simulated clock, s; large, so that no small number passes for a time."""
BEFORE_S = 1.0
"""For which everything runs before a trial begins: the policy's history is full then."""
MOST_SEED = 10**9
"""Largest seed of a session."""
NEVER_S = 1e9
"""Age at which positions and borehole are too old for an advice: never, as the study gives them."""


@spec
class TwinGround:
    """Simulated operators at the twin, with policy and lever display of the loop.

    Attributes:
        plant: The machine beside its block.
        guidance: How advice is shown.
        policy: Policy bundle that advises.
        settle_s: Time for which a recording goes on after the insertion.
        num_processes: Processes that the trials are spread over; 0: one a core.
        guided: Operators with advice.
        unguided: The same persons without.
    """

    plant: Connection
    guidance: LeverGuidance
    policy: str
    settle_s: NonNegative
    num_processes: Index
    guided: Operator
    unguided: Operator

    def conduct(self, data: StudyData, machine: Machine, session: Session) -> None:
        """Do every trial of a plan that counts, and write recordings and trials into the study's folder.

        Practice is left out, since these operators do not learn.
        """
        from joblib import Parallel, delayed

        design, folder = data.design, data.folder
        todo = [trial for trial in data.planned if trial.period]
        people = list(data.plan["participants"])
        run = delayed(self.run_trial)
        calls = [
            run(design, trial, people.index(trial.participant), machine, session) for trial in todo
        ]
        recordings = Parallel(self.num_processes or -1, return_as="generator")(calls)
        done = track_items(zip(todo, recordings, strict=True), "simulated trials", len(todo))
        for trial, recording in done:
            hole = design.holes[trial.hole]
            name = f"{folders.RECORDINGS}/{trial.name}.parquet"
            write_recording(recording, folder / name)
            found = measure_trial(recording, machine, hole, design.success, design.limit_s)
            facts: dict[str, Any] = {
                **asdict(trial),
                "outcome": "inserted" if found["success"] else "time limit",
                "recording": name,
                "simulated": True,
                "operator": name_spec(getattr(self, trial.condition)),
            }
            folders.write_trial(folder, trial.name, facts)

    def run_trial(
        self, design: Design, trial: Trial, number: int, machine: Machine, session: Session
    ) -> Recording:
        """Return the recording of a trial by the person `number`, with advice where it was shown."""
        import torch

        # Processes side by side leave no core to the threads of each.
        torch.set_num_threads(1)
        q, hole = np.array(design.starts[trial.start]), design.holes[trial.hole]
        rim_m, is_guided = np.array(hole.center_in_base_m), trial.condition == "guided"
        # A session's seed is smaller than a stream's.
        own = replace(session, seed=session.stream(f"twin {trial.name}") % MOST_SEED)
        person = Person(number, session.stream("study operators"), own.generator("operator"))
        operator = getattr(self, trial.condition).build(machine, person)
        desk = TwinDesk(self, machine, own, q, rim_m, is_guided)
        left = round(self.settle_s / machine.period_s)
        for _ in range(round(design.limit_s / machine.period_s)):
            q, shown = desk.seen()
            advice = shown if is_guided else np.full(machine.num_joints, np.nan)
            desk.run_period(operator(q, rim_m, advice))
            # The recording goes on for a while after the insertion, as that of a real trial does.
            tip_m = compute_tool_kinematics(machine, desk.seen()[0]).tip_in_base_m
            left -= find_insertion(tip_m[None], hole, design.success) is not None
            if left <= 0:
                break
        return desk.end()


class TwinDesk:
    """One trial: plant and advice on a clock of their own; `BEFORE_S` have gone by when it begins.

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
        self._machine, self._rim_m, self._is_guided = machine, rim_m, is_guided
        self._now_s = BEGIN_S
        start, hole = tuple(q.tolist()), tuple(rim_m.tolist())
        # A plant that cannot be placed has no such fields; `link=site` has.
        placed = replace(ground.plant, start=start, hole_in_base_m=hole)  # type: ignore[type-var]
        self._link = placed.build(machine, 1, session)
        self._memory = LoopMemory(machine.num_joints, commands=False)
        target = self._memory.target.new()
        target["t_s"], target["center_in_base_m"] = BEGIN_S, rim_m
        self._memory.target.write(target)
        self._state = RecordLayout(OperatorState, machine.num_joints).new()
        settings = PolicyProcessConfig(
            machine, ground.policy, ground.guidance, NEVER_S, NEVER_S, pitch_rad=None
        )
        bundle = PolicyBundle(ground.policy, machine)
        self._adviser = PolicyAdviser(settings, bundle, self._memory)
        self._display = LeverMap(machine)
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
        q, now_s = self.seen()[0], self._now_s + self._machine.period_s
        force = getattr(self._link, "extra", dict)().get("force_n", np.zeros(1))
        advised, advice = self._memory.advice.read(), np.full(len(given), np.nan)
        if advised is not None and advised.valid:
            advice = np.array(advised.u)
        u = self._link.send(Command(given)).u
        self._rows.append((q, u, advice, float(force[0])))
        # As the bus process publishes it; the flow of a period is one feedback of the valves.
        self._now_s = now_s
        self._state = replace(
            self._state,
            t_s=now_s,
            q=self.seen()[0],
            q_t_s=now_s,
            q_plausible=True,
            flow=u,
            flow_sum=self._state.flow_sum + u,
            flow_number=self._state.flow_number + 1,
            flow_t_s=now_s,
            trusted=True,
        )
        self._memory.state.write(self._state)
        self._adviser.run_cycle(0, now_s)
        shown = self._memory.advice.read()
        assert shown is not None
        self._shown = self._display.command(shown.lever_rad, shown.button_right)

    def end(self) -> Recording:
        """Return the trial at the control rate, commands as the valves got them."""
        self._memory.close()
        q, u, advice, force_n = map(np.array, zip(*self._rows, strict=True))
        t_s = np.arange(len(q)) * self._machine.period_s
        extra = {"force_n": force_n.astype(np.float32)}
        for index, axis in enumerate("xyz"):
            extra[f"target_{axis}_m"] = np.full(len(q), self._rim_m[index], np.float32)
        if self._is_guided:
            for j, name in enumerate(self._machine.joint_names):
                extra[f"advice_{name}"] = advice[:, j].astype(np.float32)
        return replace(make_motion(self._machine, "simulated operator", t_s, u, q), extra=extra)
