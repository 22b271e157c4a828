"""Effects on the speed that a joint reaches for a valve opening, joint by joint."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import ClassVar

import torch

from actuators.effects.effect import EffectSpec, Memory, StepInputs
from actuators.effects.ranges import EffectNumber, Value
from actuators.effects.targets import TargetBacklash, TargetLag
from brokk_rl.spec import spec

WARM_UPS_S = (60.0, 150.0, 400.0, 1200.0, 3600.0)
"""Time constants of warming up that a diagnosis tries."""


@spec
class FlowGain(EffectSpec):
    """Speed per command changed, both ways.

    Attributes:
        joints: Joints it acts on, or `all`.
        gain: Factor on the speed.
    """

    side = "speed"
    numbers: ClassVar = {"gain": EffectNumber("1", none=1.0, typical=0.85, bounds=(0.1, 3.0))}

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`(gain - 1) moved`."""
        return (now.value["gain"] - 1.0) * now.moved, {}


@spec
class Asymmetry(EffectSpec):
    """Speed per command changed in one direction.

    Attributes:
        joints: Joints it acts on, or `all`.
        extend_gain: Factor on the speed in the positive direction.
        retract_gain: The same for the negative direction.
    """

    side = "speed"
    numbers: ClassVar = {
        "extend_gain": EffectNumber("1", none=1.0, typical=0.8, bounds=(0.1, 3.0)),
        "retract_gain": EffectNumber("1", none=1.0, typical=0.8, bounds=(0.1, 3.0)),
    }

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`(gain of the direction - 1) moved`."""
        gain = torch.where(now.moved > 0, now.value["extend_gain"], now.value["retract_gain"])
        return (gain - 1.0) * now.moved, {}


@spec
class Lag(EffectSpec):
    """A slower first-order response.

    Attributes:
        joints: Joints it acts on, or `all`.
        time_constant_s: Time constant with which the speed follows that of the inner model.
    """

    side = "speed"
    variants = MappingProxyType({"position": TargetLag, "torque": TargetLag})
    numbers: ClassVar = {
        "time_constant_s": EffectNumber(
            "s", none=0.0, typical=0.12, bounds=(0.0, 2.0), scale="time"
        )
    }

    def begin(self, now: StepInputs) -> Memory:
        """The joint goes on as fast as it moved last."""
        return {"speed": measure_last_step(now)}

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Solve `time_constant v' + v = v_inner` exactly over the period.

        `speed` is the motion in one period.
        """
        periods = now.value["time_constant_s"] / now.plant.period_s
        decay, behind = torch.exp(-1.0 / periods.clamp(min=1e-6)), now.memory["speed"] - now.moved
        return behind * periods * (1.0 - decay), {"speed": now.moved + behind * decay}


