"""The receiving side of the bus process: from frames to what is known of the machine."""

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
    BusDescription,
    MessageLayout,
)
from deploy.bus.protection import ChannelTrust, MessageFault, ProtectedChannel
from deploy.guard.guard import GuardInput
from deploy.guard.limits import GuardLimits, build_joint_bounds
from deploy.guard.plausibility import PlausibilityFilter

OWN = 8
"""Commands last sent that are known again: on some buses a node hears itself."""
FROM_PC = 2
"""Value of `FlowSource`."""
STAMP_MODULUS_S = 65.536
"""The gateway's clock of the example wraps here."""
FORGET_S = 60.0
"""The best transit time is taken anew over such times, so that clocks may drift."""


@dataclass
class BusReceiver:
    """What is known of the machine, message by message.

    Attributes:
        description: The bus.
        machine: The machine.
        limits: For plausibility.
    """

    description: BusDescription
    machine: Machine
    limits: GuardLimits

    def __post_init__(self) -> None:
        machine, described = self.machine, self.description
        heard = [layout for node in (GATEWAY, REMOTE) for layout in described.sent_by(node)]
        self.channels = {
            layout.name: ProtectedChannel(layout.modulus)
            for layout in heard
            if layout.data_id is not None
        }
        self._wanted = {layout.frame_id: layout for layout in heard}
        needed = {
            described.message_of(name)
            for name in ("DeadMan", "EStop", "ExclusiveSelected", f"Flow_{machine.joint_names[0]}")
        }
        needed |= {described.message_of(f"Position_{joint}") for joint in machine.joint_names}
        self._needed = needed & set(self.channels)
        self.body = build_joint_bounds(
            machine.lower.tolist(),
            machine.upper.tolist(),
            machine.max_speed.tolist(),
            machine.is_exclusive.tolist(),
        )
        self.plausibility = PlausibilityFilter(self.limits, self.body)
        count = machine.num_joints
        self.q, self.q_t_s, self.q_valid = (
            np.zeros(count),
            np.full(count, -math.inf),
            np.zeros(count, dtype=bool),
        )
        self.flow, self.flow_sum, self.flow_number, self.flow_t_s = (
            np.zeros(count),
            np.zeros(count),
            0,
            -math.inf,
        )
        self.followed = False
        self.lever, self.levers_t_s = np.zeros(4), -math.inf
        self.button_right = self.deadman = self.remote_on = False
        self.estop, self.exclusive_selected, self.oil_c, self.status_t_s = (
            False,
            False,
            math.nan,
            -math.inf,
        )
        self.frames = self.refused = 0
        self.held_up_s, self._transit = 0.0, _TransitTime()
        self._own: deque[bytes] = deque(maxlen=OWN)
        self._stranger_s = -math.inf

    @property
    def frame_ids(self) -> list[int]:
        """Identifiers to receive: what gateway and remote send, and valve commands of others."""
        return [*self._wanted, self.description.command.frame_id]

    def sent(self, data: bytes) -> None:
        """Is told the data of a command that this process sends itself, before it does."""
        self._own.append(data)

    def take(self, frame: CanFrame, now_s: float) -> MessageFault | None:
        """Takes in a frame; returns what is wrong with it."""
        layout = self._wanted.get(frame.frame_id)
        if layout is None:
            if frame.frame_id == self.description.command.frame_id and frame.data not in self._own:
                self._stranger_s = now_s
            return None
        self.frames += 1
        channel = self.channels.get(layout.name)
        values = self.description.decode(layout, frame.data)
        if isinstance(values, MessageFault):
            fault = channel.refuse(values) if channel else values
        else:
            fault = channel.take(int(values[COUNTER])) if channel else None
        if fault is not None or isinstance(values, MessageFault):
            self.refused += 1
            return fault
        self._use(layout, values, now_s)
        return None

    def seen(self, now_s: float, bus_up: bool) -> GuardInput:
        """Returns what the guard is to know."""
        return GuardInput(
            q=tuple(self.q.tolist()),
            joints_age_s=now_s - float(self.q_t_s.min()) + self.held_up_s,
            joints_plausible=bool(self.q_valid.all()) and self.plausibility.plausible,
            trusted=self.trusted,
            levers_age_s=now_s - self.levers_t_s if self.remote_on else math.inf,
            lever=float(np.abs(self.lever).max()),
            deadman=self.deadman,
            status_age_s=now_s - self.status_t_s,
            estop=self.estop,
            bus_up=bus_up,
            followed=self.followed,
            alone=now_s - self._stranger_s > 1.0,
        )

    @property
    def trusted(self) -> bool:
        """Whether none of the channels that matter has become invalid."""
        return all(self.channels[name].trust is not ChannelTrust.INVALID for name in self._needed)

    @property
    def lost(self) -> int:
        """Messages that the counters have skipped."""
        return sum(channel.lost for channel in self.channels.values())

    def _use(self, layout: MessageLayout, values: dict[str, float], now_s: float) -> None:
        machine, stamp = self.machine, values.get("Stamp")
        if stamp is not None:
            self.held_up_s = self._transit.held_up(stamp, now_s)
        for j, joint in enumerate(machine.joint_names):
            position = values.get(f"Position_{joint}")
            if position is not None:
                self.q_valid[j] = values.get(f"Valid_{joint}", 1.0) == 1.0
                if self.plausibility.accept(j, now_s, position) and self.q_valid[j]:
                    self.q[j], self.q_t_s[j] = position, now_s
        if f"Flow_{machine.joint_names[0]}" in values:
            self.followed = values["FlowSource"] == FROM_PC
            self.flow = np.array([values[f"Flow_{joint}"] for joint in machine.joint_names])
            self.flow_sum, self.flow_number, self.flow_t_s = (
                self.flow_sum + self.flow,
                self.flow_number + 1,
                now_s,
            )
        if "DeadMan" in values:
            self.lever = np.array([values[f"Lever_{axis}"] for axis in LEVER_AXES])
            self.button_right, self.deadman = values["ButtonRight"] == 1.0, values["DeadMan"] == 1.0
            self.remote_on, self.levers_t_s = values["RemoteOn"] == 1.0, now_s
        if "EStop" in values:
            self.estop, self.exclusive_selected = (
                values["EStop"] == 1.0,
                values["ExclusiveSelected"] == 1.0,
            )
            self.oil_c, self.status_t_s = values.get("OilTemperature", math.nan), now_s


class _TransitTime:
    """How much longer than at best a stamped message was on its way, whatever the two clocks say."""

    def __init__(self) -> None:
        self._offset_s: float | None = None
        self._best_s, self._recent_s, self._since_s = math.inf, math.inf, -math.inf

    def held_up(self, stamp_s: float, now_s: float) -> float:
        raw_s = now_s - stamp_s
        if self._offset_s is None:
            self._offset_s = raw_s
        # clocks differ by a constant and whole turns of the stamp
        transit_s = (
            raw_s - self._offset_s + STAMP_MODULUS_S / 2
        ) % STAMP_MODULUS_S - STAMP_MODULUS_S / 2
        if now_s - self._since_s > FORGET_S:
            self._best_s, self._recent_s, self._since_s = (
                min(self._recent_s, transit_s),
                transit_s,
                now_s,
            )
        self._recent_s = min(self._recent_s, transit_s)
        self._best_s = min(self._best_s, transit_s)
        return transit_s - self._best_s
