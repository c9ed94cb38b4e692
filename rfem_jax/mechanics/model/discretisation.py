"""From a described mechanism to a model: discretisation, closed start, rank and mobility.

Place in the pipeline: building, nominal_geometry -> **discretisation** -> everything else.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError, require_choice, suggestion
from rfem_jax.description.basics.numbers import is_known
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.mechanism.mechanism import AS_GIVEN, ELEMENTS, EQUILIBRIUM, PLANAR, Mechanism
from rfem_jax.description.parameters.parts import parts_of
from rfem_jax.mechanics.laws.point_laws import PointLaw
from rfem_jax.mechanics.model.assembly_modes import Closed, chosen_closure, given_coordinates, is_far
from rfem_jax.mechanics.model.building import build_model, reaction_length
from rfem_jax.mechanics.model.model import Model, at_closing
from rfem_jax.mechanics.model.nominal_geometry import (
    NominalGeometry,
    Placed,
    closure_jacobian,
    gaps,
    geometry_of,
    joint_units,
    moved,
    node_place,
    null_space,
    place,
    rank,
    shortest,
)
from rfem_jax.mechanics.model.normal_loads import require_unique_normal_loads
from rfem_jax.mechanics.model.planar_loops import model_reactions_text, reactions_across
from rfem_jax.mechanics.model.sources import CLOSING_TOLERANCE, RIGID_CLOSING_TOLERANCE
from rfem_jax.mechanics.model.start_freedoms import with_start_freedoms
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.warmth import growths

SMALLEST_DISTANCE = 1e-9  # of two points with a force between them, of the longest link
IDLE_TOLERANCE = 1e-3  # of a motion of size one
UNDECIDED = 1e-6  # share of an ideal coupling in loads that nothing decides
ROUNDING = 1e-12  # of the longest link: of loops that close
SMALLEST_CHANGE = 1e-10  # of an equation of loops that a joint can be moved for, relative


class StartHeld(NamedTuple):
    """How a simulation starts: "as_given" or in "equilibrium"; names of the joint coordinates, as "A" or "C.T_y", that
    it holds first: those of drives, and those for the freedoms that no drive holds; of those with initial rates."""

    kind: str
    driven: tuple[str, ...]
    undriven: tuple[str, ...]
    rates: tuple[str, ...]


class Structure(NamedTuple):
    """Coordinates and constraints of a model at its nominal start.

    coordinates: number of coordinates, sprung directions of compliant joints among them; constraints: closure
    equations, those of sprung directions left out; rank: of their Jacobian; mobility: coordinates - rank, the degrees
    of freedom; rigid_*: the same with every link and every joint rigid; redundant: the multipliers, hence the joint
    loads, are not unique; gap [m]: how far the cut joint that closes worst stays open at the start with every link
    rigid; idle: names of links in a loop that could move alone if all were rigid, as a rod between two spherical joints
    about its own axis; start: what the start of a simulation holds; reactions: of planar rigid loops a sentence on the
    loads across their plane that nobody asked for.
    """

    coordinates: int
    constraints: int
    rank: int
    mobility: int
    rigid_coordinates: int
    rigid_rank: int
    rigid_mobility: int
    redundant: bool
    gap: float
    idle: tuple[str, ...] = ()
    start: StartHeld = StartHeld(AS_GIVEN, (), (), ())
    reactions: str = ""


def discretise(mechanism: Mechanism, rfes: int | Mapping[str, int] | None = None, elements: str | None = None) -> Model:
    """Divide the links into rigid finite elements and close the loops at the start.

    **Arguments:** `mechanism`: a `Mechanism`; `rfes`: number of rfes of every flexible link, or {name: number} of
    some (None: each link's own); `elements`: "linear" or "geometrically_exact" spring-damping elements (None:
    the mechanism's).

    **Raises:** `InputError` if JAX is not in double precision, if the loops cannot be closed with
    the given lengths and start angles, or if the reactions are not unique and the mechanism does
    not ask for the minimum-norm ones.
    """
    require_float64()
    elements = mechanism.elements if elements is None else elements
    require_choice(elements, ELEMENTS, "elements")
    counts = _numbers_of_rfes(mechanism, rfes)
    built = build_model(mechanism, counts, elements == "geometrically_exact")
    modes = {one.name: one.mode for one in mechanism.cut_joints if one.mode}
    model = _closed_as_given(_close(built, modes, _about_warmth(mechanism)), np.asarray(built.start_joints))
    _require_apart(model)
    _require_needed(model)
    structure = describe(model)
    topology = with_start_freedoms(_with_idle(model), _rates_given(model, mechanism))
    model = dataclasses.replace(model, topology=topology)
    if structure.redundant and mechanism.redundant_reactions == PLANAR and (across := reactions_across(model)):
        topology, length = (
            model.topology._replace(minimum_norm=True, across=across),
            reaction_length(parts_of(mechanism)),
        )
        model = dataclasses.replace(model, topology=topology, reaction_length=length)
    if structure.redundant and not model.topology.minimum_norm:
        locks = "" if structure.rigid_mobility else " Nothing moves: with rigid links its joints lock (mobility 0)."
        raise InputError(
            "Argument `mechanism` must have unique joint reactions, but its "
            f"{structure.constraints} closure equations have rank {structure.rank}: rigid loops with "
            "parallel axes or slides are statically indeterminate. Make one link of each loop flexible between its "
            "joints of the loop, give joints of each loop a compliance or a freer kind, or set redundant_reactions = "
            '"minimum_norm" in the table [mechanism] (an argument of `Mechanism`) to get the reactions of least norm.'
            + locks
        )
    if structure.redundant and model.topology.slender:
        names = ", ".join(f"`{model.topology.links[l]}`" for l in model.topology.slender)
        raise InputError(
            f"Argument `flexibility` of link {names} must be left out where reactions are not unique, but was given; "
            "segments that stretch and shear share them."
        )
    if structure.redundant:
        require_unique_normal_loads(model)
    if structure.redundant and structure.gap > RIGID_CLOSING_TOLERANCE * float(np.max(model.length)):
        raise InputError(
            f"Argument `mechanism` must close at its start, but its rigid loops stay open by {structure.gap:.3g} m, "
            "which no link can take up; give angles and positions with more decimals, or make a link of each loop "
            "flexible."
        )
    return _remembering(model, structure)


def _numbers_of_rfes(mechanism: Mechanism, rfes: int | Mapping[str, int] | None) -> dict[str, int]:
    """Numbers of rfes of all links by name, with those that take the place of flexible links' own ones."""
    own = {link.name: link.elements for link in mechanism.links}
    flexible = [link.name for link in mechanism.links if link.flexible and not link.reduced]
    if rfes is None:
        return own
    given = rfes if isinstance(rfes, Mapping) else dict.fromkeys(flexible, rfes)
    for name, count in given.items():
        if name not in flexible:
            raise InputError(
                f"Argument `rfes` must be of flexible links, but `{name}` is not one; {suggestion(name, flexible)}"
            )
        if count != int(count) or count < 2:
            raise InputError(f"Argument `rfes` must be a whole number of at least 2, but is {count}.")
    return own | {name: int(count) for name, count in given.items()}


def _with_idle(model: Model) -> Model:
    """The model with the coordinates that stand for idle freedoms at its start."""
    idle = tuple(sorted(_idle_coordinates(model)))
    return dataclasses.replace(model, topology=model.topology._replace(idle=idle)) if idle else model


def _closed_as_given(model: Model, given: Float[np.ndarray, " numbers"]) -> Model:
    """The closed model, closed once more from the start that the description gives: coordinates that stand for freedoms
    without a drive, and those of ideal couplings, keep their values, if the loops close so as well."""
    of_start = at_closing(model)
    if of_start.topology.n_constraints == 0:
        return model
    topology = with_start_freedoms(_with_idle(model), {})
    chosen = tuple(k for k in topology.undriven if k not in topology.idle)
    coupled = tuple(k for k in given_coordinates(topology, given) if k in topology.coupled and k not in chosen)
    geometry = geometry_of(of_start)
    before = np.abs(gaps(geometry, place(geometry, np.asarray(model.start_joints))).residual).max()
    for kept in dict.fromkeys((chosen + coupled, chosen)):
        if kept:
            joints, residual, alignment, cuts = close_at(of_start, given, (*topology.held, *kept))
            if np.abs(residual).max() <= max(2.0 * before, ROUNDING) and not (alignment < 0.0).any():
                return dataclasses.replace(model, start_joints=jnp.asarray(joints), cut_angles=jnp.asarray(cuts))
    return model


def _rates_given(model: Model, mechanism: Mechanism) -> dict[int, str]:
    """{coordinate with an initial rate: the argument that gives it}; zeros in lists are of those that may follow."""
    topology, rates = model.topology, {}
    for l, name in enumerate(topology.joints[: topology.n_links]):
        joint = mechanism.joint(name)
        for k, rate in zip(topology.own_coordinates[l], joint.start_rates, strict=True):
            if rate is not None and (joint.rates is None or rate != 0.0):
                rates[k] = f"`{joint.rate_field(topology.freedoms[k].rotation)}` of joint `{name}`"
    return rates


def _remembering(model: Model, structure: Structure) -> Model:
    """The model that knows its mobility, and how many of its closure equations say nothing new; with such ones designs
    must close as rigid loops do."""
    if structure.redundant:
        topology = model.topology._replace(redundant=structure.constraints - structure.rank)
        model = dataclasses.replace(model, topology=topology)
    assert model.source is not None, "discretised models have one"
    blueprint = model.source.blueprint
    closing = RIGID_CLOSING_TOLERANCE if structure.redundant else blueprint.closing_tolerance
    mobility = structure.rigid_mobility, structure.mobility
    blueprint = dataclasses.replace(blueprint, closing_tolerance=closing, mobility=mobility)
    return dataclasses.replace(model, source=dataclasses.replace(model.source, blueprint=blueprint))


def _require_apart(model: Model) -> None:
    """Raise InputError for a force between points that coincide at the start: it has no direction."""
    geometry = geometry_of(model)
    placed = place(geometry, np.asarray(model.start_joints))
    for name, law in _point_pair_forces(model).items():
        one, other = _places(geometry, placed, law)
        if not np.linalg.norm(other - one) > SMALLEST_DISTANCE * geometry.scale:
            raise InputError(
                f"Argument `points` of force {name!r} must lie apart at the start, but coincide: a force along their "
                "line has no direction there; move one of them, or take a force at a joint."
            )


def _require_needed(model: Model) -> None:
    """Raise InputError for an ideal coupling that says what others, or the loops, say already, so that its load is
    undecided."""
    topology, geometry = model.topology, geometry_of(model)
    if not topology.ideal:
        return
    placed = place(geometry, np.asarray(model.start_joints))
    undecided = null_space(closure_jacobian(geometry, placed, rigid=False).T)[-len(topology.ideal) :]
    for name, row in zip(topology.ideal, undecided, strict=True):
        if np.abs(row).max(initial=0.0) > UNDECIDED:
            raise InputError(
                f"Argument `stiffness` of coupling {name!r} must be given, since without it the coupling is ideal and "
                "says what others, or the loops, say already, so that its load is undecided; give the stiffness of "
                "its mesh, or leave the coupling out."
            )


def _point_pair_forces(model: Model) -> dict[str, PointLaw]:
    """The forces along the line of two points."""
    return {name: law for name, law in (model.frame_forces or {}).items() if isinstance(law, PointLaw)}


def _places(geometry: NominalGeometry, placed: Placed, law: PointLaw) -> list[np.ndarray]:
    """The two points of a force, in global axes."""
    frames = [(node_place(geometry, placed, end.node), end) for end in (law.parent, law.child)]
    return [point + rotation @ np.asarray(end.position) for (rotation, point), end in frames]


def describe(model: Model) -> Structure:
    """Rank and mobility at the nominal start, flexible and with every link rigid (theory (5.8))."""
    geometry = geometry_of(model)
    placed = place(geometry, np.asarray(model.start_joints))
    jacobian = closure_jacobian(geometry, placed, rigid=False)
    residual = gaps(geometry, placed).residual
    sprung = model.topology.sprung_coordinates
    own = [k for k in range(model.topology.n_freedoms) if k not in sprung]
    rigid = closure_jacobian(geometry, placed)[:, own]
    of_all, of_rigid = rank(jacobian), rank(rigid)
    constraints, size = jacobian.shape
    size -= 3 * int(np.sum(model.topology.slender_rfes))  # displacements that follow from angles
    size -= sum(one.idle for one in model.topology.reduced)
    return Structure(
        coordinates=size,
        constraints=constraints,
        rank=of_all,
        mobility=size - of_all,
        rigid_coordinates=len(own),
        rigid_rank=of_rigid,
        rigid_mobility=len(own) - of_rigid,
        redundant=of_all < constraints,
        gap=float(np.abs(residual).max(initial=0.0) * np.max(np.asarray(model.length))),
        idle=tuple(dict.fromkeys(_idle_coordinates(model).values())),
        start=start_held(model.topology),
        reactions=model_reactions_text(model),
    )


def start_held(topology: Topology) -> StartHeld:
    """Kind of the start of a simulation, and the coordinates that it holds."""
    undriven = () if topology.settles else topology.undriven
    named = (tuple(map(topology.label_of, some)) for some in (topology.held, undriven, topology.rated))
    return StartHeld(EQUILIBRIUM if topology.settles else AS_GIVEN, *named)


def _idle_coordinates(model: Model) -> dict[int, str]:
    """{joint coordinate that stands for an idle freedom: its link}: links with two joints or more, one of them on a
    moving link, that can move while no other does, all of them rigid and their joint not driven (theory (5.17))."""
    topology, geometry = model.topology, geometry_of(model)
    if topology.n_cuts == 0:
        return {}
    n = topology.n_links
    placed = place(geometry, np.asarray(model.start_joints))
    laws = [] if model.forces is None else model.forces.values()
    # A freedom that a spring holds is not idle.
    held = [*(law.coordinate for law in laws if law.holds()), *topology.sprung_coordinates]
    sprung = [np.eye(topology.n_freedoms)[held]]
    for coupling in (one for one in (model.couplings or {}).values() if one.stiffness is not None):
        positions = jnp.asarray(model.start_joints)[np.array(coupling.places)]
        direction = coupling.starting_at(model.start_joints).tangent(positions, jnp.zeros(2), 1.0, 0.0)[0]
        sprung.append(np.asarray(direction) @ np.eye(topology.n_freedoms)[list(coupling.coordinates)])
    twists, units = np.zeros((n, 6, topology.n_freedoms)), joint_units(geometry)
    for l, parent in enumerate(topology.parents[:n]):
        if parent != BASE:
            twists[l] = twists[topology.link_of(parent)]
        for k in topology.coordinates[l]:
            twists[l, :, k] += units[k] * placed.twists[k]
    twists[:, 3:] /= geometry.scale
    stretched = [_stretching(model, placed, law, twists) for law in _point_pair_forces(model).values()]
    held = [closure_jacobian(geometry, placed)[:, : topology.n_freedoms], *sprung, *stretched]
    free = null_space(np.vstack(held))
    if free.shape[1] == 0:
        return {}
    moving = twists @ free
    driven = [topology.link_of_freedom[k] for k in topology.drives]
    ends = zip(topology.parents, topology.children)
    pairs = [tuple(-1 if node == BASE else topology.link_of(node) for node in pair) for pair in ends]
    idle = {}
    for l in range(n):
        joined = [a if b == l else b for a, b in pairs if l in (a, b)]
        if len(joined) < 2 or max(joined) < 0 or l in driven:
            continue
        alone = null_space(np.delete(moving, l, axis=0).reshape(-1, free.shape[1]))
        if alone.shape[1] == 0:
            continue
        size, directions = np.linalg.svd(moving[l] @ alone)[1:]
        motions = free @ alone @ directions[: int(np.sum(size > IDLE_TOLERANCE))].T
        # As many coordinates of the link's own joint as it has idle freedoms, those that move most.
        from scipy.linalg import qr  # few mechanisms need it, and it takes a tenth of a second

        *_, order = qr(motions[list(topology.coordinates[l])].T, mode="r", pivoting=True)
        idle |= {topology.coordinates[l][k]: topology.links[l] for k in order[: motions.shape[1]]}
    return idle


def _with_dependent_drives(model: Model, joints: Float[np.ndarray, " numbers"]) -> Topology:
    """The topology with the coordinates of drives that follow from those of the drives before (theory (5.8))."""
    geometry = geometry_of(model)
    placed, freedoms = place(geometry, joints), model.topology.n_freedoms
    sprung = np.eye(freedoms)[list(model.topology.sprung_coordinates)]
    rigid = np.vstack([closure_jacobian(geometry, placed)[:, :freedoms], sprung])
    found = []
    for matrix in (rigid, closure_jacobian(geometry, placed, rigid=False)):
        unit, kept, following = np.eye(matrix.shape[1]), [], []
        for k in model.topology.drives:
            adds = rank(np.vstack([matrix, unit[[*kept, k]]])) > rank(np.vstack([matrix, unit[kept]]))
            (kept if adds or not kept else following).append(k)
        found.append(tuple(following))
    return model.topology._replace(dependent=found[0], blocked=found[1])


def _stretching(model: Model, placed: Placed, law: PointLaw, twists: np.ndarray) -> np.ndarray:
    """Change (1, F) of the distance of two points over the longest link by motions of the joints, from the twists
    (L, 6, F) of rigid links."""
    geometry = geometry_of(model)
    one, other = _places(geometry, placed, law)
    direction = (other - one) / np.linalg.norm(other - one)
    change = np.zeros((1, twists.shape[2]))
    for end, sign in ((law.parent, -1.0), (law.child, 1.0)):
        if end.node != BASE:
            of_link = twists[model.topology.link_of(end.node)]
            arm = np.cross(other / geometry.scale, direction)  # of a force along the line, about the origin
            change += sign * (arm @ of_link[:3] + direction @ of_link[3:])
    return change


def close_at(
    model: Model, joints: Float[np.ndarray, " numbers"], held: tuple[int, ...] | None = None
) -> tuple[
    Float[np.ndarray, " numbers"],
    Float[np.ndarray, " constraints"],
    Float[np.ndarray, " cuts"],
    Float[np.ndarray, " cuts"],
]:
    """Refine the position of all joints so that the nominal rigid loops close: Newton's method with steps of least
    norm (theory (5.10)).

    **Arguments:** `held`: the joint coordinates that stay (None: those of drives that assembly holds).

    **Returns:** position, residuals (constraints,) over the longest link, alignment and angle of each
    cut joint as in `cut_joints.Closure`.
    """
    topology, geometry = model.topology, geometry_of(model)
    fixed = {*(topology.held if held is None else held), *topology.sprung_coordinates}
    free = np.array([k for k in range(topology.n_freedoms) if k not in fixed], dtype=int)
    units = joint_units(geometry)[free]
    joints, change = np.array(joints, dtype=float), np.zeros(topology.n_freedoms)
    for _ in range(100):
        placed = place(geometry, joints)
        jacobian = closure_jacobian(geometry, placed)[:, free]
        step = shortest(jacobian, gaps(geometry, placed).residual, SMALLEST_CHANGE)
        largest = np.abs(step).max(initial=0.0)
        change[free] = -units * step * min(1.0, 0.5 / max(largest, 1e-300))
        joints = moved(topology, joints, change)
        if largest < 1e-14:
            break
    residual, alignment, cut_angles = gaps(geometry, place(geometry, joints))
    return joints, residual, alignment, cut_angles


def _about_warmth(mechanism: Mechanism) -> str:
    """What to do where loops do not close by the temperatures of a mechanism; nothing where it has none."""
    if all(is_known(growth) and growth == 1.0 for growth in growths(parts_of(mechanism)).values()):
        return ""
    return " A temperature that bends links is an error of a case, or has a tolerance: give it there."


def _stays_open(model: Model, residual: Float[np.ndarray, " constraints"], hint: str) -> InputError:
    """Which loop, or ideal coupling, stays open the most."""
    topology, size, row = model.topology, float(np.abs(residual).max()), int(np.abs(residual).argmax())
    joint = next((topology.joints[j] for j, rows in zip(topology.cuts, topology.constraints) if row in rows), None)
    if joint is None:
        name = topology.ideal[row - topology.n_constraints]
        turns = not topology.slides[(model.couplings or {})[name].coordinates[1]]
        gap = f"{np.degrees(size):.3g} deg" if turns else f"{size * float(np.max(model.length)):.3g} m"
        return InputError(
            f"Argument `mechanism` must close at its start, but coupling {name!r} stays apart by {gap}; check its "
            "`offset` and the start values of its joints, or leave `offset` out, which then is that of the start."
        )
    return InputError(
        f"Argument `mechanism` must close at its start, but joint {joint!r} stays open by "
        f"{size * float(np.max(model.length)):.3g} m with every link rigid; check lengths, positions and start angles "
        f"(all but the driven one are refined, and other starts were tried).{hint}"
    )


def _is_closed(closed: Closed) -> bool:
    """Whether the loops are closed, with all axes alike."""
    return bool(np.abs(closed.residual).max() < CLOSING_TOLERANCE and (closed.alignment >= 0.0).all())


def _close(model: Model, modes: dict[str, str], hint: str) -> Model:
    """Close the nominal rigid loops at the start, or say why they cannot close; `modes` of the loops, by cut joints."""
    if model.topology.n_constraints == 0:
        return model
    if len(model.topology.drives) > 1:
        closed = close_at(at_closing(model), np.asarray(model.start_joints), model.topology.drives[:1])[0]
        model = dataclasses.replace(model, topology=_with_dependent_drives(model, closed))
    of_start, topology = at_closing(model), model.topology
    if of_start.topology.n_constraints == 0:
        return model
    closed = Closed(*close_at(of_start, np.asarray(model.start_joints)))
    if modes or not np.abs(closed.residual).max() < CLOSING_TOLERANCE or is_far(of_start, closed):
        chosen = chosen_closure(of_start, lambda start: Closed(*close_at(of_start, start)), _is_closed, modes)
        if chosen is None and modes and np.abs(closed.residual).max() < CLOSING_TOLERANCE:
            words = " and ".join(f"`{name}` {mode}" for name, mode in modes.items())
            raise InputError(
                f"Argument `mechanism` must close at its start as its modes say, but does not with {words}; leave "
                "`mode` out, or check lengths and positions."
            )
        closed = closed if chosen is None else chosen
    joints, residual, alignment, cut_angles = closed
    if not np.abs(residual).max() < CLOSING_TOLERANCE:
        raise _stays_open(of_start, residual, hint)
    if (alignment < 0.0).any():
        worst = topology.n_links + int(alignment.argmin())
        axes = "hinge axes" if topology.kinds[worst] == "revolute" else f"frames ({topology.kinds[worst]})"
        raise InputError(
            f"Argument `mechanism` must close with both {axes} of joint {topology.joints[worst]!r} alike, but "
            "they point in opposite directions; turn the frame of its child by 180 deg."
        )
    start, angles = (jnp.asarray(values, jnp.float64) for values in (joints, cut_angles))
    return dataclasses.replace(model, start_joints=start, cut_angles=angles)
