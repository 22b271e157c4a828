"""Effects of the library as changes of a plant's parameters, with sizes in the library's units.

Each function changes some of the parameters, `(J,)` each, in place. It gets the parameters of the
effect's spec. A plant may have some of an effect anyway (an overlap, a weight on its flow); the
fault adds to it, as the library's effect does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from exam.plants.plant_parameters import PlantParameters
from exam.plants.valve import LAND_LEAK

FaultSizes = Mapping[str, np.ndarray]
"""Parameters of an effect by name, `(J,)`, at the value that changes nothing where the fault is
not."""


def _add_dead_time(n: PlantParameters, size: FaultSizes) -> None:
    n["transport_s"] = n["transport_s"] + size["dead_time_s"]


def _add_delay_jitter(n: PlantParameters, size: FaultSizes) -> None:
    n["jitter_s"] = n["jitter_s"] + size["jitter_s"]


def _add_frame_loss(n: PlantParameters, size: FaultSizes) -> None:
    n["loss"] = n["loss"] + size["probability"]


def _add_clock_offset(n: PlantParameters, size: FaultSizes) -> None:
    n["stamp_s"] = n["stamp_s"] + size["offset_s"]


def _add_dead_band(n: PlantParameters, size: FaultSizes) -> None:
    for side in ("extend", "retract"):
        overlap = n[f"overlap_{side}"]
        n[f"overlap_{side}"] = overlap + size[side] * (
            1.0 - overlap
        )  # a command of `size` more before the land opens


def _add_saturation(n: PlantParameters, size: FaultSizes) -> None:
    n["stop"] = np.minimum(n["stop"], size["level"])


def _add_rate_limit(n: PlantParameters, size: FaultSizes) -> None:
    n["stroke_s"] = n["stroke_s"] + size["stroke_s"]


def _add_lag(n: PlantParameters, size: FaultSizes) -> None:
    n["pilot_s"] = n["pilot_s"] + size["time_constant_s"]


def _add_stiction(n: PlantParameters, size: FaultSizes) -> None:
    """Add a break-away pressure; `start` counts from where the valve begins to open."""
    overlap = np.minimum(n["overlap_extend"], n["overlap_retract"])
    open_at = np.maximum(size["start"] - overlap, 0.0) / (1.0 - overlap) * (size["start"] > 0)
    n["breakaway"] = open_at / (open_at + LAND_LEAK)


def _add_flow_gain(n: PlantParameters, size: FaultSizes) -> None:
    n["speed_scale"] = n["speed_scale"] * size["gain"]


def _add_asymmetry(n: PlantParameters, size: FaultSizes) -> None:
    n["extend"] = n["extend"] * size["extend_gain"]
    n["retract"] = n["retract"] * size["retract_gain"]


def _add_load_dependence(n: PlantParameters, size: FaultSizes) -> None:
    n["sensitivity"] = n["sensitivity"] + size["sensitivity"]


def _add_flow_sharing(n: PlantParameters, size: FaultSizes) -> None:
    n["demand"] = np.maximum(n["demand"], size["demand"])  # a worn pump


def _add_creep(n: PlantParameters, size: FaultSizes) -> None:
    n["leak"] = n["leak"] + size["sink_rad_s"]


def _add_thermal_drift(n: PlantParameters, size: FaultSizes) -> None:
    n["drift"], n["drift_s"] = n["drift"] + size["change"], size["time_s"]


def _add_backlash(n: PlantParameters, size: FaultSizes) -> None:
    n["gap_rad"] = n["gap_rad"] + size["gap_rad"]


def _add_compliance(n: PlantParameters, size: FaultSizes) -> None:
    n["soft_s"], n["soft_damping"] = n["soft_s"] + size["ringing_s"], size["damping"]


def _add_quantisation(n: PlantParameters, size: FaultSizes) -> None:
    n["step_rad"] = n["step_rad"] + size["step_rad"]


def _add_sensor_noise(n: PlantParameters, size: FaultSizes) -> None:
    n["extra_noise_rad"] = n["extra_noise_rad"] + size["sigma_rad"]


def _add_encoder_bias(n: PlantParameters, size: FaultSizes) -> None:
    n["bias_rad"] = n["bias_rad"] + size["bias_rad"]


def _add_encoder_scale(n: PlantParameters, size: FaultSizes) -> None:
    n["scale"] = n["scale"] * size["scale"]


def _add_link_length(n: PlantParameters, size: FaultSizes) -> None:
    n["extra_m"] = n["extra_m"] + size["extra_m"]


def _add_base_tilt(n: PlantParameters, size: FaultSizes) -> None:
    n["roll_rad"], n["pitch_rad"] = (
        n["roll_rad"] + size["roll_rad"],
        n["pitch_rad"] + size["pitch_rad"],
    )


FAULTS: dict[str, Callable[[PlantParameters, FaultSizes], None]] = {
    "dead_time": _add_dead_time,
    "delay_jitter": _add_delay_jitter,
    "frame_loss": _add_frame_loss,
    "clock_offset": _add_clock_offset,
    "dead_band": _add_dead_band,
    "saturation": _add_saturation,
    "rate_limit": _add_rate_limit,
    "lag": _add_lag,
    "stiction": _add_stiction,
    "flow_gain": _add_flow_gain,
    "asymmetry": _add_asymmetry,
    "load_dependence": _add_load_dependence,
    "flow_sharing": _add_flow_sharing,
    "creep": _add_creep,
    "thermal_drift": _add_thermal_drift,
    "backlash": _add_backlash,
    "compliance": _add_compliance,
    "quantisation": _add_quantisation,
    "sensor_noise": _add_sensor_noise,
    "encoder_bias": _add_encoder_bias,
    "encoder_scale": _add_encoder_scale,
    "link_length": _add_link_length,
    "base_tilt": _add_base_tilt,
}
"""By name of the effect. `extrinsics` is not among them: a case has no estimates of boreholes to
see it by."""


def apply_faults(numbers: PlantParameters, faults: Mapping[str, FaultSizes]) -> PlantParameters:
    """Return a machine's numbers with faults.

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
