"""Effects of load: the arm's weight, and the other joints on the same pump."""

from __future__ import annotations

from typing import ClassVar

import torch

from actuators.effects.effect import EffectSpec, Memory, StepInputs
from actuators.effects.ranges import EffectNumber, Value
from brokk_rl.spec import spec

LEAST_HEAD, MOST_HEAD = 0.05, 2.0
"""Pressure over the valve against that without load: a joint neither stalls nor runs away in a
static formula."""


@spec
class LoadDependence(EffectSpec):
    """Speed depends on pose and weight: slower lifting, faster lowering.

    Where masses are not known, the weight is a function of the joint's own position: the first
    harmonic of its angle, or a line over the travel of a sliding joint.

    Attributes:
        joints: Joints it acts on, or `all`.
        sensitivity: Share of the weight, over the machine's `yield_force`, that is missing from the
            pressure over the valve.
        lowering: Share of that by which lowering is faster: 1 for a plain valve, 0 where a pump that
            senses the load is short of pressure only when it lifts.
        pose_cos: Share that the weight takes from the pressure over the valve in the middle of the
            travel, positive direction, where masses are not known; it follows the cosine of the
            angle from there.
        pose_sin: The same with the sine of the angle (over half the travel for a sliding joint).
    """

    lowering: Value = 1.0  # a plain valve, as files from before this number mean
    pose_cos: Value = 0.0  # neutral: files from before this number lack it
    pose_sin: Value = 0.0  # neutral: files from before this number lack it
    side = "speed"
    numbers: ClassVar = {
        "sensitivity": EffectNumber("1", none=0.0, typical=0.5, bounds=(0.0, 1.5), masses=True),
        "lowering": EffectNumber("1", none=None, typical=1.0, bounds=(0.0, 1.0), trials=(0.0, 1.0)),
        # A stretched-out boom bears half the yield force, of which a half is missing.
        "pose_cos": EffectNumber("1", none=0.0, typical=0.25, bounds=(-0.9, 0.9), masses=False),
        "pose_sin": EffectNumber("1", none=0.0, typical=0.25, bounds=(-0.9, 0.9), masses=False),
    }

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`moved (sqrt(1 + sensitivity load / yield_force) - 1)`: orifice; load + where lowered."""
        if now.plant.has_masses:
            weight, sensitivity = now.plant.weight(now.history.q[:, -1]), now.value["sensitivity"]
        else:
            sin, cos = now.plant.read_pose(now.history.q[:, -1])
            weight, sensitivity = now.value["pose_cos"] * cos + now.value["pose_sin"] * sin, 1.0
        load = now.moved.sign() * weight
        load = load * torch.where(load > 0.0, now.value["lowering"], 1.0)
        head = 1.0 + sensitivity * load
        return now.moved * (head.clamp(LEAST_HEAD, MOST_HEAD).sqrt() - 1.0), {}


@spec
class Creep(EffectSpec):
    """Sinks at zero command: oil leaks through the closed valve, the more the heavier the load.

    Attributes:
        joints: Joints it acts on, or `all`.
        sink_rad_s: Speed under a weight as large as the machine's `yield_force` (m/s for a sliding
            joint); a stretched-out boom bears about half of that, a slewing joint none.
        drift_rad_s: Speed where masses are not known, in the positive direction.
    """

    drift_rad_s: Value = 0.0  # neutral: files from before this number lack it
    side = "speed"
    numbers: ClassVar = {
        "sink_rad_s": EffectNumber(
            "rad/s", none=0.0, typical=0.004, bounds=(0.0, 0.1), scale="speed", masses=True
        ),
        # Half of that: a boom bears about half of its yield force.
        "drift_rad_s": EffectNumber(
            "rad/s", none=0.0, typical=0.002, bounds=(-0.05, 0.05), scale="speed", masses=False
        ),
    }

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`sink weight / yield_force period`, in the direction of the weight, moving or not."""
        if not now.plant.has_masses:
            return now.value["drift_rad_s"] * now.plant.period_s + 0.0 * now.moved, {}
        return now.value["sink_rad_s"] * now.plant.weight(
            now.history.q[:, -1]
        ) * now.plant.period_s, {}


@spec
class FlowSharing(EffectSpec):
    """Joints slow each other when moving together, as they share one pump.

    Attributes:
        joints: Joints on the pump, or `all`; others neither draw from it nor are slowed.
        demand: Flow of a joint at the machine's `max_speed` over the flow of the pump.
    """

    side = "joints"
    shared = True
    numbers: ClassVar = {"demand": EffectNumber("1", none=0.0, typical=0.7, bounds=(0.0, 4.0))}

    def extra(self, now: StepInputs) -> tuple[torch.Tensor, Memory]:
        """`moved (1 / max(1, sum of demands) - 1)`: all are slowed in proportion."""
        demand = now.value["demand"]
        asked = (demand * (now.moved / now.plant.full_step).abs()).sum(1, keepdim=True)
        return now.moved * (1.0 / asked.clamp(min=1.0) - 1.0) * (demand > 0), {}
