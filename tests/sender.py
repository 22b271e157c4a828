"""Gateway and remote as senders: messages of the example bus, stamped and counted, on a clock that is told the time."""

from __future__ import annotations

from pathlib import Path

from composed import MACHINE, option
from desk import DBC

from brokk_rl.machine import Machine
from brokk_rl.registry import resolve_package_path
from deploy.bus.can_bus import CanFrame
from deploy.bus.description import BusDescription
from deploy.kernel.guard import GuardDecision, GuardInput, GuardState, GuardTrip
from deploy.kernel.protection import MessageFault
from deploy.kernel.receiver import BusReceiver
from deploy.runtime.operator_state import OperatorState

LIMITS = option("guard", "default")
BUS = BusDescription(DBC, MACHINE)
DBC_TEXT = resolve_package_path(DBC).read_text()
PERIODS_S = {
    name: one.period_s for name, one in BUS.layouts.items() if one.sender in ("GATEWAY", "REMOTE")
}
HOME = dict(zip((f"Position_{name}" for name in MACHINE.joint_names), MACHINE.home, strict=True))
USUAL = (
    HOME
    | {f"Valid_{name}": 1 for name in MACHINE.joint_names}
    | {"DeadMan": 1, "RemoteOn": 1, "FlowSource": 2, "OilTemperature": 35, "RoundTrip": 0.03}
)
DECISION = GuardDecision(
    GuardState.SILENT, (0.1, 0.2, 0.3, 0.4, 0.5), GuardTrip.BUS_DOWN, GuardTrip.ESTOP
)


def build_other_bus(folder: Path, text: str) -> BusDescription:
    """Returns the bus of another description than the shipped one."""
    path = folder / "other.dbc"
    path.write_text(text)
    return BusDescription(str(path), MACHINE)


class Sender:
    """Gateway and remote as they send, with a clock that is 40 s ahead of the receiver's."""

    def __init__(self, bus: BusDescription = BUS, machine: Machine = MACHINE) -> None:
        self.bus, self.now_s = bus, 1000.0
        self.receiver = BusReceiver(bus, machine, LIMITS)
        self.counters = dict.fromkeys(PERIODS_S, 0)
        self.values: dict[str, float] = USUAL | bus.identity

    def build(self, name: str, late_s: float = 0.0, **values: float) -> CanFrame:
        self.counters[name] += 1
        layout = self.bus.layouts[name]
        known = self.values | {"Stamp": self.now_s + 40.0 - late_s} | values
        return CanFrame(layout.frame_id, self.bus.encode(name, known, self.counters[name]))

    def send(self, name: str, late_s: float = 0.0, **values: float) -> MessageFault | None:
        return self.receiver.take(self.build(name, late_s, **values), self.now_s)

    def go(self, seconds: float, *left_out: str, late_s: dict[str, float] | None = None) -> None:
        """Let all messages come at their rates, but for some."""
        for _ in range(round(seconds * 100)):
            self.now_s += 0.01
            for name, period_s in PERIODS_S.items():
                if name not in left_out and round(self.now_s * 100) % round(period_s * 100) == 0:
                    self.send(name, (late_s or {}).get(name, 0.0))

    def seen(self, controls_age_s: float = 0.01) -> GuardInput:
        return self.receiver.build_guard_input(self.now_s, True, controls_age_s)

    def state(self, bus_up: bool = True) -> OperatorState:
        return self.receiver.build_state(self.now_s, bus_up, DECISION, GuardTrip.NONE, 7)
