"""Gravity load on each joint, from masses and geometry; batched, in torch."""

from functools import lru_cache

import numpy as np
import torch

from brokk_rl.machine import Machine

GRAVITY_M_S2 = 9.81
"""Gravity, m/s²: standard gravity (9.80665), rounded."""


class Gravity:
    """Generalised force of gravity on each joint of a serial machine that stands level.

    Args:
        machine: Axes, origins, masses and centres of mass.
        device: Where to compute.
    """

    def __init__(self, machine: Machine, device: torch.device) -> None:
        def tensor(rows: list) -> torch.Tensor:
            return torch.tensor(rows, dtype=torch.float32, device=device)

        bodies = machine.bodies
        self._axis = tensor([body.axis for body in bodies])
        self._origin_m = tensor([[d.value for d in body.origin_m] for body in bodies])
        self._com_m = tensor([body.com_m for body in bodies])
        self._mass_kg = tensor([body.mass_kg.value for body in bodies])
        self._hinge = tensor([float(joint.kind == "hinge") for joint in machine.joints])
        self._carried_kg = self._mass_kg.flip(0).cumsum(0).flip(0)
        x, y, z = self._axis.unbind(1)
        zero = torch.zeros_like(x)
        self._cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
        self._cross_twice = self._cross @ self._cross
        self._eye = torch.eye(3, device=device)

    def load(self, q: torch.Tensor) -> torch.Tensor:
        """Return the gravity load in the positive direction at `q`, `(N, J)`, Nm or N."""
        axis, origin_m, moments = self._place(q)
        carried = moments.flip(1).cumsum(1).flip(1) - self._carried_kg[:, None] * origin_m
        # z component of axis x lever arm, times mass.
        turning = axis[..., 0] * carried[..., 1] - axis[..., 1] * carried[..., 0]
        lifting = self._carried_kg * axis[..., 2]
        return -GRAVITY_M_S2 * (self._hinge * turning + (1.0 - self._hinge) * lifting)

    def overturn(self, q: torch.Tensor) -> torch.Tensor:
        """Return the moment of the arm's weight about the base frame's origin, `(N, 3)`, Nm."""
        moment = self._place(q)[2].sum(1)
        x, y = moment[:, 0], moment[:, 1]
        return GRAVITY_M_S2 * torch.stack((-y, x, torch.zeros_like(x)), 1)

    def _place(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return joint axes, joint origins (m), and mass times place of each body (kg m).

        Each `(N, J, 3)`, in the base frame.
        """
        angle = (q * self._hinge)[..., None, None]
        # Rodrigues' rotation formula.
        turn = self._eye + angle.sin() * self._cross + (1.0 - angle.cos()) * self._cross_twice
        slide = (q * (1.0 - self._hinge))[..., None] * self._axis
        rotation, at_m = self._eye.expand(q.shape[0], 3, 3), q.new_zeros(q.shape[0], 3)
        origins, axes, moments = [], [], []
        for j in range(q.shape[1]):
            axes.append(rotation @ self._axis[j])
            at_m = at_m + (rotation @ (self._origin_m[j] + slide[:, j])[..., None]).squeeze(-1)
            rotation = rotation @ turn[:, j]
            origins.append(at_m)
            moments.append(self._mass_kg[j] * (at_m + rotation @ self._com_m[j]))
        return torch.stack(axes, 1), torch.stack(origins, 1), torch.stack(moments, 1)


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
        lower, upper = (
            torch.as_tensor(side, dtype=torch.float32, device=device)
            for side in (machine.lower, machine.upper)
        )
        drawn = torch.rand(
            NUM_POSES, machine.num_joints, generator=torch.Generator().manual_seed(0)
        )
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
