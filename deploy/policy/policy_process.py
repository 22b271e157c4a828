"""The policy process: in each control period from the state of the machine to an advice.

It never touches the bus. Where commands are sent at all (`deploy=auto`) it also writes them into
the request slot, which the guard reads; otherwise there is no such slot. A policy that learned behind
a person commands through the lag of a hand there.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.observation import PITCH, PROPOSALS, TARGET
from deploy.guidance import LeverDisplay, LeverGuidance
from deploy.kernel.guard import GuardTrip
from deploy.policy.bundle import PolicyBundle
from deploy.runtime.operator_state import (
    AdviceStatus,
    OperatorState,
    PolicyAdvice,
    RequestedCommand,
)
from deploy.runtime.process import CycleTimer, Stop
from deploy.runtime.shm_layout import LoopMemory, log_text

OBSERVATION_DECIMALS = 5
"""Decimals of the observation in the log, for `mode=doctor_policy`; its tolerance is 1e-3."""
ROUNDING = 1e-6
"""By which a command in float32 may exceed full and still count as full."""


class PolicyHistory:
    """The last `H` samples of the state, oldest first, sampled from a faster bus at the policy's rate.

    One sample a control period: the newest measured position, and the mean feedback of the valves
    over the period, as in a recording. A single missed period is interpolated; valves of which
    nothing was heard in one period keep their last feedback. After a longer gap, or after stale
    values, the history is filled anew before the policy gives advice again: it has never seen a
    history with a hole in training.

    Args:
        machine: Gives `H` and `J`.

    Attributes:
        q: Positions, `(H, J)`.
        u: Commands in force in the period that ended with each position, `(H, J)`.
        proposed: Commands that the policy proposed, `(H, J)`.
        filled: Samples since the history was last emptied.
    """

    def __init__(self, machine: Machine) -> None:
        shape = (machine.num_history, machine.num_joints)
        self.q, self.u, self.proposed = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self.filled = 0
        # -1: no flow was heard yet, so there is no difference to form.
        self._flow_sum, self._flow_number, self._silent = np.zeros(machine.num_joints), -1, 0

    @property
    def full(self) -> bool:
        """True if every sample was measured."""
        return self.filled >= len(self.q)

    def empty(self) -> None:
        """Drop all samples."""
        self.filled, self._flow_number, self._silent = 0, -1, 0

    def sample(self, state: OperatorState, missed: int) -> None:
        """Take a sample of a fresh state; `missed` periods went by without one."""
        number, before = state.flow_number, self._flow_number
        u = np.array(state.flow)
        # The mean over the period is exact, since sums and counts go on between samples.
        if 0 <= before < number:
            u = (state.flow_sum - self._flow_sum) / (number - before)
        self._silent = self._silent + 1 if number == before else 0
        if self._silent > 1:  # the valves' messages have stopped
            self.filled = 0
        self._flow_sum, self._flow_number = np.array(state.flow_sum), number
        if missed > 1:
            self.filled = 0
        # One missed period is bridged by the middle; more would be invented.
        if missed == 1 and self.filled:
            self._push((self.q[-1] + state.q) / 2, u)
        self._push(np.array(state.q), u)

    def propose(self, u: np.ndarray) -> None:
        """Append the commands that were proposed."""
        self.proposed = np.concatenate([self.proposed[1:], u[None]])

    def _push(self, q: np.ndarray, u: np.ndarray) -> None:
        # Proposals from before a gap belong to another motion.
        if not self.filled:
            self.proposed = np.zeros_like(self.proposed)
        self.q = np.concatenate([self.q[1:], q[None]])
        self.u = np.concatenate([self.u[1:], u[None]])
        self.filled += 1


@dataclass(frozen=True)
class PolicyProcessConfig:
    """Settings of a policy process.

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


def run(stop: Stop, config: PolicyProcessConfig, memory: LoopMemory) -> None:
    """Run until asked to stop.

    Raises:
        CheckpointError: the bundle cannot be used.
    """
    adviser = PolicyAdviser(config, PolicyBundle(config.folder, config.machine), memory)
    # The period comes from the machine: the policy was trained at this rate.
    timer = CycleTimer(config.machine.period_s)
    while not stop():
        timer.wait()
        adviser.run_cycle(timer.begin(), time.monotonic())
    report = {"process": "policy"} | timer.report()
    memory.reports.put(json.dumps(report).encode())


