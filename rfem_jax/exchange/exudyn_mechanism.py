"""A model with its errors as plain numbers for Exudyn, and what Exudyn, or this translation, cannot hold.

Place in the pipeline: Model, AssemblyErrors -> **exudyn_mechanism** -> exudyn_program, exudyn_writer.

Only numbers are shared: masses, inertias, frames of joints with their errors, stiffnesses, and the start. Axes are
those of `exudyn_program`: (x, y, z) there = (z, x, y) here.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.drives.family import AnyMotion, GivenDrive
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.kinematics.motion import all_frames, motion_of
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.laws.joint_laws import SpringLaw, TableLaw
from rfem_jax.mechanics.laws.point_laws import ConstantVector, GivenLoad, SpringBetween
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors

STEPS = 2000  # rows of a drive over the whole duration, at least
TURNED = [2, 0, 1]  # ours -> Exudyn's axes
_AXES = {"x": 1, "y": 2, "z": 0}  # Exudyn's of ours
_applied = eqx.filter_jit(apply_errors)


def exudyn_numbers(
    model: Model, errors: AssemblyErrors, start: tuple[ModelWithErrors, State] | None = None
) -> dict[str, Any]:
    """What `exudyn_program` builds a mechanism of, without a drive (`drive_pieces`).

    **Arguments:** `start`: constants and state of the assembled mechanism (None: the nominal start at rest, whose loops
    the errors leave open).

    **Raises:** `InputError` for what cannot be translated.
    """
    require_translated(model)
    topology = model.topology
    actual, state = start or (_applied(model, errors), static_state(topology, model.start_coordinates()))
    bodies, rotation = _bodies(actual, state)
    driven = None
    if topology.drives:
        driven = _motion(topology.motion_of(topology.drives[0])) | {
            "joint": topology.joints[topology.link_of_freedom[topology.drives[0]]],
            "start": float(np.asarray(state.position.joints)[topology.driven_position]),
        }
    return {
        "gravity": np.asarray(model.gravity)[TURNED],
        "bodies": bodies,
        "elements": _elements(actual),
        "springs": [_spring(actual, one) for one in _frame_forces(actual, SpringBetween)],
        "loads": [_load(actual, one) for one in _frame_forces(actual, GivenLoad)],
        "joints": [_joint(model, actual, state, j) for j in range(len(topology.joints))],
        "idle": [_idle(topology, actual, rotation, k) for k in topology.idle],
        "places": _places(topology, actual),
        "tracked": list(actual.points or {}),
        "order": list(topology.joint_order),
        "driven": driven,
        "no_statics": _why_no_statics(topology),
        "drive": None,
    }


def drive_pieces(drive: AnyMotion | None, duration: float) -> dict[str, Any]:
    """What a drive says to `exudyn_program`: its kind, and values with two derivatives at ends of equal steps, from one
    of its jumps to the next."""
    jumps = [] if drive is None else [float(one) for one in drive.breakpoints() if 0.0 < one < duration]
    found = []
    for phase, (begin, end) in enumerate(pairwise([0.0, *jumps, duration])):
        count = 1 if drive is None else max(10, round(STEPS * (end - begin) / duration))
        values = np.zeros((count + 1, 3)) if drive is None else _drive_rows(drive, phase, begin, end, count)
        found.append({"begin": begin, "end": end, "values": values})
    kind = None if drive is None else "force" if isinstance(drive, GivenDrive) else "motion"
    return {"drive": kind, "pieces": found}


def _drive_rows(drive: Any, phase: int, begin: float, end: float, count: int) -> np.ndarray:
    def force(t):
        return jnp.asarray(drive.force_at(t, phase), jnp.float64)

    def rate(t):
        return jax.jvp(force, (t,), (jnp.ones(()),))

    def row(t):
        if not isinstance(drive, GivenDrive):
            return jnp.stack([jnp.asarray(x, jnp.float64) for x in drive.motion_at(t, phase)])
        (value, first), (_, second) = jax.jvp(rate, (t,), (jnp.ones(()),))
        return jnp.stack([value, first, second])

    return np.asarray(jax.jit(jax.vmap(row))(jnp.linspace(begin, end, count + 1)))


def require_translated(model: Model) -> None:
    """Raises InputError for what cannot be translated."""
    topology, friction = model.topology, model.friction or {}
    clear, acting = [topology.joints[j] for j in topology.clearances], _acting(model)
    bowed = [name.partition(".")[0] for name in topology.error_names if ".bow_" in name]
    bodies = [topology.links[one.link] for one in topology.reduced]
    curved = [topology.links[l] for l in topology.curved if topology.links[l] not in bodies]
    forms = dict.fromkeys([*curved, *bowed]) or (topology.links if not bodies else ())
    told = {
        "links with an axis, errors of form or sections that couple bending, shear and torsion": (
            forms if topology.shaped else ()
        ),
        "reduced bodies": bodies,
        "links that neither stretch nor shear": [topology.links[l] for l in topology.slender],
        "temperature gradients, which bend links without load": ["some on its links"]
        if model.curvature is not None
        else (),
        "links without mass": [topology.links[l] for l in topology.massless],
        "redundant constraints, for which its solver has no answer and which a flexible link takes away": (
            ["some in its loops"] if topology.redundant else ()
        ),
        "joints with clearance": clear,
        "forces along joints that are neither springs nor tables": [
            name for name, law in (model.forces or {}).items() if not isinstance(law, SpringLaw | TableLaw)
        ],
        "couplings of joints": list(model.couplings or ()),
        "loads along links": list(model.line_loads or ()),
        "tables and functions between points, and loads at points that change": [
            name for name, one in (model.frame_forces or {}).items() if not (clear or _is_translated(one))
        ],
        "forces about axes of joints with several rotations": [
            name for name, (j, rotation) in acting.items() if rotation and topology.kind(j).nominal.angles > 1
        ],
        # Exudyn's springs along an axis leave out the moment of a force beside the parent's point.
        "forces along one of several directions in which a joint on a moving link slides": [
            name for name, (j, rotation) in acting.items() if not rotation and _slides(topology, j, 2)
        ],
        "friction by the load at both ends of a bearing, or of a compliant joint": [
            name
            for name, one in friction.items()
            if one.load is not None and (one.load.length is not None or _sprung(topology, one.joint))
        ],
        "several drives": topology.drive_labels if len(topology.drives) > 1 else (),
        "compliant joints whose springs are tables": [
            name for name, spring in (model.springs or {}).items() if spring.positions is not None
        ],
        # The connector of both acts at the two points, with a moment that is left out.
        "compliant joints that slide on moving links": [
            name for j, name in enumerate(topology.joints) if _sprung(topology, j) and _slides(topology, j, 1)
        ],
        "compliant joints of which some of the rotations are sprung, or that turn about several axes": [
            name for j, name in enumerate(topology.joints) if _partly_sprung(topology, j)
        ],
    }
    for words, names in told.items():
        _refuse(words, names)


def _refuse(words: str, names: Iterable[str]) -> None:
    listed = ", ".join(name if " " in name else f"`{name}`" for name in names)
    if listed:
        raise InputError(
            f"A script for Exudyn must do without {words}, but the study has {listed}; export a study without them."
        )


def _acting(model: Model) -> dict[str, tuple[int, bool]]:
    """Joints of forces, friction and drives along motions of joints, and whether these are rotations."""
    topology, laws = model.topology, {**(model.forces or {}), **(model.friction or {})}
    found = {name: (_joint_of(topology, law), _law_motion(topology, law)[0] == "R") for name, law in laws.items()}
    for label, k in zip(topology.drive_labels, topology.drives, strict=True):
        found[f"the drive of {label}"] = topology.link_of_freedom[k], topology.freedoms[k].rotation
    return found


def _joint_of(topology: Topology, law: Any) -> int:
    return law.joint if isinstance(law, Friction) else topology.link_of_freedom[law.coordinate]


def _sprung(topology: Topology, j: int) -> tuple[str, ...]:
    return topology.sprung[j] if topology.sprung else ()


def _slides(topology: Topology, j: int, directions: int) -> bool:
    """Whether a joint slides on a moving link, in so many directions at least."""
    return topology.parents[j] != BASE and KINDS[topology.kinds[j]].displacements >= directions


def _partly_sprung(topology: Topology, j: int) -> bool:
    """Whether rotations are sprung that Exudyn's connector does not have alone."""
    kind, turns = KINDS[topology.kinds[j]], {motion for motion in _sprung(topology, j) if motion[0] == "R"}
    return bool(turns) and (kind.angles > 1 or turns != set(kind.turns_held))


