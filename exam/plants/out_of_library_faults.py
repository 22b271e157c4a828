"""Faults outside the library, which a diagnosis can only call unknown.

Each has a severity by joint: 1 for a clear fault, 0 for none.

warm_delay              commands come later and later as the machine runs
stop_delay              stops come later than starts
pose_friction           a sector of the travel in which the joint goes slowly
bouc_wen                hysteresis of the pilot stage that is no play
joystick_curve          an exponent on the command
intermittent_sticking   bouts of a second or two in which a joint hardly moves
interlock               commands are ignored for seconds while certain two joints go fast
dial_error              the encoder's disc is off centre: a periodic error over the angle
end_cushion             the last part of the travel is slow
cross_talk              the commands of the others open the valve a little
fading                  the pump tires after some seconds of work and recovers in pauses
flow_boost              above a command a second pump joins
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.plant_parameters import RAD_PER_CYCLE

KINDS = (
    "warm_delay", "stop_delay", "pose_friction", "bouc_wen", "joystick_curve", "intermittent_sticking", "interlock",
    "dial_error", "end_cushion", "cross_talk", "fading", "flow_boost",
)  # fmt: skip


class OutOfLibraryFaults:
    """The faults of several runs side by side.

    Args:
        machine: Limits and period.
        kinds: Kind of each run, or `None`, `(N,)`.
        severity: `(N, J)`.
        luck: Uniform random numbers, `(T, N)`, one a control period.
    """

    def __init__(
        self, machine: Machine, kinds: list[str | None], severity: np.ndarray, luck: np.ndarray
    ) -> None:
        self._period_s, self._lower, self._travel = (
            machine.period_s,
            machine.lower,
            machine.upper - machine.lower,
        )
        self._luck = luck
        # a kind that no run has is left out: its step costs nothing
        self._of: dict[str, np.ndarray] = {}
        for kind in KINDS:
            if kind in kinds:
                has = np.array([other == kind for other in kinds])
                self._of[kind] = severity * has[:, None]
        self._bout_s, self._blocked_s = np.zeros(len(kinds)), np.zeros(len(kinds))
        self._tired = np.zeros((len(kinds), 1))
        self._before = np.zeros_like(severity)
        self.bend = 0.12 * self._of.get("bouc_wen", np.zeros_like(severity))

    def command(self, u: np.ndarray) -> np.ndarray:
        """Return the commands that reach the valve block, `(N, J)`."""
        if (size := self._of.get("joystick_curve")) is not None:
            u = np.sign(u) * np.abs(u) ** (1.0 + 0.7 * size)
        if (size := self._of.get("cross_talk")) is not None:
            u = np.clip(u + 0.2 * size * (u.sum(1, keepdims=True) - u), -1.0, 1.0)
        if (size := self._of.get("interlock")) is not None:
            has = size > 0
            wanted = (np.abs(u) > 0.25) & has
            met = wanted.any(1) & ((np.abs(u) > 0.25).sum(1) >= 2)
            self._blocked_s = np.where(
                met & (self._blocked_s <= -3.0), 2.5 * size.max(1), self._blocked_s - self._period_s
            )
            u = np.where(has & (self._blocked_s > 0)[:, None], 0.0, u)
        return u

    def later_s(self, u: np.ndarray, t_s: np.ndarray) -> np.ndarray:
        """Return the extra delay of a frame, `(N, J)`, after a running time of `t_s`, `(N,)`."""
        later_s = np.zeros_like(u)
        if (size := self._of.get("warm_delay")) is not None:
            later_s = later_s + 0.22 * size * (1.0 - np.exp(-t_s / 500.0))[:, None]
        if (size := self._of.get("stop_delay")) is not None:
            later_s = later_s + 0.25 * size * (np.abs(u) < np.abs(self._before))
        self._before = u
        return later_s

    def tempo(self, k: int, q: np.ndarray, flow: np.ndarray) -> np.ndarray | float:
        """Return a factor on the speeds in period `k`, at `q` with `flow` of full flow."""
        factor, at = 1.0, (q - self._lower) / self._travel
        if (size := self._of.get("pose_friction")) is not None:
            factor = factor * (1.0 - 0.6 * size * np.exp(-(((at - 0.5) / 0.15) ** 2)))
        if (size := self._of.get("end_cushion")) is not None:
            end = np.where(flow > 0, 1.0 - at, at)
            factor = factor * (1.0 - 0.85 * size * np.clip(1.0 - end / 0.25, 0.0, 1.0))
        if (size := self._of.get("flow_boost")) is not None:
            factor = factor * (1.0 + 0.5 * size * (np.abs(flow) > 0.4))
        if (size := self._of.get("intermittent_sticking")) is not None:
            begins = (self._luck[k] < self._period_s / 6.0) & (self._bout_s <= 0)
            self._bout_s = np.where(begins, 1.5, self._bout_s - self._period_s)
            factor = factor * (1.0 - 0.9 * size * (self._bout_s > 0)[:, None])
        if (size := self._of.get("fading")) is not None:
            work = np.minimum(np.abs(flow).sum(1, keepdims=True), 1.0)
            self._tired += (
                (work - self._tired) * self._period_s / np.where(work > self._tired, 4.0, 8.0)
            )
            factor = factor * (1.0 - 0.6 * size * self._tired)
        return factor

    def shown(self, q: np.ndarray) -> np.ndarray:
        """Return the angles that the encoders' discs show at `q`, `(N, J)`."""
        size = self._of.get("dial_error")
        return q if size is None else q + 0.05 * size * np.sin(RAD_PER_CYCLE * q / 0.7)
