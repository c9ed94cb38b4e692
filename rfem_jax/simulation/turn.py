"""The kinetostatic turn: the mechanism held still at one position of its drive after another.

Place in the pipeline: model, errors -> static equilibria -> **turn** -> report.

At every position the loops of the perfect rigid mechanism are closed first, and the equilibrium with errors, preload
and weight is sought from there (theory (6.1)). No dynamics: what remains of the loads when the drive moves slowly.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.dynamics.load_axes import AXES, turned_loads
from rfem_jax.mechanics.dynamics.point_paths import point_motions
from rfem_jax.mechanics.dynamics.section_loads import loads_of_sections, stress_squares
from rfem_jax.mechanics.elements.linear_validity import linear_error, linear_range
from rfem_jax.mechanics.forces.bush_contacts import ContactState, contact_states
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.model.discretisation import CLOSING_TOLERANCE, close_at
from rfem_jax.mechanics.model.errors import AssemblyErrors, Errors, errors_of
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.assembly import Load, closed_at_rest, equilibrium, held_angles, named
from rfem_jax.mechanics.statics.designs import designed, status_of
from rfem_jax.simulation.equations import safe_sqrt

POSITIONS = 72  # over a revolution, unless given


class ClosedPose(eqx.Module):
    """Coordinates of the tree joints [rad, m] and angles of the cut joints [rad] of the perfect rigid mechanism, at one
    position of its drive or, with a first axis, at several."""

    start_joints: Float[Array, "*positions numbers"]
    cut_angles: Float[Array, "*positions cuts"]


class Turn(eqx.Module):
    """A mechanism held at positions of its first drive.

    position [rad, m] of the driven coordinate; loads: of all joints by their names (positions, 3), in hinge frames;
    holding: moment [N m] or force [N] that holds the driven coordinate; energy [J]: elastic and of gravity; stress
    [Pa]: largest von Mises stress of every link whose section's edge is known (rigid links too); status of each
    assembly; contacts (positions, ...): of the joints with clearance, by their names; linear_error: estimated error of
    linear elements (`linear_validity`); places [m] (positions, 3) of the points whose paths are followed, couplings
    (positions, 2): loads [N m, N] along their two coordinates, by their names; in_axes: the loads in further axes, if
    these were asked for.
    """

    position: Float[Array, "*positions"]
    loads: dict[str, Load]
    holding: Float[Array, "*positions"]
    energy: Float[Array, "*positions"]
    stress: dict[str, Float[Array, "*positions"]]
    status: Int[Array, "*positions"]
    contacts: dict[str, ContactState] = eqx.field(default_factory=dict)
    linear_error: Float[Array, "*positions"] | None = None
    places: dict[str, Float[Array, "*positions 3"]] = eqx.field(default_factory=dict)
    in_axes: dict[str, Load] = eqx.field(default_factory=dict)
    couplings: dict[str, Float[Array, "*positions 2"]] = eqx.field(default_factory=dict)


def turn_positions(
    model: Model, count: int = POSITIONS, start: float | None = None, stop: float | None = None
) -> Float[np.ndarray, " positions"]:
    """Positions (count,) [rad, m] of the first drive: over a revolution from its start without its end, or from `start`
    to `stop` with both. Raises InputError for a model without a drive, and for a slide without `start` and `stop`."""
    topology = model.topology
    if topology.driven_coordinate is None:
        raise InputError(
            "Argument `model` must have a driven joint for a turn, but no joint is driven; give the study a drive, or "
            "the mechanism a `driven_joint`."
        )
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise InputError(f"Argument `positions` must be a whole number of at least 1, but is {count!r}; 72 is usual.")
    here = float(model.start_joints[topology.driven_position])
    if start is None and stop is None and not topology.slides[topology.driven_coordinate]:
        return here + 2.0 * np.pi * np.arange(count) / count
    if stop is None:
        raise InputError(
            "Argument `stop` of a turn must be given for a drive along an axis and where `start` is, but is missing; "
            "give both ends of the range."
        )
    return np.linspace(here if start is None else start, stop, count)


def closed_poses(model: Model, positions: Float[np.ndarray, " positions"]) -> ClosedPose:
    """Closed poses of the perfect rigid mechanism at positions [rad, m] of its first drive; the search for each pose
    begins at the pose before.

    **Raises:** `InputError` for a position at which the mechanism does not close.
    """
    driven, pose, closed = model.topology.driven_position, np.asarray(model.start_joints), []
    for position in positions:
        guess = np.array(pose)
        guess[driven] = position
        pose, residual, alignment, cut = close_at(model, guess)
        if np.abs(residual).max(initial=0.0) > CLOSING_TOLERANCE or (alignment < 0.0).any():
            reached = f"; the last position that closes is {closed[-1][0][driven]:.6g}" if closed else ""
            raise InputError(
                f"Argument `positions` must be ones at which the mechanism closes, but at {position:.6g} (rad or m) of "
                f"joint `{model.driven_joint}` it does not{reached}; give a smaller range."
            )
        closed.append((pose, cut))
    joints, cuts = (np.stack(part) for part in zip(*closed, strict=True))
    return ClosedPose(jnp.asarray(joints), jnp.asarray(cuts))


def kinetostatic_turn(
    model: Model,
    errors: Errors | None = None,
    positions: Float[np.ndarray, " positions"] | None = None,
    axes: str = "joint",
) -> Turn:
    """Loads in all joints of a mechanism that is held at positions of its first drive, other drives at their start.

    **Arguments:** `errors` from `assembly_errors`, or {name: value} (None: perfect); `positions` [rad, m], as of
    `turn_positions` (None: 72 over a revolution); `axes`: "parent", "child" or "global" for the loads in these axes,
    too, as `Turn.in_axes`.

    **Returns:** `Turn`. Differentiable with respect to errors and deviations of parameters, also under jit, vmap,
    forward and reverse mode.

    **Raises:** `InputError` for a model without a driven joint, one of traced numbers, other axes, and for positions at
    which it does not close.
    """
    require_float64()
    require_choice(axes, tuple(AXES), "axes")
    if isinstance(model.start_joints, Tracer):
        raise InputError(
            "Argument `model` of a turn must have numbers that are known, as its loops are closed at every position "
            "before anything is compiled, but was made of traced ones; vary them as deviations among `errors`."
        )
    positions = turn_positions(model) if positions is None else np.atleast_1d(np.asarray(positions, float))
    poses = closed_poses(model, positions)
    return turn_over(model, errors_of(model, errors), poses, axes)


@partial(Program, nameless=True)
def turn_over(model: Model, errors: AssemblyErrors, poses: ClosedPose, axes: str = "joint") -> Turn:
    """The turn over closed poses; `axes`: as of `kinetostatic_turn`."""
    made = designed(model, None, errors)
    turn = jax.lax.map(lambda pose: held_at(made.model, made.errors, pose, axes=axes), poses)
    return eqx.tree_at(lambda t: t.status, turn, status_of(turn.status, made))


class _Still(NamedTuple):
    """A mechanism at rest, as `loads_of_sections` reads it."""

    motion: Motion
    angular: Float[Array, "3 nodes"]
    linear: Float[Array, "3 nodes"]
    wrenches: list[Float[Array, "6"]]
    frame_loads: FrameLoads | None


def held_at(model: Model, errors: AssemblyErrors, pose: ClosedPose, stresses: bool = True, axes: str = "joint") -> Turn:
    """The mechanism held at one closed pose, with the stresses of its links if wanted; `axes`: as of
    `kinetostatic_turn`."""
    # Crooked pins are those of the start.
    actual, topology = apply_errors(model, errors), model.topology
    model = eqx.tree_at(lambda m: (m.start_joints, m.cut_angles), model, (pose.start_joints, pose.cut_angles))
    position, multipliers, status = equilibrium(model, actual, held_angles(model, None))
    state = loads.static_state(topology, position)
    resting = closed_at_rest(model, actual, state, multipliers)
    at_rest = jnp.zeros((3, actual.mass.shape[0]))
    resting, wrenches = loads.moving_wrenches(actual, resting, at_rest, at_rest)
    joint = loads.loads_of_wrenches(topology, resting, wrenches, DriveInput())
    k = topology.driven_coordinate
    assert k is not None, "turns are of driven mechanisms"
    inside = {} if resting.laws is None else resting.laws.inside
    meshes = {} if resting.laws is None else resting.laws.couplings or {}
    plain = joint
    if topology.clearances:
        plain = jax.tree.map(jnp.subtract, joint, loads.contact_loads(topology, resting))
    turned = {}
    if axes != "joint":
        turned = named(model, turned_loads(topology, resting.motion, resting.closure, joint, axes))
    still = _Still(resting.motion, at_rest, at_rest, wrenches, resting.frame_loads)
    stress = {}
    edges = model.section.edges or (None,) * topology.n_links
    for l, (name, edge) in enumerate(zip(topology.links, edges, strict=True)):
        if edge is not None and stresses:
            of_sections = loads_of_sections(model, actual, state, still, l)
            stress[name] = safe_sqrt(jnp.max(stress_squares(edge, of_sections.resultants)))
    energy = loads.energies(actual, state)
    return Turn(
        position=position.joints[topology.driven_position],
        loads=named(model, joint),
        holding=loads.load_along(topology, resting.motion, plain, k) - inside.get(k, jnp.zeros(())),
        energy=energy.elastic + energy.gravity,
        stress=stress,
        status=status,
        contacts=contact_states(actual, resting.motion),
        linear_error=linear_error(linear_range(actual, position)),
        places={name: one.position for name, one in point_motions(actual, resting.motion, at_rest, at_rest).items()},
        in_axes=turned,
        couplings={name: mesh.loads for name, mesh in meshes.items()},
    )
