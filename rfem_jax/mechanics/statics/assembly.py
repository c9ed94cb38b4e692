"""Static assembly: the equilibrium in which the mechanism is put together, and its preload.

Place in the pipeline: model, errors, settling -> **assembly** -> start state of a simulation.

With errors the links are deformed when the loops are closed (theory (6.1)): the assembled state is a
stationary point of the potential energy of springs and gravity subject to the closure equations, some joints
held.  It is found from the equations of its equilibrium (`static_equations`).
"""

import functools
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import ArrayLike, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, require_choice, suggestion
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.mechanism.mechanism import AS_GIVEN, EQUILIBRIUM, STARTS
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.elements.linear_validity import linear_error, linear_range
from rfem_jax.mechanics.forces.bush_contacts import ContactState, contact_states
from rfem_jax.mechanics.forces.element_loads import frame_loads
from rfem_jax.mechanics.forces.joint_forces import (
    law_forces,
    with_ideal_couplings,
)
from rfem_jax.mechanics.kinematics.cut_joints import closure
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.errors import AssemblyErrors, Errors, require_number
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Model, State, length_scale
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors
from rfem_jax.mechanics.statics.designs import Design, designed, status_of
from rfem_jax.mechanics.statics.equilibrium_stability import (
    Stability,
)
from rfem_jax.mechanics.statics.settling import (
    settled,
    stability,
    status_at_rest,
)
from rfem_jax.mechanics.statics.static_equations import (
    start_values,
)


class Load(NamedTuple):
    """Force [N] and moment [N m] of one joint in its hinge frame."""

    force: Float[Array, "*times 3"]
    moment: Float[Array, "*times 3"]


class Assembled(NamedTuple):
    """An assembled mechanism: state at rest, preload of every joint, status code; design_gap [m]: what the loops of a
    design stay open by at the start, None without one; contacts: of the joints with clearance, None without any;
    linear_error: estimated error of linear elements (`linear_validity`); stability: how fast it is left."""

    state: State
    preload: dict[str, Load]
    status: Int[Array, ""]
    design_gap: Float[Array, ""] | None = None
    contacts: dict[str, ContactState] | None = None
    linear_error: Float[Array, ""] | None = None
    stability: Stability | None = None


def assemble(
    model: Model,
    errors: Errors | None = None,
    hold: Mapping[str, ArrayLike | str] | str | None = None,
    *,
    design: Design | None = None,
) -> Assembled:
    """Assemble the mechanism: static equilibrium with some joints held.

    **Arguments:** `errors` from `assembly_errors`, or {name: value} (None: perfect); `hold`: name of a joint with one
    coordinate -> its angle [rad] or displacement [m], or a string with a unit; None holds the coordinates that drives
    act on at their start, {} holds nothing; "as_given" holds at their start, besides, the coordinates that stand for
    the freedoms that no drive holds, as a simulation does; `design`: from `rfem_jax.design`.

    **Returns:** state (velocities zero), preload (gravity and holding moment included) and status
    (0 = ok; see `STATUS`). Differentiable with respect to errors, held angles and the numbers of the design.

    **Raises:** `InputError` if `hold` names a joint that is not a joint of the tree or has not one coordinate, or has a
    value that is no number.
    """
    hold = checked_hold(model, hold)
    made = designed(model, design, errors)
    found = _assemble(made.model, made.errors, hold)
    return found._replace(status=status_of(found.status, made), design_gap=made.gap)


@functools.partial(Program, nameless=True)
def _assemble(model: Model, errors: AssemblyErrors, hold: dict[str, Array] | str | None) -> Assembled:
    actual, held = apply_errors(model, errors), held_angles(model, hold)
    found = settled(model, actual, held)
    state = loads.static_state(model.topology, found.position)
    carried = static_loads(model, actual, state, found.multipliers)
    leaving = stability(model, actual, held, state, found.tangent, carried)
    contacts = _contacts_at(actual, state) if model.topology.clearances else None
    error = linear_error(kernel(linear_range)(*jax.lax.stop_gradient((actual, found.position))))
    status = status_at_rest(found.status, leaving)
    return Assembled(state, named(model, carried), status, contacts=contacts, linear_error=error, stability=leaving)


@kernel
def _contacts_at(actual: ModelWithErrors, state: State) -> dict[str, ContactState]:
    return contact_states(actual, motion_of(actual, state))


