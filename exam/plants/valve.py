"""The valve: pilot stage with hysteresis, a spool with stop and bounded slope, the metering land.

Commands and spool positions are parts of full stroke. All arrays `(N, J)`.
"""

from __future__ import annotations

import numpy as np

from exam.plants.plant_parameters import PlantParameters

TAU = 2.0 * np.pi
"""Radians a cycle."""
LAND_LEAK = 0.08
"""Opening at which the leak over the metering land takes half of the pressure from a joint at rest;
chosen by hand."""
WEIGHT_SHARE = 0.25
"""Change of the break-away pressure by a load of yield force; chosen by hand."""


class SpoolValve:
    """Spools of all joints.

    Args:
        numbers: The machine's; see `plant_parameters`.
    """

    def __init__(self, numbers: PlantParameters) -> None:
        self._numbers = numbers
        shape = numbers["notch"].shape
        self._pilot, self._filtered, self._spool, self._rate, self._bent = (
            np.zeros(shape) for _ in range(5)
        )
        self._omega = TAU * numbers["spool_hz"]
        self._slope = np.where(
            numbers["stroke_s"] > 0, 1.0 / np.maximum(numbers["stroke_s"], 1e-6), 50.0
        )
        leaking = numbers["breakaway"] < 1.0
        self._breaks = np.where(leaking, numbers["breakaway"], 0.99)

    def step(
        self, u: np.ndarray, dt_s: float, bend: np.ndarray, moving: np.ndarray, load: np.ndarray
    ) -> np.ndarray:
        """Return signed openings after a time step, 1 for a fully open port, waviness included.

        Args:
            u: Commands in force.
            dt_s: Time step.
            bend: Strength of a Bouc-Wen hysteresis in the pilot stage, of full command.
            moving: Whether a joint moves.
            load: Weight in the positive direction over yield force.
        """
        n = self._numbers
        half = 0.5 * n["hysteresis"]
        before = self._pilot
        self._pilot = np.clip(self._pilot, u - half, u + half)
        if bend.any():
            change, reach = self._pilot - before, np.maximum(bend, 1e-9)
            # Bouc-Wen with exponent 1: the hysteretic part follows the change and saturates at
            # `bend`
            grip = 1.0 - np.abs(self._bent) / reach * np.sign(np.maximum(self._bent * change, 0.0))
            self._bent = np.where(bend > 0, self._bent + 3.0 * change * grip, 0.0)
        wanted = self._pilot - np.clip(self._bent, -bend, bend)
        self._filtered += (wanted - self._filtered) * (dt_s / (dt_s + n["pilot_s"]))
        pull = (
            self._omega * self._omega * (self._filtered - self._spool)
            - 2.0 * n["spool_damping"] * self._omega * self._rate
        )
        self._rate = np.clip(self._rate + dt_s * pull, -self._slope, self._slope)
        moved = self._spool + dt_s * self._rate
        self._spool = np.clip(moved, -n["stop"], n["stop"])
        self._rate = np.where(self._spool == moved, self._rate, 0.0)
        return self._metered(moving, load)

    def _metered(self, moving: np.ndarray, load: np.ndarray) -> np.ndarray:
        n, spool = self._numbers, self._spool
        extends = spool > 0
        overlap = np.where(extends, n["overlap_extend"], n["overlap_retract"])
        beyond = np.maximum(np.abs(spool) - overlap, 0.0) / (1.0 - overlap)
        if n["breakaway"].any():
            stalled = beyond / (beyond + LAND_LEAK)  # pressure before a joint that rests
            needed = self._breaks * (1.0 - WEIGHT_SHARE * np.sign(spool) * load)
            beyond = np.where((stalled > needed) | moving, beyond, 0.0)
        flow = beyond * (1.0 - n["notch"] + n["notch"] * beyond)
        wave = 1.0 + n["wave"] * np.sin(TAU * n["wave_number"] * beyond + n["wave_phase"])
        side = np.where(extends, n["extend"], n["retract"] * n["retract_ratio"])
        return np.sign(spool) * flow * wave * side * n["speed_scale"]
