"""Commands of a machine as speeds, and speeds as commands, for each command interface.

A program of the policy, an excitation or an inspection thinks in speeds: at 0 a joint rests. Joints
commanded by position take the integral of such a program as their target.
Axes: `T` samples, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from brokk_rl.machine import Machine
from brokk_rl.record import Recording


def read_targets(u: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the target positions of commands `(…, J)`, rad or m: -1 and 1 are the ends of the travel."""
    middle, half = (machine.upper + machine.lower) / 2, (machine.upper - machine.lower) / 2
    return middle + u * half


def scale_targets(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the commands of target positions `(…, J)`, rad or m, cut at the ends of the travel."""
    middle, half = (machine.upper + machine.lower) / 2, (machine.upper - machine.lower) / 2
    return np.clip((q - middle) / half, -1.0, 1.0)


def find_rest(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the commands `(…, J)` under which joints rest at `q`: the position itself as a target, else 0."""
    return scale_targets(q, machine) if machine.interface == "position" else np.zeros_like(q)


class SpeedProgram:
    """Commands that carry out a program of speeds, step by step.

    A target begins where the joint is and moves on with the speed that is asked for, within the
    travel. Valves and drives take the speeds themselves.

    Args:
        machine: The machine.
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._target: np.ndarray | None = None

    def command(self, speeds: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the commands of the coming control period, and the speeds that they carry out.

        Args:
            speeds: Speeds that are asked for, of full speed, `(…, J)` in [-1, 1].
            q: Measured positions, `(…, J)`.
        """
        machine = self._machine
        if machine.interface != "position":
            return speeds, speeds
        before = q if self._target is None else self._target
        step = machine.max_speed * machine.period_s
        self._target = np.clip(before + speeds * step, machine.lower, machine.upper)
        return scale_targets(self._target, machine), (self._target - before) / step


def view_speeds(u: np.ndarray, machine: Machine) -> np.ndarray:
    """Return commands `(…, T, J)` as parts of full speed.

    Those of valves and drives are speeds already. A target changes from one sample to the next, so
    its speed acts from the sample at which the new target is given. Torques stay as they are: they
    set an acceleration, and no speed belongs to them.
    """
    if machine.interface != "position":
        return u
    step = np.diff(read_targets(u, machine), axis=-2, prepend=read_targets(u[..., :1, :], machine))
    return np.clip(step / (machine.max_speed * machine.period_s), -1.0, 1.0)


def view_recordings(recordings: Sequence[Recording], machine: Machine) -> list[Recording]:
    """Return recordings with their commands as speeds; see `view_speeds`."""
    if machine.interface != "position":
        return list(recordings)
    return [replace(one, u=view_speeds(one.u, machine)) for one in recordings]
