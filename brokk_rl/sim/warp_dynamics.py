# Kernels are written in Warp's own subset of Python, whose types a type checker does not know.
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportReturnType=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
"""Forces on an arm before contacts, and its step in time after them: one Warp launch each.

Before the contacts: the mass matrix M, the forces of the servos (`brokk_rl.sim.model`) and the
inertial forces of the present motion. They follow from Newton's and Euler's laws of every body,
projected onto the joints (Kane and Levinson, "Dynamics: Theory and Applications", 1985):

    M = Σ m Jᵀ J + Wᵀ I W        bias = Σ Jᵀ (m a) + Wᵀ (I α + ω × I ω)

J and W are the Jacobians of a body's centre of mass and turn. a and α are its accelerations while
no joint accelerates. After the contacts: MuJoCo's implicit integrator (documentation, Computation,
"implicitfast"), (M + h D) x' = M x. D is the damping of the servos that are not cut off at their
yield force.

For five joints this arithmetic takes less time than the launches of `mujoco_warp`'s recursions,
which are made for any tree. Vectors and matrices of five joints stay in a thread's registers.
"""

import functools
from typing import Any, NamedTuple

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp


class JointAlgebra(NamedTuple):
    """Types and functions of Warp for one number of degrees of freedom.

    Attributes:
        Vector: A number a degree of freedom.
        Matrix: A square matrix.
        inertia_at: `(elements, element, world)` -> the mass matrix of a world, from the lower half
            that `mujoco_warp` keeps.
        solved: `(A, b)` -> the solution of A x = b for a positive definite A, which needs no
            pivots.
    """

    Vector: Any
    Matrix: Any
    inertia_at: wp.Function
    solved: wp.Function


@functools.cache
def compile_algebra(num_dofs: int) -> JointAlgebra:
    """Return the types and functions for `num_dofs` degrees of freedom."""
    n = num_dofs
    Vector = wp.types.vector(n, wp.float32)
    Matrix = wp.types.matrix((n, n), wp.float32)

    @wp.func
    def inertia_at(elements: wp.array2d[float], element: wp.array2d[int], world: int) -> Matrix:
        inertia = Matrix()
        for i in range(n):
            for j in range(i + 1):
                if element[i, j] >= 0:
                    inertia[i, j] = elements[world, element[i, j]]
                    inertia[j, i] = inertia[i, j]
        return inertia

    @wp.func
    def solved(matrix: Matrix, right: Vector) -> Vector:
        a, x = Matrix(matrix), Vector(right)
        for k in range(n - 1):
            for i in range(k + 1, n):
                factor = a[i, k] / a[k, k]
                for j in range(k + 1, n):
                    a[i, j] = a[i, j] - factor * a[k, j]
                x[i] = x[i] - factor * x[k]
        for back in range(n):
            k = n - 1 - back
            left = x[k]
            for j in range(k + 1, n):
                left -= a[k, j] * x[j]
            x[k] = left / a[k, k]
        return x

    return JointAlgebra(Vector, Matrix, inertia_at, solved)


_SLIDE = wp.constant(int(mujoco.mjtJoint.mjJNT_SLIDE))
_NO_ROOM_FOR_ROWS = wp.constant(int(mjw.OverflowType.NEFC))
_NO_ROOM_FOR_CONTACTS = wp.constant(int(mjw.OverflowType.NARROWPHASE))
_NO_ROOM_FOR_PAIRS = wp.constant(int(mjw.OverflowType.BROADPHASE))
_BLOCK = 32  # small blocks, so that some thousand worlds spread over all of a GPU


@wp.struct
class _Arm:
    """Constants of the arm: joints, servos, and bodies by the last joint that moves them."""

    joint_kind: wp.array[int]
    armature: wp.array2d[float]
    stiffness: wp.array2d[float]
    speed_gain: wp.array2d[float]
    yield_force: wp.array2d[wp.vec2]
    bodies: wp.array[int]
    first_body: wp.array[int]
    mass: wp.array2d[float]
    inertia: wp.array2d[wp.vec3]


@wp.struct
class _Pose:
    """Axes and anchors of the joints, centres of mass and principal axes of the bodies."""

    axis: wp.array2d[wp.vec3]
    anchor: wp.array2d[wp.vec3]
    center: wp.array2d[wp.vec3]
    frame: wp.array2d[wp.mat33]


