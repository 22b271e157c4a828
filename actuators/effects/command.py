"""Effects on how much of a command the valve sees."""

from __future__ import annotations

from typing import ClassVar

import torch

from actuators.effects.effect import ANY_INTERFACE, EffectSpec, Memory, StepInputs
from actuators.effects.ranges import EffectNumber
from actuators.effects.timing import append_command
from actuators.models.parameters import open_valve
from brokk_rl.spec import spec


@spec
class DeadBand(EffectSpec):
    """No flow below a command, on each side; a full command still opens the valve fully.

    Attributes:
        joints: Joints it acts on, or `all`.
        extend: Command up to which nothing moves in the positive direction.
        retract: The same for the negative direction.
    """

    side = "command"
    recent = 1
    numbers: ClassVar = {
        "extend": EffectNumber(
            "1", none=0.0, typical=0.06, bounds=(0.0, 0.85)
        ),  # servo-driven rotary valves reach 0.75
        "retract": EffectNumber("1", none=0.0, typical=0.06, bounds=(0.0, 0.85)),
    }

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`(|u| - band) / (1 - band)` beyond the band of its side, else 0."""
        extend, retract = now.value["extend"][:, None], now.value["retract"][:, None]
        return open_valve(now.history.u, extend, retract), {}


@spec
class Saturation(EffectSpec):
    """Beyond a command the speed no longer grows: a lower top speed, both ways.

    Attributes:
        joints: Joints it acts on, or `all`.
        level: Command beyond which the valve opens no further.
    """

    side = "command"
    recent = 1
    interfaces = frozenset({"speed", "torque"})
    numbers: ClassVar = {"level": EffectNumber("1", none=1.0, typical=0.75, bounds=(0.05, 1.0))}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`u` cut off at plus and minus `level`."""
        level = now.value["level"][:, None]
        return now.history.u.clamp(-level, level), {}


@spec
class RateLimit(EffectSpec):
    """The command's slope is bounded.

    Attributes:
        joints: Joints it acts on, or `all`.
        stroke_s: Shortest time from no command to a full one.
    """

    side = "command"
    recent = 2
    interfaces = ANY_INTERFACE  # of a target: a lower top speed
    numbers: ClassVar = {
        "stroke_s": EffectNumber("s", none=0.0, typical=0.4, bounds=(0.0, 5.0), scale="time")
    }

    def begin(self, now: StepInputs) -> Memory:
        """Commands so far have been slow enough."""
        return {"sent": now.history.u[:, :-1]}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """The command, no further than `period / stroke` from the one before."""
        before = now.memory["sent"][:, -1]
        reach = now.plant.period_s / now.value["stroke_s"].clamp(min=1e-6)
        return append_command(now, now.history.u[:, -1].clamp(before - reach, before + reach))


@spec
class Stiction(EffectSpec):
    """A joint starts at a larger command than the one at which it stops.

    Attributes:
        joints: Joints it acts on, or `all`.
        start: Command beyond which a resting joint starts.
        stop: Command at which a moving joint stops; taken as `start` where it is larger.
    """

    side = "command"
    recent = 2
    smooth = False
    numbers: ClassVar = {
        "start": EffectNumber("1", none=0.0, typical=0.14, bounds=(0.0, 0.6)),
        "stop": EffectNumber("1", none=0.0, typical=0.06, bounds=(0.0, 0.6)),
    }

    def begin(self, now: StepInputs) -> Memory:
        """A joint whose command was beyond `start` is moving."""
        before = now.history.u[:, -2]
        moving = before.sign() * (before.abs() > now.value["start"])
        return {"sent": now.history.u[:, :-1], "moving": moving}

    def commands(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """The command while the joint moves, else 0; a reversal is a new start."""
        u, start = now.history.u[:, -1], now.value["start"]
        stop = torch.minimum(now.value["stop"], start)
        goes_on = (now.memory["moving"] == u.sign()) & (u.abs() > stop)
        moving = u.sign() * ((u.abs() > start) | goes_on)
        sent, memory = append_command(now, u * moving.abs())
        return sent, memory | {"moving": moving}
