"""The valve model of `actuators.models.valve`, in numpy, for one machine: what the observer expects.

`brokk mode=observe` writes its tables as JSON. The equations are those of the module named above; a
test holds both against each other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.plain_files import read_json

SCHEMA = 2
"""Of the observer's file."""
MOST_BYTES = 1 << 24
"""Size beyond which a file is none of an observer; the shipped one has 10 KB."""
BEYOND = 1.2
"""Positions, in halves of the travel from its middle, beyond which the pose counts no further."""
SHORTEST_S = 1e-6
"""Time constant below which a lag counts as none."""


def load_observer_file(path: Path) -> dict[str, Any]:
    """Return the content of an observer's file.

    Raises:
        ConfigError: it is missing, or no such file.
    """
    try:
        content = read_json(path, MOST_BYTES)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"guard.observer.path: {path} cannot be read ({error}); brokk mode=observe writes such a file"
        ) from error
    if content.get("schema") != SCHEMA:
        raise ConfigError(
            f"guard.observer.path: expected a file of schema {SCHEMA}, got {path}; make it again by brokk mode=observe"
        )
    return content


def describe_sources(content: Mapping[str, Any]) -> str:
    """Return in a few words what an observer's file was made from."""
    first, *others = content["sources"]
    return f"from {first}" + (f" and {len(others)} more" if others else "")


class ValvePredictor:
    """Predicts the motion of each control period from the commands.

    Args:
        tables: As `ValveActuator.export_tables` gives them.
        machine: Limits, speeds and period.
    """

    def __init__(self, tables: Mapping[str, Any], machine: Machine) -> None:
        number = {name: np.array(tables[name], float) for name in tables if name != "pose"}
        periods = number["dead_time_s"] / machine.period_s
        self._whole = np.floor(periods).astype(int)
        self._part = periods - self._whole
        self._half_play = number["play"] / 2
        self._spool_kept = np.exp(-machine.period_s / number["spool_s"].clip(SHORTEST_S))
        self._speed_kept = np.exp(-machine.period_s / number["speed_s"].clip(SHORTEST_S))
        self._demand, self._knots = number["demand"], number["knots"]
        self._curves = {1: number["curve_extend"], -1: number["curve_retract"]}
        self._full_step = machine.max_speed * machine.period_s
        self._lower, self._upper = machine.lower, machine.upper
        pose = tables["pose"]
        self._pose = None if pose is None else {key: np.array(pose[key], float) for key in pose}
        self._joints = np.arange(machine.num_joints)
        self.reset()

    def reset(self) -> None:
        """Forget all commands: the machine is at rest."""
        num, length = len(self._joints), int(self._whole.max()) + 2
        self._commands = deque([np.zeros(num)] * length, length)
        self._pilot, self._spool, self._step = np.zeros(num), np.zeros(num), np.zeros(num)

    def predict(self, u: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the motion in the period in which `u`, `(J,)`, is in force, from `q`, `(J,)`."""
        self._commands.append(u)
        history = np.array(self._commands)
        newest = len(history) - 1 - self._whole
        later, earlier = history[newest, self._joints], history[newest - 1, self._joints]
        acting = later + self._part * (earlier - later)
        self._pilot = np.clip(self._pilot, acting - self._half_play, acting + self._half_play)
        self._spool = self._pilot + self._spool_kept * (self._spool - self._pilot)
        signs = np.where(self._spool > 0, 1, -1)
        stroke = np.abs(self._spool)
        flow, full = np.zeros(len(u)), np.zeros(len(u))
        for j, sign in enumerate(signs):
            curve = self._curves[int(sign)][j]
            flow[j], full[j] = np.interp(stroke[j], self._knots, curve), max(curve[-1], 1e-3)
        asked = float((self._demand * flow / full).sum())
        wanted = signs * flow * self._full_step / max(asked, 1.0)
        if self._pose is not None:
            wanted = wanted * self._find_pose_factor(q, signs)
        self._step = wanted + self._speed_kept * (self._step - wanted)
        moved = q + self._step
        held = np.clip(moved, np.minimum(self._lower, q), np.maximum(self._upper, q))
        # A joint at its stop has no speed left.
        self._step = np.where(held == moved, self._step, 0.0)
        return held - q

    def _find_pose_factor(self, q: np.ndarray, signs: np.ndarray) -> np.ndarray:
        """Return the factor of each joint's speed at this pose, `(J,)`."""
        pose = self._pose
        assert pose is not None
        middle, half = (self._lower + self._upper) / 2, (self._upper - self._lower) / 2
        place = np.tile(((q - middle) / half).clip(-BEYOND, BEYOND), (len(q), 1))
        if pose["sums"].size:
            angle = q @ pose["sums"]
            waves = np.concatenate([np.cos(angle), np.sin(angle), np.ones(1)])
            weight = (waves @ pose["linear"])[:, None]
            place = np.concatenate([weight, weight**2, place], 1)
        slopes = np.where(signs[:, None] > 0, pose["extend"], pose["retract"])
        return (1.0 + (place * slopes).sum(1)).clip(0.0)
