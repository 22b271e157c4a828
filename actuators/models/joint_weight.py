"""Weight on the joints of a machine, in the linear form of a planar arm where that is exact."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from brokk_rl.kinematics import Gravity
from brokk_rl.machine import Machine

NUM_POSES = 256
"""Poses at which the linear form is fitted and checked; it has 2 J + 1 numbers a joint."""
PLANAR_ERROR = 1e-3
"""Largest error of the linear form, over the yield force. On a planar arm it is that of float32."""


class JointWeight:
    """Gravity load over the yield force of each joint.

    The weight on the joints of a planar arm is linear in the sines and cosines of the sums of its
    angles. This form takes a tenth of the time of the full mechanics, and is used where it is exact.

    Args:
        machine: A machine with known masses.
        device: Where to compute.

    Attributes:
        is_planar: Whether the linear form holds.
        sums: Sums of angles as columns, `(J, J)`.
        linear: Weight per wave, `(2 J, J)`.
        constant: Weight without any wave, `(J,)`.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        self._gravity = Gravity(machine, device)
        force = [body.yield_force.value for body in machine.bodies]
        self._force = torch.tensor(force, dtype=torch.float32, device=device)
        hinges = np.array([joint.kind == "hinge" for joint in machine.joints])
        axes = np.array([body.axis for body in machine.bodies])
        sums = np.tril(np.abs(axes @ axes.T) > 1.0 - 1e-6) & hinges & hinges[:, None]
        signs = np.sign(axes @ axes.T)
        self.sums = torch.as_tensor((sums * signs).T, dtype=torch.float32, device=device)
        lower = torch.as_tensor(machine.lower, dtype=torch.float32, device=device)
        upper = torch.as_tensor(machine.upper, dtype=torch.float32, device=device)
        generator = torch.Generator().manual_seed(0)
        drawn = torch.rand(NUM_POSES, machine.num_joints, generator=generator)
        q = drawn.to(device) * (upper - lower) + lower
        truth, waves = self._gravity.load(q) / self._force, self.build_waves(q)
        columns = torch.cat((waves, torch.ones_like(waves[:, :1])), 1).double().cpu()
        found = torch.linalg.lstsq(columns, truth.double().cpu()).solution.float().to(device)
        self.linear, self.constant = found[:-1], found[-1]
        error = torch.addmm(self.constant, waves, self.linear) - truth
        self.is_planar = bool(error.abs().max() < PLANAR_ERROR)

    def build_waves(self, q: torch.Tensor) -> torch.Tensor:
        """Return cosines and sines of the sums of angles at `q` `(N, J)`, `(N, 2 J)`."""
        angle = q @ self.sums
        return torch.cat((angle.cos(), angle.sin()), 1)

    def weigh(self, q: torch.Tensor) -> torch.Tensor:
        """Return the weight in the positive direction at `q`, `(N, J)`."""
        if self.is_planar:
            return torch.addmm(self.constant, self.build_waves(q), self.linear)
        return self._gravity.load(q) / self._force


@lru_cache(maxsize=32)
def build_joint_weight(machine: Machine, device: torch.device) -> JointWeight:
    """Return the weight on the joints of a machine, made once."""
    return JointWeight(machine, device)
