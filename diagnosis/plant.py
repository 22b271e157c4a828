"""Plants: motion of all joints under commands, row by row, here by a function of the user.

Axes: `N` rows, `T` control periods, `J` joints, `S` numbers of a state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from brokk_rl.commands import read_targets
from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine

SPEED_GAIN = 0.5
"""Share of the difference between measured and simulated motion that corrects the speed in the warm-up.
Chosen by hand: with 1 the speed has the noise of a difference of positions, with 0 all faults of the
simulator."""
TRIAL_TOLERANCE = 1e-9
"""Largest difference between a function called for two states at once and one by one, or twice."""
ModelChanges = Mapping[str, np.ndarray]
"""Changes of numbers of a plant by name, `(N, J)` each."""
NO_CHANGES: ModelChanges = {}


class Plant(ABC):
    """Motion of all joints under commands, rows independent.

    Args:
        q_at: Places of the positions in a state, `(J,)`.
        speed_at: Those of the speeds.
        has_memory: A state holds more than these.
    """

    def __init__(self, q_at: np.ndarray, speed_at: np.ndarray, has_memory: bool) -> None:
        self._q_at, self._speed_at = q_at, speed_at
        self.has_memory = has_memory

    @abstractmethod
    def start(self, q: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return states at positions and speeds `(N, J)`, `(N, S)`."""

    @abstractmethod
    def run(
        self, state: np.ndarray, commands: np.ndarray, changes: ModelChanges = NO_CHANGES
    ) -> np.ndarray:
        """Return the states after each control period, `(N, T, S)`.

        Args:
            state: Where the rows begin, `(N, S)`.
            commands: Targets (rad, m), speeds (rad/s, m/s) or torques (Nm, N), `(N, T, J)`.
            changes: Changes of numbers of the plant by name, `(N, J)` each.
        """

    def place(self, state: np.ndarray, q: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return states moved to positions and speeds `(N, J)`."""
        state = state.copy()
        state[:, self._q_at] = q
        state[:, self._speed_at] = speed
        return state

    def read(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and speeds of states, each `(…, J)`."""
        return state[..., self._q_at], state[..., self._speed_at]

    def correct(self, state: np.ndarray, q: np.ndarray, period_s: float) -> np.ndarray:
        """Return states moved to measured positions `(N, J)`, their speeds corrected by a share of the way.

        The simulator is the model of an alpha-beta filter: it knows how fast a step of the command makes a
        joint, which the last positions alone do not tell.
        """
        simulated, speed = self.read(state)
        return self.place(state, q, speed + SPEED_GAIN * (q - simulated) / period_s)


class FunctionPlant(Plant):
    """A function `step(state, command) -> state` as a plant; it has no numbers that could be changed.

    Args:
        step: The function.
        start: First state at positions and speeds; `None`: the two in a row.
        machine: The machine.
        name: Name of the function in messages.

    Raises:
        ConfigError: The function cannot be called, or returns no such state.
    """

    def __init__(
        self,
        step: Callable[..., Any],
        start: Callable[..., Any] | None,
        machine: Machine,
        name: str,
    ) -> None:
        places = np.arange(2 * machine.num_joints).reshape(2, -1)
        super().__init__(*places, has_memory=start is not None)
        self._step, self._start, self._name = step, start, name
        middle = 0.5 * (machine.lower + machine.upper)
        q = np.stack([middle, middle + 0.1 * (machine.upper - machine.lower)])
        state = self.start(q, np.zeros_like(q))
        command = read_commands(np.full_like(q, 0.1), machine)
        found = [self._call_step(*one) for one in zip(state, command, strict=True)]
        for one in found:
            if one.shape != state[0].shape:
                raise ConfigError(
                    f"simulator={name}: expected a state of {len(state[0])} numbers from step(state, command), as it was "
                    f"given, got shape {one.shape}; return positions, speeds, then what start(position, speed) added"
                )
            if not np.isfinite(one).all():
                raise ConfigError(
                    f"simulator={name}: step(state, command) returned NaN or infinity in the middle of the travel, "
                    f"at rest: {one}; it has to stay finite there"
                )
        again = self._call_step(state[0], command[0])
        if not _is_same(again, found[0]):
            raise ConfigError(
                f"simulator={name}: step(state, command) gave two answers to one state and command, {found[0]} and {again}; "
                "keep what it remembers in the state that start(position, speed) begins, and switch its noise off"
            )
        try:
            is_vectorised = _is_same(self._call_step(state, command), np.stack(found))
        except ConfigError:
            is_vectorised = False
        if not is_vectorised:
            self._step = np.vectorize(step, otypes=[float], signature="(s),(j)->(s)")

    def start(self, q: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return states at positions and speeds `(N, J)`, `(N, S)`."""
        if self._start is None:
            return np.concatenate([q, speed], 1)
        found, least = [], 2 * q.shape[1]
        for one in zip(q, speed, strict=True):
            state = self._call(self._start, "start(position, speed)", *one)
            if state.ndim != 1 or len(state) < least:
                raise ConfigError(
                    f"simulator={self._name}: expected a state of {least} numbers or more from "
                    f"start(position, speed), positions and speeds first, got shape {state.shape}"
                )
            found.append(state)
        return np.stack(found)

    def run(
        self, state: np.ndarray, commands: np.ndarray, changes: ModelChanges = NO_CHANGES
    ) -> np.ndarray:
        """Return the states after each control period; see `Plant.run`."""
        found = np.empty((*commands.shape[:2], state.shape[1]))
        for k in range(commands.shape[1]):
            state = self._call_step(state, commands[:, k])
            found[:, k] = state
        return found

    def _call_step(self, state: np.ndarray, command: np.ndarray) -> np.ndarray:
        return self._call(self._step, "step(state, command)", state, command)

    def _call(self, function: Callable[..., Any], told: str, *given: np.ndarray) -> np.ndarray:
        """Return what a function of the user makes of arrays."""
        try:
            return np.asarray(function(*(one.copy() for one in given)), dtype=float)
        except Exception as error:
            shapes = " and ".join(str(one.shape) for one in given)
            raise ConfigError(
                f"simulator={self._name}: {told} failed with {type(error).__name__}: {error}; "
                f"it got arrays of the shapes {shapes}"
            ) from error


def _is_same(some: np.ndarray, others: np.ndarray) -> bool:
    """Return whether states are the same but for rounding."""
    return some.shape == others.shape and np.allclose(some, others, rtol=0, atol=TRIAL_TOLERANCE)


def read_commands(u: np.ndarray, machine: Machine) -> np.ndarray:
    """Return commands `(…, J)` in [-1, 1] as targets (rad, m), speeds (rad/s, m/s) or torques (Nm, N)."""
    if machine.interface == "position":
        return read_targets(u, machine)
    return u * (machine.max_speed if machine.interface == "speed" else machine.max_force)
