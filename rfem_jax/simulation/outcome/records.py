"""What a run records beside its loads when it is asked to: for metrics that need it, and for no other run.

Place in the pipeline: section_loads, observation -> **records** -> integration; Problem asks for what its metrics read.

    LINK.sections           internal forces and moments along a link, and stresses: `SectionHistory`;
                            LINK@FRACTION.sections of the one section at a fraction of the length
    LINK.deflection         displacement (times, 3) [m] of its far end from its place on the undeformed link, in the
                            link's frame; LINK@FRACTION.deflection of the point at a fraction of the length
    JOINT.turning           rate (times,) [rad/s] of the child against the parent about the joint's axis, of a joint
                            that turns about several axes its size
    JOINT.friction_loss     energy (times,) [J] that friction in a joint has dissipated
    JOINT.bearing           its capacities, a `BearingCapacity`
    masses                  {link: mass with point masses [kg]}
    shaking                 what the mechanism exerts on its base, a `ShakingLoad`
    POINT.perfect_path      `PerfectPath` of the point on the perfect mechanism under the same drive, with the values of
                            the design: another simulation, which a batch shares
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.metrics.subjects import divided
from rfem_jax.mechanics.algebra.vectors import apply, dot
from rfem_jax.mechanics.dynamics.base_loads import shaking_load
from rfem_jax.mechanics.dynamics.energy_and_momentum import velocities
from rfem_jax.mechanics.dynamics.point_paths import PointMotion
from rfem_jax.mechanics.dynamics.section_loads import (
    COUPLED_ROWS,
    Moving,
    SectionLoads,
    loads_of_section,
    loads_of_sections,
    section_edges,
    stress_squares,
)
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.superelements import TENSOR_ROWS
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.outcome.observation import Instant
from rfem_jax.simulation.system.equations import Numbers, safe_sqrt

OF_LINKS, OF_JOINTS, OF_RUNS = (
    ("sections", "deflection"),
    ("turning", "friction_loss", "bearing"),
    ("masses", "shaking"),
)
PERFECT_PATH = "perfect_path"  # of points


@runtime_checkable
class Placed(Protocol):
    """A mechanism at one instant, of which only the motion is needed."""

    @property
    def motion(self) -> Motion: ...


class PerfectPath(NamedTuple):
    """The motion of a point of the perfect mechanism at the saved times; position [rad, m] and rate of its first driven
    coordinate, zero without a drive."""

    path: PointMotion
    drive_position: Float[Numbers, " times"]
    drive_rate: Float[Numbers, " times"]


class SectionHistory(eqx.Module):
    """Sections of a link at the saved times: place (sections,) [m] along the link; resultants (times, 6, sections):
    axial and shear forces N, Q_y, Q_z [N], torque T and bending moments M_y, M_z [N m], which the part with the larger
    x exerts; edge: stresses at points of the section's edge per unit of N, M_y, M_z and T, of a
    coupled section direct and shear stresses per unit of all six, None if not known; modulus:
    Young's modulus [Pa]. Of a reduced body there are places of it instead, with the components of stress xx, yy, zz,
    xy, yz, zx [Pa] as resultants."""

    place: Float[Array, "... sections"]
    resultants: Float[Array, "*times 6 sections"]
    edge: Float[Array, "loads points"] | Float[Array, "loads points sections"] | None
    modulus: Float[Array, ""] | None = None

    @property
    def stress_squares(self) -> Float[Array, "*times points sections"]:
        """Squares of the von Mises stress [Pa^2] of axial force, bending and torsion at points of the edge."""
        return stress_squares(self._known_edge, jnp.asarray(self.resultants))

    @property
    def stress(self) -> Float[Array, "*times sections"]:
        """Largest von Mises stress [Pa] at the edge of every section."""
        return safe_sqrt(jnp.max(self.stress_squares, axis=-2))

    def direct_stress(self, side: str) -> Float[Array, "*times sections"]:
        """Stress [Pa] along the link in the middle of a side of the section, "y", "-y", "z" or "-z" in the link's axes:
        what a strain gauge there feels (theory (17.15))."""
        edge, resultants = self._known_edge, jnp.asarray(self.resultants)
        if edge.shape[0] in (COUPLED_ROWS, TENSOR_ROWS):
            raise InputError(
                "Argument `side` must be of a section with sides whose middles are known, but that of this link is not "
                "symmetric or is given by a matrix, or it has a reduced body; take its largest stress, `stress`."
            )
        edge = edge if edge.ndim == 3 else edge[:, :, None]
        outermost = {"y": jnp.min, "-y": jnp.max, "z": jnp.max, "-z": jnp.min}[side]
        by_moment, moment = (edge[2], 5) if "y" in side else (edge[1], 4)
        force, moment = resultants[..., 0, :], resultants[..., moment, :]
        per_force, per_moment = (jnp.broadcast_to(x, force.shape) for x in (edge[0, 0], outermost(by_moment, axis=0)))
        return per_force * force + per_moment * moment

    def strain(self, side: str) -> Float[Array, "*times sections"]:
        """`direct_stress` over Young's modulus."""
        assert self.modulus is not None, "runs know it"
        return self.direct_stress(side) / self.modulus

    @property
    def _known_edge(self) -> Float[Array, "loads points"] | Float[Array, "loads points sections"]:
        if self.edge is None:
            raise InputError(
                "Argument `edge` of a section must be given for stresses, but is missing; write `edge_y`, `edge_z`, "
                "`edge_modulus` and `torsion_modulus` into the section, or leave out stresses of rigid bodies."
            )
        return jnp.asarray(self.edge)