def checked_hold(model: Model, hold: Mapping[str, ArrayLike | str] | str | None) -> dict[str, Array] | str | None:
    """The argument `hold` of `assemble` with arrays. Raises `InputError` as `assemble`."""
    if hold is None or isinstance(hold, str):
        return None if hold is None else require_choice(hold, (AS_GIVEN,), "hold")
    if not isinstance(hold, Mapping):
        raise InputError(
            f"Argument `hold` must be a table of values by the names of joints, but is {hold!r}; write for example "
            '{"A": "30 deg"}, or "5 mm" of a joint that slides.'
        )
    _require_tree_joints(model, hold)
    return {name: jnp.asarray(_held_value(model, name, value), jnp.float64) for name, value in hold.items()}


def _held_value(model: Model, name: str, value: ArrayLike | str) -> ArrayLike:
    """The value [rad, m] at which a joint is held, from a number or a string with a unit."""
    require_number(name, value, "hold")
    if not isinstance(value, str):
        return value
    topology = model.topology
    (k,) = topology.own_coordinates[topology.joints.index(name)]
    return quantity(value, "length" if topology.slides[k] else "angle", f"hold.{name}")


def held_angles(model: Model, hold: Mapping[str, ArrayLike] | str | None) -> dict[int, Float[Array, ""]]:
    """Index of a joint coordinate -> held value [rad, m], by the names of joints; None: those that drives act
    on, at their start; "as_given": besides those for the freedoms that no drive holds (theory (6.9)).

    **Raises:** `InputError` for a name that is not a joint of the tree with one coordinate.
    """
    topology = model.topology
    if hold is None or isinstance(hold, str):
        values = start_values(model).joints
        return {k: values[k] for k in (*topology.held, *(() if hold is None else topology.undriven))}
    _require_tree_joints(model, hold)
    return {
        topology.own_coordinates[topology.joints.index(name)][0]: jnp.asarray(value) for name, value in hold.items()
    }


def with_start(model: Model, start: str | None) -> Model:
    """The model whose simulations start so: "as_given" or "equilibrium"; None leaves it as it is.

    **Raises:** `InputError` for another word, and for an equilibrium where joints have initial rates.
    """
    if start is None:
        return model
    require_choice(start, STARTS, "start")
    if start == EQUILIBRIUM and model.topology.rated:
        raise InputError(
            f'Argument `start` must be "as_given" where joints have initial rates, but was "{start}", which is at '
            "rest; leave it out, or the rates."
        )
    return replace(model, topology=model.topology._replace(settles=start == EQUILIBRIUM))


def _require_tree_joints(model: Model, names: Iterable[str]) -> None:
    """Raise InputError for the first name that is not a joint of the tree."""
    tree = model.topology.joints[: model.topology.n_links]
    for name in names:
        if name not in tree:
            raise InputError(
                f"Argument `hold` must name joints of the tree, but {name!r} is not one; {suggestion(name, tree)}"
            )
        kind = model.topology.kind(tree.index(name)).nominal
        if len(kind.freedoms) != 1:
            raise InputError(
                f"Argument `hold` must name joints with one coordinate, but {name!r} is {kind.name} and has "
                f"{len(kind.freedoms)}; hold a revolute or prismatic joint."
            )


@kernel
def static_loads(
    model: Model, actual: ModelWithErrors, state: State, multipliers: Float[Array, " constraints"]
) -> loads.JointLoads:
    """Joint loads at rest, the moment that holds a joint included."""
    at_rest = jnp.zeros((3, actual.mass.shape[0]))
    resting = closed_at_rest(model, actual, state, multipliers)
    return loads.chain_loads(actual, resting, at_rest, at_rest, DriveInput())[0]


def closed_at_rest(
    model: Model, actual: ModelWithErrors, state: State, multipliers: Float[Array, " constraints"]
) -> loads.Resting:
    """Motion and closure of a mechanism at rest, from which its loads follow."""
    motion, scale = motion_of(actual, state), length_scale(model)
    cuts, at_nodes = closure(actual, motion, scale), frame_loads(actual, motion, None)
    laws = with_ideal_couplings(actual, law_forces(actual, state), motion, multipliers, scale)
    return loads.Resting(motion, cuts, multipliers, laws, at_nodes)


def named(model: Model, joint_loads: loads.JointLoads) -> dict[str, Load]:
    """Loads by the names of the joints, in the order of the description."""
    order = [(name, model.topology.joints.index(name)) for name in model.joint_names]
    return {name: Load(joint_loads.force[:, j], joint_loads.moment[:, j]) for name, j in order}
