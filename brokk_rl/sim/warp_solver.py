# Kernels are written in Warp's own subset of Python, whose types a type checker does not know.
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportReturnType=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
"""Contact solver of the Warp worlds: a world's whole problem in one launch.

MuJoCo finds the acceleration x that minimises a convex cost (MuJoCo documentation, Computation,
"Constraint solver" and "Primal problem"; Todorov, "Convex and analytically-invertible dynamics with
contacts and constraints", ICRA 2014):

    ½ (x - x₀)ᵀ M (x - x₀) + Σ s(J x - a)        x₀ = M⁻¹ f, the acceleration without constraints

One term of the sum is a joint limit or a contact: a limit costs ½ D r² while its residual r = J x -
a is negative; a contact has a residual along its normal and two along its surface, and an elliptic
cone divides their space into three zones (`_cone`). Newton's method with a line search along each
step finds the minimum in a few iterations.

An arm has a handful of joints and contacts, so that the solver of `mujoco_warp`, made for any size,
spends its time on launching a dozen kernels an iteration. Here a warp of 32 threads solves a world:
each thread takes a constraint and all share the sums.
"""

# (sizes of vectors and matrices are known only at run time, so that their types are values)

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from brokk_rl.sim.warp_dynamics import compile_algebra

NUM_LANES = 32
"""Threads a world. A block that is one warp sums without waiting; an arm has fewer constraints than
that."""

_SLOPE_LEFT = wp.constant(0.01)
"""The line search ends where the slope is this part of the slope at its start."""

_FRICTIONLESS = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS))
_ELLIPTIC = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC))
# Friction that MuJoCo keeps of a contact: tangential (2), torsional, rolling (2).
_FRICTION = wp.types.vector(5, wp.float32)


@wp.struct
class ConstraintRows:
    """Constraint rows of all worlds as `mujoco_warp.make_constraint` leaves them.

    The three rows of a contact follow each other.

    Attributes:
        num_rows: Rows of each world that are wanted; there may be room for fewer.
        kind: `mjtConstraint` of each row.
        contact: Number of each row's contact, where it is of one.
        first_row: First row of each contact, in column 0.
        friction: Of each contact.
        jacobian: J.
        stiffness: D.
        target: The acceleration a that each row wants.
        force: Written: the force of each row.
    """

    num_rows: wp.array[int]
    kind: wp.array2d[int]
    contact: wp.array2d[int]
    first_row: wp.array2d[int]
    friction: wp.array[_FRICTION]
    jacobian: wp.array3d[float]
    stiffness: wp.array2d[float]
    target: wp.array2d[float]
    force: wp.array2d[float]


@wp.func
def _count_rows(constraints: ConstraintRows, world: int, row: int, num_rows: int) -> int:
    """Return the number of rows of the constraint that begins at `row`: 0 if none begins there."""
    if constraints.kind[world, row] != _ELLIPTIC:
        return 1
    if constraints.first_row[constraints.contact[world, row], 0] == row and row + 3 <= num_rows:
        return 3
    return 0


@wp.func
def _evaluate_cone(
    residual: wp.vec3, stiffness: wp.vec3, mu: float, friction: wp.vec2
) -> tuple[wp.vec3, wp.mat33]:
    """Return the force -∂s/∂r of a constraint and the curvature ∂²s/∂r² of its cost.

    With t the length of the tangential residual, each part times its friction, and n the normal
    one, a contact that separates (n ≥ t) costs nothing; one that sticks (μ² n + t ≤ 0) costs ½ Σ D
    r²; one that slides, between them, ½ c (n - t)² with c = D / (1 + μ²), whose curvature is that
    of (n - t) and that of the length t, which bends across the direction of sliding.
    A single row has neither friction nor tangents: t = μ = 0.
    """
    u, v = friction[0] * residual[1], friction[1] * residual[2]
    length = wp.sqrt(u * u + v * v)
    depth = residual[0] - length
    if depth >= 0.0:
        return wp.vec3(0.0), wp.mat33(0.0)
    if mu * mu * residual[0] + length <= 0.0:
        return -wp.cw_mul(stiffness, residual), wp.diag(stiffness)
    c = stiffness[0] / (1.0 + mu * mu)
    u, v = u / length, v / length
    gradient = wp.vec3(1.0, -friction[0] * u, -friction[1] * v)
    across = wp.vec3(0.0, -friction[0] * v, friction[1] * u)
    curvature = wp.outer(gradient, gradient) - (depth / length) * wp.outer(across, across)
    return -c * depth * gradient, c * curvature


