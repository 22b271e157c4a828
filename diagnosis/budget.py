"""The gap in millimetres at the tool: what each joint's error over a free run, and each stage, means for the tip.

Errors of joints add up as vectors and may cancel. A joint's part is that of its own contribution
along the whole error, summed over
all samples: `Σ (J_j e_j) · d / Σ d · d` with `d = Σ_j J_j e_j`, which adds up to 1. Axes: `W`
windows, `K` steps, `J` joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from brokk_rl.kinematics import Kinematics
from brokk_rl.machine import Machine
from diagnosis.free_runs import WindowedRuns


@dataclass(frozen=True)
class Account:
    """Error of the tip over free runs of one simulator.

    Attributes:
        tip_rms_m: Root mean square distance between simulated and measured tip, m.
        joint_rms_m: What each joint's error alone would move the tip by, root mean square, m.
        joint_part: Part of the mean squared distance that each joint answers for; they add up to 1,
            one below 0 cancels others.
    """

    tip_rms_m: float
    joint_rms_m: dict[str, float]
    joint_part: dict[str, float]


@dataclass(frozen=True)
class Budget:
    """The gap at the tool before and after the effects that were found, and the floor; `None` where there is no such simulator.

    Attributes:
        before: Of the simulator as it was.
        after: With the selected effects.
        floor: Of the simulator on reference recordings.
        stages_m: Root mean square of what other stages add, by stage, m.
    """

    before: Account
    after: Account | None
    floor: Account | None
    stages_m: dict[str, float]

    def plain(self) -> dict[str, Any]:
        """Returns it as plain JSON data, in mm as its name says."""

        def account(one: Account | None) -> dict[str, Any] | None:
            return one and {
                "tip_rms_mm": 1e3 * one.tip_rms_m,
                "joint_rms_mm": {name: 1e3 * value for name, value in one.joint_rms_m.items()},
                "joint_part": one.joint_part,
            }

        stages = {name: 1e3 * value for name, value in self.stages_m.items()}
        return {name: account(getattr(self, name)) for name in ("before", "after", "floor")} | {
            "stages_mm": stages
        }


def account(runs: WindowedRuns, machine: Machine) -> Account:
    """Returns the error of the tip over free runs.

    Raises:
        ConfigError: the machine's geometry is not known.
    """
    given = np.isfinite(runs.error).all(2)
    measured, error = runs.measured[given], runs.error[given]
    kinematics = Kinematics(machine)
    pose, jacobian = kinematics.pose_and_jacobian(torch.as_tensor(measured, dtype=torch.float32))
    simulated = kinematics.pose(torch.as_tensor(measured + error, dtype=torch.float32))
    distance = (simulated.tip_in_base_m - pose.tip_in_base_m).numpy().astype(float)
    moved = jacobian.tip.numpy().astype(float) * error[:, None, :]  # (S, 3, J)
    whole = moved.sum(2)
    along = np.einsum("sij,si->j", moved, whole)
    part = along / max(float((whole**2).sum()), np.finfo(float).tiny)
    alone = np.sqrt((moved**2).sum(1).mean(0))
    names = machine.joint_names
    return Account(
        float(np.sqrt((distance**2).sum(1).mean())),
        dict(zip(names, alone.tolist(), strict=True)),
        dict(zip(names, part.tolist(), strict=True)),
    )
