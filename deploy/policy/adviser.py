"""The policy process: at each control period from what is known to what the operator is shown.

It never touches the bus. Where commands are sent at all (`deploy=auto`) it also writes them into
the request slot, which the guard reads; otherwise there is no such slot.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from enum import Enum

import numpy as np

from brokk_rl.machine import Machine
from deploy.guidance import Guidance, LeverDisplay
from deploy.policy.bundle import Bundle
from deploy.policy.sampling import Ring
from deploy.runtime.bus_process import TEXT
from deploy.runtime.process import Pace, Stop
from deploy.runtime.shm_layout import Exchange


class Advised(Enum):
    """Why there is an advice, or none; the order is that of `reason` in the record."""

    VALID = "valid"
    NO_STATE = "nothing from the bus"
    STALE = "positions are stale"
    IMPLAUSIBLE = "positions are not plausible"
    WARMING_UP = "history is filling"
    NO_TARGET = "no borehole is known"
    TARGET_OLD = "the borehole was found too long ago"
    REJECTED = "the policy's answer makes no sense"


REASONS = tuple(Advised)


@dataclass(frozen=True)
class Counsel:
    """What a policy process is to do.

    Attributes:
        machine: The machine.
        folder: Policy bundle.
        guidance: How advice becomes levers.
        stale_s: Age of positions from which there is no advice.
        target_s: Age of the borehole from which there is no advice.
        pitch_rad: Wanted pitch of the tool, for policies that ask for one.
    """

    machine: Machine
    folder: str
    guidance: Guidance
    stale_s: float
    target_s: float
    pitch_rad: float | None


def run(stop: Stop, counsel: Counsel, exchange: Exchange) -> None:
    """Runs until it is asked to stop.

    Raises:
        CheckpointError: the bundle cannot be used.
    """
    adviser = Adviser(counsel, Bundle(counsel.folder, counsel.machine), exchange)
    pace = Pace(counsel.machine.period_s)
    while not stop():
        pace.wait()
        adviser.cycle(pace.begin(), time.monotonic())
    exchange.reports.put(json.dumps({"process": "policy"} | pace.report()).encode())


class Adviser:
    """See the module.

    Args:
        counsel: What to do.
        bundle: The policy.
        exchange: Where to read and write.
    """

    def __init__(self, counsel: Counsel, bundle: Bundle, exchange: Exchange) -> None:
        self._counsel, self._bundle, self._exchange = counsel, bundle, exchange
        self._machine = counsel.machine
        self._ring = Ring(counsel.machine)
        self._display = LeverDisplay(counsel.guidance, counsel.machine)
        self._number = 0
        self._exclusive = counsel.machine.is_exclusive
        size = bundle.encoder.size
        bundle.command(np.zeros((1, size)))  # the first call is slow

    def cycle(self, missed: int, now_s: float) -> Advised:
        """Runs one control period; `missed` ones went by before it."""
        state, target = self._exchange.state.read(), self._exchange.target.read()
        reason = self._sample(state, missed, now_s)
        u, infer_s = np.zeros(self._machine.num_joints), 0.0
        target_m = np.zeros(3) if target is None else np.array(target["center_in_base_m"])
        if reason is Advised.VALID:
            if target is None:
                reason = Advised.NO_TARGET
            elif now_s - float(target["t_s"]) > self._counsel.target_s:
                reason = Advised.TARGET_OLD
        if reason is Advised.VALID:
            begun = time.perf_counter()
            answer = self._infer(target_m)
            infer_s = time.perf_counter() - begun
            if answer is None:
                reason = Advised.REJECTED
            else:
                u = answer
        self._ring.propose(u)
        self._publish(reason, u, target_m, infer_s, now_s)
        return reason

    def _sample(self, state: np.ndarray | None, missed: int, now_s: float) -> Advised:
        if state is None:
            return Advised.NO_STATE
        if (
            now_s - float(state["q_t_s"]) > self._counsel.stale_s
            or now_s - float(state["t_s"]) > self._counsel.stale_s
        ):
            self._ring.empty()
            return Advised.STALE
        if not state["q_plausible"] or not state["trusted"]:
            self._ring.empty()
            return Advised.IMPLAUSIBLE
        self._ring.sample(state, missed)
        return Advised.VALID if self._ring.full else Advised.WARMING_UP

    def _infer(self, target_m: np.ndarray) -> np.ndarray | None:
        """Returns masked commands, `(J,)`, or `None` where they make no sense."""
        encoder, ring = self._bundle.encoder, self._ring
        pitch = np.array([self._counsel.pitch_rad or 0.0]) if encoder.has_pitch else None
        proposed = ring.proposed[None] if encoder.has_proposals else None
        observation = encoder.encode(target_m[None], ring.q[None], ring.u[None], pitch, proposed)
        if not np.isfinite(observation).all():
            return None
        u = self._bundle.command(observation)[0].astype(float)
        moved = u != 0
        together = moved[self._exclusive].any() and moved.sum() > 1
        return None if not np.isfinite(u).all() or np.abs(u).max() > 1.0 + 1e-6 or together else u

    def _publish(
        self, reason: Advised, u: np.ndarray, target_m: np.ndarray, infer_s: float, now_s: float
    ) -> None:
        self._number += 1
        shown = self._display.show(u, self._machine.period_s)
        record = self._exchange.advice.new()
        record["t_s"], record["number"], record["reason"] = (
            now_s,
            self._number,
            REASONS.index(reason),
        )
        record["u"], record["lever_rad"], record["button_right"] = (
            u,
            shown.angles_rad,
            shown.button_right,
        )
        record["target_in_base_m"], record["infer_s"] = target_m, infer_s
        self._exchange.advice.write(record)
        if self._exchange.request is not None and reason is Advised.VALID:
            request = self._exchange.request.new()
            request["t_s"], request["u"] = now_s, u
            self._exchange.request.write(request)
        text = {
            "topic": "advice", "t_s": now_s, "reason": reason.value, "u": u.round(5).tolist(),
            "lever_rad": np.round(shown.angles_rad, 5).tolist(), "button_right": shown.button_right,
            "target_in_base_m": target_m.round(4).tolist(), "infer_s": round(infer_s, 6),
        }  # fmt: skip
        self._exchange.policy_log.put(TEXT + json.dumps(text).encode())
