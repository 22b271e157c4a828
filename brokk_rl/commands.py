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


def command_targets(q: np.ndarray, machine: Machine) -> np.ndarray:
    """Return the commands of target positions `(…, J)`, rad or m, cut at the ends of the travel."""
    middle, half = (machine.upper + machine.lower) / 2, (machine.upper - machine.lower) / 2
    return np.clip((q - middle) / half, -1.0, 1.0)


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