def require_records(model: Model, names: str | Iterable[str]) -> tuple[str, ...]:
    """The names of records, each once. Raises InputError for a record that the model does not have."""
    names = tuple(dict.fromkeys((names,) if isinstance(names, str) else names))
    for name in names:
        _require_record(model, name)
    return names


def _require_record(model: Model, name: str) -> None:
    owner, _, kind = name.rpartition(".")
    known = {
        **dict.fromkeys(OF_LINKS, model.link_names),
        **dict.fromkeys(OF_JOINTS, model.joint_names),
        "bearing": tuple(model.bearings or {}),
        PERFECT_PATH: tuple(model.points or {}),
        "friction_loss": tuple({model.topology.joints[law.joint] for law in (model.friction or {}).values()}),
    }
    if not owner and name in OF_RUNS:
        return
    if not owner or kind not in known:
        every = [f"{(known[one] or ('A',))[0]}.{one}" for one in known if known[one] or one != PERFECT_PATH]
        every += [*OF_RUNS]
        raise InputError(
            f"Argument `record` must name records, but {name!r} is not a record; {suggestion(name, every)}"
        )
    of = divided(owner)[0] if kind in OF_LINKS else owner
    if of not in known[kind]:
        special = {
            "bearing": "joints with a `bearing`", "friction_loss": "joints with friction", PERFECT_PATH: "points",
        }  # fmt: skip
        whose = special.get(kind, "joints" if kind in OF_JOINTS else "links")
        raise InputError(
            f"Argument `record` must be of {whose} of the model, but {name!r} is not; {suggestion(of, known[kind])}"
        )


def instant_records(
    model: Model, actual: ModelWithErrors, state: State, instant: Instant, names: Sequence[str]
) -> dict[str, Any]:
    """Records of one instant, by their names."""
    records: dict[str, Any] = {}
    for name in names:
        owner, _, kind = name.rpartition(".")
        if name == "shaking":
            records[name] = shaking_load(model, actual, instant.base, instant.frame_loads)
        if kind == "sections":
            records[name] = sections_of(model, actual, state, instant, owner)
        if kind == "deflection":
            records[name] = deflection(actual, instant, *divided(owner))
        if kind == "turning":
            records[name] = _turning(actual, instant, actual.topology.joints.index(owner))
    return records


def sections_of(model: Model, actual: ModelWithErrors, state: State, now: Moving, owner: str) -> SectionLoads:
    """Loads in the sections of "LINK", or in the one of "LINK@FRACTION"."""
    name, fraction = divided(owner)
    link = actual.topology.links.index(name)
    if "@" in owner:
        return loads_of_section(model, actual, state, now, link, fraction)
    return loads_of_sections(model, actual, state, now, link)


