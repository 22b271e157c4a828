"""Faults of a machine with valves: effects as changes of its numbers, and causes outside the library.

What only an effect changes has a value for each joint, `(J,)`.

No effect of the library describes the causes: they depend on time at rest, on the sign of the command
before, on other joints' motion, or on the pose without the weight. Each has a severity by joint: 1
for a plain one, 0 for none.

silted_spool     a spool that rests silts up; it sticks until the pilot force has grown, then lets go
ajar_check       after a motion the load-holding valve stays ajar for seconds: the joint sinks on
supply_voltage   commands are scaled by a supply voltage that falls and recovers with its charger
moved_stop       a stop that moved into the travel
back_flow        a missing load check and a pump that wakes slowly: a start under load first goes the
                 wrong way
stale_readings   the encoder repeats its reading for some tenths of a second, then jumps
coarse_driver    the valve's driver knows a few currents only
levelling        a levelling cylinder takes up part of the next joint's motion
moved_mounting   a cylinder mounted elsewhere: speed varies with the pose
reversal_pause   after a reversal the valve stays closed for some tenths of a second
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.changes import FaultSizes, PlantParameters, read_faults


def compute_notch_area(opening: np.ndarray, notch: np.ndarray) -> np.ndarray:
    """Return the metering area of an opening beyond the overlap, both of full ones.

    Triangular notches open with the square of the stroke up to `notch`; then the land opens in
    proportion. The slope has no jump.
    """
    full = 2.0 - notch
    land = (2.0 * opening - notch) / full
    area = np.where(opening < notch, opening**2 / (notch * full), land)
    return area * (opening > 0)


SEIZED = 0.08
"""Added friction at rest with which a joint that starts at its usual command begins to stick."""
SEIZED_PER_COMMAND = 1.0
"""Growth of that friction with the command at which the joint starts."""
USUAL_START = 0.08
"""Command at which a usual joint starts."""


def _add_stiction(n: PlantParameters, size: FaultSizes) -> None:
    """Add friction at rest, and a bleed orifice that only a larger opening overcomes."""
    start = size["start"]
    has = start > 0
    n["breakaway"] = np.where(has, SEIZED + SEIZED_PER_COMMAND * (start - USUAL_START), 0.0)
    overlap = np.minimum(n["overlap_extend"], n["overlap_retract"])
    beyond = np.clip((start - overlap) / (1.0 - overlap), 0.0, 1.0)
    flow = compute_notch_area(beyond, n["notch"])
    n["bleed"] = np.where(has, flow / np.sqrt(np.maximum(n["breakaway"], 1e-6)), 0.0)


def _add_flow_sharing(n: PlantParameters, size: FaultSizes) -> None:
    """Let the mean demand of all joints be that of the effect; joints keep their own shares."""
    wanted = size["demand"]
    share = n["demand"] / n["demand"].mean()
    n["demand"] = np.where(wanted > 0, np.maximum(n["demand"], share * wanted), n["demand"])


NEUTRAL, CHANGES = read_faults("valves")
CHANGES |= {"stiction": _add_stiction, "flow_sharing": _add_flow_sharing}

CAUSES = (
    "silted_spool", "ajar_check", "supply_voltage", "moved_stop", "back_flow", "stale_readings", "coarse_driver",
    "levelling", "moved_mounting", "reversal_pause",
)  # fmt: skip

# Sizes at severity 1, chosen by hand so that each shows plainly in the motion.
SILT_STROKE = 0.8
SILT_S = 1.0
AJAR_SPEED, AJAR_S = 0.12, 2.0
VOLTAGE_LOSS, CHARGER_S, CHARGER_SHARE = 0.25, 24.0, 0.5
STOP_TRAVEL = 0.4
BACK_FLOW, WAKING = 2.0, 0.3
STALE_EVERY_S, STALE_S = 2.5, 0.6
DRIVER_LEVELS = 3.0
LEVELLING_SHARE = 0.3
MOUNTING_RAD = 1.1
PAUSE_S = 0.7


class OutsideCauses:
    """The causes of several runs side by side.

    Args:
        machine: Limits, period, full speeds.
        severity: Of each cause, `(N, J)`.
        chance: Uniform random numbers: `phase` of each run, `(1, N)`, when its charger begins, and `luck`, `(T, N)`,
            one a control period.
        step_s: Time step of the valves.
    """

    def __init__(
        self, machine: Machine, severity: PlantParameters, chance: PlantParameters, step_s: float
    ) -> None:
        self._step_s, self._period_s = step_s, machine.period_s
        self._luck, self._phase = chance["luck"], chance["phase"][0]
        self._of = severity
        none = np.zeros((len(self._phase), machine.num_joints))
        travel = machine.upper - machine.lower
        cut = STOP_TRAVEL * travel * self._of["moved_stop"]
        # the stop that is farther from home: the machine must reach its home
        is_upper = machine.upper - machine.home >= machine.home - machine.lower
        upper = np.where(is_upper, np.maximum(machine.upper - cut, machine.home), machine.upper)
        lower = np.where(is_upper, machine.lower, np.minimum(machine.lower + cut, machine.home))
        self.lower = np.broadcast_to(lower, none.shape)
        self.upper = np.broadcast_to(upper, none.shape)
        self.mounting_rad = MOUNTING_RAD * self._of["moved_mounting"]
        self.back_flow = BACK_FLOW * self._of["back_flow"]
        self.pump_lag = 1.0 + WAKING * self._of["back_flow"].max(1, keepdims=True)
        self._rest_s, self._since_s = none.copy(), none + 1e3
        self._direction, self._pause_s = none.copy(), none.copy()
        self._stale_s, self._held = none[:, 0].copy(), none.copy()
        self._is_held = none.astype(bool)
        # a joint is levelled by the next one, the last by the one before
        self._master = np.minimum(np.arange(machine.num_joints) + 1, machine.num_joints - 1)
        self._master[-1] = max(machine.num_joints - 2, 0)

    def drive(self, u: np.ndarray, t_s: np.ndarray) -> np.ndarray:
        """Return the commands that the drivers give at the running times `t_s`, `(N,)`."""
        part = np.mod(t_s / CHARGER_S + self._phase, 1.0)
        low = (part < CHARGER_SHARE)[:, None]
        u = u * (1.0 - VOLTAGE_LOSS * self._of["supply_voltage"].max(1, keepdims=True) * low)
        size = self._of["coarse_driver"]
        levels = DRIVER_LEVELS / np.maximum(size, 1e-3)
        u = np.where(size > 0, np.round(u * levels) / levels, u)
        size = self._of["reversal_pause"]
        heads = np.sign(u) * (np.abs(u) > 0.05)
        turned = (heads * self._direction < 0) & (size > 0)
        self._pause_s = np.where(turned, PAUSE_S * size, self._pause_s - self._period_s)
        self._direction = np.where(heads != 0, heads, self._direction)
        return np.where(self._pause_s > 0, 0.0, u)

    def stick(self, moved: np.ndarray) -> np.ndarray:
        """Return the further friction of the spools, of full stroke, `(N, J)`.

        Args:
            moved: Whether each spool moved in the last step.
        """
        self._rest_s = np.where(moved, 0.0, self._rest_s + self._step_s)
        return SILT_STROKE * self._of["silted_spool"] * (1.0 - np.exp(-self._rest_s / SILT_S))

    def leak(self, is_open: np.ndarray) -> np.ndarray:
        """Return the further leak of the closed valves, of full speed, `(N, J)`."""
        size = self._of["ajar_check"]
        self._since_s = np.where(is_open, 0.0, self._since_s + self._step_s)
        return AJAR_SPEED * size * np.exp(-self._since_s / AJAR_S) * ~is_open

    def move_others(self, speed: np.ndarray) -> np.ndarray:
        """Return the speeds, rad/s or m/s, with what other joints add, `(N, J)`."""
        return speed - LEVELLING_SHARE * self._of["levelling"] * speed[:, self._master]

    def show(self, k: int, reading: np.ndarray) -> np.ndarray:
        """Return the readings of period `k` as they are sent, `(N, J)`."""
        size = self._of["stale_readings"]
        begins = (self._luck[k] < self._period_s / STALE_EVERY_S) & (self._stale_s <= 0)
        length_s = STALE_S * size.max(1)
        self._stale_s = np.where(begins, length_s, self._stale_s - self._period_s)
        stale = (self._stale_s > 0)[:, None] & (size > 0)
        self._held = np.where(stale & self._is_held, self._held, reading)
        self._is_held = stale
        return np.where(stale, self._held, reading)
