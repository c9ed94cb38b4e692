"""Whether a static equilibrium is stable: the smallest stiffness about it, and how fast it is left.

Place in the pipeline: search -> **equilibrium_stability** -> assembly, simulation.

The Jacobian of the static equations, which the search has at its end, contains the stiffness by which loads turn and
move with the mechanism, and that of the multipliers of the closure equations (theory (6.12)). Coordinates are scaled by
the square root of their own stiffness and that of the loads; in these units the smallest eigenvalue among the motions
that the closure equations leave tells an unstable equilibrium from a motion without stiffness, of which rounding alone
is left (theory (6.13), (6.14)). Where the search comes back from a disturbance, none of this is needed (theory (6.15)).
"""

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, PyTree

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.definiteness import constrained, lowest_direction, orthonormal_rows, positive
from rfem_jax.mechanics.dynamics.energy_and_momentum import energies
from rfem_jax.mechanics.dynamics.loads import JointLoads
from rfem_jax.mechanics.laws.point_laws import GivenLoad, PointLaw
from rfem_jax.mechanics.model.model import State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

# Of the stiffness in scaled coordinates. Columns of 64 rfes that a load exceeds by a thousandth are at -1e-7, what
# errors of the search and rounding leave of a motion without stiffness is below 1e-10.
UNSTABLE = 1e-9
UNLOADED = 1e-12  # stiffness that loads are taken to have at least, in units of the mechanism
# What is left of an eigenvector's equation, over its eigenvalue, below which this is real, or two are nearly equal.
REAL = 1e-2

Numbers = Array | np.ndarray


class Tangent(NamedTuple):
    """The static equations linearised about an equilibrium, of n coordinates and c multipliers, scaled.

    jacobian: its first rows are loads along joint coordinates, then forces on rfes with the opposite sign, then closure
    equations; rates (n, n): of the coordinates by the unknowns, None if they are the same; units (n,) [m, rad] of the
    coordinates; length [m], force [N]; stable: whether it is known to be stable, so that no Jacobian was formed.
    """

    jacobian: Float[Array, "unknowns unknowns"]
    rates: Float[Array, "n n"] | None
    units: Float[Array, " n"]
    length: Float[Array, ""]
    force: Float[Array, ""]
    stable: Bool[Array, ""]

    def parts(self, topology: Topology) -> tuple[Float[Array, "n n"], Float[Array, "c n"]]:
        """Stiffness, but for the signs of its rows, and constraints; springs of cut joints are eliminated, their rows
        are zero."""
        n, c = self.units.size, topology.n_constraints
        rows, closing = self.jacobian[:n], self.jacobian[n:, :n]
        if self.rates is not None:
            rows = self.rates.T @ rows
        stiffness = rows[:, :n]
        sprung = np.array(topology.sprung_rows or (False,) * c, dtype=bool)
        at = np.flatnonzero(sprung)
        if at.size:
            of_springs = jnp.linalg.solve(self.jacobian[np.ix_(n + at, n + at)], closing[at])
            stiffness = stiffness - rows[:, n + at] @ of_springs
            closing = jnp.where(sprung[:, None], 0.0, closing)
        return stiffness, closing


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


def told_by_return(actual: ModelWithErrors) -> bool:
    """Whether the chord method, where it leads back from a disturbance, tells that an equilibrium is stable (theory
    (6.15)): its matrix and that of the equations have to be symmetric, and its own without negative stiffness."""
    elements = [] if actual.frame_forces is None else actual.frame_forces.elements.values()
    positive_ones = all(isinstance(one, PointLaw | GivenLoad) for one in elements)
    return positive_ones and not actual.topology.balls and not _without_potential(actual)


def stability_of(
    actual: ModelWithErrors, state: State, tangent: Tangent, free: np.ndarray, loads: JointLoads
) -> Stability:
    """Stability of the equilibrium `state`, whose joints carry `loads`."""
    topology = actual.topology
    if not free.size:
        return _moving(topology, jnp.zeros(()), jnp.zeros(tangent.units.size))

    def softest(actual, state, tangent, loads):
        def growth_along(work: Array, along: Array) -> Array:
            mass = 2.0 * energies(actual, State(state.position, unravel(tangent.units * along))).kinetic
            rate = jnp.sqrt(jnp.maximum(-work * tangent.force * tangent.length, 0.0) / jnp.where(mass > 0.0, mass, 1.0))
            return jnp.where(mass > 0.0, rate, jnp.inf)

        unravel, load = ravel_pytree(state.velocity)[1], _load(tangent, loads)
        return _softest(topology, tangent, free, load, growth_along, not _without_potential(actual))

    given = jax.lax.stop_gradient((actual, state, tangent, loads))
    return _moving(topology, *kernel(softest, name="softest motion", in_parts=True)(*given))


