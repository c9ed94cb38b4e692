"""Loads of a mechanism, or of a structure, at rest, at its start or at given positions of what is held; of rigid links
also in given motion, which is inverse dynamics.

Place in the pipeline: model, errors -> static equilibria, seen_at_rest -> **statics** -> report, tolerancing.

Held are the coordinates of the drives and, unless the mechanism starts in equilibrium, those that stand for all other
freedoms (theory (6.9)): what holds them is in the result. At given positions the loops of the perfect rigid mechanism
are closed first, and the equilibrium with errors, preload and weight is sought from there (theory (6.1)). With rates
and accelerations of what is held those of all else follow from the closure equations, and the loads from the equations
of motion (theory (6.11)): nothing is integrated.

`StaticLoads` has the attributes of a `Run` that metrics of a mechanism at rest read, with positions in the place of
saved times.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.description.metrics.subjects import divided
from rfem_jax.kernels import kernel
from rfem_jax.labelled_data import DataFrame, Dataset
from rfem_jax.mechanics.dynamics import energy_and_momentum, loads
from rfem_jax.mechanics.dynamics.point_paths import PointMotion, point_motions
from rfem_jax.mechanics.elements.linear_validity import linear_error, linear_range
from rfem_jax.mechanics.forces.bush_contacts import ContactState, contact_states
from rfem_jax.mechanics.model.errors import Deviations, Errors, assembly_errors, deviations_of
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors
from rfem_jax.mechanics.statics.assembly import Load
from rfem_jax.mechanics.statics.designs import Design, designed, status_of
from rfem_jax.mechanics.statics.equilibrium_stability import Stability
from rfem_jax.mechanics.statics.static_equations import start_values
from rfem_jax.simulation.outcome.observation import coupling_histories, energy_at
from rfem_jax.simulation.outcome.records import (
    PerfectPath,
    asks_perfect_path,
    deflection,
    finished_records,
    require_records,
    sections_of,
)
from rfem_jax.simulation.outcome.run import CouplingHistory, DriveHistory, Energy, Loads, Metrics, PointPath
from rfem_jax.simulation.rest.poses import ClosedPose, Positions, posed, poses_at, start_pose
from rfem_jax.simulation.rest.seen_at_rest import (
    Still,
    at_rest,
    holding_load,
    in_motion,
    largest_stresses,
    shaking_at_rest,
)
from rfem_jax.simulation.stages.conclusion import LoadSummary, ball_angles, joint_coordinates, load_metrics
from rfem_jax.simulation.system.equations import Numbers, safe_sqrt, squares


class HeldMotion(NamedTuple):
    """The parts of a run's `Motion` that there are at rest."""

    drives: dict[str, DriveHistory]
    angles: dict[str, Float[Numbers, " positions ..."]]
    displacements: dict[str, Float[Numbers, " positions ..."]]


class StaticChecks(eqx.Module):
    """How far results at rest can be trusted, the worst of all positions: momentum_balance_error, force and moment that
    the whole mechanism lacks for equilibrium, relative to the largest load; linear_error, estimated error of linear
    elements (theory (1.16))."""

    momentum_balance_error: Float[Numbers, "*cases"]
    linear_error: Float[Numbers, "*cases"]


