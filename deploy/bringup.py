"""Bring-up: a checklist that runs on a machine before anybody trusts the loop on it.

It only listens; the operator moves the machine.

    bus         every message at its rate, none refused
    positions   valid, within the machine's limits, quiet at rest
    dead-man    seen pressed and released
    e-stop      seen pressed and released
    joints      each joint moved both ways with the operator's own levers: sign, dead time, speed
    shadow      the policy runs along; its advice is recorded, not shown
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError, LinkError
from brokk_rl.machine import Machine
from brokk_rl.session import Session, write_json
from brokk_rl.spec import spec
from deploy.bus.description import GATEWAY, REMOTE, BusDescription
from deploy.policy.policy_process import REASONS, AdviceStatus
from deploy.recorder import capture_reader
from deploy.recorder.capture import MCAP, CaptureConfig
from deploy.runtime.process_group import BusAndPolicySettings, ProcessGroup
from deploy.runtime.shm_layout import LoopMemory
from deploy.runtime.target import TargetSelector

log = logging.getLogger(__name__)

REPORT = "bringup.json"
POLL_S = 0.01


@dataclass(frozen=True)
class BringupResult:
    """What one check has found: its name, whether it passed, and what there is to say and to know."""

    check: str
    passed: bool
    text: str
    values: dict[str, Any]


@spec
class BringupChecklist(BusAndPolicySettings):
    """The checklist; policy and borehole are those of the shadow run.

    Attributes (and those of `Listener`):
        listen_s: How long to listen at rest.
        patience_s: How long to wait for each thing that the operator is asked to do.
        shadow_s: Length of the shadow run.
        quiet: Largest standard deviation of a position at rest (rad or m).
        rate: Smallest part of a message's nominal rate.
    """

    listen_s: float
    patience_s: float
    shadow_s: float
    quiet: float
    rate: float

    def check(self) -> None:
        for name in ("listen_s", "patience_s", "shadow_s", "quiet", "rate"):
            if getattr(self, name) <= 0:
                raise ConfigError(
                    f"bringup.{name}: expected more than 0, got {getattr(self, name)}"
                )

    def run(
        self, machine: Machine, session: Session, say: Callable[[str], None]
    ) -> list[BringupResult]:
        """Runs the checks in order, writes `bringup.json` and the capture, and returns what was found.

        Args:
            machine: The machine.
            session: Where to write.
            say: Tells the operator what to do, and what was found.

        Raises:
            LinkError: nothing is heard at all, or one of the processes has died.
            CheckpointError: the policy cannot be used on this machine.
        """
        self.refuse(machine)
        memory = LoopMemory.new(machine.num_joints, commands=False)
        children = ProcessGroup(memory, self.realtime)
        try:
            self.listen(children, machine, target_s=math.inf, pitch_rad=None)
            capture = CaptureConfig(
                session.folder, self.dbc, machine, {"source": "bring-up"}, pictures_hz=0.0
            )
            children.start("log", "deploy.recorder.capture:run", (capture,))
            findings = _Checks(self, machine, children, say).all()
        finally:
            children.end()
            memory.close()
        findings.insert(0, self._rates(machine, session))
        write_json(
            session.folder / REPORT,
            {"machine": machine.name, "findings": [asdict(one) for one in findings]},
        )
        for one in findings:
            say(f"{'passed' if one.passed else 'FAILED':7} {one.check:10} {one.text}")
        return findings

    def _rates(self, machine: Machine, session: Session) -> BringupResult:
        """Holds what was captured against the rates of the DBC."""
        description, contents = (
            BusDescription(self.dbc, machine),
            capture_reader.read_capture(session.folder / MCAP),
        )
        values, poor = {}, []
        for layout in (*description.sent_by(GATEWAY), *description.sent_by(REMOTE)):
            times = (
                contents.messages[layout.name].series("t_s")
                if layout.name in contents.messages
                else ()
            )
            rate_hz = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
            values[layout.name] = {
                "rate_hz": rate_hz,
                "nominal_hz": 1 / layout.period_s if layout.period_s else None,
            }
            if layout.period_s and rate_hz * layout.period_s < self.rate:
                poor.append(f"{layout.name} {rate_hz:.0f} of {1 / layout.period_s:.0f} Hz")
        refused = len(contents.messages.get("refused", [])) + len(
            contents.messages.get("fault", [])
        )
        text = (
            "; ".join([*poor, f"{refused} messages refused"])
            if poor or refused
            else "every message at its rate, none refused"
        )
        return BringupResult(
            "bus", not poor and not refused, text, {"messages": values, "refused": refused}
        )


class _Checks:
    """The checks that go by the machine's state."""

    def __init__(
        self,
        bringup: BringupChecklist,
        machine: Machine,
        children: ProcessGroup,
        say: Callable[[str], None],
    ) -> None:
        self._bringup, self._machine, self._children, self._say = bringup, machine, children, say
        self._memory = children.memory
        self._samples: list[tuple[float, np.ndarray, np.ndarray]] = []

    def all(self) -> list[BringupResult]:
        """Runs them."""
        self._say("listening for the machine")
        if self._until(lambda state: float(state["q_t_s"]) > 0) is None:
            raise LinkError(
                f"no joint positions within {self._bringup.patience_s:g} s; is the machine on, and the bus connected?"
            )
        return [
            self._positions(),
            self._seen("dead-man", "deadman", "press the dead-man, then release it"),
            self._seen("e-stop", "estop", "press the emergency stop, then release it"),
            self._joints(),
            self._shadow(),
        ]

    def _positions(self) -> BringupResult:
        self._say("leave the machine at rest")
        self._watch(self._bringup.listen_s)
        q = np.array([q for _, q, _ in self._samples])
        scatter, machine, last = q.std(0), self._machine, self._memory.state.read()
        outside = [
            name
            for j, name in enumerate(machine.joint_names)
            if not machine.lower[j] <= q[-1, j] <= machine.upper[j]
        ]
        noisy = [
            name for j, name in enumerate(machine.joint_names) if scatter[j] > self._bringup.quiet
        ]
        wrong = [f"{', '.join(outside)} outside the limits"] * bool(outside) + [
            f"{', '.join(noisy)} not quiet"
        ] * bool(noisy)
        if last is None or not last["q_plausible"]:
            wrong.append("not plausible")
        values = {"q": q[-1].tolist(), "standard_deviation": scatter.tolist()}
        return BringupResult(
            "positions", not wrong, "; ".join(wrong) or "valid, inside the limits, quiet", values
        )

    def _seen(self, check: str, field: str, request: str) -> BringupResult:
        self._say(request)
        pressed_s = self._until(lambda state: bool(state[field]))
        released_s = None if pressed_s is None else self._until(lambda state: not state[field])
        if pressed_s is None or released_s is None:
            what = "pressed" if pressed_s is None else "released"
            return BringupResult(
                check, False, f"not seen to be {what} within {self._bringup.patience_s:g} s", {}
            )
        return BringupResult(
            check, True, "pressed and released", {"held_s": released_s - pressed_s}
        )

    def _joints(self) -> BringupResult:
        machine, found = self._machine, dict[str, JointResponse]()
        self._say(
            f"move one joint after the other, both ways, a second or more each: {', '.join(machine.joint_names)}"
        )
        self._samples.clear()
        end_s = time.monotonic() + self._bringup.patience_s
        while time.monotonic() < end_s:
            self._watch(1.0)
            times, q, flow = (np.array(column) for column in zip(*self._samples, strict=True))
            for j, name in enumerate(machine.joint_names):
                motion = measure_joint_response(
                    times, q[:, j], flow[:, j], machine.upper[j] - machine.lower[j]
                )
                if motion is not None and name not in found:
                    found[name] = motion
                    self._say(f"{name}: {motion.text}")
            if len(found) == machine.num_joints:
                break
        missing = [name for name in machine.joint_names if name not in found]
        turned = [name for name, motion in found.items() if not motion.agrees]
        wrong = [f"not seen to move both ways: {', '.join(missing)}"] * bool(missing)
        wrong += [f"sign turned: {', '.join(turned)}"] * bool(turned)
        dead_s = [motion.dead_time_s for motion in found.values()]
        if dead_s and max(dead_s) > (machine.num_history - 1) * machine.period_s:
            wrong.append(
                f"dead time of up to {max(dead_s):.2f} s is longer than the policy's history"
            )
        text = (
            "; ".join(wrong) or f"signs agree; dead times {min(dead_s):.2f} to {max(dead_s):.2f} s"
        )
        return BringupResult(
            "joints", not wrong, text, {name: asdict(motion) for name, motion in found.items()}
        )

    def _shadow(self) -> BringupResult:
        self._say("shadow run: the policy runs along, nothing is shown")
        TargetSelector(
            self._bringup.target.build(), self._memory.target, self._memory.holes
        ).refresh()
        reasons: list[str] = []
        end_s, number = time.monotonic() + self._bringup.shadow_s, -1
        while time.monotonic() < end_s:
            advice = self._memory.advice.read()
            if advice is not None and int(advice["number"]) != number:
                number = int(advice["number"])
                reasons.append(REASONS[int(advice["reason"])].value)
            time.sleep(POLL_S)
        share = reasons.count(AdviceStatus.VALID.value) / max(1, len(reasons))
        others = sorted(set(reasons) - {AdviceStatus.VALID.value})
        text = f"{share:.0%} of {len(reasons)} advices valid" + (
            f" ({', '.join(others)})" if others else ""
        )
        return BringupResult(
            "shadow", share >= self._bringup.rate, text, {"advices": len(reasons), "valid": share}
        )

    def _watch(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self._children.check()
            state = self._memory.state.read()
            if state is not None and (
                not self._samples or float(state["t_s"]) > self._samples[-1][0]
            ):
                self._samples.append(
                    (float(state["t_s"]), np.array(state["q"]), np.array(state["flow"]))
                )
            time.sleep(POLL_S)

    def _until(self, holds: Callable[[Any], bool]) -> float | None:
        """Returns when the state first `holds`; `None` if it does not in all of the operator's time."""
        end_s = time.monotonic() + self._bringup.patience_s
        while time.monotonic() < end_s:
            self._children.check()
            state = self._memory.state.read()
            if state is not None and holds(state):
                return time.monotonic()
            time.sleep(POLL_S)
        return None


SMALLEST_FLOW = 0.1
"""Of full; less may lie in a valve's dead band."""
MOVED = 0.004
"""Part of the travel that counts as motion."""
LONGEST_S = 2.0
"""Time after the beginning of flow within which the joint must have moved."""


@dataclass(frozen=True)
class JointResponse:
    """How a joint answers.

    Attributes:
        agrees: Whether it moves in the direction of its flow, both ways.
        dead_time_s: From the beginning of flow to the first motion, the middle of what was seen.
        speed: Largest speed seen, rad/s or m/s.
    """

    agrees: bool
    dead_time_s: float
    speed: float

    @property
    def text(self) -> str:
        """In words."""
        sign = "sign agrees" if self.agrees else "SIGN TURNED"
        return f"{sign}, dead time {self.dead_time_s:.2f} s, up to {self.speed:.2f} rad/s"


def measure_joint_response(
    t_s: np.ndarray, q: np.ndarray, flow: np.ndarray, travel: float
) -> JointResponse | None:
    """Returns how a joint answers, or `None` before it was seen to move after flow of both signs.

    Args:
        t_s: Times, `(T,)`.
        q: Positions of the joint, `(T,)`, rad or m.
        flow: What its valve gets, `(T,)`, of full.
        travel: Length of its travel.
    """
    began = (
        np.flatnonzero((np.abs(flow[1:]) >= SMALLEST_FLOW) & (np.abs(flow[:-1]) < SMALLEST_FLOW))
        + 1
    )
    found: dict[int, list[tuple[bool, float]]] = {1: [], -1: []}
    for row in began:
        # at rest before, or what moves is the answer to something else
        before = t_s > t_s[row] - 0.5
        if np.ptp(q[: row + 1][before[: row + 1]]) > MOVED * travel / 2:
            continue
        window = (t_s >= t_s[row]) & (t_s <= t_s[row] + LONGEST_S)
        away = np.flatnonzero(np.abs(q[window] - q[row]) > MOVED * travel)
        if len(away):
            sign = int(np.sign(flow[row]))
            agrees = bool(np.sign(q[window][away[0]] - q[row]) == sign)
            found[sign].append(
                (
                    agrees,
                    _estimate_onset_s(t_s[window], q[window] - q[row], away[0]) - float(t_s[row]),
                )
            )
    if not found[1] or not found[-1]:
        return None
    both = [*found[1], *found[-1]]
    step = max(1, round(0.2 / max(1e-3, float(np.median(np.diff(t_s))))))
    speed = np.abs(q[step:] - q[:-step]) / np.maximum(t_s[step:] - t_s[:-step], 1e-6)
    return JointResponse(
        all(agrees for agrees, _ in both),
        float(np.median([dead_s for _, dead_s in both])),
        float(speed.max()),
    )


def _estimate_onset_s(t_s: np.ndarray, moved: np.ndarray, row: int) -> float:
    """Returns when a motion began that was noticed at `row`: a line through it and what follows, back to zero."""
    later = min(len(t_s) - 1, int(np.searchsorted(t_s, t_s[row] + 0.15)))
    speed = (moved[later] - moved[row]) / max(1e-6, t_s[later] - t_s[row])
    return float(t_s[row] - (moved[row] / speed if speed * moved[row] > 0 else 0.0))