@functools.cache
def _compile_solver(num_dofs: int) -> wp.Kernel:
    """Return the solver's kernel for `num_dofs` degrees of freedom."""
    n = num_dofs
    Vector, Matrix, inertia_at, solved = compile_algebra(n)
    Rows = wp.types.matrix((3, n), wp.float32)
    System = wp.types.matrix((n, n + 1), wp.float32)

    @wp.func
    def system(matrix: Matrix, right: Vector) -> System:
        """Return `[matrix | right]`, so that both are summed at once."""
        joined = System()
        for i in range(n):
            for j in range(n):
                joined[i, j] = matrix[i, j]
            joined[i, n] = right[i]
        return joined

    @wp.func
    def rows_at(
        constraints: ConstraintRows, world: int, row: int, span: int
    ) -> tuple[Rows, wp.vec3, wp.vec3]:
        """Return Jacobian, target and stiffness of a constraint, zeros below a single row."""
        jacobian, target, stiffness = Rows(), wp.vec3(), wp.vec3()
        for i in range(3):
            if i < span:
                for j in range(n):
                    jacobian[i, j] = constraints.jacobian[world, row + i, j]
                target[i] = constraints.target[world, row + i]
                stiffness[i] = constraints.stiffness[world, row + i]
        return jacobian, target, stiffness

    @wp.func
    def friction_at(constraints: ConstraintRows, world: int, row: int, span: int) -> wp.vec2:
        if span == 1:
            return wp.vec2()
        friction = constraints.friction[constraints.contact[world, row]]
        return wp.vec2(friction[0], friction[1])

    @wp.func
    def expansion(
        constraints: ConstraintRows,
        world: int,
        lane: int,
        num_rows: int,
        cone_width: float,
        x: Vector,
    ) -> System:
        """Write the forces at x; return this thread's part of `[Hessian | gradient]`."""
        total = System()
        for row in range(lane, num_rows, wp.block_dim()):
            span = _count_rows(constraints, world, row, num_rows)
            if span > 0:
                jacobian, target, stiffness = rows_at(constraints, world, row, span)
                friction = friction_at(constraints, world, row, span)
                force, curvature = _evaluate_cone(
                    jacobian * x - target, stiffness, cone_width * friction[0], friction
                )
                for i in range(3):
                    if i < span:
                        constraints.force[world, row + i] = force[i]
                turned = wp.transpose(jacobian)
                total += system(turned * curvature * jacobian, -(turned * force))
        return total

    @wp.func
    def slope(
        constraints: ConstraintRows,
        world: int,
        lane: int,
        num_rows: int,
        cone_width: float,
        x: Vector,
        step: Vector,
        alpha: float,
    ) -> wp.vec2:
        """Return this thread's part of the first and second derivative of the cost along `step`."""
        total = wp.vec2()
        for row in range(lane, num_rows, wp.block_dim()):
            span = _count_rows(constraints, world, row, num_rows)
            if span > 0:
                jacobian, target, stiffness = rows_at(constraints, world, row, span)
                friction = friction_at(constraints, world, row, span)
                along = jacobian * step
                residual = jacobian * x - target + alpha * along
                force, curvature = _evaluate_cone(
                    residual, stiffness, cone_width * friction[0], friction
                )
                total += wp.vec2(-wp.dot(force, along), wp.dot(along, curvature * along))
        return total

    @wp.func
    def searched(
        constraints: ConstraintRows,
        world: int,
        lane: int,
        num_rows: int,
        cone_width: float,
        x: Vector,
        step: Vector,
        start: float,
        bend: float,
        descent: float,
        num_searches: int,
    ) -> float:
        """Return the length of step with the least cost: bracketed Newton's method on the slope.

        The cost is convex along the step.

        Without constraints the slope is `start` + length `bend`; with them it begins at -`descent`.
        """
        # Plain literals would be constants to Warp.
        low, high, alpha = wp.float32(0.0), wp.float32(wp.inf), wp.float32(1.0)
        for _ in range(num_searches):
            part = slope(constraints, world, lane, num_rows, cone_width, x, step, alpha)
            sums = wp.tile_reduce(wp.add, wp.tile(part, preserve_type=True))[0]
            first, second = sums[0] + start + alpha * bend, sums[1] + bend
            if wp.abs(first) <= _SLOPE_LEFT * descent:
                break
            if first < 0.0:
                low = alpha
            else:
                high = alpha
            alpha = alpha - first / second
            if alpha <= low or alpha >= high:
                alpha = 0.5 * (low + high)
        return alpha

    @wp.kernel(module="unique", enable_backward=False)
    def solver(
        elements: wp.array2d[float],
        element: wp.array2d[int],
        force: wp.array2d[float],
        warmstart: wp.array2d[float],
        constraints: ConstraintRows,
        cone_width: wp.array[float],
        tolerance: wp.array[float],
        num_iterations: int,
        num_searches: int,
        qacc: wp.array2d[float],
        inertial_force: wp.array2d[float],
        constraint_force: wp.array2d[float],
        iterations: wp.array[int],
        peak: wp.array[float],
    ):
        world, lane = wp.tid()
        inertia = inertia_at(elements, element, world)
        smooth, x, residual, gradient = Vector(), Vector(), Vector(), Vector()
        for i in range(n):
            smooth[i] = force[world, i]
            x[i] = warmstart[world, i]
        num_rows = wp.min(constraints.num_rows[world], constraints.kind.shape[1])
        width = cone_width[world % cone_width.shape[0]]
        bound = tolerance[world % tolerance.shape[0]] * wp.trace(inertia)
        taken = wp.int32(0)
        if num_rows == 0:
            x = solved(inertia, smooth)
        else:
            for _ in range(num_iterations + 1):
                part = expansion(constraints, world, lane, num_rows, width, x)
                problem = wp.tile_reduce(wp.add, wp.tile(part, preserve_type=True))[0]
                residual = inertia * x - smooth
                hessian = Matrix(inertia)
                for i in range(n):
                    for j in range(n):
                        hessian[i, j] = hessian[i, j] + problem[i, j]
                    gradient[i] = residual[i] + problem[i, n]
                step = -solved(hessian, gradient)
                descent = -wp.dot(gradient, step)
                if wp.length(gradient) < bound or 0.5 * descent < bound or taken == num_iterations:
                    break
                start, bend = wp.dot(residual, step), wp.dot(step, inertia * step)
                alpha = searched(
                    constraints,
                    world,
                    lane,
                    num_rows,
                    width,
                    x,
                    step,
                    start,
                    bend,
                    descent,
                    num_searches,
                )
                x += alpha * step
                taken += 1
            normal = wp.float32(0.0)
            for row in range(lane, num_rows, wp.block_dim()):
                if (
                    constraints.kind[world, row] >= _FRICTIONLESS
                    and _count_rows(constraints, world, row, num_rows) > 0
                ):
                    normal += constraints.force[world, row]
            pressure = wp.tile_reduce(wp.add, wp.tile(normal))[0]
            if lane == 0:
                peak[world] = wp.max(peak[world], pressure)
        if lane == 0:
            moved = inertia * x
            for i in range(n):
                qacc[world, i] = x[i]
                inertial_force[world, i] = moved[i]
                constraint_force[world, i] = residual[i] - gradient[i]
            iterations[world] = taken

    return solver


