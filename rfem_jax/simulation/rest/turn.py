"""The kinetostatic turn: the mechanism held still at one position of its drive after another.

Place in the pipeline: model, errors -> static equilibria -> **turn** -> report.

At every position the loops of the perfect rigid mechanism are closed first, and the equilibrium with errors, preload
and weight is sought from there (theory (6.1)). No dynamics: what remains of the loads when the drive moves slowly.
"""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.kernels import kernel
from rfem_jax.labelled_data import DataFrame, Dataset
from rfem_jax.mechanics.dynamics import energy_and_momentum
from rfem_jax.mechanics.dynamics.base_loads import ShakingLoad
from rfem_jax.mechanics.dynamics.load_axes import AXES, turned_loads
from rfem_jax.mechanics.dynamics.point_paths import point_motions
from rfem_jax.mechanics.elements.linear_validity import linear_error, linear_range
from rfem_jax.mechanics.forces.bush_contacts import ContactState, contact_states
from rfem_jax.mechanics.model.errors import AssemblyErrors, Deviations, Errors, deviations_of
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors
from rfem_jax.mechanics.statics.assembly import Load, held_angles, named
from rfem_jax.mechanics.statics.designs import designed, status_of
from rfem_jax.mechanics.statics.equilibrium_stability import Stability
from rfem_jax.simulation.outcome.run import PointPath
from rfem_jax.simulation.rest.poses import ClosedPose, posed, search_poses
from rfem_jax.simulation.rest.seen_at_rest import Still, at_rest, holding_load, largest_stresses, shaking_at_rest
from rfem_jax.simulation.system.equations import Numbers

if TYPE_CHECKING:
    from rfem_jax.simulation.rest.labelled_turn import LabelledTurn

POSITIONS = 72  # over a revolution, unless given


class Turn(eqx.Module):
    """A mechanism held at positions of its first drive.

    position [rad, m] of the driven coordinate; loads: of all joints by their names (positions, 3), in hinge frames;
    holding: moment [N m] or force [N] that holds the driven coordinate; energy [J]: elastic and of gravity; stress
    [Pa]: largest von Mises stress of every link whose section's edge is known (rigid links too); status of each
    assembly; contacts (positions, ...): of the joints with clearance, by their names; linear_error: estimated error of
    linear elements (`linear_validity`); points: `PointPath` of the points that are followed, at rest, couplings
    (positions, 2): loads [N m, N] along their two coordinates, by their names; in_axes: the loads in further `axes`, if
    these were asked for; shaking: what the mechanism exerts on its base, where it has a `shaking_point`; stability
    (positions,): how fast each equilibrium is left; slides: whether the driven coordinate is a displacement.
    """

    position: Float[Array, "*positions"]
    loads: dict[str, Load]
    holding: Float[Array, "*positions"]
    energy: Float[Array, "*positions"]
    stress: dict[str, Float[Array, "*positions"]]
    status: Int[Array, "*positions"]
    contacts: dict[str, ContactState] = eqx.field(default_factory=dict)
    linear_error: Float[Array, "*positions"] | None = None
    points: dict[str, PointPath] = eqx.field(default_factory=dict)
    in_axes: dict[str, Load] = eqx.field(default_factory=dict)
    couplings: dict[str, Float[Array, "*positions 2"]] = eqx.field(default_factory=dict)
    shaking: ShakingLoad | None = None
    stability: Stability | None = None
    slides: bool = eqx.field(static=True, default=False)
    axes: str = eqx.field(static=True, default="joint")

    @property
    def places(self) -> dict[str, Float[Numbers, "*positions 3"]]:
        """Places [m] of the points that are followed, by their names."""
        return {name: one.position for name, one in self.points.items()}

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of loads, places and what holds, with units and long names."""
        return self._labelled().to_xarray()

    def to_pandas(self) -> DataFrame:
        """A `pandas.DataFrame` with a row for every position."""
        return self._labelled().to_pandas()

    def __str__(self) -> str:
        return str(self._labelled())

    def _repr_html_(self) -> str:
        return self._labelled()._repr_html_()

    def _labelled(self) -> "LabelledTurn":
        from rfem_jax.simulation.rest.labelled_turn import LabelledTurn

        return LabelledTurn.of(self)


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
    """Closed poses of the perfect rigid mechanism at positions [rad, m] of its first drive. Raises `InputError` for a
    position at which it does not close."""
    assert model.topology.driven_coordinate is not None, "turns are of driven mechanisms"
    return search_poses(model, {model.topology.driven_coordinate: positions})


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
    with jax.ensure_compile_time_eval():  # tables of couplings are read by numbers, also within a jit of the user's
        poses = closed_poses(model, positions)
    return turn_over(model, deviations_of(model, errors), poses, axes)


@partial(Program, nameless=True)
def turn_over(model: Model, errors: Deviations, poses: ClosedPose, axes: str = "joint") -> Turn:
    """The turn over closed poses; `axes`: as of `kinetostatic_turn`."""
    made = designed(model, None, errors)
    at_pose = kernel(partial(held_at, axes=axes), name="held still", in_parts=True)
    turn = jax.lax.map(lambda pose: at_pose(made.model, made.errors, pose), poses)
    return eqx.tree_at(lambda t: t.status, turn, status_of(turn.status, made))


def held_at(model: Model, errors: AssemblyErrors, pose: ClosedPose, stresses: bool = True, axes: str = "joint") -> Turn:
    """The mechanism held at one closed pose, with the stresses of its links if wanted; `axes`: as of
    `kinetostatic_turn`."""
    # Crooked pins are those of the start.
    actual, model = apply_errors(model, errors), posed(model, pose)
    see = partial(_seen, stresses=stresses, axes=axes)
    _, status, turn, leaving = at_rest(model, actual, held_angles(model, None), see)
    return replace(turn, status=status, stability=leaving)


def _seen(
    model: Model,
    actual: ModelWithErrors,
    state: State,
    still: Still,
    _: Coordinates,
    stresses: bool,
    axes: str,
) -> Turn:
    """The turn at one position, but for its status and stability."""
    topology = model.topology
    k = topology.driven_coordinate
    assert k is not None, "turns are of driven mechanisms"
    meshes = {} if still.laws is None else still.laws.couplings or {}
    turned = {}
    if axes != "joint":
        turned = named(model, turned_loads(topology, still.motion, still.closure, still.loads, axes))
    energy = energy_and_momentum.energies(actual, state)
    points = point_motions(actual, still.motion, still.angular, still.linear)
    return Turn(
        position=state.position.joints[topology.driven_position],
        loads=named(model, still.loads),
        holding=holding_load(model, still, k),
        energy=energy.elastic + energy.gravity,
        stress=largest_stresses(model, actual, state, still) if stresses else {},
        status=jnp.zeros((), jnp.int32),
        contacts=contact_states(actual, still.motion),
        linear_error=linear_error(linear_range(actual, state.position)),
        points={name: PointPath.of(one, topology.plane) for name, one in points.items()},
        in_axes=turned,
        couplings={name: mesh.loads for name, mesh in meshes.items()},
        shaking=None if model.shaking_point is None else shaking_at_rest(model, actual, still),
        slides=bool(topology.slides[k]),
        axes=axes,
    )
