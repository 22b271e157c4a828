"""Effects of the library as changes of a plant's parameters, with sizes in the library's units.

A plant may have some of an effect anyway (an overlap, a weight on its flow); the fault adds to it, as
the library's effect does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from exam.plants.changes import Change, FaultSizes, add_share, apply_changes, replace_by
from exam.plants.plant_parameters import PlantParameters
from exam.plants.valve import LAND_LEAK


def _add_stiction(n: PlantParameters, size: FaultSizes) -> None:
    """Add a break-away pressure; `start` counts from where the valve begins to open."""
    overlap = np.minimum(n["overlap_extend"], n["overlap_retract"])
    open_at = np.maximum(size["start"] - overlap, 0.0) / (1.0 - overlap) * (size["start"] > 0)
    n["breakaway"] = open_at / (open_at + LAND_LEAK)


FAULTS: dict[str, Change] = {
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
    "flow_gain": (("speed_scale", np.multiply, "gain"),),
    "asymmetry": (("extend", np.multiply, "extend_gain"), ("retract", np.multiply, "retract_gain")),
    "load_dependence": (("sensitivity", np.add, "sensitivity"),),
    "flow_sharing": (("demand", np.maximum, "demand"),),  # a worn pump
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
"""By name of the effect. `extrinsics` is not among them: a case has no estimates of boreholes to
see it by."""


def apply_faults(numbers: PlantParameters, faults: Mapping[str, FaultSizes]) -> PlantParameters:
    """Return a machine's numbers with faults; raises as `apply_changes`."""
    return apply_changes(numbers, faults, FAULTS, "a machine of exam_plants=valves")
