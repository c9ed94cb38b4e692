"""What there is to see of a mechanism at rest, or in given motion: loads, and all that follows from these.

Place in the pipeline: settling, dynamics -> **seen_at_rest** -> statics, turn.

The search for an equilibrium has the derivatives of the implicit function. What follows from it is a kernel of its own,
which is differentiated as a whole: callers say what they want to `see`, and get that.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import dynamics, loads
from rfem_jax.mechanics.dynamics.base_loads import ShakingLoad, shaking_load
from rfem_jax.mechanics.dynamics.section_loads import loads_of_sections, section_edges, stress_squares
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.joint_forces import LawForces
from rfem_jax.mechanics.kinematics.cut_joints import Closure
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation, impose
from rfem_jax.mechanics.model.model import Coordinates, Model, State, length_scale
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.statics.assembly import closed_at_rest
from rfem_jax.mechanics.statics.equilibrium_stability import Stability
from rfem_jax.mechanics.statics.settling import moving_equilibrium, settled, stability, status_at_rest
from rfem_jax.simulation.outcome.observation import solved_instant
from rfem_jax.simulation.system.equations import safe_sqrt


class Still(NamedTuple):
    """A mechanism at rest, as loads of joints and sections follow from it: see `observation.Instant`."""

    motion: Motion
    closure: Closure | None
    laws: LawForces | None
    angular: Float[Array, "3 nodes"]
    linear: Float[Array, "3 nodes"]
    wrenches: list[Float[Array, "6"]]
    frame_loads: FrameLoads | None
    loads: loads.JointLoads


T = TypeVar("T")
# Of model, state, what loads follow from, and accelerations of all coordinates.
See = Callable[[Model, ModelWithErrors, State, Still, Coordinates], T]


def at_rest(
    model: Model, actual: ModelWithErrors, held: dict[int, Float[Array, ""]], see: See[T]
) -> tuple[State, Int[Array, ""], T, Stability | None]:
    """State and status of the static equilibrium, what is to `see` there, and how fast it is left, None where that is
    not tested; `held`: as of `settled`."""
    topology = model.topology
    found = settled(model, actual, held)
    state = loads.static_state(topology, found.position)

    def seen_at(model, actual, state, multipliers):
        resting, no_acceleration = closed_at_rest(model, actual, state, multipliers), jnp.zeros((3, actual.mass.size))
        resting, wrenches = loads.moving_wrenches(actual, resting, no_acceleration, no_acceleration)
        joint = loads.loads_of_wrenches(topology, resting, wrenches, DriveInput())
        still = Still(
            resting.motion, resting.closure, resting.laws, no_acceleration, no_acceleration, wrenches,
            resting.frame_loads, joint,
        )  # fmt: skip
        return joint, see(model, actual, state, still, jax.tree.map(jnp.zeros_like, state.velocity))

    # A kernel to derivatives, too, which the whole, in parts, is not.
    carried, seen = kernel(seen_at, name="loads at rest")(model, actual, state, found.multipliers)
    leaving = stability(model, actual, held, state, found.tangent, carried)
    return state, status_at_rest(found.status, leaving), seen, leaving


def in_motion(
    model: Model, actual: ModelWithErrors, motions: dict[int, tuple[Array, Array, Array]], see: See[T]
) -> tuple[State, Int[Array, ""], T]:
    """State, status and what is to `see` of a mechanism of rigid links whose held coordinates have these positions,
    rates and accelerations."""
    held, rates = ({k: of[i] for k, of in motions.items()} for i in (0, 1))
    state, _, status = moving_equilibrium(model, actual, held, rates)
    state = impose(model.topology, state, DriveInput(motions=motions))

    def seen_at(model, actual, state, motions):
        drive, scale = DriveInput(motions=motions), length_scale(model)
        zero = jnp.zeros(())  # the loops are closed: nothing is to be stabilised
        result = dynamics.accelerations(actual, state, drive, Stabilisation(zero, zero, scale))
        now = solved_instant(actual, result, drive, scale)
        still = Still(
            now.motion, now.closure, now.laws, now.angular, now.linear, now.wrenches, now.frame_loads, now.loads
        )
        return see(model, actual, state, still, now.accelerations)

    return state, status, kernel(seen_at, name="loads in given motion")(model, actual, state, motions)


def holding_load(model: Model, still: Still, k: int) -> Float[Array, ""]:
    """Moment [N m] or force [N] from outside that holds a coordinate: the joint's load along it without the part of its
    springs and contacts (theory (6.10))."""
    topology, plain = model.topology, still.loads
    inside = {} if still.laws is None else still.laws.inside
    if topology.clearances:
        plain = jax.tree.map(jnp.subtract, plain, loads.contact_loads(topology, still))
    return loads.load_along(topology, still.motion, plain, k) - inside.get(k, jnp.zeros(()))


def largest_stresses(model: Model, actual: ModelWithErrors, state: State, still: Still) -> dict[str, Float[Array, ""]]:
    """Largest von Mises stress [Pa] of every link whose section's edge is known."""
    topology, stress = model.topology, {}
    edges = model.section.edges or (None,) * topology.n_links
    for l, (name, edge) in enumerate(zip(topology.links, edges, strict=True)):
        if edge is not None:
            of_sections = loads_of_sections(model, actual, state, still, l)
            edge = section_edges(model, actual, l, of_sections.place)
            stress[name] = safe_sqrt(jnp.max(stress_squares(edge, of_sections.resultants)))
    return stress


def shaking_at_rest(model: Model, actual: ModelWithErrors, still: Still) -> ShakingLoad:
    """What the mechanism exerts on its base."""
    return shaking_load(model, actual, loads.base_wrench(actual.topology, still.wrenches), still.frame_loads)