class ContactSolver:
    """Solver for joint limits and contacts without torsional friction.

    Replaces `mujoco_warp.solve`.

    Args:
        model: Gives the degrees of freedom and the options `iterations`, `ls_iterations` and
            `tolerance`.
        data: Worlds of the model.
        peak: Raised to the sum of the normal forces of each world's contacts, `(N,)`, in newtons;
            MuJoCo C's touch sensors agree.
    """

    def __init__(self, model: mjw.Model, data: mjw.Data, peak: wp.array) -> None:
        rows, contact = data.efc, data.contact
        constraints = ConstraintRows()
        constraints.num_rows, constraints.kind, constraints.contact = data.nefc, rows.type, rows.id
        constraints.first_row, constraints.friction = contact.efc_address, contact.friction
        constraints.jacobian, constraints.stiffness, constraints.target = rows.J, rows.D, rows.aref
        constraints.force = rows.force
        option = model.opt
        self._kernel, self._num_worlds = _compile_solver(model.nv), data.nworld
        self._inputs = [
            data.M,
            model.M_elemid,
            data.qfrc_smooth,
            data.qacc_warmstart,
            constraints,
            option.impratio_invsqrt,
        ]
        self._inputs += [option.tolerance, option.iterations, option.ls_iterations]
        self._outputs = [data.qacc, rows.Ma, data.qfrc_constraint, data.solver_niter, peak]

    def __call__(self) -> None:
        """Find the accelerations and forces of all worlds."""
        wp.launch_tiled(
            self._kernel,
            dim=self._num_worlds,
            inputs=self._inputs,
            outputs=self._outputs,
            block_dim=NUM_LANES,
        )
