"""Hydraulics of a machine with valves, from commands at the valve block to joint speeds.

Per joint, with a step of `STEP_S`:

    pilot       a chamber fills through an orifice: p' = sign(d) sqrt(|d|) / T with d = u - p
    spool       dry friction about the pilot, pushed back by the flow force: x = p / (1 + f a drop)
    metering    notches, then the land: area a(x) beyond the overlap
    inlet       q = a sqrt(min(set, supply - inlet pressure) / nominal), `set` by the compensator
    outlet      regulated: q = r a sqrt(p / (p + p0))
    chambers    p' = stiffness / volume (flow in - flow out), volumes with the stroke
    linkage     the cylinder is a side of a triangle, so its lever arm changes with the pose
    joint       force of both chambers, load, dry friction larger at rest, viscous friction
    pump        follows the highest inlet pressure plus a margin, with a lag; limited in flow and
                in power, so that the heaviest joint is starved first

Pressures and speed of a step are solved together (linearly implicit Euler); dry friction bounds the
momentum, so it stops a joint and never drives it.
"""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.changes import PlantParameters
from exam.plants.linkage import Arm
from exam.plants.valve_faults import OutsideCauses, compute_notch_area

STEP_S = 0.0025
"""Time step, s: a twentieth of a control period; the first mode of a joint lasts 50 of them."""
FORCE_RATIO = 1.6
"""Cylinder force at relief pressure over the machine's yield force; as a relief valve is set."""
FIRST_MODE_HZ = 6.0
"""First mode on closed cylinders that the machine's stiffness was estimated for, Hz."""
NOMINAL_DROP = 0.06
"""Drop over the metering edge that its compensator keeps: 15 of 250 bar."""
MARGIN = 0.11
"""Pressure of the pump above the highest load: 27 of 250 bar, above the compensators' drop."""
STANDBY = 0.08
"""Pressure of the idle pump: 20 of 250 bar."""
LINE_SOFTNESS = 0.05
"""Pump flow that the line stores per relief pressure, s. Chosen by hand; not searched."""
OUTLET_PRESSURE = 0.02
"""Pressure at which the outlet regulator begins to regulate: 5 of 250 bar."""
OPEN = 1e-4
"""Area from which a valve counts as open."""
SPOOL_STEP = 1e-5
"""Movement of a spool in a step, of full stroke, that counts as one."""
STILL = 0.004
"""Speed, of full speed, below which a joint rests. Chosen by hand; not searched."""
STRIBECK = 0.02
"""Speed, of full speed, over which friction falls from that at rest to that in motion."""
TYPICAL_HOLDING = 0.25
"""Pressure that holds two fifths of the yield force: there a leak has its nominal speed."""
EPSILON = 1e-4
"""Drop below which an orifice is laminar, so that its slope is finite."""


SIDE_RATIO = 0.3
"""Short over long side of the triangle; chosen by hand: cylinders of booms have 0.2 to 0.4."""


def _compute_arm(angle: np.ndarray) -> np.ndarray:
    """Return the lever arm over the short side: `sin(angle)` over the third side's length."""
    return np.sin(angle) / np.sqrt(1.0 + SIDE_RATIO**2 - 2.0 * SIDE_RATIO * np.cos(angle))


class PilotedSpools:
    """Pilot pressures and spools of all joints.

    Args:
        numbers: The machine's, `(N, J)`.
    """

    def __init__(self, numbers: PlantParameters) -> None:
        self._n = numbers
        shape = numbers["notch"].shape
        self.pilot, self.spool = np.zeros(shape), np.zeros(shape)
        # of an orifice that fills a chamber in 2 T the mean delay is two thirds of T
        self._fill_s = 1.5 * (numbers["fill_s"] + numbers["pilot_s"])
        stroke_s = numbers["stroke_s"]
        self._slope = np.where(stroke_s > 0, 1.0 / np.maximum(stroke_s, 1e-6), np.inf)

    def step(self, u: np.ndarray, sticking: np.ndarray, drop: np.ndarray) -> np.ndarray:
        """Return the signed metering areas after a step, `(N, J)`.

        Args:
            u: Commands in force.
            sticking: Further friction of the spools, of full stroke.
            drop: Drop over each metering edge, over the nominal one.
        """
        n, behind = self._n, u - self.pilot
        share = np.minimum(STEP_S / (self._fill_s * np.sqrt(np.abs(behind) + 1e-3)), 1.0)
        reach = STEP_S * self._slope
        self.pilot = self.pilot + np.clip(share * behind, -reach, reach)
        band = n["spool_band"] + sticking
        away = self.pilot - self.spool
        # a spool that lets go comes to rest within its own friction band
        moves = np.abs(away) > band
        rest = self.pilot - np.sign(away) * n["spool_band"]
        self.spool = np.where(moves, rest, self.spool)
        stroke = self.spool / (1.0 + n["flow_force"] * np.abs(self.spool) * drop)
        stroke = np.clip(stroke, -n["stop"], n["stop"])
        overlap = np.where(stroke > 0, n["overlap_extend"], n["overlap_retract"])
        beyond = np.maximum(np.abs(stroke) - overlap, 0.0) / (1.0 - overlap)
        edge = np.where(stroke > 0, n["extend"], n["retract"])
        return np.sign(stroke) * edge * compute_notch_area(beyond, n["notch"])


