"""Effects on targets: joints that are commanded by position.

They act on the command before the model inside sees it. A servo has its own encoder within its loop, so
that an error of that encoder shows in no recording of the two; `encoder_bias` and `encoder_scale` are
not among the effects here.
"""

from __future__ import annotations

from typing import ClassVar

import torch

from actuators.effects.effect import EffectSpec, Memory, StepInputs
from actuators.effects.ranges import EffectNumber
from actuators.effects.timing import append_command
from brokk_rl.spec import spec


@spec
class TargetBacklash(EffectSpec):
    """Play, or friction that the servo's stiffness does not overcome: small reversals are not followed.

    Both hold the joint at one side of its target until the target has turned by the width. Positions
    alone do not tell the two apart: friction loads the motor, play does not.

    Attributes:
        joints: Joints it acts on, or `all`.
        gap_rad: Whole width (m for a sliding joint): the play, or twice the Coulomb friction over the
            stiffness of the loop.
    """

    label: ClassVar = "backlash"
    side = "command"
    recent = 2
    placed = True
    interfaces = frozenset({"position"})
    numbers: ClassVar = {
        # Friction of hobby servos holds targets of 1 to 5 degrees: more than the play of pins.
        "gap_rad": EffectNumber("rad", none=0.0, typical=0.04, bounds=(0.0, 0.6), scale="travel")
    }

    def begin(self, now: StepInputs) -> Memory:
        """The target is held where the joint is, as near to it as the play allows."""
        u, plant = now.history.u[:, :-1], now.plant
        at = (now.history.q[:, -1] - plant.middle) / plant.half_travel
        return {"sent": u, "held": _hold(at, u[:, -1], now)}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Play operator on the target."""
        held = _hold(now.memory["held"], now.history.u[:, -1], now)
        sent, memory = append_command(now, held)
        return sent, memory | {"held": held}


def _hold(held: torch.Tensor, u: torch.Tensor, now: StepInputs) -> torch.Tensor:
    half = 0.5 * now.value["gap_rad"] / now.plant.half_travel
    return held.clamp(u - half, u + half)


@spec
class TargetLag(EffectSpec):
    """A slower first-order response to the target.

    Attributes:
        joints: Joints it acts on, or `all`.
        time_constant_s: Time constant with which the joint follows.
    """

    label: ClassVar = "lag"
    side = "command"
    layer = 1
    recent = 2
    interfaces = frozenset({"position", "torque"})
    numbers: ClassVar = {
        "time_constant_s": EffectNumber(
            "s", none=0.0, typical=0.12, bounds=(0.0, 2.0), scale="time"
        )
    }

    def begin(self, now: StepInputs) -> Memory:
        """The joint was at its target."""
        u = now.history.u[:, :-1]
        return {"sent": u, "slow": u[:, -1]}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """The mean over the period of the lagged target, exact for a target that is held."""
        periods = (now.value["time_constant_s"] / now.plant.period_s).clamp(min=1e-6)
        u, slow = now.history.u[:, -1], now.memory["slow"]
        later = u + (slow - u) * torch.exp(-1.0 / periods)
        sent, memory = append_command(now, later)
        return sent, memory | {"slow": later}


@spec
class Sag(EffectSpec):
    """The joint stays below its target: weight against the stiffness of the servo.

    Where masses are known, the sag follows the weight; else it is a line over the travel.

    Attributes:
        joints: Joints it acts on, or `all`.
        load_rad: Sag under a weight as large as the machine's `yield_force` (m for a sliding joint).
        sag_rad: Sag in the middle of the travel, in the negative direction, where masses are not known.
        sag_slope: Change of the sag over the change of the target, where masses are not known.
    """

    side = "command"
    layer = 2  # of the target: play holds the joint about the target less the sag
    recent = 1
    interfaces = frozenset({"position"})
    numbers: ClassVar = {
        # The weight of a stretched-out arm is about half of the yield force.
        "load_rad": EffectNumber(
            "rad", none=0.0, typical=0.08, bounds=(0.0, 1.0), scale="travel", masses=True
        ),
        "sag_rad": EffectNumber(
            "rad", none=0.0, typical=0.04, bounds=(-0.5, 0.5), scale="travel", masses=False
        ),
        # A stiffness that lets the joint sag by 1.5 % of the travel in a turn by half of it.
        "sag_slope": EffectNumber("1", none=0.0, typical=0.03, bounds=(-0.5, 0.5), masses=False),
    }

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`target - sag(target)`."""
        u, plant = now.history.u, now.plant
        if plant.has_masses:
            rows = (plant.middle + plant.half_travel * u).flatten(0, 1)
            weight = plant.weight(rows).view_as(u)
            return u + now.value["load_rad"][:, None] * weight / plant.half_travel, {}
        sag = now.value["sag_rad"][:, None] / plant.half_travel
        return u - sag - now.value["sag_slope"][:, None] * u, {}
