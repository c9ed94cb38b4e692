"""Parts of rules of differentiation: which inputs are differentiated, and the derivatives of implicit functions.

Place in the pipeline: **derivative_rules** -> statics, simulation.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

Tree = TypeVar("Tree")


def active_inputs(primals: Tree, tangents: Tree) -> tuple[Tree, Tree, Tree]:
    """Divide the arguments of a rule of `jax.custom_jvp` by whether they are differentiated.

    Most constants of a mechanism do not depend on the errors that a derivative is taken by, and need not be
    linearised.

    **Arguments:** `tangents`: a tree like `primals`, with `SymbolicZero` where there is no tangent.

    **Returns:** the leaves with a tangent, the other leaves, and the tangents; None in the other places.
    """
    moves = jax.tree.map(lambda x, dx: eqx.is_inexact_array(x) and not isinstance(dx, SymbolicZero), primals, tangents)
    inputs, fixed = eqx.partition(primals, moves)
    return inputs, fixed, eqx.filter(tangents, moves)


def implicit_function(
    equations: Callable[[Float[Array, " n"], Any], Float[Array, " n"]],
    solve: Callable[[Callable, Float[Array, " n"], Any, Float[Array, " n"]], Float[Array, " n"]],
    found: Float[Array, " n"],
    inputs: Any,
) -> Float[Array, " n"]:
    """Unknowns at which equations vanish, with their derivatives by the inputs: those of the implicit function.

    As `jax.lax.custom_root`, but no derivative is traced where none is taken.

    **Arguments:** `equations`: (unknowns, inputs) -> residual; `solve`: (linear function, value, inputs, unknowns) ->
    x for which the linear function is the value; `found`: the unknowns, without derivatives; `inputs`: a tree, with
    everything that is differentiated and that `equations` and `solve` depend on.
    """
    leaves, structure = jax.tree.flatten(inputs)  # the things of a description cannot hold masks in their places
    arrays, static = eqx.partition(leaves, eqx.is_array)

    @jax.custom_jvp
    def unknowns(found, arrays):
        return found

    @functools.partial(unknowns.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        at = unknowns(*primals)
        moving, fixed, along = active_inputs(primals[1], tangents[1])
        if not jax.tree.leaves(moving):
            return at, jnp.zeros_like(at)

        @jax.jit
        def residual(at, moving):
            return equations(at, structure.unflatten(eqx.combine(moving, fixed, static)))

        change = jax.jvp(lambda moving: residual(at, moving), (moving,), (along,))[1]
        # Jitted, so that all its places in the solution are traced, batched and transposed once.
        linear = jax.jit(jax.linearize(lambda at: residual(at, moving), at)[1])
        constant = jax.lax.stop_gradient((eqx.combine(moving, fixed), at))
        return at, -solve(linear, change, structure.unflatten(eqx.combine(constant[0], static)), constant[1])

    return unknowns(found, arrays)
