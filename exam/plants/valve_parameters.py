"""Numbers of a machine with valves: what only an effect changes, and effects as changes of them.

Each number has a value for each joint, `(J,)`.
"""

from __future__ import annotations

import numpy as np

from exam.plants.changes import Change, FaultSizes, PlantParameters, add_share, replace_by

NEUTRAL = dict.fromkeys(
    (
        "jitter_s", "loss", "stamp_s", "pilot_s", "stroke_s", "sink_rad_s", "breakaway", "bleed", "sensitivity",
        "soft_s", "soft_damping", "gap_rad", "step_rad", "extra_noise_rad", "bias_rad", "extra_m", "roll_rad",
        "pitch_rad", "drift",
    ),
    0.0,
) | {"stop": 1.0, "flow": 1.0, "scale": 1.0, "drift_s": 700.0}  # fmt: skip
"""Numbers that only an effect changes, as a machine without effects has them. `drift_s`: s, warm-up of a
small tank."""


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
    "flow_gain": (("flow", np.multiply, "gain"),),
    "asymmetry": (("extend", np.multiply, "extend_gain"), ("retract", np.multiply, "retract_gain")),
    "load_dependence": (("sensitivity", np.add, "sensitivity"),),
    "flow_sharing": _add_flow_sharing,
    "creep": (("sink_rad_s", np.add, "sink_rad_s"),),
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
