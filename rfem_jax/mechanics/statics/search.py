"""Newton's method for static equations, and the solution of the linear ones in their derivatives.

Place in the pipeline: tangent -> **search** -> assembly.

Convergence: the residual of a slender beam does not go below EA/Delta times the rounding of
positions, far above any fixed fraction of its bending forces (EI/L^2), while the positions that it
stands for are known to their last digits. So the Newton step is judged, relative to length and
radian, and every residual relative to what a step of that size would change of it (its own row of
the Jacobian; theory (6.2)).

Where recursion over the links gives a preconditioner of the Jacobian, the linear equations are solved by
iterative refinement with it.  Only where that does not converge is the Jacobian itself formed, in a loop
that is not entered otherwise: a batch pays for it only if one of its samples needs it.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.model.model import Coordinates

TOLERANCE = 1e-10
SMALLEST_SINGULAR_VALUE = 1e-12  # of equations whose entries are of size one
ABSENT = 1e-9  # entries of equations in units of the mechanism below which these say nothing
BALANCING_SWEEPS = 4
MAX_ITERATIONS = 50
# With a constant matrix convergence is linear, so the last step must be down to rounding.
CHORD_TOLERANCE, CHORD_ITERATIONS = 1e-14, 30
# Of an equilibrium, in radian and lengths of the mechanism: small enough for axial forces that it brings about, which
# go with the product of two of them. What is left of it may be in no direction that does not shrink.
DISTURBANCE, RETURNED = 1e-5, 1e-8
# The adjoint variables of the multipliers are as much larger than others as springs are stiff: all digits count.
LINEAR_TOLERANCE, ADJOINT_TOLERANCE, LARGEST_LINEAR_ERROR, LINEAR_ITERATIONS = 1e-12, 1e-16, 1e-11, 40
ITERATIONS_OF_A_STEP = 15
MAX_LOAD_STEPS = 60
SMALLEST_LOAD_STEP = 1e-3
LARGEST_ROTATION_OF_A_STEP = 0.7  # rad

Linear = Callable[[Float[Array, " n"]], Float[Array, " n"]]
# Matrix, values -> unknowns.
DenseSolver = Callable[[Float[Array, "n n"], Float[Array, " n"]], Float[Array, " n"]]
# Unknowns, args and most iterations -> unknowns, whether they were found, and the last Jacobian.
Solver = Callable[[Array, Any, int], tuple[Array, Array, Array | None]]


class Equations(NamedTuple):
    """The static equations in flat unknowns: coordinates, then multipliers.

    residual: (unknowns, args) -> residual; coordinates: unknowns -> `Coordinates`; n_coordinates: how many
    of the unknowns they are; solve: (Jacobian, values) -> unknowns, of the linearised equations (not
    lineax's, which ends the whole batch where the cotangent of a failed sample is NaN).
    """

    residual: Callable[[Float[Array, " n"], Any], Float[Array, " n"]]
    coordinates: Callable[[Float[Array, " n"]], Coordinates]
    n_coordinates: int
    solve: DenseSolver


def chord(
    equations: Equations,
    preconditioner: Linear,
    rows: Float[Array, " n"],
    start: Float[Array, " n"],
    args: Any,
    with_jacobian: bool = False,
    disturbed: Bool[np.ndarray, " n"] | None = None,
) -> tuple[Float[Array, " n"], Bool[Array, ""], Float[Array, "n n"] | None, Bool[Array, ""]]:
    """Unknowns, whether the search converged, the Jacobian there if wanted, and whether the method leads back there, by
    the chord method (Newton's with a constant matrix, here `preconditioner` for its inverse), where that does not
    converge by Newton's method from the start.

    `rows`: sums of the absolute entries of the matrix by row, of an unloaded mechanism; `disturbed`: unknowns that are
    changed a little, to see whether the chord method leads back (theory (6.15)); the Jacobian is not formed if so.
    """
    n = equations.n_coordinates

    def constant(unknowns):
        value = equations.residual(unknowns, args)
        loaded = 1.0 + jnp.max(jnp.abs(unknowns[n:]), initial=0.0)
        return value, preconditioner(value), rows * loaded, None

    def search(carry, change):
        place, going_on = carry
        end, found, _ = iterate(n, place + change, CHORD_ITERATIONS, constant, ~going_on, tolerance=CHORD_TOLERANCE)
        found = found & going_on
        return (end, found), (end, found)

    changes = jnp.zeros((1, start.size))
    if disturbed is not None:
        change = DISTURBANCE * np.random.default_rng(1).uniform(-1.0, 1.0, start.size)
        changes = jnp.stack([changes[0], jnp.where(disturbed, change, 0.0)])
    # Both searches are one loop, whose body is compiled once.
    _, (ends, found) = jax.lax.scan(search, (start, jnp.ones((), bool)), changes)
    near, converged, back = ends[0], found[0], jnp.zeros((), bool)
    if disturbed is not None:
        back = found[1] & (_size((ends[1] - near)[:n]) <= RETURNED * DISTURBANCE)
    start = jnp.where(converged, near, start)
    end, converged, matrix = newton(equations, start, args, converged=converged, with_jacobian=with_jacobian and ~back)
    return end, converged, matrix, back


def solve_dense(solve: DenseSolver, linear: Linear, value: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of linear(x) = value with the dense matrix of a linear function."""
    return solve(jax.vmap(linear, out_axes=1)(_units(jnp.zeros_like(value))[0]), value)


def solve_linear(
    solve: DenseSolver, preconditioner: Linear, linear: Linear, value: Float[Array, " n"]
) -> Float[Array, " n"]:
    """`solve_dense` by iterative refinement with a preconditioner, where that converges."""

    def refined(preconditioner, tolerance):
        def solved(linear, value):
            def solution(value):
                x, found = _refine(linear, value, preconditioner, tolerance)

                def dense(_):
                    return solve_dense(solve, linear, value), jnp.ones((), bool)

                hopeless = ~jnp.all(jnp.isfinite(value))
                return jax.lax.while_loop(lambda carry: ~carry[1], dense, (x, found | hopeless))[0]

            # Never differentiated, by `custom_linear_solve`; XLA takes long to compile loops around kernels.
            return kernel(solution, name="static solution", in_parts=True)(value)

        return solved

    transposed = jax.linear_transpose(preconditioner, value)
    return jax.lax.custom_linear_solve(
        linear,
        value,
        refined(preconditioner, LINEAR_TOLERANCE),
        transpose_solve=refined(lambda value: transposed(value)[0], ADJOINT_TOLERANCE),
    )


def _refine(linear: Linear, value: Array, preconditioner: Linear, tolerance: float) -> tuple[Array, Array]:
    """Solution by iterative refinement, as long as its increments become smaller and until the next one would be
    small, and whether it is."""

    def next_is_small(tolerance, x, increment, before):
        """Increments become smaller by nearly the same factor every time."""
        return increment * increment <= tolerance * _size(x) * before

    def going_on(carry):
        *state, count = carry
        _, increment, before = state
        # The first increment sets the angles; only the second sets the coordinates that follow from these.
        shrinking = (increment < before) | (count < 3)
        return ~next_is_small(tolerance, *state) & shrinking & (count < LINEAR_ITERATIONS)

    def improve(carry):
        x, increment, _, count = carry
        change = preconditioner(value - linear(x))
        return x + change, _size(change), increment, count + 1

    first = preconditioner(value)
    carry = (first, _size(first), _size(first), jnp.ones((), jnp.int32))
    *state, _ = jax.lax.while_loop(going_on, improve, carry)
    return state[0], next_is_small(LARGEST_LINEAR_ERROR, *state)


def _size(x: Array) -> Array:
    """Largest magnitude, zero of nothing: rigid links on fixed joints have no unknowns."""
    return jnp.max(jnp.abs(x)) if x.size else jnp.zeros(())


def linearised(function: Callable, at: Array, *others: Any) -> tuple[Array, Array]:
    """Value and Jacobian of a function at one place."""
    units, (at, others) = _units(at, others)
    along = jax.vmap(lambda unit: jax.jvp(lambda x: function(x, *others), (at,), (unit,)), out_axes=(None, 1))
    return along(units)


def _units(at: Array, *others: Any) -> tuple[Array, tuple]:
    """Unit vectors as rows, and what a matrix is made from with them.  The barrier keeps the matrix in place: much of
    it is constant, and XLA would move that out of a loop that is seldom entered."""
    rows, *given = jax.lax.optimization_barrier((jnp.arange(at.size), at, *others))
    return (rows[:, None] == rows[None]).astype(at.dtype), tuple(given)


def newton(
    equations: Equations,
    start: Float[Array, " n"],
    args: Any,
    iterations: int = MAX_ITERATIONS,
    converged: bool | Bool[Array, ""] = False,
    with_jacobian: bool | Bool[Array, ""] = False,
) -> tuple[Float[Array, " n"], Bool[Array, ""], Float[Array, "n n"] | None]:
    """Unknowns after Newton's method, whether it converged, and the Jacobian before its last step if wanted; if
    `converged` is true at the start, the unknowns stay, and the Jacobian is that of the start, zeros where an array
    says that it is not wanted."""

    n = equations.n_coordinates

    def present(unknowns):
        value, jacobian = linearised(equations.residual, unknowns, args)
        size = jnp.concatenate([jnp.ones(n), 1.0 + jnp.abs(unknowns[n:])])
        return value, equations.solve(jacobian, value), jnp.abs(jacobian) @ size, jacobian

    matrix = None if with_jacobian is False else jnp.zeros((start.size, start.size))
    return iterate(n, start, iterations, present, converged, matrix=matrix, wanted=with_jacobian)


def iterate(
    n: int,
    start: Array,
    iterations: int,
    step_from: Callable[[Array], tuple[Array, Array, Array, Array | None]],
    found: bool | Array = False,
    tolerance: float = TOLERANCE,
    matrix: Array | None = None,
    wanted: bool | Array = True,
) -> tuple[Array, Array, Array | None]:
    """Unknowns, `n` of them coordinates, after steps from `step_from` (unknowns -> residual, step, by how much a step
    of size one changes the residual, and a matrix), whether they converged, and the last matrix. With a `matrix` to
    begin with, one is made even of what is `found`, where it is `wanted`.

    The last step must be small in the coordinates (multipliers follow them: their rounding is that
    of the stiffest spring), and the residual before it small in every row against the change by such a
    step of the coordinates; the latter fails where equations contradict each other.
    """

    def going_on(carry):
        unknowns, converged, count, matrix = carry
        searching = ~converged & jnp.all(jnp.isfinite(unknowns)) & (count < iterations)
        return searching if matrix is None else searching | (wanted & (count == 0))

    def improve(carry):
        unknowns, converged, count, matrix = carry
        value, step, rows, new = step_from(unknowns)
        small_step = _size(step[:n]) <= tolerance
        # Of equations that say nothing, as of out-of-plane directions, rounding is left of both sides.
        small_residual = jnp.all(jnp.abs(value) <= TOLERANCE * jnp.maximum(rows, 1.0))
        if matrix is None:
            new = None
        return (
            jnp.where(converged, unknowns, unknowns - step),
            converged | (small_step & small_residual),
            count + 1,
            new,
        )

    carry = (start, jnp.asarray(found), jnp.zeros((), jnp.int32), matrix)
    unknowns, converged, _, matrix = jax.lax.while_loop(going_on, improve, carry)
    return unknowns, converged, matrix


def load_steps(
    equations: Equations,
    start: Float[Array, " n"],
    unloaded: Any,
    loaded: Any,
    solver: Solver | None = None,
    converged: bool | Bool[Array, ""] = False,
    with_jacobian: bool = False,
) -> tuple[Float[Array, " n"], Bool[Array, ""], Float[Array, "n n"] | None]:
    """Unknowns of the equilibrium under full load, followed from the unloaded one, whether it was reached, and the
    Jacobian there if wanted, which the `solver` has to return.

    Errors, gravity and held angles grow together from zero by a share (`unloaded` and `loaded` are the args of
    the equations): all at once first; a step on which Newton's method does not converge, or changes the angles
    of an rfe by so much that the equilibrium may be another one, is halved, any other is followed by one twice
    as long. The constants of the mechanism are interpolated, so that on the way the rotations of its frames
    hold to second order in the errors only. `solver` is Newton's method unless given; nothing is done if `converged`.
    """
    solver = functools.partial(newton, equations, with_jacobian=with_jacobian) if solver is None else solver

    def going_on(carry):
        _, reached, step, count, _ = carry
        return (reached < 1.0) & (step > SMALLEST_LOAD_STEP) & (count < MAX_LOAD_STEPS)

    def advance(carry):
        unknowns, reached, step, count, matrix = carry
        share = jnp.minimum(reached + step, 1.0)
        args = jax.tree.map(lambda a, b: a + share * (b - a), unloaded, loaded)
        new, converged, of_step = solver(unknowns, args, ITERATIONS_OF_A_STEP)
        rotation = equations.coordinates(new - unknowns).elastic[3:]
        converged = converged & (jnp.max(jnp.abs(rotation), initial=0.0) < LARGEST_ROTATION_OF_A_STEP)
        return (
            jnp.where(converged, new, unknowns),
            jnp.where(converged, share, reached),
            jnp.where(converged, 2.0 * step, 0.5 * step),
            count + 1,
            None if matrix is None or of_step is None else jnp.where(converged, of_step, matrix),
        )

    one = jnp.ones(())
    matrix = jnp.zeros((start.size, start.size)) if with_jacobian else None
    carry = (start, jnp.asarray(converged, float), one, jnp.zeros((), jnp.int32), matrix)
    unknowns, reached, _, _, matrix = jax.lax.while_loop(going_on, advance, carry)
    return unknowns, reached >= 1.0, matrix


def shortest_solution(matrix: Float[Array, "n n"], value: Float[Array, " n *k"]) -> Float[Array, " n *k"]:
    """The shortest solution of equations that may leave some unknowns open, as the angle of a door without load.

    Rows and columns are scaled to largest entries of one, so that a stiff spring or a large load takes no digits of
    others; those below `ABSENT` are left as they are.
    """
    size = jnp.abs(matrix)
    rows, columns = jnp.ones(size.shape[0]), jnp.ones(size.shape[1])

    def balance(scales, largest, there):
        return jnp.where(there, scales / jnp.sqrt(jnp.where(there, largest, 1.0)), 1.0)

    in_rows, in_columns = jnp.max(size, axis=1) > ABSENT, jnp.max(size, axis=0) > ABSENT
    for _ in range(BALANCING_SWEEPS):
        scaled = rows[:, None] * size * columns[None]
        rows = balance(rows, jnp.max(scaled, axis=1), in_rows)
        columns = balance(columns, jnp.max(scaled, axis=0), in_columns)
    inverse = jnp.linalg.pinv(rows[:, None] * matrix * columns[None], rtol=SMALLEST_SINGULAR_VALUE)
    return (columns[:, None] * inverse * rows[None]) @ value
