"""One machine of the held-out make, and the effects of the library as changes of its parameters.

Pressures are over the relief pressure, flows over that of a joint at full opening, forces over the
cylinder's at relief pressure. Each parameter has a value for each joint, `(J,)`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.machine import Machine

ArmParameters = dict[str, np.ndarray]
"""Parameters by name, `(J,)` each."""
EffectSizes = Mapping[str, np.ndarray]
"""Numbers of an effect by name, `(J,)`, neutral where a joint lacks it."""

RANGES = {
    "fill_s": (0.02, 0.05),  # time constant of filling a pilot chamber
    "overlap_extend": (0.05, 0.13),  # of full stroke
    "overlap_retract": (0.05, 0.13),
    "notch": (0.1, 0.35),  # part of the stroke in which only the notches meter
    "flow_force": (0.0, 0.08),  # of the centring spring's force, at full drop and stroke
    "area_extend": (0.95, 1.10),  # of the metering edge
    "area_retract": (1.0, 1.2),
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
    "wait_s", "queue_s", "loss", "late_s", "added_fill_s", "stroke_s", "sink", "breakaway", "bleed", "loose",
    "soft_s", "soft_damping", "added_play_rad", "step_rad", "sigma_rad", "bias_rad", "extra_m", "roll_rad",
    "pitch_rad", "oil_change", "severity",
)  # fmt: skip
"""Parameters that are 0 in a machine without effects."""
NEUTRAL = {"stop": 1.0, "spring": 1.0, "scale": 1.0, "oil_s": 700.0}
"""Parameters of a machine without effects that are not 0. `oil_s`: s, warm-up of a small tank."""
TRANSPORT_S = (0.38, 0.48)
"""Delay of radio and bus, s; one for all joints."""
PUMP_DEMAND = (0.16, 0.24)
"""Flow of a joint at full opening over the pump's."""
PUMP_POWER = (0.75, 0.95)
"""Largest product of the pump's pressure and flow."""
PUMP_LAG_S = (0.06, 0.14)
"""Time constant with which the pump follows the sensed load, s."""


def draw_machine(machine: Machine, seed: int, roughness: float) -> ArmParameters:
    """Return the parameters of the machine with this seed; `roughness` scales its nuisances."""
    generator = np.random.default_rng([seed, *b"held out"])
    count = machine.num_joints
    found: ArmParameters = {}
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


def _add_dead_time(n: ArmParameters, size: EffectSizes) -> None:
    n["wait_s"] = n["wait_s"] + size["dead_time_s"]


def _add_delay_jitter(n: ArmParameters, size: EffectSizes) -> None:
    n["queue_s"] = n["queue_s"] + size["jitter_s"]


def _add_frame_loss(n: ArmParameters, size: EffectSizes) -> None:
    n["loss"] = n["loss"] + size["probability"]


def _add_clock_offset(n: ArmParameters, size: EffectSizes) -> None:
    n["late_s"] = n["late_s"] + size["offset_s"]


def _add_dead_band(n: ArmParameters, size: EffectSizes) -> None:
    for side in ("extend", "retract"):
        own = n[f"overlap_{side}"]
        n[f"overlap_{side}"] = own + size[side] * (1.0 - own)


def _add_saturation(n: ArmParameters, size: EffectSizes) -> None:
    n["stop"] = np.minimum(n["stop"], size["level"])


def _add_rate_limit(n: ArmParameters, size: EffectSizes) -> None:
    n["stroke_s"] = n["stroke_s"] + size["stroke_s"]


def _add_lag(n: ArmParameters, size: EffectSizes) -> None:
    n["added_fill_s"] = n["added_fill_s"] + size["time_constant_s"]


SEIZED = 0.08
"""Added friction at rest with which a joint that starts at its usual command begins to stick."""
SEIZED_PER_COMMAND = 1.0
"""Growth of that friction with the command at which the joint starts."""
USUAL_START = 0.08
"""Command at which a usual joint starts."""


