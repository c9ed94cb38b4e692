"""Whether a static equilibrium is stable: the smallest stiffness about it, and how fast it is left.

Place in the pipeline: search -> **equilibrium_stability** -> assembly, simulation.

The Jacobian of the static equations, which the search has at its end, contains the stiffness by which loads turn and
move with the mechanism, and that of the multipliers of the closure equations (theory (6.12)). Coordinates are scaled by
the square root of their own stiffness and that of the loads; in these units the smallest eigenvalue among the motions
that the closure equations leave tells an unstable equilibrium from a motion without stiffness, of which rounding alone
is left (theory (6.13), (6.14)).
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from rfem_jax.mechanics.algebra.definiteness import constrained, lowest_direction, orthonormal_rows, positive
from rfem_jax.mechanics.dynamics.energy_and_momentum import energies
from rfem_jax.mechanics.dynamics.loads import JointLoads
from rfem_jax.mechanics.laws.point_laws import GivenLoad
from rfem_jax.mechanics.model.model import State, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

# Of the stiffness in scaled coordinates. Columns of 64 rfes that a load exceeds by a thousandth are at -1e-7, what
# errors of the search and rounding leave of a motion without stiffness is below 1e-10.
UNSTABLE = 1e-9
UNLOADED = 1e-12  # stiffness that loads are taken to have at least, in units of the mechanism
# What is left of an eigenvector's equation, over its eigenvalue, below which this is real, or two are nearly equal.
REAL = 1e-2

Numbers = Array | np.ndarray


class Tangent(NamedTuple):
    """The static equations linearised about an equilibrium, in the coordinates that are free (m of n), in units.

    stiffness (m, m) and constraints (c, m), without those that springs take the place of; units (m,) [m, rad] of the
    coordinates; length [m], force [N].
    """

    stiffness: Float[Array, "m m"]
    constraints: Float[Array, "c m"]
    units: Float[Array, " m"]
    length: Float[Array, ""]
    force: Float[Array, ""]


class Stability(NamedTuple):
    """How an equilibrium is left, zeros of a stable one.

    growth [1/s]: rate at which the motion away from it grows, at least; infinite without inertia. joints, links: how
    much each tree joint, and each flexible link in itself, moves in it [rad, longest links], over what moves most.
    """

    growth: Float[Numbers, "*positions"]
    joints: Mapping[str, Float[Numbers, "*positions"]]
    links: Mapping[str, Float[Numbers, "*positions"]]

    @property
    def place(self) -> str:
        """Words for the joint or the link that moves most, of one equilibrium."""
        parts = {f"joint {name}": float(x) for name, x in self.joints.items()}
        parts |= {f"link {name}": float(x) for name, x in self.links.items()}
        return max(parts, key=lambda name: parts[name], default="")


def is_tested(topology: Topology, held: Iterable[int]) -> bool:
    """Whether the equilibrium with these joint coordinates held may be unstable, and the equations know it: of ideal
    joints and links with linear elements, whose stiffness knows no axial force, only where something moves freely."""
    compliant = any(of for j, of in enumerate(topology.sprung) if j not in topology.clearances)
    mobile = bool({*topology.held, *topology.undriven} - set(held))
    return mobile or topology.exact or bool(topology.slender) or compliant


def free_coordinates(topology: Topology, held: np.ndarray) -> np.ndarray:
    """Places of the coordinates, as many as rates, that are not `held` and do not follow from others."""
    return np.setdiff1d(np.arange(topology.n_freedoms + 6 * topology.n_rfes), held)


def tangent_of(
    topology: Topology,
    jacobian: Float[Array, "unknowns unknowns"],
    free: np.ndarray,
    rates: Float[Array, "n n"] | None,
    scales: tuple[Float[Array, " n"], Float[Array, ""], Float[Array, ""]],
) -> Tangent:
    """The tangent of a Jacobian of the static equations; `rates`: of the coordinates by the scaled unknowns, None if
    they are the same; scales: units of the coordinates, length and force."""
    units, length, force = scales
    n, c = units.size, topology.n_constraints
    # Loads along joints stand on the one side of the equations, generalised forces of rfes on the other.
    sign = jnp.asarray(np.where(np.arange(n) < topology.n_freedoms, 1.0, -1.0))[:, None]
    rows = sign * jacobian[:n]
    if rates is not None:
        rows = rates.T @ rows
    stiffness, closing = rows[:, :n], jacobian[n:, :n]
    sprung = np.array(topology.sprung_rows or (False,) * c, dtype=bool)
    at = np.flatnonzero(sprung)
    if at.size:
        of_springs = jnp.linalg.solve(jacobian[np.ix_(n + at, n + at)], closing[at])
        stiffness = stiffness - rows[:, n + at] @ of_springs
    return Tangent(
        stiffness[np.ix_(free, free)], closing[np.ix_(np.flatnonzero(~sprung), free)], units[free], length, force
    )


def stability_of(
    actual: ModelWithErrors, state: State, tangent: Tangent, free: np.ndarray, loads: JointLoads
) -> Stability:
    """Stability of the equilibrium `state`, whose joints carry `loads`."""
    if not free.size:
        return _moving(actual.topology, jnp.zeros(()), free, jnp.zeros(0))
    actual, state, tangent, loads = jax.lax.stop_gradient((actual, state, tangent, loads))
    zeros, unravel = ravel_pytree(state.velocity)
    unstable, along = _softest(tangent, _load(tangent, loads), symmetric=not _without_potential(actual))
    rates = unravel(zeros.at[free].set(tangent.units * along))
    mass = 2.0 * energies(actual, State(state.position, rates)).kinetic
    stiffness = (along @ tangent.stiffness @ along) * tangent.force * tangent.length
    rate = jnp.sqrt(jnp.maximum(-stiffness, 0.0) / jnp.where(mass > 0.0, mass, 1.0))
    growth = jnp.where(unstable, jnp.where(mass > 0.0, rate, jnp.inf), 0.0)
    return _moving(actual.topology, growth, free, along)


def _load(tangent: Tangent, loads: JointLoads) -> Float[Array, ""]:
    """The largest stiffness that loads of this size give, in units of the mechanism."""
    force, moment = jnp.max(jnp.abs(loads.force)), jnp.max(jnp.abs(loads.moment))
    return UNLOADED + (force + moment / tangent.length) / tangent.force


def _softest(tangent: Tangent, load: Float[Array, ""], symmetric: bool) -> tuple[Bool[Array, ""], Float[Array, " m"]]:
    """Whether a motion has a negative stiffness in scaled coordinates, and the one with the lowest, in units of the
    coordinates, zero if not."""
    root = 1.0 / jnp.sqrt(jnp.abs(jnp.diagonal(tangent.stiffness)) + load)
    matrix = root[:, None] * tangent.stiffness * root[None]
    scale = 1.0 + jnp.max(jnp.sum(jnp.abs(matrix), axis=1))
    matrix = constrained(matrix / scale, orthonormal_rows(tangent.constraints * root[None]))
    least, middle = UNSTABLE / scale, 0.5 * (matrix + matrix.T)
    n = root.size

    def found(matrix):
        value, vector, left = lowest_direction(matrix)
        # A pair of complex eigenvalues is flutter, which depends on damping.
        diverging = True if symmetric else (value < -least) & (left <= REAL * jnp.abs(value))
        return jnp.asarray(diverging), vector

    # What has a positive symmetric part has no real eigenvalue that is negative. A search without result has none.
    stable = positive(middle + least * jnp.eye(n)) | ~jnp.all(jnp.isfinite(matrix))
    nothing = jnp.zeros((), bool), jnp.zeros(n)
    unstable, vector = jax.lax.cond(stable, lambda _: nothing, found, middle if symmetric else matrix)
    return unstable, vector * root


def _without_potential(actual: ModelWithErrors) -> bool:
    """Whether loads turn with links, or are moments, which have no potential where a link may turn about any axis."""
    if actual.frame_forces is None:
        return False
    given = [one for one in actual.frame_forces.elements.values() if isinstance(one, GivenLoad)]
    return any(one.turning or one.moment for one in given) or any(
        one.turning for one in (actual.frame_forces.lines or {}).values()
    )


def _moving(topology: Topology, growth: Float[Array, ""], free: np.ndarray, along: Float[Array, " m"]) -> Stability:
    """The stability with shares in the motion `along` of the free coordinates by joints and links."""
    sizes = jnp.zeros(topology.n_freedoms + 6 * topology.n_rfes).at[free].set(jnp.abs(along))
    largest = jnp.max(sizes, initial=0.0)
    sizes = jnp.where(growth > 0.0, sizes / jnp.where(largest > 0.0, largest, 1.0), 0.0)
    rfes = sizes[topology.n_freedoms :].reshape(6, topology.n_rfes)
    owned = {topology.joints[l]: sizes[np.array(at, int)] for l, at in enumerate(topology.coordinates) if at}
    within = {
        name: rfes[:, np.flatnonzero(topology.link_of_rfe == l)]
        for l, (name, elements) in enumerate(zip(topology.links, topology.elements, strict=True))
        if elements > 1
    }
    return Stability(growth, *({name: jnp.max(x) for name, x in parts.items()} for parts in (owned, within)))