def _is_translated(element: Any) -> bool:
    return isinstance(element, SpringBetween) or (
        isinstance(element, GivenLoad) and isinstance(element.value, ConstantVector)
    )


def _why_no_statics(topology: Topology) -> str:
    if topology.rated:
        return "This mechanism must start as the script says, with the rates that were given."
    if topology.undriven and not topology.settles:
        return "This mechanism must start as the script says: at first its free motions are held where they were given."
    return ""


def _law_motion(topology: Topology, law: Any) -> str:
    if isinstance(law, Friction):
        return f"{'TR'[law.component // 3]}_{'xyz'[law.component % 3]}"
    return topology.motion_of(law.coordinate)


def _motion(motion: str) -> dict[str, Any]:
    return {"rotation": motion[0] == "R", "axis": _AXES[motion[2]]}


def _turned(matrix: Any) -> np.ndarray:
    """A tensor, or a rotation between two frames, in Exudyn's axes."""
    return np.asarray(matrix)[TURNED][:, TURNED]


@eqx.filter_jit
def _placed(actual: ModelWithErrors, state: State):
    """Frames of all nodes, velocities of the links and of the free rfes in these."""
    motion = motion_of(actual, state)
    return *all_frames(actual.topology, motion), motion.links.velocity, motion.relative.angular, motion.relative.linear


