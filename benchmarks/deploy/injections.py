"""Injected faults on the way between gateway and PC: python benchmarks/deploy/injections.py <json> [trials] [words].

Twin, gateway, bus process and policy as they are, on a clock of their own (`tests/stage.py`); a
bridge between them delays, copies and corrupts messages, and strangers send. Each trial begins at
another phase of all cycles. Times count until the valves get nothing, for good; "moves" says that
they still move at the end of the time watched. With words only the rows that hold one of them are
measured again, and the others stay as the file has them.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]  # the folder of this file is there already

import numpy as np  # noqa: E402
from composed import option  # noqa: E402
from further_injections import FRESH, FURTHER, LASTING, STAMPED, WATCHED_S  # noqa: E402
from stage import Mode, Stage  # noqa: E402

from brokk_rl.kinematics import compute_tool_kinematics  # noqa: E402
from brokk_rl.machine import Machine  # noqa: E402
from deploy.kernel.guard import GuardState  # noqa: E402

LATCHED = GuardState.LATCHED
USUALLY_WATCHED_S = 4.0
QUIET_S = 1.0
"""Standstill after which a trial is over: nothing moves again before somebody presses the dead-man."""
MESSAGES = ("JointPos1", "JointPos2", "LeverState", "MachineStatus", "ValveFeedback", "ValveCmd")


def start_second_remote(stage: Stage, trial: int) -> None:
    """A second remote holds the dead-man while the real one releases it."""
    stage.bridge.second_remote, stage.bridge.remote_offset = True, trial % 4
    stage.fault("deadman_released")


def start_second_remote_alone(stage: Stage, trial: int) -> None:
    """A second remote begins to send, both hold the dead-man."""
    stage.bridge.second_remote, stage.bridge.remote_offset = True, trial % 16


def copy_levers(stage: Stage, trial: int) -> None:
    """A repeater's late copies of `LeverState`; then the real remote releases the dead-man."""
    late_s = (0.24, 0.26, 0.28, 0.30, 0.56, 0.58, 0.60, 0.62)[trial % 8]
    stage.bridge.echo_s = {"LeverState": late_s}
    stage.go(late_s + 0.2)
    stage.fault("deadman_released")


def copy_commands(stage: Stage, trial: int) -> None:
    """A repeater's late copies of `ValveCmd` at the gateway; then the PC stands still."""
    stage.bridge.echo_s = {"ValveCmd": (0.24, 0.26, 0.28, 0.30)[trial % 4]}
    stage.go(0.6)
    stage.pause(1.0)


def send_foreign_commands(stage: Stage, trial: int) -> None:
    """A foreign node sends `ValveCmd` beside the PC."""
    stage.bridge.foreign = {"Command_q3": 0.5, "CommandMode": 1}


def stop_beside_hung_supervisor(stage: Stage, trial: int) -> None:
    """The page's STOP while the supervisor hangs."""
    stage.supervised = False
    stage.stop()


def hang_supervisor(stage: Stage, trial: int) -> None:
    """The supervisor hangs; nobody presses anything."""
    stage.supervised = False


def break_sensor(fault: str, text: str) -> Callable[[Stage, int], None]:
    def inject(stage: Stage, trial: int) -> None:
        stage.fault(fault)

    inject.__doc__ = text
    return inject


def corrupt_half(message: str) -> Callable[[Stage, int], None]:
    def inject(stage: Stage, trial: int) -> None:
        stage.bridge.half = message

    inject.__doc__ = f"Every second `{message}` is corrupt."
    return inject


def delay(message: str) -> Callable[[Stage, int], None]:
    def inject(stage: Stage, trial: int) -> None:
        stage.bridge.delay_s = {message: 0.2}

    inject.__doc__ = f"`{message}` comes 0.2 s late from now on."
    return inject


def drop_feedback(stage: Stage, trial: int) -> None:
    """The valves' feedback stays away."""
    stage.fault("drop", "ValveFeedback")


def hide_stuck_sensors(stage: Stage, trial: int) -> None:
    """The valves' feedback comes 0.2 s late, and the position sensors stand still."""
    stage.bridge.delay_s = {"ValveFeedback": 0.2}
    stage.fault("stuck")


def loosen_contact(stage: Stage, trial: int) -> None:
    """Every second position of the first joint is off by 0.5 rad, with a right CRC."""

    def spoil(values: dict[str, float]) -> None:
        values["Position_q1"] += 0.5 * (values["Counter"] % 2)

    stage.bridge.alter = {"JointPos1": spoil}


def turn_joint(stage: Stage, trial: int) -> None:
    """The first joint's sensor jumps by a whole turn, as far as its signal goes."""

    def spoil(values: dict[str, float]) -> None:
        turned = values["Position_q1"] + 2 * math.pi * (1 - 2 * (trial % 2))
        values["Position_q1"] = max(-3.2, min(3.2, turned))

    stage.bridge.alter = {"JointPos1": spoil}


