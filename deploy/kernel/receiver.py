"""The receiving side of the bus process: frames in, `OperatorState` and `GuardInput` out.

Pure: the caller brings frames and time. Every age counts from the stamp of a message, not from its
arrival.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from brokk_rl.machine import Machine
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import (
    COUNTER,
    GATEWAY,
    LEVER_AXES,
    REMOTE,
    STAMP,
    BusDescription,
    MessageLayout,
)
from deploy.guidance import LeverMap
from deploy.kernel.clock import GatewayClock
from deploy.kernel.flow_check import FROM_PC, FlowCheck
from deploy.kernel.guard import NOTHING_OBSERVED, GuardDecision, GuardInput, GuardTrip, Observation
from deploy.kernel.limits import GuardLimits, JointBounds
from deploy.kernel.plausibility import PlausibilityFilter
from deploy.kernel.protection import ChannelTrust, MessageFault, ProtectedChannel
from deploy.runtime.operator_state import OperatorState

NUM_OWN_COMMANDS = 8
"""Commands sent last that are recognised as our own: on some buses a node hears itself. More than a
bus process can send before it reads them back; chosen by hand."""
STRANGER_S = 1.0
"""Time for which a valve command of another node counts against commanding. Chosen by hand: many
periods of any cyclic sender."""


@dataclass
class BusReceiver:
    """Known values of the machine, updated message by message.

    Attributes:
        description: The bus.
        machine: The machine.
        limits: For plausibility.
        observation: Newest result of the observer, as the bus process's logic sets it.
    """

    description: BusDescription
    machine: Machine
    limits: GuardLimits

    def __post_init__(self) -> None:
        machine, described = self.machine, self.description
        heard = [*described.sent_by(GATEWAY), *described.sent_by(REMOTE)]
        self.channels: dict[str, ProtectedChannel] = {}
        for layout in heard:
            if layout.data_id is not None:
                self.channels[layout.name] = layout.open_channel()
        self._layouts = {layout.frame_id: layout for layout in heard}
        # The clock is learned from the stamps that wrap last: they are the finest and the surest.
        own = [layout.stamp_wrap_s for layout in heard if layout.sender == GATEWAY]
        self._clock, self._longest_wrap_s = GatewayClock(), max(own, default=0.0)
        # A gateway that does not measure it reports none.
        self.round_trip_s = math.inf if described.has_signal("RoundTrip") else 0.0
        self._needed = described.list_needed() & set(self.channels)
        self.bounds = JointBounds(
            tuple(machine.lower.tolist()),
            tuple(machine.upper.tolist()),
            tuple(machine.max_speed.tolist()),
            tuple(machine.is_exclusive.tolist()),
            machine.dead_time_s,
        )
        self.flow_check = FlowCheck(self.limits.flow, machine.num_joints, self.limits.round_trip_s)
        has_levers = {lever.joint for lever in machine.levers} >= set(machine.joint_names)
        self._lever_map = LeverMap(machine) if has_levers else None
        self.flow_source = 0
        # Whether the gateway goes by our description and machine; `None` until it says so.
        self.described: bool | None = None
        self._stamp_s = 0.0
        self.plausibility = PlausibilityFilter(self.limits, self.bounds)
        self.observation = NOTHING_OBSERVED
        count = machine.num_joints
        # Ages start at infinity: nothing is known before the first message.
        self.q, self.q_valid = np.zeros(count), np.zeros(count, dtype=bool)
        self.q_t_s = np.full(count, -math.inf)
        self.flow, self.flow_sum = np.zeros(count), np.zeros(count)
        self.flow_number, self.flow_t_s = 0, -math.inf
        self.followed = False
        self.lever, self.levers_t_s = np.zeros(len(LEVER_AXES)), -math.inf
        self.button_right = self.deadman = self.remote_on = False
        self.estop = self.exclusive_selected = False
        self.oil_c, self.status_t_s = math.nan, -math.inf
        self.frames = self.refused = 0
        # Delay of the newest message of each name.
        self._delay_s: dict[str, float] = {}
        self._own: deque[bytes] = deque(maxlen=NUM_OWN_COMMANDS)
        self._stranger_s = -math.inf

    @property
    def frame_ids(self) -> list[int]:
        """Identifiers to receive: all of gateway and remote, and valve commands of others."""
        return [*self._layouts, self.description.command.frame_id]

    def note_own_command(self, data: bytes, now_s: float) -> None:
        """Remember the data of a command that this process is about to send."""
        self._own.append(data)
        values = self.description.decode(self.description.command, data)
        assert not isinstance(values, MessageFault)
        # As it is coded: rounded, and within the range of its signals.
        u = tuple(values[f"Command_{joint}"] for joint in self.machine.joint_names)
        self.flow_check.note_command(now_s, u)

    def take(
        self, frame: CanFrame, now_s: float, steady_s: float | None = None
    ) -> MessageFault | None:
        """Decode a frame and use its values; return its fault, if any.

        Args:
            frame: The frame.
            now_s: When it came.
            steady_s: The same by a clock that nobody slews, to compare with the gateway's; `None`:
                `now_s` is one.
        """
        steady_s = now_s if steady_s is None else steady_s
        layout = self._layouts.get(frame.frame_id)
        if layout is None:
            # A command that this process did not send comes from a second commander.
            if frame.frame_id == self.description.command.frame_id and frame.data not in self._own:
                self._stranger_s = now_s
            return None
        self.frames += 1
        channel = self.channels.get(layout.name)
        values = self.description.decode(layout, frame.data)
        if isinstance(values, MessageFault):
            # A refused frame still moves the channel towards "invalid".
            fault = channel.refuse(values) if channel else values
        else:
            fault = self._check_stamp(layout, values.get(STAMP, 0.0), steady_s)
            if fault is not None and channel is not None:
                channel.refuse(fault)
            elif channel is not None:
                fault = channel.take(int(values[COUNTER]), values.get(STAMP, 0.0), now_s)
        if fault is not None or isinstance(values, MessageFault):
            self.refused += 1
            return fault
        sent_s = now_s
        if layout.stamp_wrap_s:
            sent_s = self._clock.find_sent_s(values[STAMP], layout.stamp_wrap_s, steady_s)
            sent_s += now_s - steady_s
        if math.isfinite(sent_s):
            self._delay_s[layout.name] = now_s - sent_s
        self._use(values, sent_s, now_s)
        return None

    @property
    def stamp_s(self) -> float:
        """Newest stamp of the gateway, to be put into commands."""
        return self._clock.newest_s

    @property
    def held_up_s(self) -> float:
        """Largest delay of a message beyond the shortest; 0 where none has come."""
        return max(self._delay_s.values(), default=0.0)

    def build_guard_input(
        self,
        now_s: float,
        bus_up: bool,
        controls_age_s: float,
        page_age_s: float = 0.0,
        present_age_s: float = math.inf,
    ) -> GuardInput:
        """Return the values that the guard decides by.

        Args:
            now_s: Time of the cycle.
            bus_up: Whether the bus works.
            controls_age_s: Age of the operator's switches.
            page_age_s: Age of the page's signal.
            present_age_s: Since a person touched the page last.
        """
        return GuardInput(
            q=tuple(self.q.tolist()),
            # The oldest position counts: the guard needs all joints.
            joints_age_s=now_s - float(self.q_t_s.min()),
            joints_plausible=self.plausible,
            trusted=self.trusted,
            # A remote that is off is as good as one that never came.
            levers_age_s=now_s - self.levers_t_s if self.remote_on else math.inf,
            lever=float(np.abs(self.lever).max()),
            deadman=self.deadman,
            status_age_s=now_s - self.status_t_s,
            estop=self.estop,
            bus_up=bus_up,
            followed=self.followed,
            feedback_age_s=now_s - self.flow_t_s,
            alone=self._is_alone(now_s),
            controls_age_s=controls_age_s,
            round_trip_s=self.round_trip_s,
            page_age_s=page_age_s,
            present_age_s=present_age_s,
            described=self.described,
            observed=self.found.fault,
        )

    @property
    def found(self) -> Observation:
        """Fault of the valves' flow, else of the joints' motion."""
        flow = self.flow_check
        if flow.fault is GuardTrip.NONE:
            return self.observation
        return Observation(flow.fault, flow.joint)

    def build_state(
        self, now_s: float, bus_up: bool, decision: GuardDecision, target: GuardTrip, missed: int
    ) -> OperatorState:
        """Return the state to publish.

        Args:
            now_s: Time of the cycle.
            bus_up: Whether the bus works.
            decision: The guard's, in this cycle.
            target: Fault of the borehole.
            missed: Cycles missed so far.
        """
        return OperatorState(
            t_s=now_s,
            q=self.q.copy(),
            # Infinite ages become 0, since a record has no infinity.
            q_t_s=max(0.0, float(self.q_t_s.min())),
            q_plausible=self.plausible,
            flow=self.flow,
            flow_sum=self.flow_sum,
            flow_number=self.flow_number,
            flow_t_s=max(0.0, self.flow_t_s),
            lever=self.lever,
            button_right=self.button_right,
            deadman=self.deadman,
            remote_on=self.remote_on,
            levers_t_s=max(0.0, self.levers_t_s),
            estop=self.estop,
            exclusive_selected=self.exclusive_selected,
            status_t_s=max(0.0, self.status_t_s),
            oil_c=self.oil_c,
            held_up_s=self.held_up_s,
            round_trip_s=self.round_trip_s,
            bus_up=bus_up,
            trusted=self.trusted,
            alone=self._is_alone(now_s),
            guard=decision.state,
            trip=decision.trip,
            cause=decision.cause,
            sent=np.array(decision.u),
            frames=self.frames,
            refused=self.refused,
            lost=sum(channel.lost for channel in self.channels.values()),
            missed=missed,
            target=target,
            prompt=decision.prompt,
            observed_joint=self.found.joint + 1,
        )

    @property
    def plausible(self) -> bool:
        """True if the sensors call all positions valid, and none has jumped."""
        return bool(self.q_valid.all()) and self.plausibility.plausible

    @property
    def trusted(self) -> bool:
        """True if none of the needed channels has become invalid."""
        return all(self.channels[name].trust is not ChannelTrust.INVALID for name in self._needed)

    def _is_alone(self, now_s: float) -> bool:
        return now_s - self._stranger_s > STRANGER_S

    def _check_stamp(
        self, layout: MessageLayout, stamp_s: float, steady_s: float
    ) -> MessageFault | None:
        """Learn from a stamp; return the fault of one from the future."""
        wrap_s = layout.stamp_wrap_s
        if not wrap_s:
            return None
        if layout.sender == GATEWAY and wrap_s == self._longest_wrap_s:
            is_early = self._clock.learn(stamp_s, wrap_s, steady_s)
            self._stamp_s = stamp_s
        else:
            is_early = self._clock.is_early(stamp_s, wrap_s, steady_s)
        return MessageFault.EARLY if is_early else None

    def _use(self, values: dict[str, float], sent_s: float, now_s: float) -> None:
        machine = self.machine
        for j, joint in enumerate(machine.joint_names):
            position = values.get(f"Position_{joint}")
            if position is not None:
                # A sensor without a validity signal is taken at its word.
                self.q_valid[j] = values.get(f"Valid_{joint}", 1.0) == 1.0
                # The filter is asked first, so that it also learns of positions called invalid.
                if self.plausibility.accept(j, sent_s, position) and self.q_valid[j]:
                    self.q[j], self.q_t_s[j] = position, sent_s
        if f"Flow_{machine.joint_names[0]}" in values:
            self.flow = np.array([values[f"Flow_{joint}"] for joint in machine.joint_names])
            # Sums and counts, so that a reader can form the mean flow of any period.
            self.flow_sum, self.flow_number = self.flow_sum + self.flow, self.flow_number + 1
            self.flow_t_s = sent_s
        if "FlowSource" in values:
            self.flow_source = int(values["FlowSource"])
            self.followed = self.flow_source == FROM_PC
        if "RoundTrip" in values:
            self.round_trip_s = values["RoundTrip"]
        if "DeadMan" in values:
            self.lever = np.array([values[f"Lever_{axis}"] for axis in LEVER_AXES])
            pressed = values["DeadMan"] == 1.0 and not self.deadman
            self.button_right, self.deadman = values["ButtonRight"] == 1.0, values["DeadMan"] == 1.0
            self.remote_on, self.levers_t_s = values["RemoteOn"] == 1.0, sent_s
            self._note_levers(now_s)
            # Without `RoundTrip` nobody could tell a clock that was set back from a real delay.
            if pressed and self.description.has_signal("RoundTrip"):
                self._clock.accept_delay(self._stamp_s, self.limits.joints_s)
        if "DescriptionHash" in values:
            expected = self.description.identity
            self.described = all(values[name] == expected[name] for name in expected)
        if "EStop" in values:
            self.estop = values["EStop"] == 1.0
            self.exclusive_selected = values["ExclusiveSelected"] == 1.0
            self.oil_c, self.status_t_s = values.get("OilTemperature", math.nan), sent_s
        # Last: a message may hold flow, source and emergency stop together.
        if f"Flow_{machine.joint_names[0]}" in values:
            flow = tuple(self.flow.tolist())
            source, known_s = self.flow_source, self.round_trip_s
            self.flow_check.take(now_s, flow, source, self.estop, known_s)

    def _note_levers(self, now_s: float) -> None:
        """Tell the comparison of flows what the operator's levers ask for."""
        num_joints = self.machine.num_joints
        asked = np.zeros(num_joints)
        if self.remote_on and self._lever_map is not None:
            angles_rad = self.lever * self._lever_map.axis_full_rad
            asked = self._lever_map.command(angles_rad, self.button_right)
        elif self.remote_on and self.lever.any():
            # Nobody knows which joint they move.
            self.flow_check.note_levers(now_s, (-1.0,) * num_joints)
            asked = np.ones(num_joints)
        self.flow_check.note_levers(now_s, tuple(asked.tolist()))