def _add_stiction(n: ArmParameters, size: EffectSizes) -> None:
    """Add friction at rest, and a bleed orifice that only a larger opening overcomes."""
    start = size["start"]
    has = start > 0
    n["breakaway"] = np.where(has, SEIZED + SEIZED_PER_COMMAND * (start - USUAL_START), 0.0)
    overlap = np.minimum(n["overlap_extend"], n["overlap_retract"])
    beyond = np.clip((start - overlap) / (1.0 - overlap), 0.0, 1.0)
    flow = compute_notch_area(beyond, n["notch"])
    n["bleed"] = np.where(has, flow / np.sqrt(np.maximum(n["breakaway"], 1e-6)), 0.0)


def _add_flow_gain(n: ArmParameters, size: EffectSizes) -> None:
    n["spring"] = n["spring"] * size["gain"] ** 2  # flow grows with the root of the drop


def _add_asymmetry(n: ArmParameters, size: EffectSizes) -> None:
    n["area_extend"] = n["area_extend"] * size["extend_gain"]
    n["area_retract"] = n["area_retract"] * size["retract_gain"]


def _add_load_dependence(n: ArmParameters, size: EffectSizes) -> None:
    n["loose"] = n["loose"] + size["sensitivity"]


def _add_flow_sharing(n: ArmParameters, size: EffectSizes) -> None:
    """Let the mean demand of all joints be that of the effect; joints keep their own shares."""
    wanted = size["demand"]
    share = n["demand"] / n["demand"].mean()
    n["demand"] = np.where(wanted > 0, np.maximum(n["demand"], share * wanted), n["demand"])


def _add_creep(n: ArmParameters, size: EffectSizes) -> None:
    n["sink"] = n["sink"] + size["sink_rad_s"]


def _add_thermal_drift(n: ArmParameters, size: EffectSizes) -> None:
    n["oil_change"], n["oil_s"] = n["oil_change"] + size["change"], size["time_s"]


def _add_backlash(n: ArmParameters, size: EffectSizes) -> None:
    n["added_play_rad"] = n["added_play_rad"] + size["gap_rad"]


def _add_compliance(n: ArmParameters, size: EffectSizes) -> None:
    n["soft_s"], n["soft_damping"] = n["soft_s"] + size["ringing_s"], size["damping"]


# The six faults of readings and geometry from here on repeat those of other makes. They add the label's
# own number, which is what the number means, so that there is nothing to write otherwise. Sharing them
# would let a change for a make that is developed on reach the one that is held out.
def _add_quantisation(n: ArmParameters, size: EffectSizes) -> None:
    n["step_rad"] = n["step_rad"] + size["step_rad"]


def _add_sensor_noise(n: ArmParameters, size: EffectSizes) -> None:
    n["sigma_rad"] = n["sigma_rad"] + size["sigma_rad"]


def _add_encoder_bias(n: ArmParameters, size: EffectSizes) -> None:
    n["bias_rad"] = n["bias_rad"] + size["bias_rad"]


def _add_encoder_scale(n: ArmParameters, size: EffectSizes) -> None:
    n["scale"] = n["scale"] * size["scale"]


def _add_link_length(n: ArmParameters, size: EffectSizes) -> None:
    n["extra_m"] = n["extra_m"] + size["extra_m"]


def _add_base_tilt(n: ArmParameters, size: EffectSizes) -> None:
    for name in ("roll_rad", "pitch_rad"):
        n[name] = n[name] + size[name]


CHANGES: dict[str, Callable[[ArmParameters, EffectSizes], None]] = {
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
"""Change of the parameters by effect, in place. `extrinsics` is not among them: a case has no
estimates of boreholes to see it by."""


def change_machine(numbers: ArmParameters, effects: Mapping[str, EffectSizes]) -> ArmParameters:
    """Return a machine with effects.

    Raises:
        ConfigError: an effect is unknown.
    """
    found = {name: value.copy() for name, value in numbers.items()}
    for name, size in effects.items():
        if name not in CHANGES:
            raise ConfigError(
                f"exam: the held-out make lacks '{name}'; {list_choices(name, CHANGES)}"
            )
        CHANGES[name](found, size)
    return found