def _bodies(actual: ModelWithErrors, state: State) -> tuple[list[dict[str, Any]], np.ndarray]:
    """All rfes, links first: mass, inertia, place and velocity of the centre of mass; and their rotations (n, 3, 3)."""
    rotation, point, velocity, turning, moving = (np.asarray(one) for one in _placed(actual, state))
    n, link = actual.topology.n_links, np.asarray(actual.topology.link_of_rfe, dtype=int)
    angular, linear = velocity[:3], velocity[3:]
    of_links = np.moveaxis(rotation[:, :, :n], 2, 0)[link]
    turning, moving = (np.einsum("kij,jk->ik", of_links, one) for one in (turning, moving))
    free = moving + np.cross(point[:, n:], turning, axis=0)
    angular = np.concatenate([angular, angular[:, link] + turning], axis=1)
    linear = np.concatenate([linear, linear[:, link] + free], axis=1)
    centre = point + np.einsum("ijn,jn->in", rotation, np.asarray(actual.centre))
    velocity = linear + np.cross(angular, centre, axis=0)
    mass, inertia = np.asarray(actual.mass), np.asarray(actual.inertia)
    turned = np.stack([_turned(rotation[:, :, i]) for i in range(len(mass))])
    found = [
        {
            "mass": float(mass[i]), "inertia": _turned(inertia[:, :, i]), "centre": centre[TURNED, i],
            "rotation": turned[i], "velocity": velocity[TURNED, i], "angular": angular[TURNED, i],
        }
        for i in range(len(mass))
    ]  # fmt: skip
    return found, turned


