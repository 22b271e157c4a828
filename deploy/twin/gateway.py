"""Executable reference of the gateway's rules: which sender gets the valves, and when none does.

    levers moved at a remote that is on   the operator has the valves, whatever else is sent
    valid commands, dead-man held         the PC has them, after three frames with mode idle
    otherwise                             zero flow

Commands that stay away for `TIMEOUT_S`, whose counter stands still or whose CRC is wrong count as
missing; the PC then begins again with idle frames. Zero flow at an emergency stop, and when the
remote is lost. Commands and levers carry the newest stamp of this gateway's clock that their senders
have heard: those that are too old are refused, wherever on the way they were held up.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from brokk_rl.machine import Machine
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import COUNTER, LEVER_AXES, STAMP, BusDescription
from deploy.guidance import AXES, LeverMap
from deploy.kernel.protection import ChannelTrust, MessageFault

TIMEOUT_S = 0.07
"""Age of the last valid command from which there is none; three cycles and a half, within the 100
ms that are promised."""
REMOTE_S = 0.13
"""Age of the remote's last message from which it is lost: six of its periods, and a half."""
ROUND_TRIP_S = 0.15
"""Age of the stamp in a command above which it is refused: the 150 ms that are promised for delay."""
ROUNDING_S = 1e-6
"""Rounding error that a difference of times may have, s."""
LARGEST_ROUND_TRIP_S = 0.51
"""Largest value of the signal `RoundTrip` in the example DBC; "not measured" is sent as this too."""
FORGET_S = 1.0
"""Silence of the PC after which its next command counts as heard anew. Chosen by hand."""
IDLE_FRAMES = 3
"""Frames with mode idle before the PC gets the valves: a program that wakes up late begins anew."""
NEUTRAL = 0.03
"""Deflection, of full, above which the operator's hand is on a lever. Chosen by hand: below that of
the guard, so that the gateway always notices first."""
NOBODY, LEVERS, PC = 0, 1, 2
"""Values of `FlowSource`."""


class GatewayState(Enum):
    """Values of the signal `GatewayState`."""

    IDLE = 0
    LEVERS = 1
    PC = 2
    TIMEOUT = 3
    STOPPED = 4


class Gateway:
    """Gateway between bus and valves. Pure: the caller brings frames and time.

    Args:
        description: The bus.
        machine: The machine.

    Attributes:
        estop: Whether the emergency stop is pressed.
        heard_s: Since when the PC is heard.
        round_trip_s: Age of the stamp in the newest command.
    """

    def __init__(self, description: BusDescription, machine: Machine) -> None:
        self._description, self._machine = description, machine
        self._command = description.command
        self._remote = description.layouts[description.message_of("DeadMan")]
        self._channels = {}
        for layout in (self._command, self._remote):
            self._channels[layout.name] = layout.open_channel()
        self._most_s = {self._command.name: ROUND_TRIP_S, self._remote.name: REMOTE_S}
        self._map = LeverMap(machine)
        self._u, self._u_s, self._mode, self._idle = np.zeros(machine.num_joints), -np.inf, 0, 0
        self._lever, self._remote_s = np.zeros(len(AXES)), -np.inf
        self._button = self._deadman = self._on = False
        self.estop, self.heard_s = False, np.inf
        self.round_trip_s, self._round_trip_t_s = np.inf, -np.inf

    def take(self, frame: CanFrame, now_s: float) -> None:
        """Take in a frame of PC or remote."""
        layout = self._description.by_id.get(frame.frame_id)
        if layout is None or layout.name not in self._channels:
            return
        channel, values = self._channels[layout.name], self._description.decode(layout, frame.data)
        if isinstance(values, MessageFault):
            channel.refuse(values)
            return
        stamp_s = values.get(STAMP, 0.0)
        age_s = 0.0
        if layout.stamp_wrap_s:
            # A stamp of this very moment must not seem to lie in the future, through rounding.
            age_s = (now_s - stamp_s + ROUNDING_S) % layout.stamp_wrap_s
        if layout is self._command:
            self.round_trip_s, self._round_trip_t_s = age_s, now_s
        if age_s > self._most_s[layout.name]:
            channel.refuse(MessageFault.LATE)
            return
        fault = channel.take(int(values[COUNTER]), stamp_s, now_s)
        if fault is not None or channel.trust is not ChannelTrust.VALID:
            return
        if layout is self._remote:
            self._lever = np.array([values[f"Lever_{axis}"] for axis in LEVER_AXES])
            self._button, self._deadman = values["ButtonRight"] == 1.0, values["DeadMan"] == 1.0
            self._on, self._remote_s = values["RemoteOn"] == 1.0, now_s
            return
        if now_s - self._u_s > TIMEOUT_S:
            self._idle = 0
        if now_s - self._u_s > FORGET_S:
            self.heard_s = now_s
        self._mode = int(values["CommandMode"])
        self._idle = min(IDLE_FRAMES, self._idle + 1) if self._mode == 0 else self._idle
        self._u = np.array([values[f"Command_{joint}"] for joint in self._machine.joint_names])
        self._u_s = now_s

    def decide(self, now_s: float) -> tuple[np.ndarray, int, GatewayState]:
        """Return the flow of the valves, `(J,)`, its source, and the gateway's state."""
        nothing = np.zeros(self._machine.num_joints)
        remote = self._on and now_s - self._remote_s <= REMOTE_S and self._trusts(self._remote.name)
        if self.estop or not remote:
            self._idle = 0  # whoever commands begins again
            return nothing, NOBODY, GatewayState.STOPPED
        if np.abs(self._lever).max() > NEUTRAL:
            self._idle = 0
            flow = self._map.command(self._lever * self._map.axis_full_rad, self._button)
            return flow, LEVERS, GatewayState.LEVERS
        if now_s - self._u_s > TIMEOUT_S or not self._trusts(self._command.name):
            return nothing, NOBODY, GatewayState.TIMEOUT
        if not self._deadman or self._mode != 1 or self._idle < IDLE_FRAMES:
            return nothing, NOBODY, GatewayState.IDLE
        moved = self._u != 0
        if moved[self._machine.is_exclusive].any() and moved.sum() > 1:
            return nothing, NOBODY, GatewayState.IDLE
        return self._u, PC, GatewayState.PC

    def report_round_trip_s(self, now_s: float) -> float:
        """Return the signal `RoundTrip`."""
        known = now_s - self._round_trip_t_s <= FORGET_S
        return min(LARGEST_ROUND_TRIP_S, self.round_trip_s) if known else LARGEST_ROUND_TRIP_S

    @property
    def exclusive_selected(self) -> bool:
        """True if the exclusive joint is selected at the remote."""
        return self._button

    def _trusts(self, name: str) -> bool:
        return self._channels[name].trust is not ChannelTrust.INVALID