class PolicyAdviser:
    """Advice of the policy, one control period after the other.

    Args:
        config: Settings.
        bundle: The policy.
        memory: Where to read and write.
    """

    def __init__(
        self, config: PolicyProcessConfig, bundle: PolicyBundle, memory: LoopMemory
    ) -> None:
        self._config, self._bundle, self._memory = config, bundle, memory
        self._machine = config.machine
        self._history = PolicyHistory(config.machine)
        self._display = LeverDisplay(config.guidance, config.machine)
        self._number = 0
        self._observed = np.zeros(0)
        bundle.command(np.zeros((1, bundle.encoder.size)))  # the first call is slow

    def run_cycle(self, missed: int, now_s: float) -> AdviceStatus:
        """Run one control period; `missed` ones went by before it."""
        state, target = self._memory.state.read(), self._memory.target.read()
        status = self._sample(state, missed, now_s)
        u, infer_s, self._observed = np.zeros(self._machine.num_joints), 0.0, np.zeros(0)
        target_m = np.zeros(3) if target is None else np.array(target["center_in_base_m"])
        if status is AdviceStatus.VALID:
            if target is None:
                status = AdviceStatus.NO_TARGET
            elif now_s - float(target["t_s"]) > self._config.target_s:
                status = AdviceStatus.TARGET_OLD
            elif state is not None and state.target is not GuardTrip.NONE:
                status = AdviceStatus.TARGET_REFUSED
            elif not self._bundle.is_trained_for(target_m):
                status = AdviceStatus.TARGET_UNKNOWN
            # What comes after the end of its episodes no policy has been trained for.
            elif self._bundle.is_done(self._history.q[-1], target_m, self._config.pitch_rad):
                status = AdviceStatus.DONE
        if status is AdviceStatus.VALID:
            begun = time.perf_counter()
            answer = self._infer(target_m)
            infer_s = time.perf_counter() - begun
            if answer is None:
                status = AdviceStatus.REJECTED
            else:
                u = answer
        # Zero is remembered too: the history must show that nothing was proposed.
        self._history.propose(u)
        self._publish(status, u, target_m, infer_s, now_s)
        return status

    def _sample(self, state: OperatorState | None, missed: int, now_s: float) -> AdviceStatus:
        if state is None:
            return AdviceStatus.NO_STATE
        stale_s = self._config.stale_s
        # Old positions, old commands in force and a silent bus process are equally bad.
        if now_s - min(state.q_t_s, state.flow_t_s, state.t_s) > stale_s:
            self._history.empty()
            return AdviceStatus.STALE
        if not state.q_plausible or not state.trusted:
            self._history.empty()
            return AdviceStatus.IMPLAUSIBLE
        if state.observed_joint:
            self._history.empty()
            return AdviceStatus.FAULT
        self._history.sample(state, missed)
        return AdviceStatus.VALID if self._history.full else AdviceStatus.WARMING_UP

    def _infer(self, target_m: np.ndarray) -> np.ndarray | None:
        """Return masked commands, `(J,)`; `None` where the policy's answer is not usable."""
        history = self._history
        values = {
            TARGET: target_m[None],
            "q": history.q[None],
            "u": history.u[None],
            PITCH: np.array([self._config.pitch_rad or 0.0]),
            PROPOSALS: history.proposed[None],
        }
        observation = self._bundle.encoder.encode(values)
        # A target of NaN would otherwise reach the network.
        if not np.isfinite(observation).all():
            return None
        self._observed = observation[0]
        u = self._bundle.command(observation)[0].astype(float)
        moved = u != 0
        # the bundle masks its commands; an exclusive joint beside others means that it is damaged
        together = moved[self._machine.is_exclusive].any() and moved.sum() > 1
        if not np.isfinite(u).all() or np.abs(u).max() > 1.0 + ROUNDING or together:
            return None
        return u

    def _build_request(self, status: AdviceStatus, u: np.ndarray, now_s: float) -> RequestedCommand:
        """Return the command to ask for; without advice the last one must not go on."""
        if self._bundle.hand is not None:
            u = self._bundle.hand.give(u, status is AdviceStatus.VALID)
        if status in (AdviceStatus.VALID, AdviceStatus.DONE):
            return RequestedCommand(now_s, u)
        if status is AdviceStatus.REJECTED:
            return RequestedCommand(now_s, np.full(len(u), np.nan))
        # Too old for the guard from the beginning: withdrawn.
        return RequestedCommand(-math.inf, u)

    def _publish(
        self,
        status: AdviceStatus,
        u: np.ndarray,
        target_m: np.ndarray,
        infer_s: float,
        now_s: float,
    ) -> None:
        self._number += 1
        # The display moves by one period even without advice, back towards neutral.
        shown = self._display.show(u, self._machine.period_s)
        advice = PolicyAdvice(
            t_s=now_s,
            number=self._number,
            reason=status,
            u=u,
            lever_rad=shown.angles_rad,
            button_right=shown.button_right,
            target_in_base_m=target_m,
            infer_s=infer_s,
        )
        self._memory.advice.write(advice)
        # The request slot exists only where commands may be sent.
        if self._memory.request is not None:
            self._memory.request.write(self._build_request(status, u, now_s))
        values = {
            "reason": status.value,
            "u": u.round(5).tolist(),
            "lever_rad": np.round(shown.angles_rad, 5).tolist(),
            "button_right": shown.button_right,
            "target_in_base_m": target_m.round(4).tolist(),
            "infer_s": round(infer_s, 6),
            "observation": self._observed.round(OBSERVATION_DECIMALS).tolist(),
        }
        log_text(self._memory.policy_log, "advice", now_s, values)
