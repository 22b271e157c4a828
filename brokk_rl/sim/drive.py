"""Drive: servos that follow the actuator model, hold the arm, and yield to an obstacle.

Each joint has a servo of its own inside MuJoCo, force = stiffness (act - q) - damping q', cut off
at the yield force (the relief valve). Its reference accumulates the predicted increments. "Present
position + increment" would be wrong: any sag under load becomes the next starting point, and the
arm sinks. Within a control period the reference moves on at constant speed v (MuJoCo integrates
ctrl = v into act). It leads by v damping / stiffness, so that damping does not cost a lag.

The simulation has no gravity. The actuator model was learned on a machine that has its weight, so
its increments already contain the effect of gravity, which must not be counted twice. Nothing but
the machine moves: this is the same as compensating gravity link by link, and cheaper.

"""

import mujoco
import numpy as np
import torch

from brokk_rl.machine import Machine

DAMPING_RATIO = 0.7
"""Of the servo against the inertia seen at the joint at home; a heavier pose is damped less."""


MAX_SPEED, SPEED_MARGIN = 20.0, 4.0
"""Joint speed (rad/s or m/s) beyond which a world counts as diverged: forty times what `brokk170`
can do, and a multiple of what a faster machine can."""
FASTEST_MODE = 0.7
"""Largest change of phase of the drives' fastest mode in a substep, rad, that a new machine gets: the
integrator becomes unstable at 2, and `brokk170` reaches 0.9 in its worst pose."""


def compute_inertia(model: mujoco.MjModel, q: np.ndarray) -> np.ndarray:
    """Return the mass matrix of an arm at `q`, `(J, J)`, kg m² or kg."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def find_fastest_mode(
    model: mujoco.MjModel, stiffness: np.ndarray, poses: np.ndarray
) -> tuple[float, int]:
    """Return the fastest mode of an arm on its drives, rad/s, and the joint that moves most in it.

    Coupled joints swing faster than each alone: what counts is the largest eigenvalue of M⁻¹ K.

    Args:
        model: Model of the arm alone.
        stiffness: Of each drive, `(J,)`, Nm/rad or N/m.
        poses: Poses to look at, `(P, J)`.
    """
    fastest, joint = 0.0, 0
    for q in poses:
        # symmetric: K^½ M⁻¹ K^½
        root = np.sqrt(stiffness)
        inverse = np.linalg.inv(compute_inertia(model, q))
        values, vectors = np.linalg.eigh(root[:, None] * inverse * root)
        if values[-1] > fastest:
            fastest, joint = float(values[-1]), int(np.abs(vectors[:, -1]).argmax())
    return float(np.sqrt(fastest)), joint


def add_drive(spec: mujoco.MjSpec, machine: Machine, inertia: np.ndarray) -> None:
    """Add one servo per joint, in machine order.

    Args:
        spec: Model with the joints.
        machine: Gives stiffness and yield force.
        inertia: Inertia seen at each joint, `(J,)`, kg m² or kg.
    """
    for joint, body, seen in zip(machine.joints, machine.bodies, inertia, strict=True):
        stiffness = body.stiffness.value
        damping = 2.0 * DAMPING_RATIO * float(np.sqrt(stiffness * seen))
        actuator = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.set_to_intvelocity(kp=stiffness, kv=damping)
        actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = (-body.yield_force.value, body.yield_force.value)


class DriveReferences:
    """References of all drives of all worlds; every update is in place.

    Args:
        model: Compiled model with the servos.
        machine: Gives the control period and yield forces.
        num_worlds: `N`.
        device: Where the worlds live.
        dtype: Type in which the reference accumulates.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        machine: Machine,
        num_worlds: int,
        device: torch.device | str,
        dtype: torch.dtype,
    ) -> None:
        stiffness, damping = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]

        def constant(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        self.reference = torch.zeros(num_worlds, machine.num_joints, dtype=dtype, device=device)
        self._rate = 1.0 / machine.period_s
        self._max_speed = max(MAX_SPEED, SPEED_MARGIN * float(machine.max_speed.max()))
        self._lead = constant(damping / stiffness)
        self._leash = constant(
            np.array([body.yield_force.value for body in machine.bodies]) / stiffness
        )

    def set_servos(
        self, stiffness: torch.Tensor, damping: torch.Tensor, yield_force: torch.Tensor
    ) -> None:
        """Give each world servos of its own, each argument `(N, J)` or `(J,)`.

        The first call makes room for them, later ones write in place.
        """
        if self._lead.dim() == 1:
            self._lead = self._lead.expand_as(self.reference).clone()
            self._leash = self._leash.expand_as(self.reference).clone()
        self._lead.copy_(damping / stiffness)
        self._leash.copy_(yield_force / stiffness)

    def step(
        self, q: torch.Tensor, increment: torch.Tensor, act: torch.Tensor, ctrl: torch.Tensor
    ) -> None:
        """Move the references on by one control period.

        The reference never leads the joint by more than the lead that opens the relief valve. So a
        blocked joint does not wind up.

        Args:
            q: Present positions, `(N, J)`.
            increment: Predicted motion over the coming period, `(N, J)`.
            act: Written: activations at the start of the period, `(N, J)`.
            ctrl: Written: reference speeds, `(N, J)`.
        """
        reference = self.reference
        torch.clamp(reference, q - self._leash, q + self._leash, out=reference)
        ctrl.copy_(increment).mul_(self._rate)
        torch.addcmul(reference, self._lead, ctrl, out=act)
        reference.add_(increment)

    def diverged(self, qvel: torch.Tensor) -> torch.Tensor:
        """Return diverged worlds, `(N,)` bool: absurd or NaN joint speeds, infinite references.

        Args:
            qvel: Joint speeds, `(N, J)`.


        The references count because the cut-off at the yield force turns NaN into a force that
        looks sound.
        """
        return (self.reference.mul(0.0).add_(qvel).abs_().amax(1) <= self._max_speed).logical_not_()

    def reset(self, mask: torch.Tensor, q: torch.Tensor) -> None:
        """Put the references of the worlds of `mask`, `(N,)` bool, to `q`, `(N, J)`."""
        torch.where(mask[:, None], q.to(self.reference.dtype), self.reference, out=self.reference)
