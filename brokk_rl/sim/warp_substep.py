"""One substep of all Warp worlds, made of `mujoco_warp`'s stages or of launches of our own."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from brokk_rl.errors import ConfigError
from brokk_rl.machine import Machine
from brokk_rl.sim.warp_algebra import MAX_DOFS
from brokk_rl.sim.warp_dynamics import Dynamics
from brokk_rl.sim.warp_solver import Solver

_CONTACT = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS))
"""Constraints of this type and those after it are contacts."""


@wp.kernel(enable_backward=False)
def _keep_peak(
    num_rows: wp.array[int],
    kind: wp.array2d[int],
    contact: wp.array2d[int],
    force: wp.array2d[float],
    first_row: wp.array2d[int],
    peak: wp.array[float],
):
    """Raises each world's peak to the sum of the normal forces of its contacts, the first row of each in an elliptic cone.

    The same as the sum of the touch sensors (`sim.native` reads those), for one launch instead of
    eight.
    """
    world = wp.tid()
    total = wp.float32(0.0)  # a plain literal would be a constant to Warp
    for row in range(wp.min(num_rows[world], kind.shape[1])):
        if kind[world, row] >= _CONTACT and first_row[contact[world, row], 0] == row:
            total += force[world, row]
    peak[world] = wp.max(peak[world], total)


def check(compiled: mujoco.MjModel, machine: Machine, is_fused: bool) -> None:
    """Raises a `ConfigError` for what a substep leaves out."""
    left_out = {
        "tendons": compiled.ntendon,
        "equalities": compiled.neq,
        "deformable bodies": compiled.nflex,
        "plugins": compiled.nplugin,
        "friction in joints": compiled.dof_frictionloss.any(),
    }
    passive = (
        compiled.jnt_stiffness,
        compiled.dof_damping,
        compiled.body_gravcomp,
        compiled.opt.density,
        compiled.opt.viscosity,
    )
    too_much = {
        "actuators": compiled.nu != machine.num_joints,
        "branches": (compiled.dof_parentid != np.arange(-1, compiled.nv - 1)).any(),
        "springs, dampers or fluids": any(np.any(values) for values in passive),
        "torsional friction (condim above 3)": (
            np.concatenate([compiled.geom_condim, compiled.pair_dim]) > 3
        ).any(),
        f"more than {MAX_DOFS} joints": compiled.nv > MAX_DOFS,
    }
    if found := [
        name for name, count in (left_out | (too_much if is_fused else {})).items() if count
    ]:
        instead = "sim.fused=false or sim=native" if is_fused else "sim=native"
        raise ConfigError(
            f"machine {machine.name}: sim=warp simulates arms that are one chain of links, but its MJCF has {', '.join(found)}; "
            f"remove them, or choose {instead}"
        )


def staged(model: mjw.Model, data: mjw.Data, peak: wp.array) -> Callable[[], None]:
    """Returns `mjw.step` for a chain of bodies, without its stages for cameras, deformable bodies, tendons and sensors.

    Some 60 launches, and ten an iteration of the solver. The GPU waits for launches, not for
    arithmetic: every stage that a model does not need costs time.

    Args:
        model: The model.
        data: All worlds.
        peak: Raised to the contact force of each world, `(N,)`, N.
    """
    rows = data.efc
    forces = [data.nefc, rows.type, rows.id, rows.force, data.contact.efc_address]

    def step() -> None:
        mjw.kinematics(model, data)
        mjw.com_pos(model, data)
        mjw.crb(model, data)
        mjw.collision(model, data)
        mjw.make_constraint(model, data)
        mjw.transmission(model, data)
        mjw.fwd_velocity(model, data)
        mjw.fwd_actuation(model, data)
        mjw.fwd_acceleration(model, data, factorize=True)
        mjw.solve(model, data)
        mjw.implicit(model, data)
        wp.launch(_keep_peak, data.nworld, forces, [peak])

    return step


def fused(
    compiled: mujoco.MjModel, model: mjw.Model, data: mjw.Data, peak: wp.array
) -> Callable[[], None]:
    """Returns the same for an arm of a few joints driven by servos, in 18 launches.

    Args:
        compiled: The model as MuJoCo has it.
        model: The model.
        data: All worlds.
        peak: Raised to the contact force of each world, `(N,)`, N.
    """
    dynamics, solve = Dynamics(compiled, model, data), Solver(model, data, peak)

    def step() -> None:
        mjw.kinematics(model, data)
        dynamics.before_contacts()
        mjw.collision(model, data)
        mjw.make_constraint(model, data)
        solve()
        dynamics.after_contacts()

    return step