def _elements(actual: ModelWithErrors) -> list[dict[str, Any]]:
    """The spring-damping elements, with their points from the centres of mass."""
    topology, stiffness, found = actual.topology, np.asarray(actual.stiffness), []
    for link, (first, stop) in enumerate(topology.ranges):
        for k in range(first, stop):
            left, right = link if k == first else topology.n_links + k - 1, topology.n_links + k
            start = float(actual.beam_middle[link]) if k == first else 0.0
            levers = start + float(actual.lever_left[k]), float(actual.lever_right[k])
            points = [_from_centre(actual, node, [x, 0.0, 0.0]) for x, node in zip(levers, (left, right))]
            rows = stiffness[:, k].reshape(2, 3)[:, TURNED].ravel()
            found.append(
                {"bodies": [left, right], "points": points, "stiffness": rows, "damping": float(actual.damping[k])}
            )
    return found


def _from_centre(actual: ModelWithErrors, node: int, place: Any) -> np.ndarray:
    """A place on a node from its centre of mass; of the base as it is."""
    return (np.asarray(place) - (0.0 if node == BASE else np.asarray(actual.centre)[:, node]))[TURNED]


def _frame_forces(actual: ModelWithErrors, of: type) -> list[Any]:
    elements = {} if actual.frame_forces is None else actual.frame_forces.elements
    return [one for one in elements.values() if isinstance(one, of)]


def _spring(actual: ModelWithErrors, one: SpringBetween) -> dict[str, Any]:
    ends = (one.parent, one.child)
    numbers = {"stiffness": one.stiffness, "damping": one.damping, "referenceLength": one.free_length}
    return {
        "bodies": [end.node for end in ends],
        "points": [_from_centre(actual, end.node, end.position) for end in ends],
        "numbers": {name: float(x) for name, x in (numbers | {"force": one.preload}).items()},
    }


def _load(actual: ModelWithErrors, one: GivenLoad) -> dict[str, Any]:
    value, node = np.asarray(one.value.values), one.child.node  # pyright: ignore[reportAttributeAccessIssue]
    value = np.asarray(one.child.rotation) @ value if one.turning else value
    point = _from_centre(actual, node, one.child.position)
    return {"body": node, "point": point, "value": value[TURNED], "turning": one.turning, "moment": one.moment}


def _joint(model: Model, actual: ModelWithErrors, state: State, j: int) -> dict[str, Any]:
    topology = model.topology
    kind, sprung = KINDS[topology.kinds[j]], _sprung(topology, j)
    tilts = any(motion[0] == "R" for motion in sprung)
    shifts = [int(axis in kind.across and f"T_{'xyz'[axis]}" not in sprung) for axis in TURNED]
    turns = [0, 0, 0] if tilts else {0: [1, 1, 1], 1: [1, 1, 0], 2: [0, 1, 0], 3: [0, 0, 0]}[kind.angles]
    found = {
        "name": topology.joints[j], "kind": kind.name, "cut": j >= topology.n_links, "held": [*shifts, *turns],
        "turns": kind.angles, "tilts": tilts, "shifts": [_AXES[one[2]] for one in kind.motions if one[0] == "T"],
    }  # fmt: skip
    for side, nodes, rotations, places in (
        ("seat", topology.parents, actual.seat_rotation, actual.seat_position),
        ("bore", topology.children, actual.bore_rotation, actual.bore_position),
    ):
        point = _from_centre(actual, nodes[j], np.asarray(places)[:, j])
        found[side] = {"body": nodes[j], "rotation": _turned(np.asarray(rotations)[:, :, j]), "point": point}
    start = np.asarray(state.position.joints)
    friction = [one for one in (model.friction or {}).values() if one.joint == j]
    laws = [one for one in (model.forces or {}).values() if topology.link_of_freedom[one.coordinate] == j]
    found["laws"] = [_law(topology, one, start) for one in (*laws, *friction)]
    found["bushing"] = _bushing(model, j, found) if sprung else None
    return found


