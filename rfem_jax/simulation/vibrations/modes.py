"""Natural frequencies and modes about an assembled configuration, with derivatives.

Place in the pipeline: model, errors -> static equilibrium -> **modes** -> report.

The equations of motion are linearised about the equilibrium with its errors, preload and weight (theory (11.15)): mass,
damping and stiffness are derivatives of the residual of the equations of motion, so that whatever acts on a mechanism
is in them. Every eigenpair is the root of its equations (theory (11.16)), so that derivatives of any order follow by
the implicit function theorem (theory (11.17); R. B. Nelson, AIAA J. 14 (1976) 1201-1205); those of repeated eigenvalues
do not exist.

`vibration` is another way, for limits of the step: of the perfect mechanism, undeformed, and without loads.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.implicit.residual import evaluate_residual
from rfem_jax.mechanics.kinematics.slender_links import with_displacements
from rfem_jax.mechanics.model.errors import AssemblyErrors, Errors
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, Model, State, length_scale
from rfem_jax.mechanics.model.orientations import moved
from rfem_jax.mechanics.model.status import NO_MODES, OK
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors
from rfem_jax.mechanics.statics.assembly import checked_hold, held_angles
from rfem_jax.mechanics.statics.designs import Design, designed, status_of
from rfem_jax.mechanics.statics.settling import equilibrium
from rfem_jax.simulation.system.driving import require_masses
from rfem_jax.simulation.system.equations import safe_sqrt

RANK_TOLERANCE = 1e-10
REPEATED = 1e-4  # relative distance of squared frequencies below which they count as repeated


class NaturalModes(eqx.Module):
    """The lowest modes about an equilibrium, by increasing frequency.

    frequency [Hz], zero where the equilibrium is not stable in the mode; square [rad^2/s^2] of the angular frequency,
    negative there; damping: ratio of a mode's damping to the critical one (of links and joints; coupling of modes left
    out); joints (modes, F), elastic (modes, 6, rfes): shapes, of modal mass one [1/sqrt(kg) times the coordinate's
    unit]; separation: relative distance of `square` from the next one, below `REPEATED` derivatives mean nothing;
    asymmetry: of the stiffness matrix, relative, not zero only under forces without a potential; position: the
    equilibrium; status: of the assembly, or `NO_MODES` where frequencies or shapes are not finite.
    """

    frequency: Float[Array, " modes"]
    square: Float[Array, " modes"]
    damping: Float[Array, " modes"]
    joints: Float[Array, "modes freedoms"]
    elastic: Float[Array, "modes 6 rfes"]
    separation: Float[Array, " modes"]
    asymmetry: Float[Array, ""]
    position: Coordinates
    status: Int[Array, ""]

    @property
    def repeated(self) -> Float[Array, "*batch modes"]:
        """1 where a frequency is repeated and has no derivative, else 0."""
        return jnp.where(self.separation < REPEATED, 1.0, 0.0)


def natural_frequencies(
    model: Model,
    errors: Errors | None = None,
    *,
    hold: Mapping[str, ArrayLike | str] | str | None = None,
    locked: bool = True,
    count: int = 6,
    design: Design | None = None,
) -> NaturalModes:
    """Natural frequencies and modes about the static equilibrium of a mechanism with its errors.

    **Arguments:** `errors` from `assembly_errors`, or {name: value} (None: perfect); `hold`: as of `assemble`, joints
    at given angles [rad] or displacements [m] (None: the driven ones at their start, all else in equilibrium);
    `locked`: whether these are locked in the vibration, or only held by a constant moment; `count`: number of modes, at
    most as many as there are; `design`: from `rfem_jax.design`, other values for numbers of the model.

    **Returns:** `NaturalModes`. Works under jit, vmap, forward and reverse mode and Hessians; derivatives of simple
    frequencies only.

    **Raises:** `InputError` for a bad `count`, and as `assemble`.
    """
    require_float64()
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise InputError(f"Argument `count` must be a whole number of at least 1, but is {count!r}; 6 is usual.")
    hold = checked_hold(model, hold)
    require_masses(model)
    made = designed(model, design, errors)
    modes = _natural(made.model, made.errors, hold, bool(locked), int(count))
    return modes if made.status is None else replace(modes, status=status_of(modes.status, made))


@partial(Program, nameless=True)
def _natural(model: Model, errors: AssemblyErrors, hold: dict[str, Array] | str | None, locked: bool, count: int):
    actual, topology = _of_even_inertia(apply_errors(model, errors)), model.topology
    held = held_angles(model, hold)
    position, multipliers, status = equilibrium(model, actual, held)
    chosen = _coordinates(topology)
    matrices = among(linearised(actual, position, multipliers, length_scale(model)), chosen)
    fixed = (*(held if locked else ()), *topology.idle)
    unit = np.eye(matrices.mass.shape[0])[list(dict.fromkeys(fixed))]
    constraints = jnp.concatenate([matrices.constraints, jnp.asarray(unit)])
    count = min(count, matrices.mass.shape[0] - constraints.shape[0] + topology.redundant)
    square, vectors, separation = _lowest(matrices, constraints, count, topology.minimum_norm)
    of_dampers = jnp.einsum("mi,ij,mj->m", vectors, matrices.damping, vectors)
    rate = safe_sqrt(square)
    finite = jnp.all(jnp.isfinite(square)) & jnp.all(jnp.isfinite(vectors)) & jnp.all(jnp.isfinite(of_dampers))
    freedoms = topology.n_freedoms
    return NaturalModes(
        frequency=rate / (2.0 * jnp.pi),
        square=square,
        damping=jnp.where(rate == 0.0, 0.0, of_dampers / jnp.where(rate == 0.0, 1.0, 2.0 * rate)),
        joints=vectors[:, :freedoms],
        elastic=_elastic_shapes(actual, position, vectors, chosen),
        separation=separation,
        asymmetry=matrices.asymmetry,
        position=position,
        status=jnp.where((status == OK) & ~finite, NO_MODES, status).astype(jnp.int32),
    )


def _of_even_inertia(actual: ModelWithErrors) -> ModelWithErrors:
    """The mechanism with superelements whose preload does not change their inertia: most of that change is taken away
    by momenta of their vibration about the deformed shape, which their matrices do not know (theory (19.4))."""
    bodies = actual.superelements
    if bodies is None:
        return actual
    return replace(actual, superelements=tuple(replace(one, inertia=jnp.zeros_like(one.inertia)) for one in bodies))


def _coordinates(topology: Topology) -> np.ndarray | None:
    """Places of the coordinates without displacements in slender links, which follow from angles, and without those
    that superelements leave over; None without any."""
    dependent = np.concatenate([np.tile(topology.slender_rfes, (3, 1)), np.zeros((3, topology.n_rfes), bool)])
    dependent |= topology.left_over
    if not dependent.any():
        return None
    return np.flatnonzero(np.append(np.zeros(topology.n_freedoms, bool), dependent.reshape(-1)) == 0)


def _elastic_shapes(
    actual: ModelWithErrors, position: Coordinates, vectors: Array, chosen: np.ndarray | None
) -> Float[Array, "modes 6 rfes"]:
    """The part of modes that is of rfes."""
    topology, freedoms = actual.topology, actual.topology.n_freedoms
    if chosen is None:
        return vectors[:, freedoms:].reshape((len(vectors), 6, topology.n_rfes))
    onto = np.eye(freedoms + 6 * topology.n_rfes)[chosen][:, freedoms:]

    def displaced(vector):
        change = (vector @ onto).reshape(position.elastic.shape)
        still = jnp.zeros_like(position.joints)
        return jax.jvp(lambda p: with_displacements(actual, p), (position,), (Coordinates(still, change),))[1].elastic

    return jax.vmap(displaced)(vectors)


class Linearised(NamedTuple):
    """Mass, damping and stiffness matrix of the coordinates as many as rates, and the Jacobian of the closure equations
    (c, n); asymmetry of the stiffness matrix, whose symmetric part this is."""

    mass: Float[Array, "n n"]
    damping: Float[Array, "n n"]
    stiffness: Float[Array, "n n"]
    constraints: Float[Array, "c n"]
    asymmetry: Float[Array, ""]


def linearised(
    actual: ModelWithErrors, position: Coordinates, multipliers: Float[Array, " constraints"], scale: Float[Array, ""]
) -> Linearised:
    """The equations of motion linearised about a mechanism at rest (theory (11.15))."""
    topology = actual.topology
    at_rest = loads.static_state(topology, position).velocity
    zeros, unravel = ravel_pytree(at_rest)
    n = zeros.size

    def residual(changes, actual, position, multipliers, scale):
        change, rates, accelerations, of_multipliers = jnp.split(changes, (n, 2 * n, 3 * n))
        state = State(moved(topology, position, unravel(change)), unravel(rates))
        at = evaluate_residual(actual, state, unravel(accelerations), multipliers + of_multipliers, DriveInput(), scale)
        forces = Coordinates(at.hinge, jnp.concatenate([at.force, at.moment]))
        return ravel_pytree(forces)[0], at.closing

    forces, closing = jax.jacfwd(kernel(residual, name="linearised equations"))(
        jnp.zeros(3 * n + topology.n_constraints), actual, position, multipliers, scale
    )
    stiffness, damping, mass, by_multipliers = (
        -forces[:, :n],
        -forces[:, n : 2 * n],
        -forces[:, 2 * n : 3 * n],
        forces[:, 3 * n :],
    )
    rows = closing[:, :n]
    sprung = np.array(topology.sprung_rows or (False,) * topology.n_constraints, dtype=bool)
    # Springs of cut joints: multipliers less what these exert vanish, which makes a stiffness and a damping of them.
    at = np.flatnonzero(sprung)
    stiffness = stiffness + by_multipliers[:, at] @ closing[at, :n]
    damping = damping + by_multipliers[:, at] @ closing[at, n : 2 * n]
    symmetric = 0.5 * (stiffness + stiffness.T)
    largest = jnp.max(jnp.abs(stiffness))
    asymmetry = jnp.max(jnp.abs(stiffness - symmetric)) / jnp.where(largest > 0.0, largest, 1.0)
    return Linearised(
        0.5 * (mass + mass.T), 0.5 * (damping + damping.T), symmetric, rows[np.flatnonzero(~sprung)], asymmetry
    )


def among(matrices: Linearised, chosen: np.ndarray | None) -> Linearised:
    """Matrices of some of the coordinates; None: all."""
    if chosen is None:
        return matrices
    square = np.ix_(chosen, chosen)
    mass, damping, stiffness = (one[square] for one in (matrices.mass, matrices.damping, matrices.stiffness))
    return Linearised(mass, damping, stiffness, matrices.constraints[:, chosen], matrices.asymmetry)


def _lowest(
    matrices: Linearised, constraints: Float[Array, "c n"], count: int, redundant: bool
) -> tuple[Float[Array, " modes"], Float[Array, "modes n"], Float[Array, " modes"]]:
    """Squared frequencies, vectors of modal mass one, and separations of the lowest modes."""
    lower = jnp.linalg.cholesky(matrices.mass)
    inverse = jax.scipy.linalg.solve_triangular(lower, jnp.eye(lower.shape[0]), lower=True)
    stiffness = inverse @ matrices.stiffness @ inverse.T
    scale = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(stiffness), axis=1)))
    scale = jnp.where(scale > 0.0, scale, 1.0)
    rows = constraints @ inverse.T
    rows = rows / jax.lax.stop_gradient(_sizes(rows))
    stiffness = stiffness / scale
    pairs, separation, left_open = _eigenpairs(*jax.lax.stop_gradient((stiffness, rows)), count)
    found = _differentiable(pairs, stiffness, rows, left_open if redundant else jnp.zeros_like(left_open))
    return found.value * scale, found.vector @ inverse, separation


class Eigenpairs(NamedTuple):
    """Eigenpairs of a symmetric matrix on the null space of rows: values, vectors of length one, multipliers of the
    rows."""

    value: Float[Array, " modes"]
    vector: Float[Array, "modes n"]
    multiplier: Float[Array, "modes c"]


@jax.custom_jvp
def _differentiable(
    pairs: Eigenpairs, matrix: Float[Array, "n n"], rows: Float[Array, "c n"], left_open: Float[Array, "c c"]
) -> Eigenpairs:
    """Eigenpairs with their derivatives by the matrix and the rows; `left_open`: as of `_eigenpairs`."""
    del matrix, rows, left_open
    return pairs


@_differentiable.defjvp
def _by_implicit_functions(primals, tangents):
    """Derivatives of the roots of theory (11.16) by the implicit function theorem; that of a value is (11.17)."""
    _, matrix, rows, left_open = primals
    _, of_matrix, of_rows, _ = tangents
    n, c = matrix.shape[0], rows.shape[0]
    pairs = _differentiable(*primals)

    def change(value, vector, multiplier):
        bordered = jnp.block([
            [matrix - value * jnp.eye(n), rows.T, -vector[:, None]],
            [rows, left_open, jnp.zeros((c, 1))],
            [vector[None], jnp.zeros((1, c)), jnp.zeros((1, 1))],
        ])  # fmt: skip
        right = jnp.concatenate([of_matrix @ vector + multiplier @ of_rows, of_rows @ vector, jnp.zeros(1)])
        found = -jnp.linalg.solve(bordered, right)
        return Eigenpairs(found[n + c], found[:n], found[n : n + c])

    return pairs, jax.vmap(change)(*pairs)


def _sizes(rows: Float[Array, "c n"]) -> Float[Array, "c 1"]:
    """Lengths of rows; of what rounding leaves of rows that say nothing, that of the largest."""
    sizes = jnp.linalg.norm(rows, axis=1, keepdims=True)
    largest = jnp.max(sizes, initial=0.0)
    return jnp.where(sizes > RANK_TOLERANCE * largest, sizes, jnp.where(largest > 0.0, largest, 1.0))


def _eigenpairs(matrix: Array, rows: Array, count: int) -> tuple[Eigenpairs, Array, Array]:
    """The lowest eigenpairs of a symmetric matrix on the null space of `rows`, relative distances (modes,) of their
    values, and the projector (c, c) onto multipliers that no row determines."""
    n, c = matrix.shape[0], rows.shape[0]
    onto, inverse, left_open = jnp.zeros((n, n)), jnp.zeros((n, c)), jnp.zeros((c, c))
    if c:
        left, singular, right = jnp.linalg.svd(rows, full_matrices=False)
        there = singular > RANK_TOLERANCE * jnp.max(singular)
        onto = (right * jnp.where(there, 1.0, 0.0)[:, None]).T @ right
        left_open = jnp.eye(c) - (left * jnp.where(there, 1.0, 0.0)[None]) @ left.T
        inverse = (right * jnp.where(there, 1.0 / jnp.where(there, singular, 1.0), 0.0)[:, None]).T @ left.T
    free = jnp.eye(n) - onto
    # What is constrained comes after all modes.
    values, vectors = jnp.linalg.eigh(free @ matrix @ free + 3.0 * onto)
    gaps = jnp.diff(values)
    nearest = jnp.minimum(jnp.append(gaps, jnp.inf)[:count], jnp.insert(gaps, 0, jnp.inf)[:count])
    chosen = vectors[:, :count].T
    multipliers = -(chosen @ matrix - values[:count, None] * chosen) @ inverse
    apart = jnp.where(nearest == 0.0, 0.0, nearest / jnp.abs(values[:count]))
    return Eigenpairs(values[:count], chosen, multipliers), apart, left_open
