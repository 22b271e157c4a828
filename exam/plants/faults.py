"""Effects of the library's names, as changes of a machine's numbers. Sizes are given in the library's words, by joint.

Each function takes the numbers, `(J,)` each, changes some in place, and gets what an effect's spec
calls its parameters. Where a machine has some of an effect anyway (an overlap, a weight on its
flow), the fault comes on top, as the library's does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from exam.plants.anatomy import Anatomy
from exam.plants.valve import LAND_LEAK

Sizes = Mapping[str, np.ndarray]
"""Parameters of an effect by name, `(J,)`, at the value that changes nothing where the fault is
not."""


def _dead_time(n: Anatomy, size: Sizes) -> None:
    n["transport_s"] = n["transport_s"] + size["dead_time_s"]


def _delay_jitter(n: Anatomy, size: Sizes) -> None:
    n["jitter_s"] = n["jitter_s"] + size["jitter_s"]


def _frame_loss(n: Anatomy, size: Sizes) -> None:
    n["loss"] = n["loss"] + size["probability"]


def _clock_offset(n: Anatomy, size: Sizes) -> None:
    n["stamp_s"] = n["stamp_s"] + size["offset_s"]


def _dead_band(n: Anatomy, size: Sizes) -> None:
    for side in ("extend", "retract"):
        overlap = n[f"overlap_{side}"]
        n[f"overlap_{side}"] = overlap + size[side] * (
            1.0 - overlap
        )  # a command of `size` more before the land opens


def _saturation(n: Anatomy, size: Sizes) -> None:
    n["stop"] = np.minimum(n["stop"], size["level"])


def _rate_limit(n: Anatomy, size: Sizes) -> None:
    n["stroke_s"] = n["stroke_s"] + size["stroke_s"]


def _lag(n: Anatomy, size: Sizes) -> None:
    n["pilot_s"] = n["pilot_s"] + size["time_constant_s"]


def _stiction(n: Anatomy, size: Sizes) -> None:
    """`start` counts from where the valve begins to open: the pressure that a small opening holds must break away."""
    overlap = np.minimum(n["overlap_extend"], n["overlap_retract"])
    open_at = np.maximum(size["start"] - overlap, 0.0) / (1.0 - overlap) * (size["start"] > 0)
    n["breakaway"] = open_at / (open_at + LAND_LEAK)


def _flow_gain(n: Anatomy, size: Sizes) -> None:
    n["speed_scale"] = n["speed_scale"] * size["gain"]


def _asymmetry(n: Anatomy, size: Sizes) -> None:
    n["extend"] = n["extend"] * size["extend_gain"]
    n["retract"] = n["retract"] * size["retract_gain"]


def _load_dependence(n: Anatomy, size: Sizes) -> None:
    n["sensitivity"] = n["sensitivity"] + size["sensitivity"]


def _flow_sharing(n: Anatomy, size: Sizes) -> None:
    n["demand"] = np.maximum(n["demand"], size["demand"])  # a worn pump


def _creep(n: Anatomy, size: Sizes) -> None:
    n["leak"] = n["leak"] + size["sink_rad_s"]


def _thermal_drift(n: Anatomy, size: Sizes) -> None:
    n["drift"], n["drift_s"] = n["drift"] + size["change"], size["time_s"]


def _backlash(n: Anatomy, size: Sizes) -> None:
    n["gap_rad"] = n["gap_rad"] + size["gap_rad"]


def _compliance(n: Anatomy, size: Sizes) -> None:
    n["soft_s"], n["soft_damping"] = n["soft_s"] + size["ringing_s"], size["damping"]


def _quantisation(n: Anatomy, size: Sizes) -> None:
    n["step_rad"] = n["step_rad"] + size["step_rad"]


def _sensor_noise(n: Anatomy, size: Sizes) -> None:
    n["extra_noise_rad"] = n["extra_noise_rad"] + size["sigma_rad"]


def _encoder_bias(n: Anatomy, size: Sizes) -> None:
    n["bias_rad"] = n["bias_rad"] + size["bias_rad"]


def _encoder_scale(n: Anatomy, size: Sizes) -> None:
    n["scale"] = n["scale"] * size["scale"]


def _link_length(n: Anatomy, size: Sizes) -> None:
    n["extra_m"] = n["extra_m"] + size["extra_m"]


def _base_tilt(n: Anatomy, size: Sizes) -> None:
    n["roll_rad"], n["pitch_rad"] = (
        n["roll_rad"] + size["roll_rad"],
        n["pitch_rad"] + size["pitch_rad"],
    )


FAULTS: dict[str, Callable[[Anatomy, Sizes], None]] = {
    "dead_time": _dead_time, "delay_jitter": _delay_jitter, "frame_loss": _frame_loss, "clock_offset": _clock_offset,
    "dead_band": _dead_band, "saturation": _saturation, "rate_limit": _rate_limit, "lag": _lag, "stiction": _stiction,
    "flow_gain": _flow_gain, "asymmetry": _asymmetry, "load_dependence": _load_dependence, "flow_sharing": _flow_sharing,
    "creep": _creep, "thermal_drift": _thermal_drift, "backlash": _backlash, "compliance": _compliance,
    "quantisation": _quantisation, "sensor_noise": _sensor_noise, "encoder_bias": _encoder_bias,
    "encoder_scale": _encoder_scale, "link_length": _link_length, "base_tilt": _base_tilt,
}  # fmt: skip
"""By name of the effect. `extrinsics` is not among them: a case has no estimates of boreholes to
see it by."""


def afflicted(numbers: Anatomy, faults: Mapping[str, Sizes]) -> Anatomy:
    """Returns a machine's numbers with faults.

    Raises:
        ConfigError: a fault is unknown.
    """
    found = {name: value.copy() for name, value in numbers.items()}
    for name, size in faults.items():
        if name not in FAULTS:
            raise ConfigError(
                f"exam: no plant has the effect '{name}'; {list_choices(name, FAULTS)}"
            )
        FAULTS[name](found, size)
    return found