def _bushing(model: Model, j: int, joint: dict[str, Any]) -> dict[str, Any]:
    """Stiffnesses and dampings (6, 6) of a compliant joint, in frames in which Exudyn's connector can have them."""
    topology = model.topology
    kind, rows = KINDS[topology.kinds[j]], np.zeros((2, 6))
    for name, spring in (model.springs or {}).items():
        of, direction = name.split(".")
        for motion in kind.directions[direction] if of == topology.joints[j] else ():
            rows[:, _AXES[motion[2]] + 3 * (motion[0] == "R")] = float(spring.stiffness), float(spring.damping)
    seat, bore = joint["seat"]["rotation"], joint["bore"]["rotation"]
    if topology.parents[j] == BASE or np.abs(seat - np.eye(3)).max() < 1e-9:
        return {"stiffness": np.diag(rows[0]), "damping": np.diag(rows[1]), "seat": seat, "bore": bore}
    if joint["tilts"] and kind.angles:
        _refuse(
            "joints that turn and have sprung tilts, on a moving parent whose axes they do not have", [joint["name"]]
        )
    # Of a seat askew in a moving parent the axes of the parent, since the connector multiplies the two rotations of its
    # first marker in the wrong order; exact for displacements, of the second order in tilts.
    turn = np.kron(np.eye(2), seat)
    stiffness, damping = (turn @ np.diag(one) @ turn.T for one in rows)
    return {"stiffness": stiffness, "damping": damping, "seat": np.eye(3), "bore": bore @ seat.T}


def _law(topology: Topology, law: Any, start: Sequence[float] | np.ndarray) -> dict[str, Any]:
    """A force along a motion; inside: whether it is part of the joint's load."""
    at = {"start": 0.0 if law.place is None else float(start[law.place]), **_motion(_law_motion(topology, law))}
    if isinstance(law, SpringLaw):
        numbers = {"stiffness": law.stiffness, "damping": law.damping, "offset": law.rest}
        numbers["torque" if at["rotation"] else "force"] = -law.preload
        return at | {"type": "spring", "inside": True, "numbers": {name: float(x) for name, x in numbers.items()}}
    if isinstance(law, TableLaw):
        numbers = {"positions": np.asarray(law.positions), "forces": np.asarray(law.forces)}
        return at | {"type": "table", "inside": False, "numbers": numbers}
    static = law.law != "tanh"
    numbers = {"sliding": law.constant, "viscous": law.viscous, "rate": law.sliding_rate,
               "more": law.static_constant - law.constant if static else 0.0}  # fmt: skip
    numbers = {name: float(x) for name, x in numbers.items()} | {"static": static}
    if law.load is None:
        return at | {"type": "friction", "inside": True, "numbers": numbers}
    more = law.load.static_arm - law.load.arm if static else 0.0
    numbers |= {"arm": float(law.load.arm), "more_arm": float(more), "scale": float(law.load.scale)}
    numbers["across"] = [axis for axis in range(3) if axis != _AXES["xyz"[law.axis]]]
    return at | {"type": "friction by load", "inside": True, "numbers": numbers}


def _idle(topology: Topology, actual: ModelWithErrors, rotation: np.ndarray, coordinate: int) -> dict[str, Any]:
    """The rotation of an idle freedom, and the frame on the child that is the parent's at the start."""
    j = topology.link_of_freedom[coordinate]
    parent = np.eye(3) if topology.parents[j] == BASE else rotation[topology.parents[j]]
    bore = rotation[topology.children[j]].T @ parent @ _turned(np.asarray(actual.seat_rotation)[:, :, j])
    return {"joint": topology.joints[j], "axis": _AXES["xyz"[topology.freedoms[coordinate].axis]], "bore": bore}


def _places(topology: Topology, actual: ModelWithErrors) -> dict[str, list[Any]]:
    """Body and point of all points, and of the joints' centres on their children."""
    points = {name: (one.node, one.position) for name, one in (actual.points or {}).items()}
    joints = {
        name: (topology.children[j], np.asarray(actual.bore_position)[:, j]) for j, name in enumerate(topology.joints)
    }
    return {name: [node, _from_centre(actual, node, place)] for name, (node, place) in (joints | points).items()}
