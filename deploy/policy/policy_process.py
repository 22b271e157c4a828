"""What the policy remembers, sampled from a faster bus at its own rate.

One sample a control period: the newest measured position, and the mean of what the valves really
got over the period, as a recording holds it. A single missed period is filled in halfway between
its neighbours, and valves of which nothing was heard in
one period still get what they got. After more, or after anything stale, the ring is filled anew
before the policy speaks again: a history with a hole is one that it has never seen in training.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from brokk_rl.machine import Machine
from deploy.guidance import LeverDisplay, LeverGuidance
from deploy.policy.bundle import PolicyBundle
from deploy.runtime.bus_process import TEXT
from deploy.runtime.process import CycleTimer, Stop
from deploy.runtime.shm_layout import LoopMemory


class PolicyHistory:
    """The last `H` samples, oldest first.

    Args:
        machine: Gives `H` and `J`.

    Attributes:
        q: Positions, `(H, J)`.
        u: Commands in force in the period that ended with each position, `(H, J)`.
        proposed: What was proposed, `(H, J)`.
        filled: Samples since it was last emptied.
    """

    def __init__(self, machine: Machine) -> None:
        shape = (machine.num_history, machine.num_joints)
        self.q, self.u, self.proposed = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self.filled = 0
        self._flow_sum, self._flow_number, self._silent = np.zeros(machine.num_joints), -1, 0

    @property
    def full(self) -> bool:
        """Whether every sample was measured."""
        return self.filled >= len(self.q)

    def empty(self) -> None:
        """Forgets all samples."""
        self.filled, self._flow_number, self._silent = 0, -1, 0

    def sample(self, state: Any, missed: int) -> None:
        """Takes a sample of a fresh record of `STATE`; `missed` periods went by without one."""
        number, before = int(state["flow_number"]), self._flow_number
        u = (
            (state["flow_sum"] - self._flow_sum) / (number - before)
            if 0 <= before < number
            else np.array(state["flow"])
        )
        self._silent = self._silent + 1 if number == before else 0
        if self._silent > 1:  # the valves' messages have stopped
            self.filled = 0
        self._flow_sum, self._flow_number = np.array(state["flow_sum"]), number
        if missed > 1:
            self.filled = 0
        if missed == 1 and self.filled:
            self._push((self.q[-1] + state["q"]) / 2, u)
        self._push(np.array(state["q"]), u)

    def propose(self, u: np.ndarray) -> None:
        """Notes what was proposed."""
        self.proposed = np.concatenate([self.proposed[1:], u[None]])

    def _push(self, q: np.ndarray, u: np.ndarray) -> None:
        if not self.filled:
            self.proposed = np.zeros_like(self.proposed)
        self.q, self.u = (
            np.concatenate([self.q[1:], q[None]]),
            np.concatenate([self.u[1:], u[None]]),
        )
        self.filled += 1


class AdviceStatus(Enum):
    """Why there is an advice, or none; the order is that of `reason` in the record."""

    VALID = "valid"
    NO_STATE = "nothing from the bus"
    STALE = "positions are stale"
    IMPLAUSIBLE = "positions are not plausible"
    WARMING_UP = "history is filling"
    NO_TARGET = "no borehole is known"
    TARGET_OLD = "the borehole was found too long ago"
    REJECTED = "the policy's answer makes no sense"


REASONS = tuple(AdviceStatus)


@dataclass(frozen=True)
class PolicyProcessConfig:
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
    guidance: LeverGuidance
    stale_s: float
    target_s: float
    pitch_rad: float | None


def run(stop: Stop, counsel: PolicyProcessConfig, memory: LoopMemory) -> None:
    """Runs until it is asked to stop.

    Raises:
        CheckpointError: the bundle cannot be used.
    """
    adviser = PolicyAdviser(counsel, PolicyBundle(counsel.folder, counsel.machine), memory)
    pace = CycleTimer(counsel.machine.period_s)
    while not stop():
        pace.wait()
        adviser.cycle(pace.begin(), time.monotonic())
    memory.reports.put(json.dumps({"process": "policy"} | pace.report()).encode())


class PolicyAdviser:
    """See the module.

    Args:
        counsel: What to do.
        bundle: The policy.
        memory: Where to read and write.
    """

    def __init__(
        self, counsel: PolicyProcessConfig, bundle: PolicyBundle, memory: LoopMemory
    ) -> None:
        self._counsel, self._bundle, self._memory = counsel, bundle, memory
        self._machine = counsel.machine
        self._ring = PolicyHistory(counsel.machine)
        self._display = LeverDisplay(counsel.guidance, counsel.machine)
        self._number = 0
        self._exclusive = counsel.machine.is_exclusive
        size = bundle.encoder.size
        bundle.command(np.zeros((1, size)))  # the first call is slow

    def cycle(self, missed: int, now_s: float) -> AdviceStatus:
        """Runs one control period; `missed` ones went by before it."""
        state, target = self._memory.state.read(), self._memory.target.read()
        reason = self._sample(state, missed, now_s)
        u, infer_s = np.zeros(self._machine.num_joints), 0.0
        target_m = np.zeros(3) if target is None else np.array(target["center_in_base_m"])
        if reason is AdviceStatus.VALID:
            if target is None:
                reason = AdviceStatus.NO_TARGET
            elif now_s - float(target["t_s"]) > self._counsel.target_s:
                reason = AdviceStatus.TARGET_OLD
        if reason is AdviceStatus.VALID:
            begun = time.perf_counter()
            answer = self._infer(target_m)
            infer_s = time.perf_counter() - begun
            if answer is None:
                reason = AdviceStatus.REJECTED
            else:
                u = answer
        self._ring.propose(u)
        self._publish(reason, u, target_m, infer_s, now_s)
        return reason

    def _sample(self, state: np.ndarray | None, missed: int, now_s: float) -> AdviceStatus:
        if state is None:
            return AdviceStatus.NO_STATE
        if (
            now_s - float(state["q_t_s"]) > self._counsel.stale_s
            or now_s - float(state["t_s"]) > self._counsel.stale_s
        ):
            self._ring.empty()
            return AdviceStatus.STALE
        if not state["q_plausible"] or not state["trusted"]:
            self._ring.empty()
            return AdviceStatus.IMPLAUSIBLE
        self._ring.sample(state, missed)
        return AdviceStatus.VALID if self._ring.full else AdviceStatus.WARMING_UP

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
        self,
        reason: AdviceStatus,
        u: np.ndarray,
        target_m: np.ndarray,
        infer_s: float,
        now_s: float,
    ) -> None:
        self._number += 1
        shown = self._display.show(u, self._machine.period_s)
        record = self._memory.advice.new()
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
        self._memory.advice.write(record)
        if self._memory.request is not None and reason is AdviceStatus.VALID:
            request = self._memory.request.new()
            request["t_s"], request["u"] = now_s, u
            self._memory.request.write(request)
        text = {
            "topic": "advice", "t_s": now_s, "reason": reason.value, "u": u.round(5).tolist(),
            "lever_rad": np.round(shown.angles_rad, 5).tolist(), "button_right": shown.button_right,
            "target_in_base_m": target_m.round(4).tolist(), "infer_s": round(infer_s, 6),
        }  # fmt: skip
        self._memory.policy_log.put(TEXT + json.dumps(text).encode())
