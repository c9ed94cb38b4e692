"""Loads of planar loops of rigid links: unique within the plane, not across it.

Place in the pipeline: nominal_geometry, normal_loads -> **planar_loops** -> discretisation, errors, designs.

Loops of rigid links whose hinges are parallel, and whose slides are perpendicular to these, have three closure
equations too many. The reactions that these leave open, states of self-stress, are forces along the normal of the plane
and moments about axes in it: the loads in the plane are unique, and those across it are zero where the whole mechanism
is symmetric to its plane, or else those of least norm (theory (5.20)). An error that such a state does work on opens a
loop in which nothing gives: its loads are infinite, and it has no derivatives.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.tolerances.error_catalogue import LINK_ERRORS
from rfem_jax.mechanics.laws.line_loads import LineLoad
from rfem_jax.mechanics.laws.point_laws import ConstantVector, GivenLoad
from rfem_jax.mechanics.model.building import PartStructure, arrays_of
from rfem_jax.mechanics.model.form import wave
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.nominal_geometry import (
    NominalGeometry,
    Placed,
    axis_places,
    closure_jacobian,
    gaps,
    geometry_of,
    node_place,
    null_space,
    place,
)
from rfem_jax.mechanics.model.normal_loads import UNIQUE, joint_wrenches

ZERO_ACROSS, LEAST_ACROSS = "zero", "least_norm"
PLACES = 50  # along a link that must lie in the plane
IN_PLANE = 1e-9  # of the longest link, of a direction, of a moment of inertia
DIFFERENCE = 1e-6  # of a number, m or rad, for its effect on the loops


class _SelfStress(NamedTuple):
    """The perfect mechanism at its start; force (J, 3, k) and moment (J, 3, k) about the child's centre over the
    longest link, of all joints, by the orthonormal multipliers (c, k) of k states of self-stress."""

    geometry: NominalGeometry
    placed: Placed
    multipliers: Float[np.ndarray, "multipliers states"]
    force: Float[np.ndarray, "joints 3 states"]
    moment: Float[np.ndarray, "joints 3 states"]

    @property
    def smallest(self) -> float:
        """What counts as no load."""
        return UNIQUE * max(float(np.abs(part).max(initial=0.0)) for part in (self.force, self.moment))

    def loads(self, joint: int, axis: np.ndarray, turns: bool, centre: np.ndarray) -> bool:
        """Whether self-stress does work where a joint's frame turns about an axis through a centre, or moves along
        it."""
        force, moment = self.force[joint], self.moment[joint]
        if turns:
            arm = (self.placed.child_centre[joint] - centre) / self.geometry.scale
            force = moment + np.cross(arm, force, axisb=0, axisc=0)
        return bool(np.abs(axis @ force).max(initial=0.0) > self.smallest)


def _self_stress(model: Model) -> _SelfStress:
    geometry = geometry_of(model)
    placed = place(geometry, np.asarray(model.start_joints))
    multipliers = null_space(closure_jacobian(geometry, placed, rigid=False).T)
    force, moment = joint_wrenches(geometry, placed, multipliers)
    return _SelfStress(geometry, placed, multipliers, force, moment)


def reactions_across(model: Model) -> str:
    """What the loads across the plane of planar rigid loops are: "zero" by symmetry or "least_norm"; "" where loads in
    the plane are not unique either, or the loops are in no plane."""
    state = _self_stress(model)
    normal = _normal(state)
    if normal is None:
        return ""
    return ZERO_ACROSS if _is_symmetric(model, state, normal) else LEAST_ACROSS


def _normal(state: _SelfStress) -> np.ndarray | None:
    """The normal of the plane of all joints that states of self-stress load, if these load them across it alone."""
    topology, turns, slides = state.geometry.topology, [], []
    loaded = [j for j in range(len(topology.joints)) if _size(state, j) > state.smallest]
    for j in loaded:
        freedoms = [one for one in topology.kind(j).nominal.freedoms if not one.any_axis]
        if sum(one.rotation for one in freedoms) > 1:
            return None
        for one in freedoms:
            (turns if one.rotation else slides).append(state.placed.joint_rotation[j][:, one.axis])
    if turns:
        normal = turns[0]
    elif len(slides) > 1:
        normal = np.linalg.svd(np.array(slides))[2][-1]  # of slides alone
    else:
        return None
    if any(np.linalg.norm(np.cross(axis, normal)) > UNIQUE for axis in turns):
        return None
    across = normal[:, None] * np.einsum("i,jik->jk", normal, state.force)[:, None]
    about = np.einsum("i,jik->jk", normal, state.moment)
    in_plane = max(np.abs(state.force - across).max(initial=0.0), np.abs(about).max(initial=0.0))
    return normal if loaded and in_plane <= state.smallest else None


def _size(state: _SelfStress, joint: int) -> float:
    return float(max(np.abs(state.force[joint]).max(initial=0.0), np.abs(state.moment[joint]).max(initial=0.0)))


def _is_symmetric(model: Model, state: _SelfStress, normal: np.ndarray) -> bool:
    """Whether all joints, masses, forces and gravity of a mechanism are symmetric to one plane at its start, which its
    motions keep."""
    topology, placed, geometry = model.topology, state.placed, state.geometry
    height = float(normal @ placed.centre[0])
    along = abs(normal @ np.asarray(model.gravity)) <= IN_PLANE * np.linalg.norm(np.asarray(model.gravity))

    def inside(*points: np.ndarray) -> bool:
        return all(abs(normal @ point - height) <= IN_PLANE * geometry.scale for point in points)

    def keeps_plane(joint: int) -> bool:
        freedoms = topology.kind(joint).nominal.freedoms
        axes = [(one.rotation, placed.joint_rotation[joint][:, one.axis]) for one in freedoms if not one.any_axis]
        ball = any(one.any_axis for one in freedoms) and bool(topology.rated)
        tilts = [np.cross(axis, normal) if turns else axis @ normal for turns, axis in axes]
        return not ball and all(np.linalg.norm(one) <= IN_PLANE for one in tilts)

    joints = range(len(topology.joints))
    return bool(
        along
        and inside(*placed.centre, *placed.child_centre)
        and all(keeps_plane(j) for j in joints)
        and all(_link_is_symmetric(model, state, normal, l, inside) for l in range(topology.n_links))
        and all(_mass_is_symmetric(model, state, normal, m, inside) for m in range(len(topology.masses)))
        and all(_force_is_symmetric(state, normal, law, inside) for law in (model.frame_forces or {}).values())
        and all(_line_load_is_symmetric(model, state, normal, law, inside) for law in (model.line_loads or {}).values())
    )


def _link_is_symmetric(model: Model, state: _SelfStress, normal: np.ndarray, link: int, inside) -> bool:
    """Whether the axis of a link with a section lies in the plane, and one of the section's axes across it; of a
    reduced body nobody knows."""
    if link in [one.link for one in model.topology.reduced]:
        return False
    if not float(model.section.line_density[link]) > 0.0 and model.topology.elements[link] == 1:
        return True
    rotation, origin = state.placed.rotation[link], state.placed.origin[link]
    principal = np.abs(rotation.T @ normal)[1:].max()
    curve, camber = (None, None) if model.form is None else model.form.lines.of(link)
    turned = any(one is not None and np.any(np.asarray(one)) for one in
                 (None if curve is None else curve.rolls, None if camber is None else camber.powers))  # fmt: skip
    places = axis_places(model, link, np.linspace(0.0, 1.0, PLACES if link in model.topology.curved else 2))
    lies = inside(*(origin + rotation @ place for place in places))
    return bool(lies and principal >= 1.0 - IN_PLANE and not turned and _section_is_symmetric(model, link))


def _section_is_symmetric(model: Model, link: int) -> bool:
    """Whether the mass centre of a link's sections is on its axis, and nothing couples directions; of a rigid link its
    inertia alone counts."""
    if model.form is None:
        return True
    topology, (first, last) = model.topology, model.topology.ranges[link]
    nodes = [link, *range(topology.n_links + first, topology.n_links + last)]
    bodies, compliance = model.form.bodies, np.asarray(model.form.segments.compliance)[..., first:last]
    couplings = np.asarray(bodies.rotary)[..., nodes], compliance
    return not np.any(np.asarray(bodies.offset)[..., nodes]) and not any(
        np.any(one * (1.0 - np.eye(one.shape[1]))[None, :, :, None]) for one in couplings
    )


def _mass_is_symmetric(model: Model, state: _SelfStress, normal: np.ndarray, mass: int, inside) -> bool:
    """Whether the centre of a mass lies in the plane, and the normal is one of its principal axes."""
    rotation, point = node_place(state.geometry, state.placed, model.topology.masses[mass])
    tensor = np.diag(np.asarray(model.point_inertia)[:, mass])
    if model.point_products is not None:
        xy, xz, yz = np.asarray(model.point_products)[:, mass]
        tensor = tensor + np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
    axis = rotation.T @ normal
    leaning = np.linalg.norm(np.cross(tensor @ axis, axis)) <= IN_PLANE * np.linalg.norm(tensor)
    weightless = not float(model.point_mass[mass]) > 0.0
    return bool((weightless or inside(point + rotation @ np.asarray(model.point_position)[:, mass])) and leaning)


def _force_is_symmetric(state: _SelfStress, normal: np.ndarray, law, inside) -> bool:
    """Whether a force element acts in the plane: a given moment about the normal, all others at points in the plane; of
    functions of time that is not known."""
    frames = [(node_place(state.geometry, state.placed, end.node), end) for end in (law.parent, law.child)]
    points = [point + rotation @ np.asarray(end.position) for (rotation, point), end in frames]
    if not isinstance(law, GivenLoad):
        return inside(*points)
    if not isinstance(law.value, ConstantVector):
        return False
    (rotation, _), end = frames[1]
    value = np.asarray(law.value.values)
    value = rotation @ np.asarray(end.rotation) @ value if law.turning else value
    leaning = np.cross(value, normal) if law.moment else value @ normal
    fits = np.linalg.norm(leaning) <= IN_PLANE * np.linalg.norm(value)
    return bool(fits and (law.moment or inside(points[1])))


def _line_load_is_symmetric(model: Model, state: _SelfStress, normal: np.ndarray, law: LineLoad, inside) -> bool:
    """Whether a force along a link acts in the plane; of functions of time that is not known."""
    rotation, origin = state.placed.rotation[law.link], state.placed.origin[law.link]
    ends = [one for one in (law.first, law.last) if one is not None]
    constant = [np.asarray(one.values) for one in ends if isinstance(one, ConstantVector)]
    length = float(model.length[law.link])
    shares = np.linspace(float(law.begin), float(law.end), PLACES) / length
    places = (origin + rotation @ place for place in axis_places(model, law.link, shares))
    if len(constant) < len(ends) or not inside(*places):
        return False
    values = [rotation @ value if law.turning else value for value in constant]
    return bool(all(abs(value @ normal) <= IN_PLANE * np.linalg.norm(value) for value in values))


def reactions_text(across: str, length: float) -> str:
    """What the loads of planar rigid loops are, in a sentence; `length` [m]: over which moments count."""
    if not across:
        return ""
    rest = "those across it are zero, since all joints, masses and forces lie in it."
    if across == LEAST_ACROSS:
        rest = (
            "those across it, which rigid links leave open, are the least: force^2 + (moment / "
            f"{length:g} m)^2 of all joints (a flexible link or a joint that gives would tell them)."
        )
    return f"Loads in the plane of the rigid loops are unique; {rest}"


def model_reactions_text(model: Model | None) -> str:
    """`reactions_text` of a model; "" for one whose loads are unique, or are those that it asks for."""
    if model is None or not model.topology.across:
        return ""
    assert model.reaction_length is not None, "such a model has one"
    return reactions_text(model.topology.across, float(np.asarray(model.reaction_length)))


def require_closable(model: Model, names: Sequence[str], what: str) -> None:
    """Raise InputError for the first of traced numbers (errors, or full names of parameters) that opens a planar loop
    of rigid links across its plane: whatever it is, nothing can be computed, and no derivative either."""
    for name in opening(model, names):
        numbers = () if model.source is None else model.source.blueprint.names.all
        shown = next((one.name for one in numbers if one.full == name), name)
        raise InputError(
            f"Argument `{what}` must be of what the loops can take up, but `{shown}` opens a loop of rigid links "
            "across its plane, where nothing gives: its loads are infinite, however small it is. Make one link of "
            "the loop flexible, or let one of its joints give (a compliance or a clearance)."
        )


def opening(model: Model, names: Sequence[str]) -> Iterator[str]:
    """Those of numbers (errors, or full names of parameters) that open a planar loop of rigid links across its
    plane."""
    if not names or not model.topology.across:
        return
    if isinstance(model.length, Tracer) or isinstance(model.start_joints, Tracer):
        return
    state = _self_stress(model)
    for name in names:
        with jax.ensure_compile_time_eval():
            opens = _error_opens if name in model.topology.error_names else _number_opens
            opened = opens(model, state, name)
        if opened:
            yield name


def _error_opens(model: Model, state: _SelfStress, name: str) -> bool:
    """Whether self-stress does work on an error of a joint or a link."""
    topology, placed = model.topology, state.placed
    owner, _, error = name.partition(".")
    if owner in topology.links:
        l = topology.links.index(owner)
        turns, axis = error == "twist", placed.rotation[l][:, 0 if error in LINK_ERRORS else "xyz".index(error[-1])]
        return any(state.loads(j, axis, turns, placed.origin[l]) for j in _reached(model, l, error))
    j = topology.joints.index(owner)
    of_child = error.startswith("child.")
    axes, centre = (placed.child_rotation, placed.child_centre) if of_child else (placed.joint_rotation, placed.centre)
    return state.loads(j, axes[j][:, "xyz".index(error[-1])], not error.removeprefix("child.").startswith("d_"),
                       centre[j])  # fmt: skip


def _reached(model: Model, link: int, error: str) -> list[int]:
    """The joints on a link that an error of it displaces or turns: at its end, by errors of form also before it, by a
    camber as by a bow."""
    topology, form = model.topology, model.form
    sides = [(topology.parents, topology.parent_at_end, "seats"), (topology.children, topology.child_at_end, "bores")]
    found = []
    for nodes, at_end, name in sides:
        for j in (j for j, node in enumerate(nodes) if node >= 0 and topology.link_of(node) == link):
            formed = form is not None and link in topology.formed
            share = float(getattr(form, name).share[j]) if formed else float(at_end[j])
            if (share if error in LINK_ERRORS else wave(jnp.asarray(share))) > IN_PLANE:
                found.append(j)
    return found


def _number_opens(model: Model, state: _SelfStress, name: str) -> bool:
    """Whether self-stress does work on a change of a number of the description."""
    if ".camber." in name:  # an error of form that is given as numbers: the nominal geometry knows nothing of it
        return _error_opens(model, state, name.partition(".")[2])
    assert model.source is not None, "asked for before"
    blueprint = model.source.blueprint
    at = [one.full for one in blueprint.names.all].index(name)
    numbers, structure = np.asarray(model.source.numbers), PartStructure(model.topology, blueprint.points, False)
    found = []
    for sign in (-1.0, 1.0):
        values = numbers.copy()
        values[at] += sign * DIFFERENCE
        changed = geometry_of(arrays_of(blueprint.filled(values.tolist()), structure))
        residual = gaps(changed, place(changed, np.asarray(model.start_joints))).residual
        found.append(residual * changed.scale / state.geometry.scale)
    slope = (found[1] - found[0]) / (2.0 * DIFFERENCE)
    return bool(np.abs(slope @ state.multipliers).max(initial=0.0) > UNIQUE / state.geometry.scale)
