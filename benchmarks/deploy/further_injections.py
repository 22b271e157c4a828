"""Injected faults of machine, bus, clocks and memory, for `injections.py`.

Each function breaks something on a stage whose machine moves (`tests/stage.py`); `trial` picks a
variant. Its docstring is its row in the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from stage import Stage

from deploy.bus.can_bus import CanFrame
from deploy.bus.description import COUNTER, STAMP
from deploy.runtime.shm_layout import RecordSlot
from deploy.twin.remote import RadioRemote

Inject = Callable[[Stage, int], None]
Values = dict[str, float]
STAMPED = ("JointPos1", "JointPos2", "JointPos3", "MachineStatus", "ValveFeedback")
"""Messages with the gateway's own clock."""
COUNTER_TURN = 16
"""Messages after which a counter begins anew."""
OFF_S = (0.15, 0.2, 0.3, 0.6, 1.2, 2.5)
"""Lengths of a pause: beyond the limits of age, and beyond all memory of the receivers."""


def hold_button(stage: Stage) -> None:
    """Let the operator hold the dead-man, whatever happens."""
    stage.twin._holds_deadman = lambda now_s: True


def reboot_remote(stage: Stage, trial: int) -> None:
    """The remote reboots, 0.15 to 2.5 s long, and its dead-man is held all the time."""
    remote, end_s = (
        RadioRemote(stage.twin._description, stage.machine),
        stage.now_s + OFF_S[trial % 6],
    )
    stage.twin._remote = remote
    remote.is_ready = False

    def boot(frame: CanFrame) -> None:
        if stage.now_s >= end_s:
            RadioRemote.hear(remote, frame)

    remote.hear = boot


def reboot_gateway(stage: Stage, trial: int) -> None:
    """The gateway reboots, its clock begins at 0, and the dead-man is held all the time."""
    end_s = stage.now_s + OFF_S[trial % 6]
    stage.start_twin()
    stage.twin.cycle = lambda now_s: None
    stage.twin.hear = lambda frame, now_s: None

    def boot() -> None:
        if stage.now_s >= end_s:
            stage.meddle = None
            stage.clock_jump_s = -stage.now_s
            stage.start_twin()
            hold_button(stage)

    stage.meddle = boot


def leave_bus(stage: Stage, trial: int) -> None:
    """The PC's controller goes off the bus for 0.15 to 2.5 s; the dead-man is held all the time."""
    hold_button(stage)
    end_s = stage.now_s + OFF_S[trial % 6]
    stage.air.broken = True

    def restart() -> None:
        stage.air.broken = stage.now_s < end_s

    stage.meddle = restart


def stand_still(stage: Stage, trial: int) -> None:
    """The bus process gets no processor for 0.08 to 0.5 s."""
    stage.pause((0.08, 0.1, 0.13, 0.16, 0.19, 0.25, 0.5)[trial % 7])


def stand_still_often(stage: Stage, trial: int) -> None:
    """The bus process gets no processor for 0.15 s in every 0.4 s."""
    for _ in range(6):
        stage.pause(0.15)
        stage.go(0.25)


def bounce_estop(stage: Stage, trial: int) -> None:
    """A loose contact: the emergency stop is on for one message alone."""
    seen: list[float] = []

    def spoil(values: Values) -> None:
        values["EStop"] = float(not seen)
        seen.append(1.0)

    stage.bridge.alter = {"MachineStatus": spoil}


