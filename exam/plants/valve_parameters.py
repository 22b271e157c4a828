"""Parameters of one machine with valves, drawn from a seed; effects of the library as changes of them.

Pressures are over the relief pressure, flows over that of a joint at full opening, forces over the
cylinder's at relief pressure. Each parameter has a value for each joint, `(J,)`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from brokk_rl.machine import Machine
from exam.plants.changes import (
    Change,
    FaultSizes,
    PlantParameters,
    add_share,
    apply_changes,
    replace_by,
)

RANGES = {
    "fill_s": (0.02, 0.05),  # time constant of filling a pilot chamber
    "overlap_extend": (0.05, 0.13),  # of full stroke
    "overlap_retract": (0.05, 0.13),
    "notch": (0.1, 0.35),  # part of the stroke in which only the notches meter
    "flow_force": (0.0, 0.08),  # of the centring spring's force, at full drop and stroke
    "extend": (0.95, 1.10),  # area of the metering edge
    "retract": (1.0, 1.2),
    "rod_area": (0.6, 0.85),  # over the bore's
    "mode_hz": (4.5, 8.0),  # of the joint on its closed cylinder in the middle of the stroke
    "viscous": (0.08, 0.16),  # friction force at full speed
    "coulomb": (0.015, 0.035),
    "static": (1.2, 1.8),  # friction at rest over that in motion
    "pin": (0.02, 0.06),  # friction of the pins over the load
    "linkage_rad": (1.4, 1.75),  # angle of the cylinder's triangle in the middle of the travel
    "outlet": (1.05, 1.10),  # flow that the outlet regulator passes over that of the inlet
    "noise_rad": (0.0002, 0.0005),
}
"""Range of each parameter, uniform, joint by joint."""
NUISANCES = {
    "linkage_swing_rad": (0.14, 0.24),  # turn of that triangle to either end of the travel
    "settling": (0.02, 0.035),  # standard deviation of a compensator's rest from motion to motion
    "spool_band": (0.006, 0.018),  # friction of the spool, of full stroke
    "droop": (0.0, 0.10),  # loss of the compensator's drop under full load pressure
    "play_rad": (0.0002, 0.0008),
    "warm_change": (-0.01, 0.03),  # of speed, from cold to warm oil
}
"""Ranges of the nuisances; all scale with the roughness."""
ABSENT = (
    "jitter_s", "loss", "stamp_s", "pilot_s", "stroke_s", "leak", "breakaway", "bleed", "sensitivity",
    "soft_s", "soft_damping", "gap_rad", "step_rad", "extra_noise_rad", "bias_rad", "extra_m", "roll_rad",
    "pitch_rad", "drift", "outside_severity",
)  # fmt: skip
"""Parameters that are 0 in a machine without effects."""
NEUTRAL = {"stop": 1.0, "spring": 1.0, "scale": 1.0, "drift_s": 700.0}
"""Parameters of a machine without effects that are not 0. `drift_s`: s, warm-up of a small tank."""
TRANSPORT_S = (0.38, 0.48)
"""Delay of radio and bus, s; one for all joints."""
PUMP_DEMAND = (0.16, 0.24)
"""Flow of a joint at full opening over the pump's."""
PUMP_POWER = (0.75, 0.95)
"""Largest product of the pump's pressure and flow."""
PUMP_LAG_S = (0.06, 0.14)
"""Time constant with which the pump follows the sensed load, s."""


