"""Location of the gap: the share of each joint in the squared error beyond the floor.

The floor is the error of the same simulator on reference recordings that it was not fitted to.
Axes: `W` windows, `K` steps, `J` joints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brokk_rl.machine import Machine
from diagnosis.answer import JointGap, Selected, Stage, Where
from diagnosis.effect_library import EffectType
from diagnosis.free_runs import WindowedRuns

TINY = np.finfo(float).tiny
"""Smallest divisor: a sum of squares may be 0."""


def find_stage(selected: Sequence[Selected], kinds: Sequence[EffectType]) -> Stage | None:
    """Return where the first named effect lies on the way from command to estimate; `None` without any."""
    named = selected[0].effect if selected else ""
    return next((kind.stage for kind in kinds if kind.name == named), None)


def locate_gap(
    runs: WindowedRuns, reference: WindowedRuns | None, machine: Machine, stage: Stage | None = None
) -> Where:
    """Return where the gap lies; the shares of all joints add up to 1.

    Args:
        runs: Free runs through field recordings.
        reference: The same simulator's through reference recordings that it was not fitted to;
            `None`: there is no floor, and every error counts.
        machine: Gives joints and limits.
        stage: Part of the way from command to estimate, as the answer tells it.
    """
    square = np.nanmean(runs.error**2, axis=(0, 1))
    floor = np.zeros_like(square)
    if reference is not None:
        floor = np.nanmean(reference.error**2, axis=(0, 1))
    excess = np.maximum(square - floor, 0.0)
    if not excess.any():
        excess = square
    share = excess / (machine.upper - machine.lower) ** 2
    share = share / max(float(share.sum()), TINY)
    joints = {}
    rows = zip(np.sqrt(square).tolist(), np.sqrt(floor).tolist(), share.tolist(), strict=True)
    for joint, (rmse, least, part) in zip(machine.joints, rows, strict=True):
        joints[joint.name] = JointGap(rmse, least, part, joint.unit)
    return Where(joints, stage)
