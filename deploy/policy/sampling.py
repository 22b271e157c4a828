"""What the policy remembers, sampled from a faster bus at its own rate.

One sample a control period: the newest measured position, and the mean of what the valves really
got over the period, as a recording holds it. A single missed period is filled in halfway between
its neighbours, and valves of which nothing was heard in
one period still get what they got. After more, or after anything stale, the ring is filled anew
before the policy speaks again: a history with a hole is one that it has never seen in training.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from brokk_rl.machine import Machine


class Ring:
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