class StaticLoads(eqx.Module):
    """A mechanism at rest at one position, or at several, which are the axis that a run has for times.

    position [rad, m] and holding [N m, N] of every coordinate that is held, by its name ("A", "C.T_y"): holding is what
    has to act on it from outside. loads: of all joints (positions, 3), in hinge frames; metrics of them over the
    positions; angles [rad], displacements [m] of the tree joints; energy [J]; points: `PointPath` of every point;
    rate, acceleration of the held coordinates, zero at rest; recorded: by the names of `outcome.records`,
    "LINK.sections" and "LINK.deflection" of flexible links among them, "shaking" where it is asked for; couplings:
    `CouplingHistory` of every coupling;
    stress [Pa]: largest von Mises stress of every link whose section's edge is known; contacts: of joints with
    clearance; status: code of `STATUS` of every position; stability (positions,): how fast each equilibrium is left,
    None in motion.
    """

    position: dict[str, Float[Numbers, "*positions"]]
    holding: dict[str, Float[Numbers, "*positions"]]
    loads: Loads
    metrics: Metrics
    angles: dict[str, Float[Numbers, "..."]]
    displacements: dict[str, Float[Numbers, "..."]]
    energy: Energy
    stress: Mapping[str, Float[Numbers, "*positions"]]
    points: dict[str, PointPath]
    contacts: dict[str, ContactState]
    recorded: dict[str, Any]
    checks: StaticChecks
    status: Int[Numbers, "*positions"]
    rate: dict[str, Float[Numbers, "*positions"]]
    acceleration: dict[str, Float[Numbers, "*positions"]]
    couplings: dict[str, CouplingHistory] = eqx.field(default_factory=dict)
    stability: Stability | None = None

    @property
    def preload(self) -> dict[str, Load]:
        """Loads at the first position."""
        return {name: Load(load.force[0], load.moment[0]) for name, load in self.loads.items()}

    @property
    def motion(self) -> HeldMotion:
        """Where it is, in the form of a run's motion; held coordinates are driven ones."""
        drives = {name: DriveHistory(x, self.rate[name], self.holding[name]) for name, x in self.position.items()}
        return HeldMotion(drives, self.angles, self.displacements)

    def to_xarray(self) -> Dataset:
        """An `xarray.Dataset` of everything, with units and long names."""
        from rfem_jax.simulation.rest.labelled_statics import LabelledStatics

        return LabelledStatics.of(self).to_xarray()

    def to_pandas(self) -> DataFrame:
        """A `pandas.DataFrame` with a row for every position."""
        from rfem_jax.simulation.rest.labelled_statics import LabelledStatics

        return LabelledStatics.of(self).to_pandas()

    def __str__(self) -> str:
        from rfem_jax.simulation.rest.labelled_statics import LabelledStatics

        return str(LabelledStatics.of(self))

    def _repr_html_(self) -> str:
        from rfem_jax.simulation.rest.labelled_statics import LabelledStatics

        return LabelledStatics.of(self)._repr_html_()


def static_loads(
    model: Model,
    errors: Errors | None = None,
    positions: Positions | None = None,
    *,
    design: Design | None = None,
    record: str | Iterable[str] = (),
) -> StaticLoads:
    """Loads in all joints, sections and points of a mechanism or a structure at rest.

    **Arguments:** `errors` from `assembly_errors`, or {name: value} (None: perfect); `positions`: {name of a held
    coordinate, as "A" or "C.T_y": its value, or values (n,) [rad, m]}, others stay at their start (None: the start);
    `design`: from `rfem_jax.design`; `record`: what the result records besides, as of `simulate`, such as
    "beam@0.5.deflection".

    **Returns:** `StaticLoads`. Differentiable with respect to errors, design and deviations of parameters, also under
    jit, vmap, forward and reverse mode.

    **Raises:** `InputError` for a coordinate that is not held, and for positions at which the loops do not close.
    """
    require_float64()
    asked = require_records(model, (*usual_records(model), *([record] if isinstance(record, str) else record)))
    poses = poses_at(model, positions)
    return static_loads_at(model, deviations_of(model, errors), poses, asked, design)


def inverse_dynamics(
    model: Model,
    positions: Positions | None = None,
    rates: Positions | None = None,
    accelerations: Positions | None = None,
    errors: Errors | None = None,
    *,
    design: Design | None = None,
    record: str | Iterable[str] = (),
) -> StaticLoads:
    """Loads in all joints and what has to drive a mechanism of rigid links in a given motion, at one instant or at
    several, without integration.

    **Arguments:** `positions`, `rates` [rad/s, m/s], `accelerations` [rad/s^2, m/s^2]: {name of a held coordinate, as
    "A" or "C.T_y": value, or values (n,)}; positions that are not given are those of the start, rates and accelerations
    zero; `errors`, `design`, `record`: as of `static_loads`.

    **Returns:** `StaticLoads`, whose `holding` drives.  Differentiable as `static_loads`.

    **Raises:** `InputError` as `static_loads`, and for links or joints that give way, which would swing.
    """
    require_float64()
    asked = require_records(model, [record] if isinstance(record, str) else record)
    poses = poses_at(model, positions, rates or {}, accelerations or {})
    return static_loads_at(model, deviations_of(model, errors), poses, asked, design)


