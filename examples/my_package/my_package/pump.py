"""An effect: one pump for all joints, which leaves the most loaded joint behind."""

from __future__ import annotations

from typing import ClassVar

import torch

from actuators.effects.effect import EffectSpec, Memory, StepInputs
from actuators.effects.ranges import EffectNumber
from brokk_rl.spec import spec

HALVINGS = 10
"""Halvings of the interval in which the pump's pressure lies: to a thousandth of relief pressure."""
IDLE_PRESSURE = 0.08
"""Pressure that drives the pump's whole flow through an open centre, over relief pressure: about
15 of 180 bar; chosen by hand."""


@spec
class Pump(EffectSpec):
    """Joints that draw from one pump without compensators.

    The pump's pressure is that at which the joints, and the open centre, take its whole flow. A
    joint whose load is above that pressure stands still. One whose load is far below it runs faster
    than commanded.

    Attributes:
        joints: Joints on the pump, or `all`; the others move as commanded.
        demand: Flow of a joint at the machine's `max_speed` over the flow of the pump.
        handicap: Pressure that a joint needs beside that for the arm's weight, over relief pressure.
        bearing: The machine's `yield_force` over the force at relief pressure.
        margin: Pressure across a valve at which it passes its nominal flow, over relief pressure.
        surplus: Largest pressure across a valve, over `margin`; 1: a compensator limits it.
        stroke: Opening at which a spool closes its centre; 0 or less: there is no open centre.
    """

    side = "joints"
    shared = True
    label = "my_pump"
    numbers: ClassVar = {
        "demand": EffectNumber("1", none=0.0, typical=0.7, bounds=(0.0, 4.0)),
        "handicap": EffectNumber("1", none=None, typical=0.1, bounds=(0.0, 2.0)),
        "bearing": EffectNumber("1", none=None, typical=0.6, bounds=(0.0, 2.0)),
        "margin": EffectNumber("1", none=None, typical=0.1, bounds=(0.01, 1.0), per_joint=False),
        "surplus": EffectNumber("1", none=None, typical=1.0, bounds=(1.0, 20.0), per_joint=False),
        "stroke": EffectNumber("1", none=None, typical=0.5, bounds=(-1.0, 2.0), per_joint=False),
    }

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`moved (sqrt(pressure across the valve / margin) - 1)`: orifice."""
        value, is_on_pump = now.value, now.value["demand"] > 0.0
        opening = (now.moved / now.plant.full_step).abs()
        load = value["handicap"] + torch.zeros_like(opening)
        if now.plant.has_masses:
            weight = now.plant.weight(now.history.q[:, -1])
            load = load - value["bearing"] * now.moved.sign() * weight
        load = load.clamp(min=0.0)  # a falling weight drives no pump
        pressure = self._balance(value, opening, load)
        flow = torch.where(is_on_pump, _compute_flow(pressure - load, value), 1.0)
        return now.moved * (flow - 1.0), {}

    def _balance(
        self, value: dict[str, torch.Tensor], opening: torch.Tensor, load: torch.Tensor
    ) -> torch.Tensor:
        """Return the pressure at which all flow is taken, over relief pressure, `(N, 1)`.

        At 1 the relief valve takes what is left.
        """
        stroke, asked = value["stroke"], value["demand"] * opening
        left = (1.0 - opening / stroke.clamp(min=1e-6)).clamp(min=0.0)
        left = torch.where(value["demand"] > 0.0, left, 1.0)
        centre = left.square().prod(1, keepdim=True) * (stroke > 0.0)
        pressure = torch.full_like(centre, 0.5)
        for i in range(HALVINGS):
            taken = (asked * _compute_flow(pressure - load, value)).sum(1, keepdim=True)
            taken = taken + centre * (pressure / IDLE_PRESSURE).sqrt()
            pressure = pressure + torch.where(taken < 1.0, 0.25, -0.25) * 0.5**i
        return pressure


def _compute_flow(across: torch.Tensor, value: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return the flow of valves over their nominal one, for the pressure across them."""
    return (across / value["margin"]).clamp(min=0.0).minimum(value["surplus"]).sqrt()
