"""The outlet: all that is shown to an operator, taken from the slots at one moment; terminal and page read only this.

Plain data in SI units. What is stale is said to be so by its age, never left out; whoever draws it
greys it by that.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from typing import Any

from deploy.guard.guard import GuardState
from deploy.guidance import LeverAngles, LeverPositions
from deploy.policy.policy_process import REASONS, AdviceStatus
from deploy.runtime.bus_process import TRIPS
from deploy.runtime.shm_layout import LoopMemory


@dataclass(frozen=True)
class Advice:
    """What the policy proposes.

    Attributes:
        valid: Whether there is an advice; if not, `levers` are on their way to neutral and `reason`
            says why.
        reason: Why there is none.
        age_s: Since it was made.
        number: Counts up; tells a new advice from an old one.
        levers: To show in green.
        command: The commands behind it, in machine order.
        target_in_base_m: The borehole it is for.
    """

    valid: bool
    reason: str
    age_s: float
    number: int
    levers: LeverAngles
    command: tuple[float, ...]
    target_in_base_m: tuple[float, ...]


@dataclass(frozen=True)
class Machine:
    """What is known of the machine.

    Attributes:
        q: Joint positions, rad or m, in machine order.
        q_age_s: Their age.
        flow: What the valves get, of full.
        levers: The operator's own levers, of full; to show in blue.
        levers_age_s: Their age.
        exclusive_selected: Whether q2 is selected at the machine.
        oil_c: Temperature of the oil, degrees Celsius; `None` where not measured.
    """

    q: tuple[float, ...]
    q_age_s: float
    flow: tuple[float, ...]
    levers: LeverPositions
    levers_age_s: float
    exclusive_selected: bool
    oil_c: float | None


@dataclass(frozen=True)
class Safety:
    """Whether anything is sent, and what stands against it.

    Attributes:
        commands: Whether this loop can command valves at all; in the default mode it cannot.
        state: The guard's: `SILENT`, `LATCHED`, `READY`, `ACTIVE`.
        trip: What is wrong now, `nothing` where all is well.
        cause: What latched it.
        deadman: Whether the dead-man is held.
        estop: Whether an emergency stop is on.
        bus_up: Whether the bus works.
        trusted: Whether messages arrive uncorrupted.
        plausible: Whether positions make sense.
        sent: Commands sent, in machine order.
        refused: Messages refused so far.
        lost: Messages lost so far.
        log_dropped: Records that the log could not take: what is recorded has gaps.
    """

    commands: bool
    state: str
    trip: str
    cause: str
    deadman: bool
    estop: bool
    bus_up: bool
    trusted: bool
    plausible: bool
    sent: tuple[float, ...]
    refused: int
    lost: int
    log_dropped: int


@dataclass(frozen=True)
class LoopSnapshot:
    """Everything at one moment; `None` where nothing has come yet.

    Attributes:
        t_s: Monotonic time.
        alive: Whether the bus process is at work.
        advice: What to do.
        machine: How the machine stands.
        safety: What may be sent.
    """

    t_s: float
    alive: bool
    advice: Advice | None
    machine: Machine | None
    safety: Safety | None

    def plain(self) -> dict[str, Any]:
        """Returns it as plain JSON data; what is not finite is null."""
        return _to_plain(asdict(self))


ALIVE_S = 0.2
"""Age of the newest state up to which the bus process is said to be at work."""


def read_snapshot(memory: LoopMemory) -> LoopSnapshot:
    """Returns what is to be shown now."""
    state, advice, now_s = memory.state.read(), memory.advice.read(), time.monotonic()
    proposed = None
    if advice is not None:
        proposed = Advice(
            valid=REASONS[int(advice["reason"])] is AdviceStatus.VALID,
            reason=REASONS[int(advice["reason"])].value,
            age_s=now_s - float(advice["t_s"]),
            number=int(advice["number"]),
            levers=LeverAngles(
                *advice["lever_rad"].tolist(), button_right=bool(advice["button_right"])
            ),
            command=tuple(advice["u"].tolist()),
            target_in_base_m=tuple(advice["target_in_base_m"].tolist()),
        )
    if state is None:
        return LoopSnapshot(now_s, False, proposed, None, None)
    oil_c = float(state["oil_c"])
    machine = Machine(
        q=tuple(state["q"].tolist()),
        q_age_s=now_s - float(state["q_t_s"]),
        flow=tuple(state["flow"].tolist()),
        levers=LeverPositions(*state["lever"].tolist(), button_right=bool(state["button_right"])),
        levers_age_s=now_s - float(state["levers_t_s"]),
        exclusive_selected=bool(state["exclusive_selected"]),
        oil_c=oil_c if math.isfinite(oil_c) else None,
    )
    safety = Safety(
        commands=memory.request is not None,
        state=GuardState(int(state["guard"])).name,
        trip=TRIPS[int(state["trip"])].value,
        cause=TRIPS[int(state["cause"])].value,
        deadman=bool(state["deadman"]),
        estop=bool(state["estop"]),
        bus_up=bool(state["bus_up"]),
        trusted=bool(state["trusted"]),
        plausible=bool(state["q_plausible"]),
        sent=tuple(state["sent"].tolist()),
        refused=int(state["refused"]),
        lost=int(state["lost"]),
        log_dropped=sum(pipe.dropped for pipe in memory.logs),
    )
    return LoopSnapshot(now_s, now_s - float(state["t_s"]) < ALIVE_S, proposed, machine, safety)


def _to_plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
