"""The end of a step of an implicit method, as a function that is differentiated and evaluated well.

Place in the pipeline: newton -> **implicit_step** -> generalised_alpha.

Derivatives are those of the solution of a step's equations, not of the corrections that find it; they
are found by corrections with Newton's matrix, as many as the accuracy of the loads asks for.

A method gives: `solve(constants, *given)`: unknowns and the step's end; `end_of_step(unknowns, constants,
*given)`: what is left over, and the end if that is nothing; `end_by_wrenches`: the end with given wrenches;
`guess`, `matrix`, `refinements`.  Constants are the links' operators, time, step length and largest load; given
are conditions, trajectory and memory.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rfem_jax.compilation.scalars import in_scalars, nothing_known
from rfem_jax.compilation.whole_loops import implicit_in_scalars
from rfem_jax.mechanics import condensation
from rfem_jax.mechanics.newton import Correction, correction, correction_and_wrenches, residual_of
from rfem_jax.simulation import equations

SOLUTION = "solution of an implicit step"  # what reverse mode keeps of a step


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def solved_step(method, constants, *given):
    """Trajectory and memory at the end of a step."""
    return _solve(method, constants, *given)[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _unknowns(method, constants, *given):
    return _solve(method, constants, *given)[0]


@functools.partial(jax.jit, static_argnums=0)
def _solve(method, constants, *given):
    """Newton's method; jitted, so that transformations of the loops around it trace it once."""
    if not implicit_in_scalars():
        return method.solve(constants, *given)
    zeros = _zeros_of_constants(constants, given[0]), *_zeros_of(given)
    return in_scalars(method.solve, zeros)(constants, *given)


def _differentiate(method, primals, tangents):
    constants, *given = primals
    inputs, fixed, along = equations.moving_parts(given, list(tangents[1:]))
    # With the solution at hand, reverse mode need not repeat Newton's method.
    solution = jax.tree.map(
        lambda x: checkpoint_name(x, SOLUTION), _unknowns(method, constants, *given)
    )
    return _end_and_tangent(method, constants, solution, inputs, fixed, along)


def _differentiate_unknowns(method, primals, tangents):
    ends = _differentiate(method, primals, tangents)
    return tuple(Correction(end.accelerations, end.multipliers) for _, end in ends)


solved_step.defjvp(_differentiate, symbolic_zeros=True)
_unknowns.defjvp(_differentiate_unknowns, symbolic_zeros=True)


@functools.partial(jax.jit, static_argnums=0)
def _end_and_tangent(method, constants, solution, inputs, fixed, along):
    """The end of a step with given unknowns, and its derivative along a change of the inputs."""
    arguments = constants, solution, inputs, fixed, along
    evaluate = functools.partial(_corrected_tangent, method)
    if not implicit_in_scalars():
        return evaluate(*arguments)
    given = eqx.combine(inputs, fixed)
    moves = jax.tree.map(lambda x: x is not None, inputs, is_leaf=lambda x: x is None)
    of_inputs, of_fixed = eqx.partition(_zeros_of(given), moves)
    of_constants, of_solution = _zeros_of_constants(constants, given[0]), nothing_known(solution)
    return in_scalars(evaluate, (of_constants, of_solution, of_inputs, of_fixed, of_inputs))(*arguments)


def _corrected_tangent(method, constants, solution, inputs, fixed, along):
    """By corrections of the tangents, with one linearisation at the solution."""

    def at(unknowns, inputs):
        left, end = method.end_of_step(unknowns, constants, *eqx.combine(inputs, fixed))
        return (residual_of(left), end), left

    def guess(inputs):
        return method.guess(constants, *eqx.combine(inputs, fixed))

    (_, end), push, left = jax.linearize(at, solution, inputs, has_aux=True)
    given = eqx.combine(inputs, fixed)
    topology = given[0].realised.topology
    # Newton's matrix: XLA sees that it is there already; reverse mode forms it without Newton's method.
    at_guess, _ = method.end_of_step(method.guess(constants, *given), constants, *given)
    matrix = method.matrix(constants, given[0], at_guess)

    def refine(found, _):
        left_over, _ = push(found, along)
        return jax.tree.map(jnp.add, found, correction(topology, matrix, left_over)), None

    found = jax.jvp(guess, (inputs,), (along,))[1]
    if method.refinements > 1:
        found, _ = jax.lax.scan(refine, found, None, length=method.refinements - 1)
    left_over, end_tangent = push(found, along)

    # What the last correction changes of the loads follows from the matrix, too, with errors of the size of
    # those that the correction leaves; to evaluate it costs half as much again.
    def last(wrenches, unknowns):
        return method.end_by_wrenches(wrenches, unknowns, left, constants, *given)

    change, wrenches = correction_and_wrenches(topology, matrix, left_over)
    tree_joints = list(left.wrenches[: topology.n_links])
    more = jax.jvp(last, (tree_joints, solution), (wrenches, change))[1]
    return _alike_batched(end, solution), jax.tree.map(jnp.add, end_tangent, more)


def _alike_batched(end, solution):
    """The end of a step with the batch axes of the solution also where nothing depends on it: JAX takes the
    axes of the value for those of this rule, and Newton's loop gives them to all."""
    nothing = solution.accelerations.angles[0] - solution.accelerations.angles[0]

    def independent(end):
        trajectory, (*_, rates, instant) = end
        of_instant = instant.drift, instant.drift_angle, instant.arm, instant.stabilising, instant.multiplier
        return trajectory.integrals.work, rates.work, *of_instant

    return eqx.tree_at(independent, end, replace_fn=lambda x: x + nothing)


def _zeros_of(given):
    """Entries of conditions, trajectory and memory that are zero for all numbers."""
    conditions, *others = given
    return [equations.structural_zeros(conditions), *nothing_known(others)]


def _zeros_of_constants(constants, conditions):
    topology = conditions.realised.topology
    if topology.exact:
        return nothing_known(constants)
    return condensation.structural_zeros(topology), *nothing_known(constants[1:])