class SensingValves:
    """Spools, chambers, joints and a pump that senses the highest load.

    Args:
        numbers: The machine's, `(N, J)`.
        machine: Limits, masses, full speeds, yield forces, stiffness.
        causes: What it has outside the library.
    """

    def __init__(self, numbers: PlantParameters, machine: Machine, causes: OutsideCauses) -> None:
        self._n, self._causes, self._full_speed = numbers, causes, machine.max_speed
        self._spools = PilotedSpools(numbers)
        self._middle = 0.5 * (machine.lower + machine.upper)
        self._half = 0.5 * (machine.upper - machine.lower)
        self._swing_rad = numbers["linkage_swing_rad"] + causes.mounting_rad
        self._weight = Arm(machine, numbers)
        shape = numbers["notch"].shape
        self._sticking = causes.stick(np.zeros(shape, dtype=bool))
        self.speed = np.zeros(shape)
        self._bore, self._rod = np.zeros(shape), np.zeros(shape)
        self._supply = np.full((shape[0], 1), STANDBY)
        force = FORCE_RATIO * np.array([body.yield_force.value for body in machine.bodies])
        stiffness = np.array([body.stiffness.value for body in machine.bodies])
        inertia = stiffness / (2.0 * np.pi * FIRST_MODE_HZ) ** 2
        self._push = force / (inertia * machine.max_speed)  # 1/s
        period_s = np.hypot(1.0 / numbers["mode_hz"], numbers["soft_s"])
        omega = 2.0 * np.pi / period_s
        self._stiffness = omega**2 / self._push / (1.0 + numbers["rod_area"])  # 1/s
        soft = 2.0 * numbers["soft_damping"] * omega / self._push
        is_soft = numbers["soft_s"] > 0
        self._viscous = np.where(is_soft, np.minimum(soft, numbers["viscous"]), numbers["viscous"])
        # a soft joint rings: dry friction of full size would end that after one swing
        self._coulomb = numbers["coulomb"] * np.where(is_soft, 0.4, 1.0)
        self._sink = 0.4 * numbers["sink_rad_s"] / machine.max_speed
        # resting cylinders bear the weight
        home = np.tile(machine.home, (shape[0], 1))
        self.take_pose(home, home)
        self._bore = np.maximum(-self._force, 0.0) + 0.1
        self._rod = (self._bore + self._force) / numbers["rod_area"]

    def take_pose(self, q: np.ndarray, link: np.ndarray) -> None:
        """Take the pose of cylinders and links, `(N, J)`, for the steps of a control period."""
        share, at_rad = (q - self._middle) / self._half, self._n["linkage_rad"]
        arm = _compute_arm(at_rad + self._swing_rad * share)
        self._lever = arm / _compute_arm(at_rad)  # over that in the middle of the travel
        self._stroke = np.clip(0.5 + 0.5 * share, 0.0, 1.0)
        self._force = self._weight.load(link) / FORCE_RATIO

    def open(self, u: np.ndarray) -> np.ndarray:
        """Return which valves are open, `(N, J)`, a step after commands `u`."""
        before = self._spools.spool
        head = self._supply - np.minimum(self._bore, self._rod)
        drop = np.clip(head / NOMINAL_DROP, 0.0, 1.0)
        self._area = self._spools.step(u, self._sticking, drop)
        self._sticking = self._causes.stick(np.abs(self._spools.spool - before) > SPOOL_STEP)
        return np.abs(self._area) > OPEN

    def move(self, flow: np.ndarray) -> np.ndarray:
        """Return the speeds after a step, rad/s or m/s, `(N, J)`.

        Args:
            flow: Factor on the flows at the same opening, `(N, J)`.
        """
        n, dt, area, lever, force = self._n, STEP_S, self._area, self._lever, self._force
        extends, opened, ratio = area > 0, np.abs(area), n["rod_area"]
        spring = flow**2  # flow grows with the root of the drop
        p_in = np.where(extends, self._bore, self._rod)
        p_out = np.where(extends, self._rod, self._bore)
        is_open = opened > OPEN
        # a loose compensator lets the drop change with the load that its inlet feels
        usual = np.where(extends, 0.12 * ratio, 0.12)
        felt = FORCE_RATIO * n["sensitivity"] * (usual - p_in)
        relaxed = spring * (1.0 - n["droop"] * p_in) * np.clip(1.0 + felt, 0.05, 2.0)
        head = self._supply - p_in
        drop = np.minimum(NOMINAL_DROP * relaxed, head)
        side = np.where(extends, 1.0, ratio)  # both edges give the same speed
        # flow over area: the root of the drop, linear close to 0
        inlet = side * opened * (drop / np.sqrt((np.abs(drop) + EPSILON) * NOMINAL_DROP))
        back_flow = self._causes.back_flow
        inlet = np.where(inlet < 0, back_flow * inlet, inlet)
        throttled = head < NOMINAL_DROP * relaxed
        is_sloped = throttled & ((head > 0) | (back_flow > 0))
        steepest = side * opened * 0.5 / np.sqrt(NOMINAL_DROP * (np.abs(head) + EPSILON))
        slope_in = np.where(is_sloped, steepest, 0.0)
        # the outlet regulator: with the same loose spring it passes more under more pressure
        passed = n["outlet"] * np.where(extends, ratio, 1.0) * opened * flow
        felt = FORCE_RATIO * n["sensitivity"] * (p_out - 0.12)
        passed = passed * np.sqrt(np.clip(1.0 + felt, 0.05, 2.0))
        drained = np.maximum(p_out, 0.0) + OUTLET_PRESSURE
        outlet = passed * np.sqrt(np.maximum(p_out, 0.0) / drained)
        steepest = drained**1.5 * np.sqrt(np.maximum(p_out, 1e-3))
        slope_out = passed * 0.5 * OUTLET_PRESSURE / steepest
        bled = np.where(is_open, n["bleed"] * np.sqrt(np.maximum(p_in, 0.0)), 0.0)
        inlet = inlet - bled
        sink = self._sink + self._causes.leak(is_open)
        lost_bore = sink * np.sqrt(np.maximum(self._bore, 0.0) / TYPICAL_HOLDING)
        lost_rod = ratio * sink * np.sqrt(ratio * np.maximum(self._rod, 0.0) / TYPICAL_HOLDING)
        to_bore = np.where(extends, inlet, -outlet) - lost_bore
        to_rod = np.where(extends, -outlet, inlet) - lost_rod
        slope_bore = np.where(extends, slope_in, slope_out)
        slope_rod = np.where(extends, slope_out, slope_in)
        # volumes: a tenth of the stroke is dead; the rod side is smaller by its area
        k_bore = dt * self._stiffness * 0.6 / (0.1 + self._stroke)
        k_rod = dt * self._stiffness * 0.6 / (ratio * (1.1 - self._stroke))
        k_bore = k_bore / (1.0 + k_bore * slope_bore)
        k_rod = k_rod / (1.0 + k_rod * slope_rod)
        bore = self._bore + k_bore * to_bore
        rod = self._rod + k_rod * to_rod
        drive = dt * self._push
        springs = drive * lever**2 * (k_bore + ratio**2 * k_rod)
        momentum = self.speed + drive * (lever * (bore - ratio * rod) + force)
        rubbing = drive * self._compute_friction(force)
        speed = np.sign(momentum) * np.maximum(np.abs(momentum) - rubbing, 0.0)
        self.speed = speed / (1.0 + springs + drive * self._viscous)
        self._bore = np.clip(bore - k_bore * lever * self.speed, 0.0, 1.0)
        self._rod = np.clip(rod + k_rod * ratio * lever * self.speed, 0.0, 1.0)
        self._follow_load(np.where(is_open, p_in, 0.0), inlet + bled, slope_in)
        return self.speed * self._full_speed

    def _compute_friction(self, force: np.ndarray) -> np.ndarray:
        """Return dry friction, over the cylinder's force: larger at rest, and under load."""
        n = self._n
        moving = self._coulomb + n["pin"] * np.abs(force)
        extra = self._coulomb * (n["static"] - 1.0) + n["breakaway"]
        # a seized pin lets go at once; usual friction falls with the speed
        still = np.abs(self.speed)
        usual = np.exp(-((still / STRIBECK) ** 2))
        return moving + np.where(n["breakaway"] > 0, extra * (still < STILL), extra * usual)

    def _follow_load(self, sensed: np.ndarray, flow: np.ndarray, slope: np.ndarray) -> None:
        """Move the pump's pressure on by a step."""
        n, dt = self._n, STEP_S
        lag_s, power = n["pump_s"][:, :1] * self._causes.pump_lag, n["power"][:, :1]
        wanted = np.clip(sensed.max(1, keepdims=True) + MARGIN, STANDBY, 1.0)
        rise = (wanted - self._supply) * (1.0 - np.exp(-dt / lag_s))
        asked = (n["demand"] * flow).sum(1, keepdims=True)
        spare = np.minimum(1.0, power / np.maximum(self._supply, 0.05)) - asked
        softness = LINE_SOFTNESS + dt * (n["demand"] * slope).sum(1, keepdims=True)
        self._supply = np.clip(self._supply + np.minimum(rise, dt * spare / softness), 0.0, 1.0)

    def stop(self, where: np.ndarray, q: np.ndarray) -> None:
        """Take the speed from joints at their stops `q`; both `(N, J)`, `where` bool."""
        self.speed = np.where(where, 0.0, self.speed)