def stick_lever(stage: Stage, trial: int) -> None:
    """A lever sticks at a tenth of its way, or more, for the PC alone."""
    axes = ("left_theta", "left_psi", "right_theta", "right_psi")
    value = (0.06, -0.1, 0.5, -1.0)[trial // 4 % 4]

    def spoil(values: Values) -> None:
        values[f"Lever_{axes[trial % 4]}"] = value

    stage.bridge.alter = {"LeverState": spoil}


def freeze_stamp(name: str) -> Inject:
    def inject(stage: Stage, trial: int) -> None:
        first: list[float] = []

        def spoil(values: Values) -> None:
            first.append(values[STAMP])
            values[STAMP] = first[0]

        stage.bridge.alter = {name: spoil}

    inject.__doc__ = f"The stamps of `{name}` stand still."
    return inject


def scale_clock(rate: float) -> Inject:
    def inject(stage: Stage, trial: int) -> None:
        def run_on() -> None:
            stage.clock_jump_s += 1e-3 * rate
            if stage.ms % 4000 == 0:
                # To and fro, so that no joint comes to its end.
                stage.wanted = tuple(-u for u in stage.wanted)

        stage.meddle = run_on

    inject.__doc__ = f"The gateway's clock is {abs(rate):.0%} too {'fast' if rate > 0 else 'slow'}."
    return inject


def lose_turn(name: str) -> Inject:
    def inject(stage: Stage, trial: int) -> None:
        stage.bridge.lose[name] = COUNTER_TURN

    inject.__doc__ = f"{COUNTER_TURN} messages `{name}` are lost: its counter fits again."
    return inject


def impersonate(name: str) -> Inject:
    def inject(stage: Stage, trial: int) -> None:
        layout = stage.bridge._remote._description.layouts[name]
        period_ms, newest = round(1e3 * layout.period_s), dict[str, float]()
        stage.bridge.alter = {name: newest.update}

        def send() -> None:
            if newest and stage.ms % period_ms == trial % period_ms:
                description = stage.bridge._remote._description
                counter = int(newest[COUNTER]) + (trial // 4) % COUNTER_TURN
                data = description.encode(name, newest, counter % COUNTER_TURN)
                stage.air.inbox.append(CanFrame(layout.frame_id, data))

        stage.meddle = send

    inject.__doc__ = f"A second sender of `{name}` with right CRC and stamps, any of 16 counters."
    return inject


def fill_with_ones(name: str) -> Inject:
    def inject(stage: Stage, trial: int) -> None:
        def spoil(values: Values) -> None:
            for signal in values:
                if signal.startswith("Position_"):
                    values[signal] = (-0.0001, 3.2)[trial % 2]

        stage.bridge.alter = {name: spoil}

    inject.__doc__ = f"`{name}`: a sensor that is cut off, all bits one or full scale, right CRC."
    return inject


def swap_sensors(stage: Stage, trial: int) -> None:
    """The sensors of two joints change places, without a jump."""
    first: dict[str, float] = {}

    def spoil(values: Values) -> None:
        one, two = values["Position_q3"], values["Position_q4"]
        first.setdefault("q3", one)
        first.setdefault("q4", two)
        values["Position_q3"] = first["q3"] + two - first["q4"]
        values["Position_q4"] = first["q4"] + one - first["q3"]

    stage.bridge.alter = {"JointPos2": spoil}


def swap_feedback(stage: Stage, trial: int) -> None:
    """The feedback of two valves changes places."""

    def spoil(values: Values) -> None:
        values["Flow_q1"], values["Flow_q3"] = values["Flow_q3"], values["Flow_q1"]

    stage.bridge.alter = {"ValveFeedback": spoil}


def hide_flow(stage: Stage, trial: int) -> None:
    """The feedback says that the valves get nothing, and they do."""

    def spoil(values: Values) -> None:
        for signal in values:
            if signal.startswith("Flow_"):
                values[signal] = 0.0

    stage.bridge.alter = {"ValveFeedback": spoil}


def lag_sensors(stage: Stage, trial: int) -> None:
    """A filter in the sensors: positions of 0.3 s ago under fresh stamps, and the arm turns back."""
    past: dict[str, list[float]] = {}

    def spoil(values: Values) -> None:
        for signal in values:
            if signal.startswith("Position_"):
                before = past.setdefault(signal, [values[signal]] * 30)
                before.append(values[signal])
                values[signal] = before.pop(0)

    stage.bridge.alter = dict.fromkeys(("JointPos1", "JointPos2", "JointPos3"), spoil)
    stage.wanted = tuple(-u for u in stage.wanted)


def round_positions(stage: Stage, trial: int) -> None:
    """Bits of the sensors are missing: positions in steps of 0.1 rad."""

    def spoil(values: Values) -> None:
        for signal in values:
            if signal.startswith("Position_"):
                values[signal] = round(values[signal], 1)

    stage.bridge.alter = dict.fromkeys(("JointPos1", "JointPos2", "JointPos3"), spoil)


def age_commands(stage: Stage, trial: int) -> None:
    """The policy grows slower: its commands are older by 10 ms each 50 ms."""
    begin_s, wanted = stage.now_s, stage.wanted
    stage.request_s = 60.0

    def send() -> None:
        if stage.ms % 50 == 3:
            late_s = 0.2 * (stage.now_s - begin_s)
            stage._write("request", t_s=stage.now_s - late_s, u=wanted)

    stage.meddle = send


def flip_memory(name: str) -> Inject:
    def inject(stage: Stage, trial: int) -> None:
        slot: RecordSlot = getattr(stage.memory, name)
        memory, draw = slot.memory, np.random.default_rng(trial)

        def flip() -> None:
            memory.bytes[8 + int(draw.integers(memory.size - 8))] ^= 1 << int(draw.integers(8))

        stage.meddle = flip

    inject.__doc__ = f"A bit of the shared memory of `{name}` flips each millisecond."
    return inject


def forget_stop(stage: Stage, trial: int) -> None:
    """STOP is pressed, then its memory is damaged; the dead-man is pressed again."""
    stage.stop()
    stage.go(0.1)
    memory, draw = stage.memory.page.memory, np.random.default_rng(trial)
    for at in range(8, memory.size):
        memory.bytes[at] ^= int(draw.integers(1, 256))
    stage.fault("deadman_released")
    stage.go(0.2)
    stage.fault("none")


def flap_switches(stage: Stage, trial: int) -> None:
    """The supervisor arms and disarms 20 times a second, at last it disarms."""
    for number in range(21):
        stage.arm(number % 2 == 1)
        stage.go(0.05)


def write_nonsense(stage: Stage, trial: int) -> None:
    """The policy's request holds NaN, infinity, too much, or the exclusive joint with others."""
    u = list(stage.wanted)
    u[trial % 5] = (math.nan, math.inf, -math.inf, 1.01, -1e300)[trial // 5 % 5]
    if trial % 6 == 5:
        u = [0.1, 0.2, 0.0, 0.0, 0.0]
    stage.wanted = tuple(u)


SENSORS_CUT = [fill_with_ones(name) for name in STAMPED[:3]]
SLOW_CLOCK, FAST_CLOCK = scale_clock(-0.01), scale_clock(0.01)
FURTHER: list[Inject] = [
    reboot_remote,
    reboot_gateway,
    leave_bus,
    stand_still,
    stand_still_often,
    bounce_estop,
    stick_lever,
    *(freeze_stamp(name) for name in (*STAMPED, "LeverState", "ValveCmd")),
    SLOW_CLOCK,
    FAST_CLOCK,
    *(lose_turn(name) for name in (*STAMPED, "LeverState", "ValveCmd")),
    *(impersonate(name) for name in (*STAMPED, "LeverState")),
    *SENSORS_CUT,
    swap_sensors,
    swap_feedback,
    hide_flow,
    lag_sensors,
    round_positions,
    age_commands,
    *(flip_memory(name) for name in ("request", "controls", "target")),
    forget_stop,
    flap_switches,
    write_nonsense,
]
"""While somebody else commands."""
FRESH = (
    reboot_remote,
    reboot_gateway,
    leave_bus,
    SLOW_CLOCK,
    FAST_CLOCK,
    *SENSORS_CUT,
    forget_stop,
)
"""Those after which a stage is of no use any more."""
LASTING = (reboot_remote, reboot_gateway, leave_bus, stand_still, forget_stop, bounce_estop)
"""Those that are watched to the end: the machine might move again."""
WATCHED_S = {SLOW_CLOCK: 30.0, FAST_CLOCK: 30.0}
"""Those that take longer than others."""
