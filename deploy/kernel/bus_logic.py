"""Logic of the bus process: frames and requests in, frames and state out.

Pure: no clock, no bus, no shared memory; `deploy.kernel.bus_process` brings all of it.

* A message that ends a motion acts when it arrives, not in the next cycle.
* A command that stops motion goes out at once, others with the cycle time of the DBC.
* When sending ends, by the operator's stop or by its switches, zero goes out a few times before the
  silence. When the process ends, zero goes out once more.
* The operator's stop is stronger than any arming before it, whoever still says "armed".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from brokk_rl.machine import Machine
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import STAMP, BusDescription
from deploy.kernel.guard import (
    CommandRequest,
    Guard,
    GuardDecision,
    GuardInput,
    GuardState,
    GuardTrip,
)
from deploy.kernel.limits import GuardLimits
from deploy.kernel.protection import MessageFault
from deploy.kernel.receiver import BusReceiver
from deploy.kernel.target_check import SeenTarget, TargetCheck
from deploy.runtime.operator_state import (
    OperatorControls,
    OperatorState,
    PageSignal,
    RequestedCommand,
)

# They are handed in.
if TYPE_CHECKING:
    from deploy.checks.envelope import Envelope
    from deploy.checks.observer import Observer

CYCLE_S = 0.01
"""Half the cycle time of valve commands in the example DBC (20 ms)."""
LAST_ZEROS = 5
"""Zero commands before silence: 100 ms of the example bus, longer than the 70 ms after which the
gateway misses commands. One of them would do; the others are for a bus that loses some."""
IDLE, COMMAND = 0, 1
"""Values of `CommandMode`."""
TOLD_S = 10.0
"""Time for which a fault of a joint stands where nothing is ever sent. Chosen by hand."""
UP = (0.0, 0.0, 1.0)
HEARTBEAT = "PcHeartbeat"
"""Message with the state of this computer; optional in a DBC."""


@dataclass(frozen=True)
class BusInputs:
    """Newest records of the other processes; `None` where nothing has come.

    Attributes:
        controls: Switches on the operator's side.
        page: Signal of the operator's page; its stop is stronger than all switches before it, once
            it was read.
        request: Command to be sent.
        target: The chosen borehole.
    """

    controls: OperatorControls | None
    page: PageSignal | None
    request: RequestedCommand | None
    target: SeenTarget | None


class BusLogic:
    """Decisions of one bus cycle: frames to send and the state to publish.

    Args:
        description: The bus.
        machine: The machine.
        limits: Of the guard.
        envelope: Of the arm; `None`: there is none.
        observer: Of the joints' motion; `None`: there is none.
        commands: Whether anything is ever sent.
        needs_page: Whether commands are sent only while the operator's page lives.

    Attributes:
        receiver: Known values of the machine.
        decision: Of the guard, in the last cycle; `None` before the first.
    """

    def __init__(
        self,
        description: BusDescription,
        machine: Machine,
        limits: GuardLimits,
        envelope: Envelope | None,
        observer: Observer | None,
        commands: bool,
        needs_page: bool,
    ) -> None:
        self._description, self._machine, self._commands = description, machine, commands
        self._needs_page, self._page_age_s, self._present_age_s = needs_page, 0.0, math.inf
        self.receiver = BusReceiver(description, machine, limits)
        self._guard = Guard(limits, self.receiver.bounds, envelope)
        self.decision: GuardDecision | None = None
        ground_m, normal = None, UP
        if limits.envelope is not None:
            ground_m, normal = limits.envelope.ground_m, limits.envelope.face_normal
        self._target_check = TargetCheck(limits.target, machine, ground_m, normal)
        self._target = GuardTrip.NONE
        self._observer, self._joints_s = observer, limits.joints_s
        # Sum and number of valve feedback at the observer's last update.
        self._flow_sum, self._flow_number = np.zeros(machine.num_joints), 0
        self._zeros_left, self._found_s = 0, -math.inf
        # The latest stop is remembered here: what is written over it later takes nothing back.
        self._stopped_s, self._controls_age_s = -math.inf, math.inf
        # Counters and due times are kept by message name, since each has its own cycle.
        self._counters: dict[str, int] = {}
        self._due_s: dict[str, float] = {}

    def take(
        self, frame: CanFrame, now_s: float, steady_s: float | None = None
    ) -> tuple[MessageFault | None, bool]:
        """Take in a frame; return its fault, if any, and whether to decide at once."""
        fault = self.receiver.take(frame, now_s, steady_s)
        # Only while commanding: otherwise there is no motion to end, and the cycle keeps its time.
        if self.decision is None or self.decision.state is not GuardState.ACTIVE:
            return fault, False
        return fault, self._guard.stops(self._build_guard_input(now_s, True))

    def decide(
        self, now_s: float, bus_up: bool, inputs: BusInputs, num_missed: int
    ) -> list[CanFrame]:
        """Let the guard decide; return the frames to send now.

        Args:
            now_s: Monotonic time.
            bus_up: Whether the bus works.
            inputs: Newest records of the other processes.
            num_missed: Cycles missed so far.
        """
        controls, requested = inputs.controls, inputs.request
        self._controls_age_s = math.inf if controls is None else now_s - controls.t_s
        self._note_page(now_s, inputs.page)
        if self._observer is not None:
            self._observe(self._observer, now_s, inputs.target)
        seen = self._build_guard_input(now_s, bus_up)
        request = self._build_request(now_s, requested, inputs.target)
        before = self.decision
        armed = self._commands and is_armed(controls, self._stopped_s)
        self.decision = self._guard.decide(now_s, armed, seen, request)
        if not self._commands:
            return []
        if self.decision.sends:
            self._zeros_left = LAST_ZEROS
        elif self._zeros_left == 0:
            return []
        stops = before is not None and any(before.u) and not any(self.decision.u)
        silenced = before is not None and before.sends and not self.decision.sends
        return self._build_frames(now_s, at_once=stops or silenced, num_missed=num_missed)

    def _note_page(self, now_s: float, page: PageSignal | None) -> None:
        """Take in the signal of the operator's page."""
        if page is not None:
            self._stopped_s = max(self._stopped_s, page.stopped_s)
            self._present_age_s = now_s - page.present_s
        if self._needs_page:
            self._page_age_s = math.inf if page is None else now_s - page.t_s

    def _build_guard_input(self, now_s: float, bus_up: bool) -> GuardInput:
        ages_s = (self._controls_age_s, self._page_age_s, self._present_age_s)
        return self.receiver.build_guard_input(now_s, bus_up, *ages_s)

    def _build_request(
        self, now_s: float, requested: RequestedCommand | None, target: SeenTarget | None
    ) -> CommandRequest | None:
        """Check the borehole, with or without a command; return the command with what is known of it."""
        faces_m, is_seen, self._target = None, False, GuardTrip.NONE
        if target is not None:
            self._target = self._target_check.check(now_s, target)
            faces_m = (target.center_in_base_m, *target.seen_in_base_m)
            is_seen = bool(target.seen_in_base_m)
        if requested is None:
            return None
        u, age_s = tuple(requested.u.tolist()), now_s - requested.t_s
        return CommandRequest(u, age_s, self._target, faces_m, is_seen)

    def _observe(self, observer: Observer, now_s: float, target: SeenTarget | None) -> None:
        """Let the observer compare the last control period with its model, where one is over."""
        known = self.receiver
        # An armed operator clears a fault by the dead-man. Who only listens has to be told for a while.
        self._found_s = now_s if observer.observation.joint < 0 else self._found_s
        if not known.deadman and (self._commands or now_s - self._found_s > TOLD_S):
            observer.clear()
        oldest_s = min(float(known.q_t_s.min()), known.flow_t_s)
        if now_s - oldest_s > self._joints_s or not known.plausible:
            observer.forget()
        elif observer.is_due(now_s):
            number = known.flow_number - self._flow_number
            # Without news the flow stays as it is.
            flow = (known.flow_sum - self._flow_sum) / number if number else known.flow
            self._flow_sum, self._flow_number = known.flow_sum, known.flow_number
            may_touch = self._target_check.may_touch(known.q, target)
            observer.update(now_s, known.q, flow, may_touch)
        known.observation = observer.observation

    def build_state(self, now_s: float, bus_up: bool, num_missed: int) -> OperatorState:
        """Return the state to publish; call `decide` first."""
        assert self.decision is not None
        return self.receiver.build_state(now_s, bus_up, self.decision, self._target, num_missed)

    def end(self, now_s: float, num_missed: int) -> list[CanFrame]:
        """Return the last frames: zero, where anything was being sent."""
        if self.decision is None or not self.decision.sends:
            return []
        # To the guard the bus is going down. That is the strictest input: no request overrides it.
        closing = self._build_guard_input(now_s, False)
        self.decision = self._guard.decide(now_s, True, closing, None)
        return self._build_frames(now_s, at_once=True, num_missed=num_missed)

    def _build_frames(self, now_s: float, at_once: bool, num_missed: int) -> list[CanFrame]:
        """Return the guard's decision as a frame, and the heartbeat, where they are due.

        This is the one place from which valves are commanded.
        """
        assert self.decision is not None
        values: dict[str, float] = {STAMP: self.receiver.stamp_s}
        for joint, u in zip(self._machine.joint_names, self.decision.u, strict=True):
            values[f"Command_{joint}"] = u
        values["CommandMode"] = COMMAND if self.decision.state is GuardState.ACTIVE else IDLE
        frames = []
        command = self._build_frame(self._description.command.name, values, now_s, at_once)
        if command is not None:
            frames.append(command)
            self._zeros_left -= not self.decision.sends
            # Remembered before it is sent: the bus may deliver it back before `send` returns.
            self.receiver.note_own_command(command.data, now_s)
        # The gateway expects a heartbeat only where its DBC has one.
        if HEARTBEAT in self._description.layouts:
            state = {"PcState": self.decision.state.value, "Overruns": num_missed}
            heartbeat = self._build_frame(HEARTBEAT, state, now_s, at_once=False)
            frames += [] if heartbeat is None else [heartbeat]
        return frames

    def _build_frame(
        self, name: str, values: Mapping[str, float], now_s: float, at_once: bool
    ) -> CanFrame | None:
        """Return the next frame of a message, `None` where it is not due."""
        layout = self._description.layouts[name]
        due_s, period_s = self._due_s.get(name, now_s), layout.period_s
        # half a cycle early is on time: the next chance would be half a cycle late
        if now_s < due_s - CYCLE_S / 2 and not at_once:
            return None
        self._due_s[name] = max(due_s, now_s - period_s) + period_s
        counter = self._counters[name] = self._counters.get(name, -1) + 1
        data = self._description.encode(name, values, counter)
        return CanFrame(layout.frame_id, data, layout.extended)


def is_armed(controls: OperatorControls | None, stopped_s: float) -> bool:
    """Return whether commands are to be sent: armed, and later than the last stop at `stopped_s`."""
    return controls is not None and controls.armed and controls.armed_t_s > stopped_s
