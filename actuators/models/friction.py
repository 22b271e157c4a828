"""Dry friction of a drive that depends on speed and load: the models M1 to M6 of BAM.

Duclusaud, Passault, Padois and Ly, "Extended Friction Models for the Physics Simulation of Servo
Actuators", ICRA 2025. With the force `f` of the motor, the force `w` against it from outside (weight) and
`rest = exp(-(|speed| / stribeck_m_s) ** stribeck_power)` a joint has at most the friction

    coulomb + |motor_load f + outside_load w|
        + rest (stribeck + |motor_load_at_rest f + outside_load_at_rest w| + square)

and viscous friction beside it. `square` is `outside_load_square w^2 / full` where the motor pushes harder
than the weight, `motor_load_square f^2 / full` where the weight does, and 0 where both push the same way;
`full` is the force at full command, so that all loads are without unit.

    M1  coulomb, viscous          M2  and stribeck
    M3  M1 and equal loads        M4  M2, M3 and equal loads at rest
    M5  M4 with loads that differ M6  M5 and squares
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

LOADS = (
    "motor_load", "outside_load", "motor_load_at_rest", "outside_load_at_rest",
    "motor_load_square", "outside_load_square",
)  # fmt: skip
STRIBECK_SPEED = 0.05
"""Stribeck speed over the machine's `max_speed` where none is given: BAM's range for servos of some
rad/s is 0.1 to 1 rad/s."""


def compute_dry_friction(
    value: Mapping[str, torch.Tensor],
    speed: torch.Tensor,
    motor: torch.Tensor,
    outside: torch.Tensor,
    full: torch.Tensor,
) -> torch.Tensor:
    """Return the largest dry friction, N or Nm; all arrays have one shape, or broadcast to it.

    Args:
        value: `coulomb_n`, `stribeck_n`, `stribeck_m_s`, `stribeck_power` and `LOADS` by name.
        speed: Speed, m/s or rad/s.
        motor: Force of the motor in the positive direction, N or Nm.
        outside: Force from outside against the positive direction.
        full: Force at full command.
    """
    rest = torch.exp(-((speed.abs() / value["stribeck_m_s"]) ** value["stribeck_power"]))
    moving = (value["motor_load"] * motor + value["outside_load"] * outside).abs()
    standing = value["motor_load_at_rest"] * motor + value["outside_load_at_rest"] * outside
    square = torch.where(
        outside.abs() < motor.abs(),
        value["outside_load_square"] * outside.square(),
        value["motor_load_square"] * motor.square(),
    )
    square = square / full * (motor * outside > 0.0)  # they push against each other
    return value["coulomb_n"] + moving + rest * (value["stribeck_n"] + standing.abs() + square)