def usual_records(model: Model) -> tuple[str, ...]:
    """What is recorded of the flexible links."""
    topology = model.topology
    names = [name for name, n in zip(topology.links, topology.elements, strict=True) if n > 1]
    bodies = {topology.links[one.link] for one in topology.reduced}
    kinds = ("sections", "deflection")
    return tuple(f"{name}.{kind}" for name in names for kind in (kinds[1:] if name in bodies else kinds))


@partial(Program, nameless=True)
def static_loads_at(
    model: Model,
    errors: Deviations,
    poses: ClosedPose | None,
    asked: Sequence[str],
    design: Design | None = None,
) -> StaticLoads:
    """Static loads over closed poses, None for the start; `asked`: names of records."""
    perfect = None
    if asks_perfect_path(asked):
        # Errors of places are from where the perfect mechanism of the same design is.
        perfect = designed(model, design, assembly_errors(model)).model
    made = designed(model, design, errors)
    poses = start_pose(made.model) if poses is None else poses
    actual = apply_errors(made.model, made.errors)
    at_pose = kernel(partial(_at_pose, asked=asked), name="loads at rest", in_parts=True)
    found = jax.lax.map(lambda pose: at_pose(made.model, actual, pose), poses)
    paths = {} if perfect is None else _perfect_paths(perfect, poses, asked)
    return _named_results(made.model, actual, found, asked, paths, status_of(found.status, made))


class _Seen(NamedTuple):
    """What follows from the loads at one position, by index."""

    holding: tuple[Float[Array, ""], ...]
    loads: loads.JointLoads
    squares: Float[Array, "4 joints"]
    energy: Energy
    stress: dict[str, Float[Array, ""]]
    points: dict[str, PointMotion]
    contacts: dict[str, ContactState]
    saved: dict[str, Any]
    balance: Float[Array, ""]
    linear_error: Float[Array, ""]
    couplings: dict[str, CouplingHistory]


class _Found(NamedTuple):
    """What there is at one position; rates and accelerations of what is held."""

    position: Coordinates
    seen: _Seen
    status: Int[Array, ""]
    rates: Float[Array, " held"]
    accelerations: Float[Array, " held"]
    stability: Stability | None


def _at_pose(model: Model, actual: ModelWithErrors, pose: ClosedPose, asked: Sequence[str]) -> _Found:
    model = posed(model, pose)
    values, held, seen = start_values(model).joints, model.topology.held_at_start, partial(_seen, asked=asked)
    if pose.rates is None or pose.accelerations is None:
        zeros = jnp.zeros(len(held))
        state, status, there, leaving = at_rest(model, actual, {k: values[k] for k in held}, seen)
        return _Found(state.position, there, status, zeros, zeros, leaving)
    motions = {k: (values[k], pose.rates[i], pose.accelerations[i]) for i, k in enumerate(held)}
    state, status, there = in_motion(model, actual, motions, seen)
    return _Found(state.position, there, status, pose.rates, pose.accelerations, None)


def _seen(
    model: Model, actual: ModelWithErrors, state: State, still: Still, accelerated: Coordinates, asked: Sequence[str]
) -> _Seen:
    axial, normal, moment = squares(model.topology, still.loads)
    zero = jnp.zeros(())
    return _Seen(
        holding=tuple(holding_load(model, still, k) for k in model.topology.held_at_start),
        loads=still.loads,
        squares=jnp.stack([axial, normal, axial + normal, moment]),
        energy=energy_at(actual, state, zero, zero),
        stress=largest_stresses(model, actual, state, still),
        points=point_motions(actual, still.motion, still.angular, still.linear),
        contacts=contact_states(actual, still.motion),
        saved=_saved(model, actual, state, still, asked),
        balance=jax.lax.stop_gradient(_balance(actual, state, still, accelerated)),
        linear_error=linear_error(linear_range(actual, state.position)),
        couplings=coupling_histories(still.laws),
    )


def _saved(model: Model, actual: ModelWithErrors, state: State, still: Still, asked: Sequence[str]) -> dict[str, Any]:
    """Records of one position, by their names; nothing turns, and no friction has dissipated anything."""
    records: dict[str, Any] = {}
    for name in asked:
        owner, _, kind = name.rpartition(".")
        if kind == "sections":
            records[name] = sections_of(model, actual, state, still, owner)
        if kind == "deflection":
            records[name] = deflection(actual, still, *divided(owner))
        if name == RECORD:
            records[name] = shaking_at_rest(model, actual, still)
    return records


