"""The discretised mechanism: `Model`, and the state's coordinates.

Place in the pipeline: topology; building makes it -> **model** -> with_errors -> kinematics.

Arrays are components first (see `algebra`); symbols as in `topology`.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Float

from rfem_jax.mechanics.laws.bearings import BearingCapacity
from rfem_jax.mechanics.laws.couplings import CouplingLaw
from rfem_jax.mechanics.laws.frame_forces import FrameForce
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.laws.joint_laws import JointLaw
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring
from rfem_jax.mechanics.laws.line_loads import LineLoad
from rfem_jax.mechanics.laws.point_laws import GivenLoad, TimeVector
from rfem_jax.mechanics.model.form import Form
from rfem_jax.mechanics.model.profiles import Profile, Taper
from rfem_jax.mechanics.model.sources import Source
from rfem_jax.mechanics.model.summary import model_text
from rfem_jax.mechanics.model.superelements import Superelement
from rfem_jax.mechanics.model.topology import Topology


class CarriedPoint(eqx.Module):
    """A point whose path is followed: the node that carries it and its position (3,) [m] in that node's frame;
    observer: the link from which it is seen, or the base; joint: whose centre on the child it is, None of others."""

    node: int = eqx.field(static=True)
    observer: int = eqx.field(static=True)
    position: Float[Array, "3"]
    joint: int | None = eqx.field(static=True, default=None)


class Coordinates(eqx.Module):
    """Coordinates of the tree joints [rad, m], joint by joint in the order of their links and of each kind's
    freedoms (positions of spherical and free joints: quaternions, see `orientations`), and the six coordinates (x, y,
    z, phi_x, phi_y, phi_z) [m, rad] of every free rfe relative to its link frame, with R = R_z R_y R_x (exact
    elements: R_y R_z R_x); also used for their rates and accelerations."""

    joints: Float[Array, " numbers"]
    elastic: Float[Array, "6 rfes"]


class State(eqx.Module):
    """Coordinates and rates of the mechanism at one instant."""

    position: Coordinates
    velocity: Coordinates


class Sections(eqx.Module):
    """Properties of the links' cross-sections, per unit length.

    stiffness: EA, GA_y, GA_z [N], GJ, EI_y, EI_z [N m^2], in the order of a sde's deflections (du, dphi).
    line_density: rho A [kg/m].
    rotary: rho I_x, rho I_y, rho I_z [kg m].
    damping: time constant eta of the stiffness-proportional damping [s].
    edges: of each link the stresses at points of its section's edge per unit of axial force [1/m^2], of bending moment
        about y and z, and of torque [1/m^3]; None where the edge is not known; zeros of a superelement whose stresses
        are.
    """

    stiffness: Float[Array, "6 links"]
    line_density: Float[Array, " links"]
    rotary: Float[Array, "3 links"]
    damping: Float[Array, " links"]
    edges: tuple[Float[Array, "loads points"] | None, ...] = ()

    @property
    def bending(self) -> Float[Array, " links"]:
        """EI_y, for bending in the plane of motion [N m^2]."""
        return self.stiffness[4]


class Model(eqx.Module):
    """The nominal, discretised mechanism (SI units).

    length: of the links [m]; section: of their cross-sections; parent_*, child_*: frames of the joints on
    their two sides (F and F_c), relative to the node's frame, which is the link frame for rfe 0 and the frame
    at the segment's middle for a free rfe; point_*: mass [kg], place in the node's frame [m] and principal
    moments of inertia [kg m^2] of the point masses and of the links that are bodies; point_products: their J_xy, J_xz,
    J_yz [kg m^2], None where all are zero; start_joints: coordinates of the tree joints at the closed start [rad, m];
    cut_angles: angles of the cut joints there [rad]; gravity [m/s^2] in global axes; forces: along joint coordinates,
    by their names, None without any; start_rates: initial rates of all coordinates of the tree joints [rad/s, m/s], of
    which those of `Topology.rated` count, likewise; frame_forces: elements between frames on nodes, likewise; springs:
    of compliant joints, by the names of joint and direction as "A.radial", likewise; bearings: what they carry, by
    joint, likewise; reaction_length [m]: over which moments count in the norm of reactions, None unless the least are
    asked for; points: whose paths are followed, by their names, None without any; line_loads: along links, likewise;
    shaking_point [m]: about which the moment on the base is taken, None for the origin; couplings: of joint
    coordinates, by their names, None without any; curvature: rotations about y and z per length [1/m] of links without
    load, None where all are straight; profiles: of every link its sections along it, None of one without stations;
    taper: rfes and sdes of all links; both None without any stations; form: of links that are not straight, None where
    all are (`Topology.shaped`); superelements: of the links `Topology.reduced`, None without any.

    Numbers of the description change by a `rfem_jax.design`, from which all arrays follow.  `equinox.tree_at` may
    replace what is no number of a description and leaves the geometry as it is, such as the stiffnesses of one link of
    several that share a section; a design knows nothing of that.  source: the numbers that the arrays were made of,
    None of a model that only programs see.
    """

    topology: Topology = eqx.field(static=True)
    length: Float[Array, " links"]
    section: Sections
    parent_rotation: Float[Array, "3 3 joints"]
    parent_position: Float[Array, "3 joints"]
    child_rotation: Float[Array, "3 3 joints"]
    child_position: Float[Array, "3 joints"]
    point_mass: Float[Array, " masses"]
    point_position: Float[Array, "3 masses"]
    point_inertia: Float[Array, "3 masses"]
    start_joints: Float[Array, " numbers"]
    cut_angles: Float[Array, " cuts"]
    gravity: Float[Array, "3"]
    forces: dict[str, JointLaw] | None = None
    point_products: Float[Array, "3 masses"] | None = None
    frame_forces: dict[str, FrameForce] | None = None
    friction: dict[str, Friction] | None = None
    springs: dict[str, CompliantSpring] | None = None
    source: Source | None = None
    bearings: dict[str, BearingCapacity] | None = None
    start_rates: Float[Array, " freedoms"] | None = None
    reaction_length: Float[Array, ""] | None = None
    points: dict[str, CarriedPoint] | None = None
    line_loads: dict[str, LineLoad] | None = None
    shaking_point: Float[Array, "3"] | None = None
    couplings: dict[str, CouplingLaw] | None = None
    curvature: Float[Array, "2 links"] | None = None
    profiles: tuple[Profile | None, ...] | None = None
    taper: Taper | None = None
    form: Form | None = None
    superelements: tuple[Superelement, ...] | None = None

    @property
    def vectors_of_time(self) -> list[TimeVector]:
        """The given loads at points and along links, as functions of time."""
        at_points = [one.value for one in (self.frame_forces or {}).values() if isinstance(one, GivenLoad)]
        along = [part for one in (self.line_loads or {}).values() for part in (one.first, one.last)]
        return at_points + [part for part in along if part is not None]

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of all its things, which are no part of programs (`compilation.naming`)."""
        parts = self.forces, self.friction, self.frame_forces, self.line_loads, self.couplings
        forces = (name for part in parts for name in part or {})
        others = () if self.source is None else self.source.own_names
        forces, points = ((one.partition(".")[0] for one in names) for names in (forces, self.points or {}))
        return (*self.topology.joints, *self.topology.links, *forces, *points, *others)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """All joints in the order of the description."""
        return self.topology.joint_order

    @property
    def link_names(self) -> tuple[str, ...]:
        """All links, parents before children."""
        return self.topology.links

    @property
    def driven_joint(self) -> str | None:
        """Name of the joint that the first drive acts on."""
        driven = self.topology.driven
        return None if driven is None else self.topology.joints[driven]

    def __str__(self) -> str:
        return model_text(self)

    __repr__ = __str__

    def start_coordinates(self) -> Coordinates:
        """Nominal start: closed geometry, undeformed links."""
        elastic = jnp.zeros((6, self.topology.n_rfes))
        return Coordinates(self.start_joints, elastic)


def at_closing(model: Model) -> Model:
    """The model as its start is closed: an ideal coupling whose offset is that of the start says nothing about it."""
    given = tuple(name for name in model.topology.ideal if (model.couplings or {})[name].offset is not None)
    if given == model.topology.ideal:
        return model
    return replace(model, topology=model.topology._replace(ideal=given))


def length_scale(model: Model) -> Float[Array, ""]:
    """The longest nominal link [m]: a scale, on which no result depends."""
    if not isinstance(model.length, Tracer):
        return jnp.asarray(np.max(np.asarray(model.length)), jnp.float64)
    return jax.lax.stop_gradient(jnp.max(model.length))
