"""The end of a step of an implicit method, as a function that is differentiated and evaluated well.

Place in the pipeline: newton -> **implicit_step** -> generalised_alpha.

Derivatives are those of the solution of a step's equations (implicit function theorem), not of the
corrections that find it; they are found by corrections with Newton's matrix, as many as the accuracy of the
loads asks for (theory (7.17) to (7.20)).  What these leave over is seen in the derivative of `Run.equation_residual`.

A method gives: `matrix(operators, constants, *given)`; `solve(constants, *given)`: the step's end;
`end_of_step(unknowns, constants, *given)`: residual, and the end if that is nothing; `end_by_wrenches`: the
end with given wrenches; `guess`, `refinements`.  Constants are Newton's matrix, time, step length and largest
load; given are conditions, trajectory and memory.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rfem_jax.mechanics.newton import Correction, correction, correction_and_wrenches, residual_of
from rfem_jax.simulation import equations
from rfem_jax.simulation.batches import like_batched

SOLUTION = "solution of an implicit step"  # what reverse mode keeps of a step


@functools.partial(jax.jit, static_argnums=0)
def form_matrix(method, operators, constants, *given):
    """Newton's matrix of a step; jitted, so that transformations of the loops around it trace it once."""
    return method.matrix(operators, constants, *given)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def solved_step(method, constants, *given):
    """Trajectory and memory at the end of a step."""
    end = _solve(method, constants, *given)
    return like_batched(end, end[1].accelerations.angles)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _unknowns(method, constants, *given):
    _, memory = _solve(method, constants, *given)
    return Correction(memory.accelerations, memory.multipliers)


@functools.partial(jax.jit, static_argnums=0)
def _solve(method, constants, *given):
    """Newton's method."""
    return method.solve(constants, *given)


def _differentiate(method, primals, tangents):
    constants, *given = primals
    inputs, fixed, along = equations.moving_parts(given, list(tangents[1:]))
    # With the solution at hand, reverse mode need not repeat Newton's method.
    solution = jax.tree.map(
        lambda x: checkpoint_name(x, SOLUTION), _unknowns(method, constants, *given)
    )
    end, tangent = _end_and_tangent(method, constants, solution, inputs, fixed, along)
    return like_batched(end, solution.accelerations.angles), tangent


def _differentiate_unknowns(method, primals, tangents):
    ends = _differentiate(method, primals, tangents)
    return tuple(Correction(end.accelerations, end.multipliers) for _, end in ends)


solved_step.defjvp(_differentiate, symbolic_zeros=True)
_unknowns.defjvp(_differentiate_unknowns, symbolic_zeros=True)


@functools.partial(jax.jit, static_argnums=0)
def _end_and_tangent(method, constants, solution, inputs, fixed, along):
    """The end of a step with given unknowns, and its derivative along a change of the inputs."""
    return _corrected_tangent(method, constants, solution, inputs, fixed, along)


def _corrected_tangent(method, constants, solution, inputs, fixed, along):
    """By corrections of the tangents, with one linearisation at the solution."""

    def at(unknowns, inputs):
        left, end = method.end_of_step(unknowns, constants, *eqx.combine(inputs, fixed))
        return (residual_of(left), end), left

    def guess(inputs):
        return method.guess(constants, *eqx.combine(inputs, fixed))

    (_, end), push, left = jax.linearize(at, solution, inputs, has_aux=True)
    given, matrix = eqx.combine(inputs, fixed), constants[0]
    topology = given[0].realised.topology

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
    return end, jax.tree.map(jnp.add, end_tangent, more)