@functools.cache
def _compile_kernels(num_dofs: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Return the kernels that run before and after the contacts."""
    n = num_dofs
    Vector, Matrix, inertia_at, solved = compile_algebra(n)
    Columns = wp.types.matrix((n, 3), wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def before(
        arm: _Arm,
        pose: _Pose,
        element: wp.array2d[int],
        root: int,
        qpos: wp.array2d[float],
        qvel: wp.array2d[float],
        act: wp.array2d[float],
        reference: wp.array2d[wp.vec3],
        motion: wp.array2d[wp.spatial_vector],
        elements: wp.array2d[float],
        servo: wp.array2d[float],
        smooth: wp.array2d[float],
    ):
        world = wp.tid()
        inertia, bias = Matrix(), Vector()
        # For each joint at unit speed: its turn, and the velocity of a point at `origin`.
        turns, moves = Columns(), Columns()
        origin = pose.anchor[world, 0]
        omega, alpha, acceleration, point = wp.vec3(), wp.vec3(), wp.vec3(), wp.vec3(origin)
        for k in range(n):
            axis = pose.axis[world, k]
            anchor = pose.anchor[world, k]
            arm_to = anchor - point
            acceleration += wp.cross(alpha, arm_to) + wp.cross(omega, wp.cross(omega, arm_to))
            point = anchor
            speed = qvel[world, k] * axis
            turned = wp.cross(omega, speed)
            if arm.joint_kind[k] == _SLIDE:
                moves[k] = axis
                acceleration += 2.0 * turned
            else:
                turns[k] = axis
                moves[k] = wp.cross(axis, origin - anchor)
                alpha += turned
                omega += speed
            motion[world, k] = wp.spatial_vector(turns[k], moves[k])
            for at in range(arm.first_body[k], arm.first_body[k + 1]):
                body = arm.bodies[at]
                mass = arm.mass[world % arm.mass.shape[0], body]
                frame = pose.frame[world, body]
                tensor = (
                    frame
                    * wp.diag(arm.inertia[world % arm.inertia.shape[0], body])
                    * wp.transpose(frame)
                )
                center = pose.center[world, body]
                to = center - point
                force = mass * (
                    acceleration + wp.cross(alpha, to) + wp.cross(omega, wp.cross(omega, to))
                )
                torque = tensor * alpha + wp.cross(omega, tensor * omega)
                for i in range(k + 1):
                    move = moves[i] + wp.cross(turns[i], center - origin)
                    bias[i] = bias[i] + wp.dot(move, force) + wp.dot(turns[i], torque)
                    for j in range(i + 1):
                        other = moves[j] + wp.cross(turns[j], center - origin)
                        inertia[i, j] = (
                            inertia[i, j]
                            + mass * wp.dot(move, other)
                            + wp.dot(turns[i], tensor * turns[j])
                        )
        reference[world, root] = origin
        for i in range(n):
            for j in range(i + 1):
                if element[i, j] >= 0:
                    own = wp.where(i == j, arm.armature[world % arm.armature.shape[0], i], 0.0)
                    elements[world, element[i, j]] = inertia[i, j] + own
            bound = arm.yield_force[world % arm.yield_force.shape[0], i]
            stiffness = arm.stiffness[world % arm.stiffness.shape[0], i]
            speed_gain = arm.speed_gain[world % arm.speed_gain.shape[0], i]
            pull = stiffness * (act[world, i] - qpos[world, i]) + speed_gain * qvel[world, i]
            servo[world, i] = wp.clamp(pull, bound[0], bound[1])
            smooth[world, i] = servo[world, i] - bias[i]

    @wp.kernel(module="unique", enable_backward=False)
    def after(
        arm: _Arm,
        element: wp.array2d[int],
        timestep: wp.array[float],
        elements: wp.array2d[float],
        servo: wp.array2d[float],
        qacc: wp.array2d[float],
        inertial_force: wp.array2d[float],
        ctrl: wp.array2d[float],
        num_rows: wp.array[int],
        num_contacts: wp.array[int],
        num_pairs: wp.array[int],
        max_rows: int,
        max_contacts: int,
        qpos: wp.array2d[float],
        qvel: wp.array2d[float],
        act: wp.array2d[float],
        time: wp.array[float],
        warmstart: wp.array2d[float],
        overflow: wp.array[int],
    ):
        world = wp.tid()
        h = timestep[world % timestep.shape[0]]
        system, right = inertia_at(elements, element, world), Vector()
        for i in range(n):
            bound = arm.yield_force[world % arm.yield_force.shape[0], i]
            if servo[world, i] > bound[0] and servo[world, i] < bound[1]:
                speed_gain = arm.speed_gain[world % arm.speed_gain.shape[0], i]
                system[i, i] = system[i, i] - h * speed_gain
            right[i] = inertial_force[world, i]
        change = solved(system, right)
        for i in range(n):
            speed = qvel[world, i] + h * change[i]
            qvel[world, i] = speed
            qpos[world, i] = qpos[world, i] + h * speed
            act[world, i] = act[world, i] + h * ctrl[world, i]
            warmstart[world, i] = qacc[world, i]
        time[world] = time[world] + h
        lost = overflow[world]
        if num_rows[world] > max_rows:
            lost = lost | _NO_ROOM_FOR_ROWS
        if num_contacts[0] > max_contacts:
            lost = lost | _NO_ROOM_FOR_CONTACTS
        if num_pairs[0] > max_contacts:
            lost = lost | _NO_ROOM_FOR_PAIRS
        overflow[world] = lost

    return before, after


class ArmDynamics:
    """Forces and time step of an arm of servos, in place of several stages of `mujoco_warp`.

    Kinematics, collisions, constraints and their solution stay outside.

    Args:
        mujoco_model: The arm: joints in one chain, each driven by the servo of its number
            (`brokk_rl.sim.model`).
        model: The same on the device.
        data: Worlds of the model.
    """

    def __init__(self, mujoco_model: mujoco.MjModel, model: mjw.Model, data: mjw.Data) -> None:
        last_dof = np.array(
            [_find_last_dof(mujoco_model, body) for body in range(mujoco_model.nbody)]
        )
        bodies = np.argsort(last_dof, kind="stable")
        bodies = bodies[last_dof[bodies] >= 0]
        arm, pose = _Arm(), _Pose()
        arm.joint_kind, arm.armature, arm.mass, arm.inertia = (
            model.jnt_type,
            model.dof_armature,
            model.body_mass,
            model.body_inertia,
        )
        device = data.qpos.device
        arm.stiffness = _view_parameter(model.actuator_gainprm, 0)
        arm.speed_gain = _view_parameter(model.actuator_biasprm, 2)  # minus damping
        arm.yield_force = model.actuator_forcerange
        arm.bodies = wp.array(bodies, dtype=int, device=device)
        first = np.searchsorted(last_dof[bodies], np.arange(mujoco_model.nv + 1))
        arm.first_body = wp.array(first, dtype=int, device=device)
        pose.axis, pose.anchor, pose.center, pose.frame = (
            data.xaxis,
            data.xanchor,
            data.xipos,
            data.ximat,
        )
        root = int(mujoco_model.body_rootid[bodies[0]])
        state = [data.qpos, data.qvel, data.act]
        servo, inertia = data.actuator_force, data.M
        counts = [data.nefc, data.nacon, data.ncollision, data.njmax, data.naconmax]
        self._before = [arm, pose, model.M_elemid, root, *state]
        # contact Jacobians measure `cdof` from `subtree_com` of the root: any point near will do
        self._before += [data.subtree_com, data.cdof, inertia, servo, data.qfrc_smooth]
        self._after = [
            arm,
            model.M_elemid,
            model.opt.timestep,
            inertia,
            servo,
            data.qacc,
            data.efc.Ma,
            data.ctrl,
            *counts,
        ]
        self._after += [*state, data.time, data.qacc_warmstart, data.overflow]
        self._kernels, self._num_worlds = _compile_kernels(model.nv), data.nworld

    def before_contacts(self) -> None:
        """Compute `cdof`, `M` and `qfrc_smooth` for collisions and solver."""
        wp.launch(self._kernels[0], self._num_worlds, self._before, block_dim=_BLOCK)

    def after_contacts(self) -> None:
        """Advance the state by a substep with the accelerations found."""
        wp.launch(self._kernels[1], self._num_worlds, self._after, block_dim=_BLOCK)


def _view_parameter(parameters: wp.array, index: int) -> wp.array:
    """Return one number of each vector of an array `(N, J)` of vectors, without a copy."""
    assert parameters.ptr is not None
    size = wp.types.type_size_in_bytes(wp.float32)
    return wp.array(
        ptr=parameters.ptr + index * size,
        dtype=wp.float32,
        shape=parameters.shape,
        strides=parameters.strides,
        device=parameters.device,
    )


def _find_last_dof(model: mujoco.MjModel, body: int) -> int:
    """Return the last degree of freedom that moves `body`, -1 for none."""
    welded = model.body_weldid[body]
    return (
        int(model.body_dofadr[welded] + model.body_dofnum[welded] - 1)
        if model.body_dofnum[welded]
        else -1
    )
