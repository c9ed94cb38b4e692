"""Closing the loops of a mechanism whose numbers are traced, at the start, all links undeformed.

Place in the pipeline: kinematics, cut_joints -> **start_closure** -> designs.

The unknowns z are changes of the joint coordinates from the nominal start, but of those that are held or sprung. They
solve (theory (14.3))

    J^T Phi(z, p) + P0 z = 0,    P0 = 1 - J0^+ J0,

with the Jacobian J of the closure equations Phi: the loops are closed as far as they can be, and what they leave free
stays at the nominal start, to whose Jacobian J0 the projector P0 belongs.  Newton's method follows the geometry p from
the nominal one, so that the mechanism stays on its branch; derivatives are those of the implicit function, with J held
(theory (14.5)).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.derivative_rules import implicit_function
from rfem_jax.mechanics.algebra.vectors import pseudo_inverse, solve_equations
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.kinematics.cut_joints import Closure, closure
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Coordinates, Model, length_scale
from rfem_jax.mechanics.model.orientations import moved
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import apply_errors

STEPS = 8  # in which the geometry goes from the nominal one to that of the design
ITERATIONS = 60
TOLERANCE = 1e-11  # of the last step of Newton's method, whose convergence is quadratic
LARGEST_STEP = 0.5
RANK_TOLERANCE = 1e-10


class ClosedStart(NamedTuple):
    """joints: position of the tree joints; cut_angles [rad]; gap [m]: what the loops stay open by."""

    joints: Float[Array, " numbers"]
    cut_angles: Float[Array, " cuts"]
    gap: Float[Array, ""]


def close_start(nominal: Model, made: Model) -> ClosedStart:
    """Start values that close the loops of a model.

    **Arguments:** `nominal`: a model of the same structure that is closed; `made`: the model, whose start has its own
    held values and else the nominal ones.
    """
    free, onto = _free_coordinates(nominal.topology)
    scale = length_scale(nominal)
    units = jnp.where(np.array(nominal.topology.slides, dtype=bool)[free], scale, 1.0)

    def closed(z: Float[Array, " free"], model: Model, units: Float[Array, " free"]) -> tuple[Coordinates, Closure]:
        change = Coordinates((z * units) @ onto, jnp.zeros((6, model.topology.n_rfes)))
        position = moved(model.topology, model.start_coordinates(), change)
        return position, _closure_at(model, position)

    def residual(z: Float[Array, " free"], model: Model) -> Float[Array, " constraints"]:
        return closed(z, model, units)[1].residual / scale

    # The search is not differentiated: its derivatives are those of the implicit function, taken at its result.
    one, other = jax.lax.stop_gradient((nominal, made))
    found, matrix, kept = _follow(residual, len(free), one, other)

    def equations(z, inputs):
        model, units, scale, matrix, kept = inputs
        return matrix.T @ closed(z, model, units)[1].residual / scale + kept @ z

    def solve(linear, value, inputs, z):
        del inputs, z
        return solve_equations(jax.vmap(linear, out_axes=1)(jnp.eye(value.shape[0])), value)

    z = implicit_function(equations, solve, found, (made, units, scale, matrix, kept))
    position, now = closed(z, made, units)
    return ClosedStart(position.joints, now.angle, jnp.max(jnp.abs(now.residual)))


def _free_coordinates(topology: Topology) -> tuple[np.ndarray, np.ndarray]:
    """The joint coordinates that closing changes, and the matrix (free, F) that puts them among all."""
    fixed = {*topology.held_at_start, *topology.sprung_coordinates} - {*topology.idle}
    free = np.array([k for k in range(topology.n_freedoms) if k not in fixed], dtype=int)
    return free, (free[:, None] == np.arange(topology.n_freedoms)).astype(float)


def _closure_at(model: Model, position: Coordinates) -> Closure:
    """The closure equations of the undeformed mechanism at a position."""
    # Ideal couplings stay: where their offset is that of the start, both coordinates keep theirs.
    bare = replace(model, forces=None, frame_forces=None, friction=None, line_loads=None)
    actual = apply_errors(bare, assembly_errors(bare))
    found = closure(actual, motion_of(actual, loads.static_state(model.topology, position)), length_scale(model))
    assert found is not None, "there are loops"
    return found


def _follow(
    residual: Callable[[Array, Model], Array], size: int, one: Model, other: Model
) -> tuple[Float[Array, " free"], Float[Array, "constraints free"], Float[Array, "free free"]]:
    """Newton's method while the geometry goes from one model's to the other's: the unknowns, zero where it fails; the
    Jacobian there; the projector P0."""

    def going_on(carry):
        z, *_, count, last = carry
        return ~last & jnp.all(jnp.isfinite(z)) & (count < ITERATIONS)

    def improve(carry):
        z, _, kept, largest, count, _ = carry
        # First at the nominal start, which gives the projector; in the end once more, at the result.
        share, last = jnp.minimum(count.astype(jnp.float64) / STEPS, 1.0), largest <= TOLERANCE
        model = jax.tree.map(lambda a, b: jnp.where(share < 1.0, a + share * (b - a), b), one, other)
        value, push = jax.linearize(lambda z: residual(z, model), z)
        matrix = jax.vmap(push, out_axes=1)(jnp.eye(size))
        of_start = jnp.eye(size) - pseudo_inverse(matrix, RANK_TOLERANCE) @ matrix
        kept = jnp.where(count == 0, of_start, kept)
        step = solve_equations(matrix.T @ matrix + kept, matrix.T @ value + kept @ z)
        largest = jnp.max(jnp.abs(step), initial=0.0)
        step = jnp.where(last, 0.0, step * jnp.minimum(1.0, LARGEST_STEP / jnp.maximum(largest, LARGEST_STEP)))
        return z - step, matrix, kept, jnp.where(share < 1.0, jnp.inf, largest), count + 1, last

    rows = jax.eval_shape(residual, jnp.zeros(size), other).shape[0]
    start = jnp.zeros(size), jnp.zeros((rows, size)), jnp.eye(size)
    carry = (*start, jnp.asarray(jnp.inf), jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    z, matrix, kept, *_ = jax.lax.while_loop(going_on, improve, carry)
    good = jnp.all(jnp.isfinite(z)) & jnp.all(jnp.isfinite(matrix))
    return jnp.where(good, z, 0.0), jnp.where(good, matrix, 0.0), jnp.where(good, kept, jnp.eye(size))
