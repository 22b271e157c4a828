"""Bring-up: a checklist that runs on a machine before anybody trusts the loop on it.

It only listens; the operator moves the machine.

    bus         every message at its rate, none refused
    positions   valid, within the machine's limits, quiet at rest, as measured by hand
    dead-man    seen pressed and released
    e-stop      seen pressed and released
    joints      each joint moved alone, both ways, with the operator's own levers: which joint moves,
                sign, dead time, speed; swapped, turned and doubled joints are named
    shadow      the policy runs along; its advice is recorded, not shown
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import Positive, spec
from deploy.bus.description import GATEWAY, REMOTE, BusDescription
from deploy.joint_response import JointResponse, describe_joint, find_pushes
from deploy.kernel.guard import GuardTrip
from deploy.recorder.capture import MCAP, CaptureConfig
from deploy.recorder.capture_reader import read_capture
from deploy.runtime.operator_state import AdviceStatus, OperatorState
from deploy.runtime.process_group import POLL_S, BusAndPolicySettings, ProcessGroup
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.supervisor import CompanionProcess
from deploy.runtime.target import TargetSelector

log = logging.getLogger(__name__)

REPORT = "bringup.json"
WATCH_S = 1.0
"""Piece of motion between two evaluations of the joints. Chosen by hand."""

FLOW_FAULTS = (GuardTrip.FLOW_UNASKED, GuardTrip.FLOW_TURNED, GuardTrip.FLOW_SCALED)
"""Faults of a valve that does not get what the levers ask for."""


@dataclass(frozen=True)
class BringupResult:
    """Result of one check.

    Attributes:
        check: Its name.
        passed: Whether it passed.
        text: The result in words.
        values: The measured values.
    """

    check: str
    passed: bool
    text: str
    values: dict[str, Any]


@spec
class BringupChecklist(BusAndPolicySettings):
    """The checklist; policy and borehole are those of the shadow run.

    Attributes (and those of `BusAndPolicySettings`):
        listen_s: Time to listen at rest.
        patience_s: Time that the operator gets for each task.
        shadow_s: Length of the shadow run.
        quiet: Largest standard deviation of a position at rest (rad or m).
        pose: Joint positions that were measured by hand where the machine rests now; `null`: none
            were, and no offset of a sensor is found.
        pose_error: Largest difference to them (rad or m).
        rate: Smallest part of a message's nominal rate.
    """

    listen_s: Positive
    patience_s: Positive
    shadow_s: Positive
    quiet: Positive
    pose: tuple[float, ...] | None
    pose_error: Positive
    rate: Positive

    def run(
        self,
        machine: Machine,
        session: Session,
        say: Callable[[str], None],
        companions: Sequence[CompanionProcess],
    ) -> list[BringupResult]:
        """Run the checks in order; write `bringup.json` and the capture.

        Args:
            machine: The machine.
            session: Where to write.
            say: Shows the operator a task, or a result.
            companions: Further processes: twin and scripted person of a rehearsal.

        Raises:
            LinkError: nothing is heard at all, or one of the processes has died.
            CheckpointError: the policy cannot be used on this machine.
            ConfigError: `pose` has another number of joints.
        """
        self.check_machine(machine)
        if self.pose is not None and len(self.pose) != machine.num_joints:
            raise ConfigError(
                f"bringup.pose: expected {machine.num_joints} positions, got {len(self.pose)}; "
                f"give those of {', '.join(machine.joint_names)}"
            )
        memory = LoopMemory(machine.num_joints, commands=False)
        # The bring-up never commands: without `commands` there is no request slot at all.
        group = ProcessGroup(memory, self.realtime, optional={})
        try:
            for one in companions:
                group.start(one.name, one.target, one.arguments, one.realtime)
            self.start_processes(
                group, machine, target_s=math.inf, pitch_rad=None, needs_page=False
            )
            facts = {"source": "bring-up"}
            capture = CaptureConfig(session.folder, self.dbc, machine, facts, pictures_hz=0.0)
            group.start("log", "deploy.recorder.capture:run", (capture,))
            results = _StateChecks(self, machine, group, say).run()
        finally:
            # The processes must end before the capture is read: its index is written at the end.
            group.end()
            memory.close()
        # Rates come from the capture, which holds every message with its own time.
        results.insert(0, self._check_rates(machine, session))
        write_json(
            session.folder / REPORT,
            {"machine": machine.name, "findings": [asdict(one) for one in results]},
        )
        for one in results:
            say(f"{'passed' if one.passed else 'FAILED':7} {one.check:10} {one.text}")
        return results

    def _check_rates(self, machine: Machine, session: Session) -> BringupResult:
        """Compare the captured messages with the rates of the DBC."""
        description = BusDescription(self.dbc, machine)
        messages = read_capture(session.folder / MCAP).messages
        values, faults = {}, []
        for layout in (*description.sent_by(GATEWAY), *description.sent_by(REMOTE)):
            name, rate_hz = layout.name, 0.0
            # A message that came once has no rate.
            if name in messages and len(times := messages[name].series("t_s")) > 1:
                rate_hz = (len(times) - 1) / (times[-1] - times[0])
            nominal_hz = 1 / layout.period_s if layout.period_s else None
            values[name] = {"rate_hz": rate_hz, "nominal_hz": nominal_hz}
            if nominal_hz and rate_hz * layout.period_s < self.rate:
                faults.append(f"{name} {rate_hz:.0f} of {nominal_hz:.0f} Hz")
        refused = len(messages.get("refused", [])) + len(messages.get("fault", []))
        text = "every message at its rate, none refused"
        passed = not faults and not refused
        if not passed:
            text = "; ".join([*faults, f"{refused} messages refused"])
        return BringupResult("bus", passed, text, {"messages": values, "refused": refused})


class _StateChecks:
    """The checks of the machine's state."""

    def __init__(
        self,
        checklist: BringupChecklist,
        machine: Machine,
        group: ProcessGroup,
        say: Callable[[str], None],
    ) -> None:
        self._checklist, self._machine, self._group, self._say = checklist, machine, group, say
        self._memory = group.memory
        self._samples: list[OperatorState] = []
        # By number of the joint, from 1.
        self._flow_faults: dict[int, GuardTrip] = {}

    def run(self) -> list[BringupResult]:
        """Run them."""
        self._say("listening for the machine")
        patience_s = self._checklist.patience_s
        if self._group.wait_for_state(lambda state: state.q_t_s > 0, patience_s) is None:
            raise LinkError(
                f"no joint positions within {patience_s:g} s; is the machine on, and the bus connected?"
            )
        return [
            self._check_positions(),
            self._check_switch("dead-man", "deadman", "press the dead-man, then release it"),
            self._check_switch("e-stop", "estop", "press the emergency stop, then release it"),
            self._check_joints(),
            self._run_shadow(),
        ]

    def _check_positions(self) -> BringupResult:
        self._say("leave the machine at rest")
        # Noise is measured at rest; the largest position error then comes from the sensor alone.
        self._collect(self._checklist.listen_s)
        q, machine = np.array([one.q for one in self._samples]), self._machine
        scatter, last = q.std(0), self._memory.state.read()
        names, faults = np.array(machine.joint_names), []
        outside = names[~((machine.lower <= q[-1]) & (q[-1] <= machine.upper))]
        noisy = names[scatter > self._checklist.quiet]
        if len(outside):
            faults.append(f"{', '.join(outside)} outside the limits")
        if len(noisy):
            faults.append(f"{', '.join(noisy)} not quiet")
        if last is None or not last.q_plausible:
            faults.append("not plausible")
        if last is not None and last.trip is GuardTrip.DESCRIPTION:
            faults.append(last.trip.value)
        faults += self._list_offsets(q.mean(0))
        compared = "no pose was measured by hand: offsets were not looked for"
        if self._checklist.pose is not None:
            compared = "as measured by hand"
        text = "; ".join(faults) or f"valid, inside the limits, quiet; {compared}"
        values = {"q": q[-1].tolist(), "standard_deviation": scatter.tolist()}
        return BringupResult("positions", not faults, text, values)

    def _list_offsets(self, q: np.ndarray) -> list[str]:
        """Return each joint whose position, of `(J,)`, is not the one measured by hand."""
        pose, found = self._checklist.pose, []
        for name, here, measured in zip(self._machine.joint_names, q, pose or q, strict=True):
            if abs(here - measured) > self._checklist.pose_error:
                found.append(f"{name} has an offset of {here - measured:+.3f}")
        return found

    def _check_switch(self, check: str, field: str, task: str) -> BringupResult:
        """Check that a switch of the state is seen pressed and released."""
        self._say(task)
        patience_s, missing = self._checklist.patience_s, "pressed"
        wait_for_state = self._group.wait_for_state
        pressed = wait_for_state(lambda state: getattr(state, field), patience_s)
        # Pressed and released are seen separately: a switch that is stuck would pass a single
        # look.
        if pressed is not None:
            missing = "released"
            released = wait_for_state(lambda state: not getattr(state, field), patience_s)
            if released is not None:
                values = {"held_s": released.t_s - pressed.t_s}
                return BringupResult(check, True, "pressed and released", values)
        return BringupResult(check, False, f"not seen to be {missing} within {patience_s:g} s", {})

    def _check_joints(self) -> BringupResult:
        machine, names = self._machine, self._machine.joint_names
        self._say(
            f"move one joint after the other, both ways, half a second or more each, with rests of two seconds: {', '.join(names)}"
        )
        found = self._watch_joints()
        missing = [name for name in names if name not in found]
        dead_s = [response.dead_time_s for response in found.values()]
        faults = []
        if missing:
            faults.append(f"not seen to move both ways: {', '.join(missing)}")
        for response in found.values():
            faults += response.faults
        for joint, trip in sorted(self._flow_faults.items()):
            faults.append(f"{names[joint - 1]}: {trip.value}")
        # The policy sees only its history: a longer dead time hides the effect of its own
        # commands. The oldest command in it began so many whole periods before the newest position.
        if dead_s and max(dead_s) > machine.num_history * machine.period_s:
            faults.append(
                f"dead time of up to {max(dead_s):.2f} s is longer than the policy's history"
            )
        text = "; ".join(faults)
        if not faults:
            text = f"each valve moves its own joint, signs agree; dead times {min(dead_s):.2f} to {max(dead_s):.2f} s"
        values = {name: asdict(response) for name, response in found.items()}
        return BringupResult("joints", not faults, text, values)

    def _watch_joints(self) -> dict[str, JointResponse]:
        """Return the responses of the joints that the operator moves in time."""
        machine, found = self._machine, dict[str, JointResponse]()
        # Samples of the earlier checks hold motion that was not asked for.
        self._samples.clear()
        end_s = time.monotonic() + self._checklist.patience_s
        while time.monotonic() < end_s and len(found) < machine.num_joints:
            self._collect(WATCH_S)
            t_s = np.array([one.t_s for one in self._samples])
            q = np.array([one.q for one in self._samples])
            flow = np.array([one.flow for one in self._samples])
            pushes = find_pushes(t_s, q, flow, machine)
            for j, name in enumerate(machine.joint_names):
                response = describe_joint(pushes, j, machine.joint_names)
                # The first complete response counts, so that a joint is reported once.
                if response is not None and name not in found:
                    found[name] = response
                    self._say(f"{name}: {response.text}")
        return found

    def _run_shadow(self) -> BringupResult:
        self._say("shadow run: the policy runs along, nothing is shown")
        target = self._checklist.target.build()
        # The target is chosen once: it must not jump during the shadow run.
        TargetSelector(target, self._memory.target, self._memory.holes).refresh()
        # A new borehole counts once it has stayed where it is.
        self._collect(2.0 * self._checklist.limits.target.settle_s)
        counts: Counter[AdviceStatus] = Counter()
        # Advices have numbers, so that none is counted twice.
        end_s, number = time.monotonic() + self._checklist.shadow_s, -1
        while time.monotonic() < end_s:
            advice = self._memory.advice.read()
            if advice is not None and advice.number != number:
                number = advice.number
                counts[advice.reason] += 1
            time.sleep(POLL_S)
        count = counts.total()
        # At least 1, so that a policy that never spoke gives 0 % and no error.
        share = counts[AdviceStatus.VALID] / max(1, count)
        others = sorted(one.value for one in counts if one is not AdviceStatus.VALID)
        text = f"{share:.0%} of {count} advices valid"
        if others:
            text += f" ({', '.join(others)})"
        passed = share >= self._checklist.rate
        return BringupResult("shadow", passed, text, {"advices": count, "valid": share})

    def _collect(self, seconds: float) -> None:
        """Collect samples of the state for some time."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            # A dead process would otherwise look like a machine at rest.
            self._group.check()
            state = self._memory.state.read()
            # The state is read faster than it changes; doubles would bias the noise to zero.
            if state is not None and (not self._samples or state.t_s > self._samples[-1].t_s):
                self._samples.append(state)
                if state.trip in FLOW_FAULTS:
                    self._flow_faults[state.observed_joint] = state.trip
            time.sleep(POLL_S)
