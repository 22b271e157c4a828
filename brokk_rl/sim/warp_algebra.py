# pyright: reportInvalidTypeForm=false
# (sizes of vectors and matrices are known only at run time, so that their types are values)
"""Vectors and matrices over a machine's joints inside Warp kernels; those of five joints stay in a thread's registers."""

import functools
from typing import Any, NamedTuple

import warp as wp

MAX_DOFS = 16
"""Up to here Warp unrolls the loops over degrees of freedom; beyond, a solver for any size is the
better one."""


class Algebra(NamedTuple):
    """Types and functions for one number of degrees of freedom; a kernel takes from it what it needs.

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
def algebra(num_dofs: int) -> Algebra:
    """Returns the types and functions for `num_dofs` degrees of freedom."""
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

    return Algebra(Vector, Matrix, inertia_at, solved)