def _load(tangent: Tangent, loads: JointLoads) -> Float[Array, ""]:
    """The largest stiffness that loads of this size give, in units of the mechanism."""
    force, moment = jnp.max(jnp.abs(loads.force)), jnp.max(jnp.abs(loads.moment))
    return UNLOADED + (force + moment / tangent.length) / tangent.force


def _softest(
    topology: Topology,
    tangent: Tangent,
    free: np.ndarray,
    load: Float[Array, ""],
    growth_along: Callable[[Array, Array], Array],
    symmetric: bool,
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """Growth of the motion with the lowest stiffness in scaled coordinates, if that is negative, and this motion, in
    units of the coordinates; zeros if not. `growth_along`: of twice the work along a motion, and this."""
    n = tangent.units.size
    nothing = jnp.zeros(()), jnp.zeros(n)

    def tested():
        matrix, rows, root = scaled_parts(topology, tangent, free, load)
        scale = 1.0 + jnp.max(jnp.sum(jnp.abs(matrix), axis=1))
        original, matrix = matrix, constrained(matrix / scale, orthonormal_rows(rows))
        least, middle = UNSTABLE / scale, 0.5 * (matrix + matrix.T)
        matrix = middle if symmetric else matrix

        def found():
            value, vector, left = lowest_direction(matrix)
            # A pair of complex eigenvalues is flutter, which depends on damping.
            diverging = jnp.asarray(symmetric) | ((value < -least) & (left <= REAL * jnp.abs(value)))
            along = vector * root
            work = vector @ original @ vector
            return jnp.where(diverging, growth_along(work, along), 0.0), along

        # What has a positive symmetric part has no real eigenvalue that is negative. A search without result has none.
        stable = positive(middle, least) | ~jnp.all(jnp.isfinite(matrix))
        return where_needed(~stable, found, nothing)

    return where_needed(~tangent.stable, tested, nothing)


def _signs(topology: Topology, n: int) -> np.ndarray:
    """Loads along joints stand on the one side of the equations, generalised forces of rfes on the other."""
    return np.where(np.arange(n) < topology.n_freedoms, 1.0, -1.0)


def scaled_parts(
    topology: Topology, tangent: Tangent, free: np.ndarray, load: Float[Array, ""]
) -> tuple[Float[Array, "n n"], Float[Array, "c n"], Float[Array, " n"]]:
    """Stiffness and constraints in scaled coordinates, and how much of its unit each of these is: zero of those that
    are not `free`, which have a stiffness of one."""
    stiffness, closing = tangent.parts(topology)
    n = tangent.units.size
    is_free = np.isin(np.arange(n), free)
    root = jnp.where(is_free, 1.0 / jnp.sqrt(jnp.abs(jnp.diagonal(stiffness)) + load), 0.0)

    def one_row(own):
        values, k, sign, scale, held = own
        return (sign * scale) * (root * values) + jnp.where(np.arange(n) == k, held, 0.0)

    # By rows, since a kernel takes arrays apart where many of the factors are known.
    own = stiffness, jnp.arange(n), jnp.asarray(_signs(topology, n)), root, jnp.where(is_free, 0.0, 1.0)
    return jax.lax.map(one_row, own), closing * root[None], root


def where_needed(needed: Bool[Array, ""], function: Callable[[], PyTree], otherwise: PyTree) -> PyTree:
    """What a function returns where it is needed, in a loop that is not entered otherwise: a batch pays for it only if
    one of its samples needs it."""
    carry = jax.lax.while_loop(lambda carry: carry[0], lambda _: (jnp.zeros((), bool), function()), (needed, otherwise))
    return carry[1]


def _without_potential(actual: ModelWithErrors) -> bool:
    """Whether loads turn with links, or are moments, which have no potential where a link may turn about any axis."""
    if actual.frame_forces is None:
        return False
    given = [one for one in actual.frame_forces.elements.values() if isinstance(one, GivenLoad)]
    return any(one.turning or one.moment for one in given) or any(
        one.turning for one in (actual.frame_forces.lines or {}).values()
    )


def _moving(topology: Topology, growth: Float[Array, ""], along: Float[Array, " n"]) -> Stability:
    """The stability with shares in the motion `along` of the coordinates by joints and links."""
    sizes = jnp.abs(along)
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