@spec
class Backlash(EffectSpec):
    """Play that is taken up at reversals.

    Attributes:
        joints: Joints it acts on, or `all`.
        gap_rad: Whole width of the play (m for a sliding joint).
    """

    side = "speed"
    variants = MappingProxyType({"position": TargetBacklash})
    numbers: ClassVar = {
        "gap_rad": EffectNumber("rad", none=0.0, typical=0.01, bounds=(0.0, 0.2), scale="travel")
    }

    def begin(self, now: StepInputs) -> Memory:
        """A moving joint lies against the side in front; a resting one in the middle."""
        q = now.history.q
        return {"slack": 0.5 * now.value["gap_rad"] * (1.0 - (q[:, -1] - q[:, 0]).sign())}

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`slack` is the way to go in the positive direction before the joint follows."""
        before = torch.minimum(now.memory["slack"], now.value["gap_rad"])
        slack = torch.minimum((before - now.moved).clamp(min=0.0), now.value["gap_rad"])
        return slack - before, {"slack": slack}


@spec
class Compliance(EffectSpec):
    """Oil and structure give way: the joint rings after a change of speed.

    Attributes:
        joints: Joints it acts on, or `all`.
        ringing_s: Period of the undamped oscillation, 1 / frequency.
        damping: Damping ratio.
    """

    side = "speed"
    numbers: ClassVar = {
        "ringing_s": EffectNumber("s", none=0.0, typical=0.3, bounds=(0.0, 2.0), scale="time"),
        # Trials reach from a ringing boom to a joint that only gives way: oil with air, long hoses.
        "damping": EffectNumber(
            "1", none=None, typical=0.12, bounds=(0.02, 0.95), trials=(0.05, 0.12, 0.3, 0.6, 0.9)
        ),
    }

    def begin(self, now: StepInputs) -> Memory:
        """The joint moves steadily."""
        still = torch.zeros_like(now.moved)
        return {
            "deflection": still,
            "rate": still,
            "speed": measure_last_step(now) / now.plant.period_s,
        }

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Solve `d'' + 2 damping w d' + w^2 d = -v'` exactly.

        The inner speed `v` changes at the beginning of each period.
        """
        period_s, damping = now.plant.period_s, now.value["damping"]
        # Beyond 100 kHz nothing is left after a period, to the last bit.
        w = 2.0 * math.pi / now.value["ringing_s"].clamp(min=1e-5)
        ringing, fade = w * torch.sqrt(1.0 - damping.square()), damping * w
        speed = now.moved / period_s
        d, rate = now.memory["deflection"], now.memory["rate"] + now.memory["speed"] - speed
        decay, turn = torch.exp(-fade * period_s), ringing * period_s
        cos, sin = torch.cos(turn), torch.sin(turn)
        after = decay * (d * cos + (rate + fade * d) / ringing * sin)
        rate = decay * (rate * cos - (fade * rate + w.square() * d) / ringing * sin)
        return after - d, {"deflection": after, "rate": rate, "speed": speed}


@spec
class ThermalDrift(EffectSpec):
    """Speed changes slowly with running time, as oil warms up.

    Attributes:
        joints: Joints it acts on, or `all`.
        change: Relative change of the speed after a long time.
        time_s: Time constant of warming up.
        elapsed_s: Time that the machine has run at the reset.
        cold_change: Relative change of the speed at switch-on, which fades while the machine warms
            up.
    """

    cold_change: Value = 0.0  # its neutral value: files from before this number lack it
    side = "speed"
    running = "elapsed_s"
    shared = True
    numbers: ClassVar = {
        "change": EffectNumber("1", none=0.0, typical=0.1, bounds=(-0.7, 2.0)),
        # Trials reach from a small tank in the cold to a whole shift: oil warms as slowly on a small
        # machine, so the time does not grow with the joints.
        "time_s": EffectNumber("s", None, 1200.0, (1.0, 36_000.0), trials=WARM_UPS_S),
        "elapsed_s": EffectNumber("s", none=None, typical=0.0, bounds=(0.0, 360_000.0)),
        "cold_change": EffectNumber("1", none=0.0, typical=0.1, bounds=(-0.7, 2.0)),
    }

    def begin(self, now: StepInputs) -> Memory:
        """The clock starts."""
        return {"running_s": torch.zeros_like(now.moved)}

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """Return the change of the way that a joint goes.

        `(change (1 - exp(-t / time)) + cold_change exp(-t / time)) moved`, `t` at the middle of the
        period.
        """
        running_s, period_s = now.memory["running_s"], now.plant.period_s
        t_s = now.value["elapsed_s"] + running_s + 0.5 * period_s
        warm = 1.0 - torch.exp(-t_s / now.value["time_s"])
        change = now.value["change"] * warm + now.value["cold_change"] * (1.0 - warm)
        return change * now.moved, {"running_s": running_s + period_s}


def measure_last_step(now: StepInputs) -> torch.Tensor:
    """Return how far the joints moved in the last period, `(N, J)`."""
    return now.history.q[:, -1] - now.history.q[:, -2]
