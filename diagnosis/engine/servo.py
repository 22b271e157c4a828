"""The position servo: a command is a target.

The target passes a delay, a limit of its slope and a lag. A loop of second order follows it, against dry
friction and weight, with a pull that has a limit. The weight depends on the simulated place: by the
measured one a real elbow whose target rested followed itself. Positions are in half travels, so that a
command is a target. Priors are those of hobby servos (Feetech STS3215: 2.9 Nm, 24 to 40 Nm/rad,
friction .05 Nm).
"""

from __future__ import annotations

from diagnosis.engine.hold_laws import JitterLaw, LossLaw
from diagnosis.engine.joint_model import JointModel, JointNumber, list_places, repeat_number
from diagnosis.engine.rows import Row, mirror_sizes, spread_sizes

NUMBERS = (
    JointNumber("slope_time_s"),
    JointNumber("command_lag_s"),
    JointNumber("filling_s"),
    JointNumber("pilot_lag_s", 0.005, 0.02, 0.002, 0.0015, 0.0, 0.5),
    JointNumber("log_closing_ratio"),
    JointNumber("closing_lag_s"),
    JointNumber("spool_lag_s"),
    JointNumber("hysteresis"),
    JointNumber("delay_s", 0.05, 0.06, 0.002, 0.0015, 0.0, 0.6),
    JointNumber("response_s", 0.05, 0.04, 0.002, 0.001, 0.008, 0.6),
    JointNumber("damping_ratio", 1.0, 0.4, 0.03, 0.02, 0.15, 5.0),
    JointNumber("sag", 0.0, 0.04, 0.001, 0.0015, -1.0, 1.0),
    *repeat_number(4, JointNumber("sag_pose", 0.0, 0.03, 0.001, 0.001, -0.6, 0.6)),
    JointNumber("dry", 0.004, 0.006, 0.0005, 0.0006, 0.0, 0.5, joins=1),
    JointNumber("static_ratio", 0.3, 0.3, 0.05, 0.05, 0.0, 3.0, joins=1),
    JointNumber("load_dry", 0.03, 0.05, 0.01, 0.01, 0.0, 0.8, joins=1),
    JointNumber("shortage", 0.4, 0.4, 0.03, 0.03, 0.0, 30.0),
    JointNumber("firmware_damping", 0.6, 0.2, 0.05, 0.03, 0.0, 1.0),
    # Numbers that only effects set.
    JointNumber("sag_load"),
    JointNumber("lead_s"),
    JointNumber("wind_s"),
    JointNumber("wound"),
)

ServoPlace = list_places(NUMBERS)
"""Place of each number as a constant of the kernels."""


def _list_effect_rows() -> list[Row]:
    """Return the rows of the library."""
    rows = []
    for s in spread_sizes(0.006, 0.3, 14):
        rows.append(Row("dead_time", (("delay_s", "add", s),)))
    for s in spread_sizes(0.01, 0.5, 14):
        rows.append(Row("lag", (("command_lag_s", "add", s),)))
        two_stages = (("command_lag_s", "add", 0.5 * s), ("pilot_lag_s", "add", 0.5 * s))
        rows.append(Row("lag", two_stages, (0, 1)))
    for s in (-0.8, -0.6, -0.42, -0.28, -0.17, -0.1, 0.1, 0.17, 0.3, 0.5, 0.9, 1.6, 2.8):
        rows.append(Row("damping", (("damping_ratio", "scale", s),)))
        # Friction in proportion to the speed acts beside a limit of the torque, not within it.
        friction = ("firmware_damping", "scale", -s / (1.0 + s))
        rows.append(Row("damping", (("damping_ratio", "scale", s), friction)))
    for s in spread_sizes(0.06, 4.0, 18):
        rows.append(Row("rate_limit", (("slope_time_s", "least", s),)))
    for s in spread_sizes(0.003, 0.3, 16):
        rows.append(Row("backlash", (("dry", "add", s),)))
        rows.append(Row("backlash", (("hysteresis", "add", s),)))
    for s in mirror_sizes(spread_sizes(0.003, 0.3, 14)):
        rows.append(Row("sag", (("sag", "add", s),)))
    for s in spread_sizes(0.005, 0.4, 12):
        rows.append(Row("sag", (("sag_load", "add", s),)))
    for s in mirror_sizes(spread_sizes(0.01, 0.2, 6)):
        rows.append(Row("sag", (("sag", "add", s), ("sag_pose_1", "add", s)), (0, 1)))
        rows.append(Row("sag", (("sag", "add", s), ("sag_pose_1", "add", -s)), (0, 1)))
    for s in spread_sizes(0.6, 15.0, 18):
        for inside in (0.2, 0.6, 0.95):
            changes = (("shortage", "least", s), ("firmware_damping", "set", inside))
            rows.append(Row("torque_limit", changes))
    return rows


def _list_outside_rows() -> list[Row]:
    """Return the rows of causes outside the library."""
    rows = []
    for s in mirror_sizes((0.01, 0.03, 0.06, 0.1, 0.2)):
        rows.append(Row("feed_forward", (("lead_s", "add", s),)))
    for wind_s in (0.1, 0.3, 1.0):
        for wound in (0.02, 0.06, 0.15):
            rows.append(Row("integral_term", (("wound", "add", wound), ("wind_s", "add", wind_s))))
    return rows


SERVO = JointModel(
    numbers=NUMBERS,
    rows=tuple(_list_effect_rows()),
    outside_rows=tuple(_list_outside_rows()),
    own_forms=frozenset({("damping_ratio", "firmware_damping")}),
    lags={"pilot_lag_s": 1.0, "command_lag_s": 1.0, "response_s": 2.0},  # damped critically
    late={"dry": 0.0, "static_ratio": 0.0, "load_dry": 0.0},
    hold_laws=(
        LossLaw(0.03, 0.1),
        LossLaw(0.12, 0.2),
        LossLaw(0.05, 0.7),
        # Each longest delay is twice the one before: the evidence tells the nearest one.
        JitterLaw(0.015, 2),
        JitterLaw(0.03, 2),
        JitterLaw(0.06, 2),
        JitterLaw(0.12, 2),
    ),
    substep_s=0.005,
    interval_s=0.1,
    settling_s=0.6,
    # With 2, 2 and 4 rounds left-out parts of a tabletop arm are less likely by 537 nats in 279,000, and a limit of torque
    # of 1.3 Nm was fitted as one of 1.0.
    fit_rounds=(4, 4, 10),
    integrates=False,
)
