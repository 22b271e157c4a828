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
from deploy.bus.description import GATEWAY, REMOTE, Description
from deploy.guard.motion import Motion, judge
from deploy.policy.adviser import REASONS, Advised
from deploy.recorder import reading
from deploy.recorder.capture import MCAP, Capture
from deploy.runtime.process_group import Children, Listener
from deploy.runtime.shm_layout import Exchange
from deploy.runtime.target import TargetSelector

log = logging.getLogger(__name__)

REPORT = "bringup.json"
POLL_S = 0.01


@dataclass(frozen=True)
class Finding:
    """What one check has found: its name, whether it passed, and what there is to say and to know."""

    check: str
    passed: bool
    text: str
    values: dict[str, Any]


@spec
class Bringup(Listener):
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

    def run(self, machine: Machine, session: Session, say: Callable[[str], None]) -> list[Finding]:
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
        exchange = Exchange.new(machine.num_joints, commands=False)
        children = Children(exchange, self.realtime)
        try:
            self.listen(children, machine, target_s=math.inf, pitch_rad=None)
            capture = Capture(
                session.folder, self.dbc, machine, {"source": "bring-up"}, pictures_hz=0.0
            )
            children.start("log", "deploy.recorder.capture:run", (capture,))
            findings = _Checks(self, machine, children, say).all()
        finally:
            children.end()
            exchange.close()
        findings.insert(0, self._rates(machine, session))
        write_json(
            session.folder / REPORT,
            {"machine": machine.name, "findings": [asdict(one) for one in findings]},
        )
        for one in findings:
            say(f"{'passed' if one.passed else 'FAILED':7} {one.check:10} {one.text}")
        return findings

    def _rates(self, machine: Machine, session: Session) -> Finding:
        """Holds what was captured against the rates of the DBC."""
        description, contents = Description(self.dbc, machine), reading.read(session.folder / MCAP)
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
        return Finding(
            "bus", not poor and not refused, text, {"messages": values, "refused": refused}
        )


class _Checks:
    """The checks that go by the machine's state."""

    def __init__(
        self, bringup: Bringup, machine: Machine, children: Children, say: Callable[[str], None]
    ) -> None:
        self._bringup, self._machine, self._children, self._say = bringup, machine, children, say
        self._exchange = children.exchange
        self._samples: list[tuple[float, np.ndarray, np.ndarray]] = []

    def all(self) -> list[Finding]:
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

    def _positions(self) -> Finding:
        self._say("leave the machine at rest")
        self._watch(self._bringup.listen_s)
        q = np.array([q for _, q, _ in self._samples])
        scatter, machine, last = q.std(0), self._machine, self._exchange.state.read()
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
        return Finding(
            "positions", not wrong, "; ".join(wrong) or "valid, inside the limits, quiet", values
        )

    def _seen(self, check: str, field: str, request: str) -> Finding:
        self._say(request)
        pressed_s = self._until(lambda state: bool(state[field]))
        released_s = None if pressed_s is None else self._until(lambda state: not state[field])
        if pressed_s is None or released_s is None:
            what = "pressed" if pressed_s is None else "released"
            return Finding(
                check, False, f"not seen to be {what} within {self._bringup.patience_s:g} s", {}
            )
        return Finding(check, True, "pressed and released", {"held_s": released_s - pressed_s})

    def _joints(self) -> Finding:
        machine, found = self._machine, dict[str, Motion]()
        self._say(
            f"move one joint after the other, both ways, a second or more each: {', '.join(machine.joint_names)}"
        )
        self._samples.clear()
        end_s = time.monotonic() + self._bringup.patience_s
        while time.monotonic() < end_s:
            self._watch(1.0)
            times, q, flow = (np.array(column) for column in zip(*self._samples, strict=True))
            for j, name in enumerate(machine.joint_names):
                motion = judge(times, q[:, j], flow[:, j], machine.upper[j] - machine.lower[j])
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
        return Finding(
            "joints", not wrong, text, {name: asdict(motion) for name, motion in found.items()}
        )

    def _shadow(self) -> Finding:
        self._say("shadow run: the policy runs along, nothing is shown")
        TargetSelector(
            self._bringup.target.build(), self._exchange.target, self._exchange.holes
        ).refresh()
        reasons: list[str] = []
        end_s, number = time.monotonic() + self._bringup.shadow_s, -1
        while time.monotonic() < end_s:
            advice = self._exchange.advice.read()
            if advice is not None and int(advice["number"]) != number:
                number = int(advice["number"])
                reasons.append(REASONS[int(advice["reason"])].value)
            time.sleep(POLL_S)
        share = reasons.count(Advised.VALID.value) / max(1, len(reasons))
        others = sorted(set(reasons) - {Advised.VALID.value})
        text = f"{share:.0%} of {len(reasons)} advices valid" + (
            f" ({', '.join(others)})" if others else ""
        )
        return Finding(
            "shadow", share >= self._bringup.rate, text, {"advices": len(reasons), "valid": share}
        )

    def _watch(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self._children.check()
            state = self._exchange.state.read()
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
            state = self._exchange.state.read()
            if state is not None and holds(state):
                return time.monotonic()
            time.sleep(POLL_S)
        return None