def finished_records(
    model: Model,
    actual: ModelWithErrors,
    saved: dict[str, Any],
    friction_losses: Float[Array, "times frictions"] | None,
    names: Sequence[str],
    perfect: dict[str, PerfectPath],
) -> dict[str, Any]:
    """The records of a run, of those of all saved times, of constants, and of the points of the perfect mechanism."""
    records: dict[str, Any] = {}
    for name in names:
        owner, _, kind = name.rpartition(".")
        if kind == "sections":
            link = model.topology.links.index(divided(owner)[0])
            edge = section_edges(model, actual, link, saved[name].place[0])
            own = model.section.edges[link] if model.section.edges else None
            plain = own is not None and own.shape[0] != TENSOR_ROWS
            modulus = None if own is None or not plain else model.section.stiffness[0, link] * own[0, 0]
            records[name] = SectionHistory(saved[name].place[0], saved[name].resultants, edge, modulus)
        elif kind == "friction_loss":
            joint = model.topology.joints.index(owner)
            laws = sorted((model.friction or {}).items())
            wanted = [friction_losses[:, i] for i, (_, law) in enumerate(laws) if law.joint == joint]  # pyright: ignore[reportOptionalSubscript] # there is friction
            records[name] = sum(wanted, jnp.zeros(()))
        elif kind == "bearing":
            records[name] = (model.bearings or {})[owner]
        elif name == "masses":
            records[name] = masses(actual)
        elif kind == PERFECT_PATH:
            records[name] = perfect[owner]
        else:
            records[name] = saved[name]
    return records


def asks_perfect_path(names: Iterable[str]) -> bool:
    """Whether any record is of the perfect mechanism."""
    return any(name.endswith(f".{PERFECT_PATH}") for name in names)


def masses(actual: ModelWithErrors) -> dict[str, Float[Array, ""]]:
    """Masses [kg] of the links with their point masses and bodies."""
    topology, by_link = actual.topology, {}
    for l, (name, (a, b)) in enumerate(zip(topology.links, topology.ranges, strict=True)):
        by_link[name] = actual.mass[l] + jnp.sum(actual.mass[topology.n_links + a : topology.n_links + b])
    return by_link


def deflection(actual: ModelWithErrors, instant: Placed, name: str, fraction: float) -> Float[Array, "3"]:
    """Displacement [m] of the point at a fraction of a link's length from its place on the undeformed link, in the
    link's frame."""
    topology, relative = actual.topology, instant.motion.relative
    link = topology.links.index(name)
    first, _ = topology.ranges[link]
    lengths, middles = topology.fractions(link)
    rfe = int(np.searchsorted(np.cumsum(lengths)[:-1], fraction, side="right"))
    for one in topology.reduced:
        if one.link == link:
            rfe = int(np.abs(fraction - np.array([0.0, *one.shares])).argmin())
    if rfe == 0:
        return jnp.zeros(3)
    k = first + rfe - 1
    if actual.form is not None:
        arms = (
            actual.form.at(link, jnp.reshape(fraction * actual.form.whole(link), 1)).position[:, 0] - actual.rest[:, k]
        )
        turned = relative.rotation[:, :, k] - jnp.eye(3)
        return relative.position[:, k] - actual.rest[:, k] + apply(turned, arms)
    arm = (fraction - middles[rfe]) * actual.beam_middle[link] / middles[0]
    along = jnp.asarray(np.eye(3)[0])
    moved = relative.position[:, k] - along * actual.rest[k]
    return moved + (relative.rotation[:, 0, k] - along) * arm


def _turning(actual: ModelWithErrors, instant: Instant, joint: int) -> Float[Array, ""]:
    """Rate [rad/s] of the child against the parent about the axis of a joint, its size where there is no axis."""
    topology = actual.topology
    spins = _node_spins(actual, instant)
    sides = topology.parents[joint], topology.children[joint]
    parent, child = (jnp.zeros(3) if node == BASE else spins[:, node] for node in sides)
    relative = child - parent
    kind = topology.kind(joint).nominal
    if kind.axis is None:
        return safe_sqrt(dot(relative, relative))
    return dot(_joint_axes(topology, instant, joint)[:, kind.axis], relative)


def _node_spins(actual: ModelWithErrors, instant: Instant) -> Float[Array, "3 nodes"]:
    """Angular velocities [rad/s] of all nodes in global axes."""
    return velocities(actual, instant.motion)[3]


def _joint_axes(topology: Topology, instant: Instant, joint: int) -> Float[Array, "3 3"]:
    """Axes of a joint's frame H, of a cut joint those of L."""
    if joint < topology.n_links:
        return instant.motion.hinges.rotation[:, :, joint]
    assert instant.closure is not None, "cut joints have closure equations"
    return instant.closure.rotation[:, :, joint - topology.n_links]