def draw_machine(machine: Machine, seed: int, roughness: float) -> PlantParameters:
    """Return the parameters of the machine with this seed; `roughness` scales its nuisances."""
    # the words are those of the first exams, whose machines can be made again
    generator = np.random.default_rng([seed, *b"held out"])
    count = machine.num_joints
    found: PlantParameters = {}
    for name, (low, high) in RANGES.items():
        found[name] = generator.uniform(low, high, count)
    for name, (low, high) in NUISANCES.items():
        found[name] = roughness * generator.uniform(low, high, count)
    found["warm_change"] = np.full(count, found["warm_change"][0])  # one tank
    found["transport_s"] = np.full(count, generator.uniform(*TRANSPORT_S))
    found["transport_s"] += generator.uniform(-0.015, 0.015, count)  # pilot lines differ in length
    found["demand"] = generator.uniform(*PUMP_DEMAND, count)
    for name, span in (("power", PUMP_POWER), ("pump_s", PUMP_LAG_S)):
        found[name] = np.full(count, generator.uniform(*span))
    found |= {name: np.zeros(count) for name in ABSENT}
    found |= {name: np.full(count, value) for name, value in NEUTRAL.items()}
    return found


def compute_notch_area(opening: np.ndarray, notch: np.ndarray) -> np.ndarray:
    """Return the metering area of an opening beyond the overlap, both of full ones.

    Triangular notches open with the square of the stroke up to `notch`; then the land opens in
    proportion. The slope has no jump.
    """
    full = 2.0 - notch
    return np.where(
        opening < notch, opening**2 / (notch * full), (2.0 * opening - notch) / full
    ) * (opening > 0)


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


def _add_flow_gain(n: PlantParameters, size: FaultSizes) -> None:
    n["spring"] = n["spring"] * size["gain"] ** 2  # flow grows with the root of the drop


def _add_flow_sharing(n: PlantParameters, size: FaultSizes) -> None:
    """Let the mean demand of all joints be that of the effect; joints keep their own shares."""
    wanted = size["demand"]
    share = n["demand"] / n["demand"].mean()
    n["demand"] = np.where(wanted > 0, np.maximum(n["demand"], share * wanted), n["demand"])


CHANGES: dict[str, Change] = {
    "dead_time": (("transport_s", np.add, "dead_time_s"),),
    "delay_jitter": (("jitter_s", np.add, "jitter_s"),),
    "frame_loss": (("loss", np.add, "probability"),),
    "clock_offset": (("stamp_s", np.add, "offset_s"),),
    "dead_band": (
        ("overlap_extend", add_share, "extend"),
        ("overlap_retract", add_share, "retract"),
    ),
    "saturation": (("stop", np.minimum, "level"),),
    "rate_limit": (("stroke_s", np.add, "stroke_s"),),
    "lag": (("pilot_s", np.add, "time_constant_s"),),
    "stiction": _add_stiction,
    "flow_gain": _add_flow_gain,
    "asymmetry": (("extend", np.multiply, "extend_gain"), ("retract", np.multiply, "retract_gain")),
    "load_dependence": (("sensitivity", np.add, "sensitivity"),),
    "flow_sharing": _add_flow_sharing,
    "creep": (("leak", np.add, "sink_rad_s"),),
    "thermal_drift": (("drift", np.add, "change"), ("drift_s", replace_by, "time_s")),
    "backlash": (("gap_rad", np.add, "gap_rad"),),
    "compliance": (("soft_s", np.add, "ringing_s"), ("soft_damping", replace_by, "damping")),
    "quantisation": (("step_rad", np.add, "step_rad"),),
    "sensor_noise": (("extra_noise_rad", np.add, "sigma_rad"),),
    "encoder_bias": (("bias_rad", np.add, "bias_rad"),),
    "encoder_scale": (("scale", np.multiply, "scale"),),
    "link_length": (("extra_m", np.add, "extra_m"),),
    "base_tilt": (("roll_rad", np.add, "roll_rad"), ("pitch_rad", np.add, "pitch_rad")),
}
"""Change of the parameters by effect, with sizes in the library's units. A machine may have some of an
effect anyway (an overlap, a leak); the fault adds to it, as the library's effect does. `extrinsics` is not
among them: a case has no estimates of boreholes to see it by."""


def change_machine(numbers: PlantParameters, effects: Mapping[str, FaultSizes]) -> PlantParameters:
    """Return a machine with effects; raises as `apply_changes`."""
    return apply_changes(numbers, effects, CHANGES, "a machine of exam_plants=valves")