def jump_clock(stage: Stage, trial: int) -> None:
    """The gateway's clock jumps by 0.1 to 30 s either way, in all its messages."""
    jump_s = (0.1, 0.2, 0.3, 1.0, 10.0, 30.0)[trial // 2 % 6] * (1 - 2 * (trial % 2))

    def shift(values: dict[str, float]) -> None:
        values["Stamp"] += jump_s

    stage.bridge.alter = dict.fromkeys(STAMPED, shift)


def lose_place(stage: Stage, trial: int) -> None:
    """The borehole's place is no number, while somebody else commands."""
    place = [2.6, 0.0, 0.75]
    place[trial % 3] = (math.nan, math.inf)[trial % 2]
    stage._write("target", t_s=stage.now_s, center_in_base_m=tuple(place))


def ask_from_future(stage: Stage, trial: int) -> None:
    """A command carries a time 100 s ahead; then its sender dies."""
    stage._write("request", t_s=stage.now_s + 100.0, u=stage.wanted)
    stage.request_s = 60.0


def arm_from_future(stage: Stage, trial: int) -> None:
    """The switches carry a time 100 s ahead; then the supervisor hangs."""
    stage._write("controls", t_s=stage.now_s + 100.0, **stage._switches)
    stage.supervised = False


def arm_late(stage: Stage, trial: int) -> None:
    """The supervisor stands still while arming is asked for, STOP comes, and it goes on arming."""
    stage.supervised = False
    stage.arm()
    stage.go(0.05)
    stage.stop()
    stage.supervised = True


def hold_messages(stage: Stage, trial: int) -> None:
    """All messages to the PC are held for 0.2 s and come at once, again and again."""
    stage.bridge.begun_ms, stage.bridge.held_s = stage.ms, 0.2


def replay_remote(stage: Stage, trial: int) -> None:
    """A recording of the remote is sent again, one turn of its stamp later, and the real one lets go."""
    stage.bridge.replayed = True
    stage.fault("deadman_released")


def insert(name: str) -> Callable[[Stage, int], None]:
    def inject(stage: Stage, trial: int) -> None:
        stage.bridge.inserted = {name: bytes((0, 1, 7, 9, 64)[trial % 5])}

    inject.__doc__ = f"`{name}` of 0, 1, 7, 9 or 64 bytes, every 20 ms."
    return inject


def copy_soon(name: str) -> Callable[[Stage, int], None]:
    def inject(stage: Stage, trial: int) -> None:
        stage.bridge.echo_s = {name: (0.001, 0.005, 0.02, 0.05)[trial % 4]}

    inject.__doc__ = f"`{name}` comes once more, 1 to 50 ms later."
    return inject


def answer(value: float) -> Callable[[Stage, int], None]:
    def inject(stage: Stage, trial: int) -> None:
        bundle = stage.adviser._bundle
        bundle.command = lambda observation: np.full((1, 5), value)

    inject.__doc__ = f"The policy answers {value:g}."
    return inject


SENSORS = [
    break_sensor("stuck", "The position sensors stand still."),
    break_sensor("drift", "The first joint's sensor drifts by 0.1 rad/s."),
    break_sensor("mirrored", "The position sensors count backwards from now on."),
]
SHORT: dict[Mode, list[Callable[[Stage, int], None]]] = {
    "collect": [
        start_second_remote,
        start_second_remote_alone,
        copy_levers,
        copy_commands,
        send_foreign_commands,
        stop_beside_hung_supervisor,
        hang_supervisor,
        *SENSORS,
        *(corrupt_half(name) for name in MESSAGES),
        *(delay(name) for name in (*MESSAGES, "JointPos3")),
        drop_feedback,
        hide_stuck_sensors,
        loosen_contact,
        turn_joint,
        jump_clock,
        lose_place,
        ask_from_future,
        arm_from_future,
        arm_late,
        hold_messages,
        replay_remote,
        *(insert(name) for name in MESSAGES),
        *(copy_soon(name) for name in MESSAGES),
        *FURTHER,
    ],
    "auto": [answer(float("nan")), answer(1e30)],
}


AFRESH = (jump_clock, replay_remote, *FRESH)
"""Injections each of whose trials has a loop of its own: a jump of the clock is not forgotten."""


def measure_stop(stage: Stage, inject: Callable[[Stage, int], None], trial: int) -> float | None:
    """Return the time until the valves get nothing for good; `None`: they still move."""
    stage.get_going()
    stage.go(0.013 * (trial % 11))  # another phase of cycles and requests
    original = stage.adviser._bundle.command if stage.adviser else None
    inject(stage, trial)
    begun_ms = stage.ms
    watched_s = WATCHED_S.get(inject, USUALLY_WATCHED_S)
    stage.go(watched_s, lambda: inject not in LASTING and _is_quiet(stage))
    if stage.adviser:
        stage.adviser._bundle.command = original
    return None if stage.stopped_ms is None else max(0, stage.stopped_ms - begun_ms) / 1e3


def _is_quiet(stage: Stage) -> bool:
    return stage.stopped_ms is not None and stage.ms - stage.stopped_ms > 1e3 * QUIET_S


def measure_constant_delay(stage: Stage) -> dict[str, object]:
    """0.5 s of delay to the PC for 150 s, then a new press: does the machine move?"""
    stage.get_going()
    stage.bridge.delay_s = {"to_pc": 0.5}
    stage.go(150.0)
    stage.fault("deadman_released")
    stage.go(1.0)
    stage.fault("none")
    stage.go(2.0)
    state = stage.view.state
    return {"moves_again": stage.moves, "guard": state.guard.name, "trip": state.trip.value}


def measure_start_delay(folder: Path) -> dict[str, object]:
    """0.3 s of delay from the first message on: does the machine move?"""
    stage = Stage(option("machine", "brokk170"), "collect", folder)
    stage.bridge.delay_s = {"to_pc": 0.3}
    moved = False
    for _ in range(4):
        stage.fault("none")
        stage.go(1.5)
        stage.fault("deadman_released")
        stage.go(1.0)
        moved = moved or stage.moves
    stage.fault("none")
    stage.go(2.0)
    state = stage.view.state
    return {"moves": moved or stage.moves, "guard": state.guard.name, "trip": state.trip.value}


def measure_drift(stage: Stage) -> dict[str, object]:
    """A delay to the PC that grows by 1 ms a second: how large is it when the machine stops?"""
    stage.get_going()
    stage.bridge.begun_ms = stage.ms
    stage.bridge.delay_s = {"to_pc": lambda since_s: 1e-3 * since_s}
    begun_ms = stage.ms
    for _ in range(100):
        # To and fro, so that no joint comes to its end.
        stage.wanted = tuple(-u for u in stage.wanted)
        stage.go(4.0, lambda: stage.memory.state.peek("guard") == LATCHED.value)
        if stage.memory.state.peek("guard") == LATCHED.value:
            break
    seconds = (stage.ms - begun_ms) / 1e3
    return {"delay_ms": round(seconds, 1), "stopped": not stage.moves}


def measure_ground(stage: Stage) -> dict[str, object]:
    """The third joint is driven down for 12 s: least height of arm and tool over the ground."""
    stage.get_going()
    stage.wanted, least_m = (0.0, 0.0, 1.0, 0.0, 0.0), [math.inf]

    def note() -> bool:
        q = np.asarray(stage.twin._q)
        least_m[0] = min(
            least_m[0], float(compute_tool_kinematics(stage.machine, q).tip_in_base_m[2])
        )
        return False

    stage.go(12.0, note)
    return {"least_height_of_the_tip_m": round(least_m[0], 3)}


def measure_row(
    machine: Machine, mode: Mode, folder: Path, inject: Callable[[Stage, int], None], trials: int
) -> dict[str, object]:
    """Return the row of an injection."""
    found, causes = [], Counter[str]()
    stage = Stage(machine, mode, folder)
    for trial in range(trials):
        if inject in AFRESH:
            stage.close()
            stage = Stage(machine, mode, folder)
        found.append(measure_stop(stage, inject, trial))
        state = stage.view.state
        joint = f"joint {state.observed_joint}: " if state.observed_joint else ""
        causes[joint + state.cause.value] += 1
    stage.close()
    stopped = sorted(1e3 * one for one in found if one is not None)
    row: dict[str, object] = {"trials": trials, "moves": found.count(None)}
    if stopped:
        row |= {"median_ms": round(stopped[len(stopped) // 2]), "worst_ms": round(stopped[-1])}
    return row | {"causes": dict(causes)}


def measure_unwatched(
    folder: Path, inject: Callable[[Stage, int], None], trials: int
) -> dict[str, object]:
    """Return the row of an injection without observer and envelope, each trial from the start."""
    moves = 0
    for trial in range(trials):
        stage = Stage(option("machine", "brokk170"), "collect", folder, watched=False)
        moves += measure_stop(stage, inject, trial) is None
        stage.close()
    return {"trials": trials, "moves": moves}


def main(path: Path, trials: int, words: Sequence[str]) -> None:
    table: dict[str, object] = json.loads(path.read_text()) if words and path.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        machine = option("machine", "brokk170")
        for mode, injections in SHORT.items():
            for inject in injections:
                key = f"{mode}: {inject.__doc__}"
                if not words or any(word in key for word in words):
                    table[key] = measure_row(machine, mode, Path(folder), inject, trials)
                    sys.stdout.write(f"{key}: {table[key]}\n")
        if not words:
            measure_others(table, Path(folder), trials)
    path.write_text(json.dumps(table, indent=2) + "\n")


def measure_others(table: dict[str, object], folder: Path, trials: int) -> None:
    """Add the rows that are no time to the table."""
    machine = option("machine", "brokk170")
    # As before there was an observer and an envelope.
    for inject in SENSORS:
        row = measure_unwatched(folder, inject, trials)
        table[f"unwatched: {inject.__doc__}"] = row
    stage = Stage(machine, "collect", folder, watched=False)
    table[f"unwatched: {measure_ground.__doc__}"] = measure_ground(stage)
    stage.close()
    stage = Stage(machine, "collect", folder)
    for measure in (measure_ground, measure_constant_delay, measure_drift):
        table[str(measure.__doc__)] = measure(stage)
    table[str(measure_start_delay.__doc__)] = measure_start_delay(folder)
    stage.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 60, tuple(sys.argv[3:]))
