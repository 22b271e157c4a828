"""Parameters of one plant, drawn from a seed: no two machines are alike."""

from __future__ import annotations

import numpy as np

from brokk_rl.machine import Machine

MAKES = ("chambers", "compensated", "throttled")
"""How the power stage of a machine works; see the module of each name."""

PlantParameters = dict[str, np.ndarray]
"""Number by name, `(J,)` each."""

RANGES = {
    "spool_hz": (4.5, 9.0),  # natural frequency of the spool
    "spool_damping": (0.75, 1.1),
    "overlap_extend": (0.04, 0.12),  # of full stroke
    "overlap_retract": (0.04, 0.12),
    "notch": (0.15, 0.5),  # progressiveness of the metering edge: 0 linear, 1 quadratic
    "speed_scale": (0.92, 1.12),  # full speed over the machine's nominal one
    "retract_ratio": (1.0, 1.3),  # retracting over extending speed
    "demand": (
        0.18,
        0.25,
    ),  # flow at full speed over the pump's: four joints together just about get it
    "sensitivity": (0.05, 0.18),  # of squared speed to weight over yield force
    "mode_hz": (5.0, 8.0),  # first mode on closed cylinders
    "friction": (0.02, 0.05),  # over the force at supply pressure
    "viscous": (0.10, 0.20),  # the same at full speed
    "answer_s": (0.03, 0.07),  # of a throttled make, from opening to speed
    "lever": (0.0, 0.05),  # change of the cylinder's lever arm over the travel
    "noise_rad": (0.0002, 0.0005),
}
"""Range of each parameter, uniform and by joint; chosen by hand for machines of the class. The
machine's file has the sources of a real one."""

NUISANCES = {
    "hysteresis": (0.006, 0.02),  # play between command and spool, of full command
    "wave": (0.01, 0.03),  # waviness of the flow curve
    "wander": (0.03, 0.04),  # standard deviation of the slow change of speed
    "wander_s": (5.0, 11.0),  # its correlation time
    "droop": (0.01, 0.03),  # loss of speed at full demand after a few seconds
    "warm_up": (-0.01, 0.03),  # change of speed over the first half hour
}
"""The same for nuisances without a tidy model; all but times scale with the roughness. Chosen by
hand."""


def draw_plant(machine: Machine, seed: int, roughness: float) -> tuple[str, PlantParameters]:
    """Return make and numbers of the machine with this seed.

    Args:
        machine: Number of joints.
        seed: Same seed, same machine.
        roughness: Size of the nuisances.
    """
    generator = np.random.default_rng(seed)
    make = MAKES[int(generator.integers(len(MAKES)))]
    count = machine.num_joints

    def each(ranges: dict[str, tuple[float, float]]) -> PlantParameters:
        return {name: generator.uniform(low, high, count) for name, (low, high) in ranges.items()}

    found = each(RANGES)
    found["transport_s"] = np.full(count, generator.uniform(0.40, 0.50)) + generator.uniform(
        -0.02, 0.02, count
    )
    found["lever_phase"] = generator.uniform(0.0, 2.0 * np.pi, count)
    rough = each(NUISANCES)
    found["wave_phase"] = generator.uniform(0.0, 2.0 * np.pi, count)
    found["wave_number"] = generator.uniform(1.5, 3.5, count)
    for name, value in rough.items():
        found[name] = value if name.endswith("_s") else value * roughness
    found["droop"] = np.full(count, found["droop"][0])  # one pump
    found["warm_up"] = np.full(count, found["warm_up"][0])  # one tank
    found |= {name: np.zeros(count) for name in ZERO_WITHOUT_FAULT}
    found |= {name: np.full(count, value) for name, value in NEUTRAL_WITHOUT_FAULT.items()}
    return make, found


RAD_PER_CYCLE = 2.0 * np.pi
"""Radians a second for one hertz."""
ZERO_WITHOUT_FAULT = (
    "jitter_s", "loss", "pilot_s", "stroke_s", "leak", "breakaway", "gap_rad", "soft_s", "soft_damping", "drift", "stamp_s",
    "step_rad", "bias_rad", "extra_m", "roll_rad", "pitch_rad", "extra_noise_rad", "outside_severity",
)  # fmt: skip
"""Numbers that are 0 in a machine without faults."""
NEUTRAL_WITHOUT_FAULT = {"stop": 1.0, "extend": 1.0, "retract": 1.0, "scale": 1.0, "drift_s": 600.0}
"""Numbers of a machine without faults that are not 0: travel of the spool, port areas, scale of the
encoder."""