def _balance(actual: ModelWithErrors, state: State, still: Still, accelerated: Coordinates) -> Float[Array, ""]:
    """Force and moment that the whole mechanism lacks for its momentum, at rest for equilibrium, over the largest load
    of a joint (theory (11.8))."""
    base = loads.base_wrench(actual.topology, still.wrenches)
    force, moment = energy_and_momentum.momentum_residual(actual, state, accelerated, base, still.frame_loads)
    largest_force = safe_sqrt(jnp.max(jnp.sum(still.loads.force**2, axis=0)))
    arm = jnp.max(jnp.abs(still.motion.hinges.point))
    largest_moment = safe_sqrt(jnp.max(jnp.sum(still.loads.moment**2, axis=0))) + largest_force * arm

    def share(part, whole):
        return jnp.max(jnp.abs(part)) / jnp.where(whole > 0.0, whole, 1.0)

    return jnp.maximum(share(force, largest_force), share(moment, largest_moment))


def _perfect_paths(model: Model, poses: ClosedPose, asked: Sequence[str]) -> dict[str, PerfectPath]:
    """Places of the points of the perfect mechanism at the same positions."""
    actual = apply_errors(model, assembly_errors(model))
    found = jax.lax.map(lambda pose: _at_pose(model, actual, pose, ()), poses)
    zeros = jnp.zeros(found.status.shape)
    names = [name.rpartition(".")[0] for name in asked if asks_perfect_path([name])]
    return {name: PerfectPath(found.seen.points[name], zeros, zeros) for name in names}


def _named_results(
    model: Model,
    actual: ModelWithErrors,
    found: _Found,
    asked: Sequence[str],
    perfect: dict[str, PerfectPath],
    status: Int[Array, " positions"],
) -> StaticLoads:
    """Results by the names of joints, links and held coordinates."""
    topology, joints = model.topology, found.position.joints
    labels = {topology.label_of(k): i for i, k in enumerate(topology.held_at_start)}
    mean = jnp.mean(jnp.stack([found.seen.squares[:, 2], found.seen.squares[:, 3]], axis=1), axis=0)
    without_axis = np.array([topology.kind(j).axis is None for j in range(len(topology.joints))])
    unknown = np.stack([without_axis, without_axis, *(2 * [np.zeros_like(without_axis)])])
    highest = jnp.where(unknown, jnp.nan, safe_sqrt(jnp.max(found.seen.squares, axis=0)))
    order = [(name, topology.joints.index(name)) for name in model.joint_names]
    balls = ball_angles(model, joints)
    held = [_coordinate(model, joints, k) for k in topology.held_at_start]
    return StaticLoads(
        position={label: held[i] for label, i in labels.items()},
        holding={label: found.seen.holding[i] for label, i in labels.items()},
        loads=Loads(
            {name: Load(found.seen.loads.force[:, :, j], found.seen.loads.moment[:, :, j]) for name, j in order}
        ),
        metrics=load_metrics(model, LoadSummary(mean, safe_sqrt(mean), highest)),
        angles=joint_coordinates(model, joints, balls, rotation=True),
        displacements=joint_coordinates(model, joints, balls, rotation=False),
        energy=found.seen.energy,
        stress=found.seen.stress,
        points={name: PointPath.of(one, topology.plane) for name, one in found.seen.points.items()},
        contacts=found.seen.contacts,
        recorded=finished_records(model, actual, found.seen.saved, None, asked, perfect),
        checks=StaticChecks(jnp.max(found.seen.balance), jnp.max(found.seen.linear_error)),
        status=status,
        rate={label: found.rates[:, i] for label, i in labels.items()},
        acceleration={label: found.accelerations[:, i] for label, i in labels.items()},
        couplings=found.seen.couplings,
        stability=found.stability,
    )


def _coordinate(model: Model, joints: Float[Array, "positions numbers"], k: int) -> Float[Array, " positions"]:
    """A held coordinate [rad, m] at all positions; zero, where it is held, of one about any axis."""
    topology = model.topology
    return jnp.zeros(joints.shape[0]) if topology.freedoms[k].any_axis else joints[:, topology.place_of(k)]


def first_status(codes: Int[Array, " positions"]) -> Int[Array, ""]:
    """The status of all positions: that of the first one that is not OK."""
    return codes[jnp.argmax(codes != 0)]
